"""Reference calibrations: the bundled library and the user's own store.

The store is a folder of one JSON file a calibration: FIELDCAL_STORE, or ``references`` in the
user's data folder. Saving under a name that exists keeps the older one in ``history``.
Which reference may be held against which photos: calib.reference_match.
"""

from __future__ import annotations

import difflib
import math
import os
import re
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import platformdirs

from calib.camera import BROWN_NAMES, BrownCamera, FloatArray
from calib.errors import FormatError, InputError, OutputError
from calib.field import LENS_NAMES, Lens
from calib.formats import read_calibration
from calib.formats.common import ReadOptions
from calib.photos.photo import CameraIdentity, Processing
from calib.reference import Reference
from calib.reference_file import is_reference_json, read_reference_file, write_reference_file
from calib.reference_match import match_reference, same_model
from calib.solution import Estimate

STORE_VARIABLE = "FIELDCAL_STORE"
_NAME = re.compile(r"[a-z0-9][a-z0-9._-]{0,79}")
#: A calibration file of another program seldom gives a precision; this is assumed of f.
ASSUMED_SIGMA_F = 0.0002


def store_folder() -> Path:
    """Where the user's references are kept."""
    given = os.environ.get(STORE_VARIABLE)
    return Path(given).expanduser() if given else platformdirs.user_data_path("fieldcal") / "references"


def bundled_names() -> tuple[str, ...]:
    """Names of the references that come with fieldcal."""
    folder = Path(str(files("calib") / "data"))
    return tuple(sorted(path.stem for path in folder.glob("*.json") if is_reference_json(path)))


def stored_names() -> tuple[str, ...]:
    """Names in the user's store."""
    return tuple(sorted(path.stem for path in _json_files(store_folder())))


def is_bundled(name: str) -> bool:
    return name in bundled_names()


def bundled_references() -> tuple[Reference, ...]:
    return tuple(_bundled(name) for name in bundled_names())


def stored_references() -> tuple[tuple[Reference, ...], tuple[str, ...]]:
    """The user's references, newest first, and one sentence for every file that is unreadable."""
    good, faults = [], []
    for path in _json_files(store_folder()):
        try:
            good.append(replace(read_reference_file(path), name=path.stem))
        except FormatError as error:
            faults.append(str(error))
    good.sort(key=lambda reference: reference.date or "", reverse=True)
    return tuple(good), tuple(faults)


def history(name: str) -> tuple[Path, ...]:
    """Older calibrations that were saved under ``name``, oldest first."""
    return tuple(sorted(_json_files(store_folder() / "history" / name)))


def load_reference(name_or_path: str | Path, options: ReadOptions | None = None) -> Reference:
    """A reference by name (the user's store first, then the library) or from a file.

    A file is a fieldcal reference or a calibration in any format of ``calib.formats``;
    ``options`` is what such a file leaves open.

    Raises:
        InputError: no such reference or file. FormatError: the file cannot be read.
    """
    text = str(name_or_path)
    if _NAME.fullmatch(text):
        stored = store_folder() / f"{text}.json"
        if stored.is_file():
            return replace(read_reference_file(stored), name=text)
        if is_bundled(text):
            return _bundled(text)
    path = Path(text).expanduser()
    if path.is_file():
        return read_reference_file(path) if is_reference_json(path) else _foreign(path, options)
    if path.is_dir():
        raise InputError(f"{path} is a folder; give a reference by its name or a calibration file.")
    known = (*stored_names(), *bundled_names())
    close = difflib.get_close_matches(text.lower(), known, n=3, cutoff=0.5)
    hint = (
        f"Did you mean {' or '.join(close)}?" if close else "`fieldcal cameras` lists those that are known."
    )
    raise InputError(f"There is no reference or file named {text}. {hint}")


def find_reference(camera: CameraIdentity) -> tuple[Reference | None, str]:
    """The reference to hold these photos against, and one sentence about it.

    The user's calibrations of this body come first, the newest first; then the library. None
    with the reason when none fits.
    """
    stored, faults = stored_references()
    candidates = [r for r in (*stored, *bundled_references()) if same_model(r, camera)]
    if camera.serial:
        candidates.sort(key=lambda r: r.serial != camera.serial)
    refusals = []
    for candidate in candidates:
        reference, note = match_reference(candidate, camera)
        if reference is not None:
            return reference, note
        refusals.append(note)
    if refusals:
        return None, refusals[0]
    name = camera.name or "this camera"
    unread = f" ({faults[0]})" if faults else ""
    return None, f"No reference calibration of {name} is known{unread}."


def check_saving(name: str) -> None:
    """Refuse a name that :func:`save_reference` could not save under, before the work, not after.

    Raises:
        InputError: the name cannot be used. OutputError: the store cannot be written.
    """
    if not _NAME.fullmatch(name):
        raise InputError(
            f"A reference cannot be named {name!r}: use small letters, digits, dots, dashes and underscores, "
            "for example phantom3-serial42-spring."
        )
    if is_bundled(name):
        raise InputError(f"{name} is a reference that comes with fieldcal; save yours under another name.")
    store = store_folder()
    there = next(folder for folder in (store, *store.parents) if os.path.lexists(folder))
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        raise OutputError(
            f"The reference store {store} cannot be written; name another folder in {STORE_VARIABLE}."
        )


def save_reference(reference: Reference) -> Path:
    """Save into the user's store under its name; an older one of that name goes to the history.

    Raises:
        InputError: the name cannot be used. OutputError: the store cannot be written.
    """
    name = reference.name
    check_saving(name)
    path = store_folder() / f"{name}.json"
    if path.is_file():
        older = store_folder() / "history" / name
        try:
            older.mkdir(parents=True, exist_ok=True)
            number = 1 + max((int(p.stem) for p in _json_files(older) if p.stem.isdigit()), default=0)
            # A link, so that the name never goes missing in between.
            (older / f"{number:04d}.json").hardlink_to(path)
        except OSError as error:
            raise OutputError(f"The older {name} cannot be kept in {older}: {error.strerror}.") from error
    write_reference_file(reference, path)
    return path


def reference_from_estimate(
    name: str, estimate: Estimate, camera: CameraIdentity, date: str | None, source: str, provenance: str = ""
) -> Reference:
    """A survey's self-calibration as a reference: total mapping, and Brown fitted to it, with sigmas."""
    made = reference_of_body(name, camera, estimate.brown, estimate.covariance, date, source, provenance)
    lens = estimate.lens
    return replace(made, brown=lens.brown, field_px=lens.field_px, covariance=estimate.lens_covariance)


def estimate_of_reference(reference: Reference, lens: Lens, correlation_factor: float) -> Estimate:
    """The calibration of a survey whose lens was held: the reference's own, with its own sigmas."""
    full = reference.lens_covariance
    fitted = reference.fitted_covariance
    covariance = full[: len(BROWN_NAMES), : len(BROWN_NAMES)] if fitted is None else fitted
    return Estimate(
        brown=reference.comparable_brown or lens.brown,
        covariance=covariance,
        lens=lens,
        lens_covariance=full,
        sigma_f_formal_px=float(covariance[0, 0] ** 0.5),
        spread_f_px=0.0,
        models={},
        rejected_models={},
        split_f_px=math.nan,
        split_sigma_f_px=math.nan,
        split_profile_ratio=math.nan,
        correlation_factor=correlation_factor,
    )


def reference_of_body(
    name: str,
    camera: CameraIdentity,
    brown: BrownCamera,
    covariance: FloatArray,
    date: str | None,
    source: str,
    provenance: str,
) -> Reference:
    """A calibration of the camera that signs its photos as ``camera``: Brown alone, covariance (11, 11)."""
    sigma = covariance.diagonal().clip(min=0) ** 0.5
    full = np.zeros((len(LENS_NAMES), len(LENS_NAMES)))
    full[: len(BROWN_NAMES), : len(BROWN_NAMES)] = covariance
    return Reference(
        name=name,
        make=camera.make,
        model=camera.model,
        width=camera.width,
        height=camera.height,
        processing=camera.processing,
        source=source,
        brown=brown,
        sigma={key: float(s) for key, s in zip(BROWN_NAMES, sigma, strict=True) if s > 0},
        covariance=full,
        serial=camera.serial,
        date=date,
        provenance=provenance,
        exif_models=(camera.model,) if camera.model else (),
        focal_mm=camera.focal_mm,
        fitted_brown=brown,
        fitted_covariance=covariance,
    )


def reference_from_camera(name: str, brown: BrownCamera, source: str) -> Reference:
    """A calibration without precision or provenance as a reference."""
    return Reference(
        name=name,
        make="",
        model="",
        width=brown.width,
        height=brown.height,
        processing=Processing.UNKNOWN,
        source=source,
        brown=brown,
        sigma={"f": ASSUMED_SIGMA_F * brown.f_px},
        provenance=f"The file gives no precision; {100 * ASSUMED_SIGMA_F:g} % of f is assumed.",
    )


def _foreign(path: Path, options: ReadOptions | None) -> Reference:
    format_name, brown = read_calibration(path, options)
    return reference_from_camera(path.stem, brown, f"{path.name} ({format_name})")


def _bundled(name: str) -> Reference:
    return read_reference_file(Path(str(files("calib") / "data")) / f"{name}.json")


def _json_files(folder: Path) -> list[Path]:
    try:
        return sorted(p for p in folder.glob("*.json") if p.is_file() and not p.name.startswith("."))
    except OSError as error:
        raise InputError(f"The reference store {folder} cannot be read: {error.strerror}.") from error

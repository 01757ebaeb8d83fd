"""``network.npz``: a check's network for planning more photos, schema "fieldcal.network/1".

A NumPy archive of plain arrays; the array ``about`` holds UTF-8 JSON with everything that is no
array. Nothing in it is ever executed, and whatever does not fit together is refused.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, NaiveDatetime

from calib.camera import BROWN_NAMES, BrownCamera, FloatArray
from calib.errors import FormatError, InputError
from calib.evidence import reference_sigma_f_px
from calib.field import FIELD_NAMES, LENS_NAMES, Lens
from calib.findings import Finding, Verdict
from calib.flown import FlownNetwork
from calib.limits import f_decides
from calib.network_design import CameraNetwork, Known
from calib.reference import Reference
from calib.report_json import FindingModel, finding_models, findings_of
from calib.result import CheckResult
from calib.wording import path_text, printable

NETWORK_FILE = "network.npz"
SCHEMA: Final = "fieldcal.network/1"
#: No network is larger, packed or unpacked; a larger file is something else, or meant to harm.
_LARGEST_BYTES, _LARGEST_UNPACKED = 100_000_000, 1_000_000_000
#: Shapes by name: k photos, m points, n views.
_SHAPES = {
    "rotations": ("k", 3, 3),
    "centres_m": ("k", 3),
    "centre_sigma_m": ("k", 3),
    "rotation_sigma_rad": ("k",),
    "points_m": ("m", 3),
    "photo": ("n",),
    "point": ("n",),
    "lens": (len(LENS_NAMES),),
    "lens_sigma": (len(LENS_NAMES),),
    "free": (len(LENS_NAMES),),
    "brown": (len(BROWN_NAMES),),
    "brown_covariance": (len(BROWN_NAMES), len(BROWN_NAMES)),
}
_OF_REFERENCE = {
    "reference_covariance": (len(LENS_NAMES), len(LENS_NAMES)),
    "reference_field_px": (len(FIELD_NAMES),),
}
#: Arrays that a file may lack.
_OPTIONAL = _OF_REFERENCE | {"way_information": ("k", 3, 3)}
#: What reading a damaged file may end in; a flipped bit may ask for a password (RuntimeError).
_DAMAGE = (ValueError, KeyError, EOFError, OSError, RuntimeError, zipfile.BadZipFile, zlib.error)
_MAY_BE_INFINITE = ("centre_sigma_m", "rotation_sigma_rad", "lens_sigma")


class SurveyPhoto(BaseModel):
    """A photo of the block, to be known again: where it was, its ``fingerprint`` ("": none), its time."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    path: str
    fingerprint: str
    time: NaiveDatetime | None


@dataclass(frozen=True)
class FlownCheck:
    """What a check found out, as far as more photos can be planned from it.

    ``brown``, ``brown_covariance`` (11, 11): the calibration with its honest covariance.
    ``origin_wgs84``: latitude, longitude, altitude of the network's frame (x east, y north, z up);
    None where no believed geotags place it. ``launch_up_m``: height of the launch point in it, where the
    photos tell. ``photos``: their names. ``files``: the same, to be known again (checks of before have none).
    """

    flown: FlownNetwork
    verdict: Verdict
    headline: str
    findings: tuple[Finding, ...]
    camera_name: str
    brown: BrownCamera
    brown_covariance: FloatArray
    sigma_f_formal_px: float
    dome_sigma_m: float
    height_agl_m: float
    origin_wgs84: tuple[float, float, float] | None
    launch_up_m: float | None
    photos: tuple[str, ...]
    geotag_fault: str | None = None
    #: (35, 35) of the reference that the dome is held against; None: there is none that decides.
    reference_covariance: FloatArray | None = None
    #: (24,) its residual field: a weak flight shows less of the lens's pattern than there is.
    reference_field_px: FloatArray | None = None
    files: tuple[SurveyPhoto, ...] = ()

    @property
    def sigma_f_percent(self) -> float:
        """Standard deviation of f in percent, as the check reports it."""
        return 100 * float(np.sqrt(self.brown_covariance[0, 0])) / self.brown.f_px

    @property
    def dome_percent(self) -> float:
        """Sigma of the dome in percent of the flying height, as the check reports it."""
        return 100 * self.dome_sigma_m / self.height_agl_m


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


Positive = Annotated[FiniteFloat, Field(gt=0)]


class _About(_Part):
    """The part of the file that is no array."""

    format: Literal["fieldcal.network/1"] = Field(alias="schema")
    width: Annotated[int, Field(gt=0, le=100_000)]
    height: Annotated[int, Field(gt=0, le=100_000)]
    noise_px: Positive
    stands_for: Annotated[FiniteFloat, Field(ge=1)]
    matched_share: Annotated[FiniteFloat, Field(gt=0, le=1)]
    verdict: Verdict
    headline: str
    findings: tuple[FindingModel, ...]
    camera: str
    sigma_f_formal_px: Positive
    dome_sigma_m: Positive
    height_agl_m: Positive
    origin_wgs84: tuple[FiniteFloat, FiniteFloat, FiniteFloat] | None
    launch_up_m: FiniteFloat | None
    photos: tuple[str, ...]
    geotag_fault: str | None
    #: Of networks written when a way was as open in every direction; they have no ``way_information``.
    shutter_sigma_m: Positive | None = None
    #: Networks written before passes were recognised have none.
    files: tuple[SurveyPhoto, ...] = ()


def flown_check(result: CheckResult) -> FlownCheck | None:
    """What there is to keep of a check; None where it did not keep its network."""
    solution = result.solution
    if result.flown is None or not np.isfinite(result.estimate.covariance).all():
        return None
    georeference = solution.georeference
    above = [
        centre[2] - photo.position.height_above_launch_m
        for photo, centre in zip(solution.photos, solution.centres_m, strict=True)
        if photo.position is not None and photo.position.height_above_launch_m is not None
    ]
    return FlownCheck(
        flown=result.flown,
        verdict=result.verdict,
        headline=result.headline,
        findings=result.findings,
        camera_name=result.camera.name,
        brown=result.estimate.brown,
        brown_covariance=result.estimate.covariance,
        sigma_f_formal_px=result.estimate.sigma_f_formal_px,
        dome_sigma_m=result.dome.left_open_m,
        height_agl_m=result.dome.flying_height_m,
        origin_wgs84=georeference.origin_wgs84 if georeference.metric else None,
        launch_up_m=float(np.median(above)) if above and georeference.metric else None,
        photos=tuple(photo.path.name for photo in solution.photos),
        geotag_fault=georeference.fault,
        **_deciding(result.reference),
        files=tuple(
            SurveyPhoto(path=path_text(photo.path.absolute()), fingerprint=photo.fingerprint, time=photo.time)
            for photo in solution.photos
        ),
    )


def _deciding(reference: Reference | None) -> dict[str, FloatArray | None]:
    """What there is of a reference that decides: the dome against it is no better known."""
    if reference is None or reference.lens is None:
        return {}
    if not f_decides(reference.lens.brown.f_px, reference_sigma_f_px(reference)):
        return {}
    return {"reference_covariance": reference.lens_covariance, "reference_field_px": reference.lens.field_px}


def network_bytes(check: FlownCheck) -> bytes:
    """The file's content; the same check gives the same bytes."""
    flown = check.flown
    net, known, lens = flown.network, flown.known, flown.network.lens
    about = _About(
        schema=SCHEMA,
        width=lens.brown.width,
        height=lens.brown.height,
        noise_px=flown.noise_px,
        stands_for=flown.stands_for,
        matched_share=flown.matched_share,
        verdict=check.verdict,
        headline=printable(check.headline),
        findings=tuple(finding_models(check.findings)),
        camera=printable(check.camera_name),
        sigma_f_formal_px=check.sigma_f_formal_px,
        dome_sigma_m=check.dome_sigma_m,
        height_agl_m=check.height_agl_m,
        origin_wgs84=check.origin_wgs84,
        launch_up_m=check.launch_up_m,
        photos=tuple(printable(name) for name in check.photos),
        geotag_fault=None if check.geotag_fault is None else printable(check.geotag_fault),
        files=check.files,
    )
    text = about.model_dump_json(by_alias=True)
    given = {name: getattr(check, name) for name in _OF_REFERENCE} | {
        "way_information": known.way_information
    }
    optional = {name: array for name, array in given.items() if array is not None}
    out = io.BytesIO()
    np.savez_compressed(
        out,
        allow_pickle=False,
        **optional,
        about=np.frombuffer(text.encode(), np.uint8),
        rotations=net.rotations,
        centres_m=net.centres_m,
        centre_sigma_m=known.centre_sigma_m.astype(np.float32),
        rotation_sigma_rad=known.rotation_sigma_rad.astype(np.float32),
        # Millimetres are more than planning needs.
        points_m=np.round(net.points_m, 3),
        photo=net.photo.astype(np.uint32),
        point=net.point.astype(np.uint32),
        lens=lens.vector,
        lens_sigma=known.lens_sigma,
        free=known.free,
        brown=check.brown.vector,
        brown_covariance=check.brown_covariance,
    )
    return out.getvalue()


def read_network(path: Path) -> FlownCheck:
    """Read ``network.npz``.

    Raises:
        InputError: not there or not readable.
        FormatError: not such a file, of another version, or damaged.
    """
    try:
        with path.open("rb") as file:
            data = file.read(_LARGEST_BYTES + 1)
    except OSError as error:
        raise InputError(f"Cannot read {path}: {(error.strerror or str(error)).lower()}.") from error
    try:
        arrays = _arrays(data)
        about = _About.model_validate(json.loads(bytes(arrays["about"]).decode("utf-8")))
        return _made(arrays, about)
    except _DAMAGE as error:
        raise FormatError(
            f"{path} is no network of a check ({SCHEMA}), or it is damaged: check the photos again."
        ) from error


def _arrays(data: bytes) -> dict[str, FloatArray]:
    """All arrays of the file, of the shapes and kinds that they must have; ValueError otherwise."""
    if len(data) > _LARGEST_BYTES:
        raise ValueError("too large")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if sum(info.file_size for info in archive.infolist()) > _LARGEST_UNPACKED:
            raise ValueError("too large")
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        there = [name for name in _OPTIONAL if name in archive.files]
        found: dict[str, FloatArray] = {name: archive[name] for name in ("about", *_SHAPES, *there)}
    sizes: dict[str, int] = {}
    for name, shape in (_SHAPES | _OPTIONAL).items():
        if name not in found:
            continue
        array = found[name]
        if array.ndim != len(shape) or array.dtype.kind not in "fuib":
            raise ValueError(f"{name} is of another kind")
        for length, given in zip(array.shape, shape, strict=True):
            wanted = given if isinstance(given, int) else sizes.setdefault(given, length)
            if length != wanted:
                raise ValueError(f"{name} does not fit the others")
        if np.isnan(array).any() or (name not in _MAY_BE_INFINITE and not np.isfinite(array).all()):
            raise ValueError(f"{name} is not finite")
    return found


def _ways(arrays: dict[str, FloatArray], about: _About, k: int) -> FloatArray | None:
    """``Known.way_information``; ValueError where it is none."""
    if about.shutter_sigma_m is not None:
        return np.tile(np.eye(3) / about.shutter_sigma_m**2, (k, 1, 1))
    ways = arrays.get("way_information")
    if ways is not None and not (np.linalg.eigvalsh(ways).min() > 0):
        raise ValueError("ways that are known to no sigma")
    return ways


def _made(arrays: dict[str, FloatArray], about: _About) -> FlownCheck:
    """The values of the file, put together; ValueError where they contradict each other."""
    a = arrays
    photo, point = a["photo"].astype(np.intp), a["point"].astype(np.intp)
    k, m = len(a["centres_m"]), len(a["points_m"])
    views = np.bincount(point, minlength=m)
    if not len(photo) or len(views) > m or views.min() < 2 or photo.max() >= k or (np.diff(point) < 0).any():
        raise ValueError("views and points contradict each other")
    if len(about.photos) != k or min(a[name].min() for name in _MAY_BE_INFINITE) <= 0:
        raise ValueError("photos and sigmas contradict each other")
    brown = BrownCamera.from_vector(about.width, about.height, a["brown"])
    lens = Lens(brown, np.zeros(len(FIELD_NAMES))).with_vector(a["lens"])
    if not (brown.f_px > 0 and lens.brown.f_px > 0 and a["brown_covariance"][0, 0] > 0):
        raise ValueError("there is no focal length")
    sigma = np.full(len(photo), about.noise_px / np.sqrt(about.stands_for))
    network = CameraNetwork(lens, a["rotations"], a["centres_m"], a["points_m"], photo, point, sigma)
    known = Known(
        a["centre_sigma_m"].astype(float),
        a["rotation_sigma_rad"].astype(float),
        a["lens_sigma"],
        a["free"].astype(bool),
        _ways(a, about, k),
    )
    return FlownCheck(
        flown=FlownNetwork(network, known, about.noise_px, about.stands_for, about.matched_share),
        verdict=about.verdict,
        headline=about.headline,
        findings=findings_of(about.findings),
        camera_name=about.camera,
        brown=brown,
        brown_covariance=a["brown_covariance"],
        sigma_f_formal_px=about.sigma_f_formal_px,
        dome_sigma_m=about.dome_sigma_m,
        height_agl_m=about.height_agl_m,
        origin_wgs84=about.origin_wgs84,
        launch_up_m=about.launch_up_m,
        photos=about.photos,
        geotag_fault=about.geotag_fault,
        **{name: a.get(name) for name in _OF_REFERENCE},
        files=about.files,
    )

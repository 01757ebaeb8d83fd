"""What ``fieldcal calibrate control`` leaves behind: reports, data, references, one folder a camera."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from calib.control import ControlCalibration
from calib.control_cameras import Campaign
from calib.control_output import campaign_json, control_json, control_reference, expected_csv, render_control
from calib.files import check_file_writable, output_folder, write_text_atomic
from calib.onsite import default_name
from calib.onsite_rules import reference_limit_percent
from calib.reference_file import write_reference_file
from calib.references import check_saving, save_reference
from calib.wording import camera_name
from daemon.output import write_stdout

CONTROL_HTML, CONTROL_JSON, REFERENCE_JSON = "control.html", "control.json", "reference.json"
EXPECTED_CSV = "expected-marks.csv"
_EARLIER = (REFERENCE_JSON, EXPECTED_CSV)


@dataclass(frozen=True)
class KeptControl:
    """A calibration, its folder, and the name it was saved under (None: f is too vague for a reference)."""

    made: ControlCalibration
    folder: Path
    saved_as: str | None


def keep_campaign(
    campaign: Campaign, out: Path, name: str | None, temperature_c: float | None, json_to: str | None
) -> tuple[KeptControl, ...]:
    """Write everything. Each of several cameras has a folder and a name of its own.

    Raises:
        InputError, OutputError: a name or a folder cannot be used; one sentence.
    """
    made = campaign.calibrations
    alone = len(made) + len(campaign.failed) == 1
    own = _distinct([default_name(one.photos[0].camera) for one in made])
    names = own if name is None else [name] if alone else [f"{name}-{each}"[:80] for each in own]
    for each in names:
        check_saving(each)
    kept: list[KeptControl] = []
    with output_folder(out):
        if json_to is not None and json_to != "-":
            check_file_writable(Path(json_to))
        for one, each, camera in zip(made, names, own, strict=True):
            folder = out if alone else out / camera
            with output_folder(folder):
                kept.append(KeptControl(one, folder, _keep(one, each, folder, temperature_c)))
        for photo, _ in campaign.failed:
            _clear(out / default_name(photo.camera), (CONTROL_HTML, CONTROL_JSON, *_EARLIER))
        failed = [f"{camera_name(photo.camera)}: {why}" for photo, why in campaign.failed]
        data = campaign_json(made, [one.saved_as for one in kept], failed)
        if json_to == "-":
            write_stdout(data)
        elif json_to is not None:
            write_text_atomic(Path(json_to), data)
    return tuple(kept)


def _distinct(names: list[str]) -> list[str]:
    """Two lenses of one camera (zoom) share its name: the later ones are numbered."""
    seen: Counter[str] = Counter()
    found = []
    for name in names:
        seen[name] += 1
        found.append(name if seen[name] == 1 else f"{name[:76]}-{seen[name]}")
    return found


def _clear(folder: Path, names: tuple[str, ...]) -> None:
    """Files of an earlier try must not be taken for this one's."""
    for name in names:
        (folder / name).unlink(missing_ok=True)


def _keep(made: ControlCalibration, name: str, folder: Path, temperature_c: float | None) -> str | None:
    saved = None
    _clear(folder, _EARLIER)
    if made.sigma_f_percent <= reference_limit_percent(made.camera.width):
        reference = control_reference(made, name, temperature_c)
        write_reference_file(reference, folder / REFERENCE_JSON)
        save_reference(reference)
        saved = name
    if made.mounted is not None and made.mounted.expected:
        write_text_atomic(folder / EXPECTED_CSV, expected_csv(made.mounted))
    write_text_atomic(folder / CONTROL_HTML, render_control(made, saved))
    write_text_atomic(folder / CONTROL_JSON, control_json(made, saved))
    return saved

"""``fieldcal calibrate``: a camera calibrated on site, accepted or not, and kept as a reference."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from calib.check import read_set
from calib.errors import InputError
from calib.files import check_file_writable, output_folder, write_text_atomic
from calib.onsite import (
    Acceptance,
    Calibration,
    Kind,
    calibrate_photos,
    calibration_reference,
    default_name,
)
from calib.onsite_json import calibration_json
from calib.onsite_report import render_calibration
from calib.photos.sort import require_block
from calib.reference_file import write_reference_file
from calib.references import check_saving, save_reference
from calib.wording import camera_name, path_text, photos_given
from daemon.output import console, write_stdout
from daemon.progress import progress_line
from daemon.terminal import BADGES, print_findings, wrapped

app = typer.Typer(
    help="Calibrate a camera on site: on a flat wall or from any convergent flight.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
DEFAULT_OUT = Path("fieldcal-out")
REPORT_HTML, REPORT_JSON, REFERENCE_JSON = "calibration.html", "calibration.json", "reference.json"

PhotosArgument = Annotated[
    list[Path], typer.Argument(metavar="PHOTOS...", help="Photos, or folders of photos.", readable=False)
]
NameOption = Annotated[
    str | None, typer.Option(help="Name in your store (default: camera and serial number).")
]
OutOption = Annotated[Path, typer.Option(metavar="DIR", help="Where report and data go.", readable=False)]
TemperatureOption = Annotated[
    float | None, typer.Option("--temperature", metavar="C", help="Air temperature, degrees Celsius.")
]
JsonOption = Annotated[
    str | None,
    typer.Option("--json", metavar="FILE|-", help="Also write calibration.json here, or to stdout."),
]
QuietOption = Annotated[bool, typer.Option("--quiet", help="Only the result; no progress.")]


@dataclass(frozen=True)
class _Wanted:
    name: str | None
    out: Path
    temperature_c: float | None
    json_to: str | None
    quiet: bool


@app.command()
def wall(
    photos: PhotosArgument,
    name: NameOption = None,
    out: OutOption = DEFAULT_OUT,
    temperature: TemperatureOption = None,
    json_to: JsonOption = None,
    quiet: QuietOption = False,
) -> int:
    """Calibrate on a flat wall, 20-30 convergent photos. Exit code 0 accepted, 3 retake, 4 cannot tell."""
    return _calibrate(photos, Kind.WALL, _Wanted(name, out, temperature, json_to, quiet))


@app.command()
def orbit(
    photos: PhotosArgument,
    name: NameOption = None,
    out: OutOption = DEFAULT_OUT,
    temperature: TemperatureOption = None,
    json_to: JsonOption = None,
    quiet: QuietOption = False,
) -> int:
    """Calibrate from any convergent flight. Exit code 0 accepted, 3 retake, 4 cannot tell."""
    return _calibrate(photos, Kind.ORBIT, _Wanted(name, out, temperature, json_to, quiet))


def _calibrate(photos: list[Path], kind: Kind, wanted: _Wanted) -> int:
    # What can be refused at once is refused before a minute's work.
    if wanted.name is not None:
        check_saving(wanted.name)
    if wanted.temperature_c is not None and not (-90 <= wanted.temperature_c <= 90):
        raise InputError(f"{wanted.temperature_c:g} is no air temperature in degrees Celsius.")
    hidden = wanted.quiet or sys.stderr is None or not sys.stderr.isatty()
    with progress_line(hidden, "starting") as report:
        found = read_set(photos, report)
        require_block(found)
        name = wanted.name or default_name(found.used[0].camera)
        check_saving(name)
        with output_folder(wanted.out):
            if wanted.json_to is not None and wanted.json_to != "-":
                check_file_writable(Path(wanted.json_to))
            made = calibrate_photos(found, kind, report, temperature_c=wanted.temperature_c)
            saved = _write(made, wanted.out, name)
    if wanted.json_to == "-":
        write_stdout(calibration_json(made, saved))
    elif wanted.json_to is not None:
        write_text_atomic(Path(wanted.json_to), calibration_json(made, saved))
    _show(made, wanted, saved)
    return made.acceptance.verdict.exit_code


def _write(made: Calibration, out: Path, name: str) -> str | None:
    """Report, data and, where it is accepted, the reference; the name it was saved under."""
    saved = None
    own_copy = out / REFERENCE_JSON
    if made.acceptance is Acceptance.ACCEPTED:
        reference = calibration_reference(made, name)
        write_reference_file(reference, own_copy)
        save_reference(reference)
        saved = name
    else:
        # The reference of an earlier try must not stand beside this report.
        own_copy.unlink(missing_ok=True)
    write_text_atomic(out / REPORT_HTML, render_calibration(made, saved))
    write_text_atomic(out / REPORT_JSON, calibration_json(made, saved))
    return saved


def _show(made: Calibration, wanted: _Wanted, saved: str | None) -> None:
    to_stderr = wanted.json_to == "-"
    say = console(to_stderr)
    if wanted.quiet:
        if not to_stderr:
            say.print(f"{made.acceptance.words}: {made.headline}", soft_wrap=True)
        return
    width = max(min(say.width, 80), 20)

    def paragraph(text: str, style: str = "", indent: str = "", hanging: str | None = None) -> None:
        for line in wrapped(text, width, indent, indent if hanging is None else hanging):
            say.print(Text(line, style=style), soft_wrap=True)

    for note in made.notes:
        paragraph(note)
    say.print()
    badge = f" {made.acceptance.words} "
    first, *rest = wrapped(made.headline, width, " " * (len(badge) + 2))
    say.print(Text.assemble((badge, BADGES[made.acceptance.verdict]), first[len(badge) :]), soft_wrap=True)
    for line in rest:
        say.print(Text(line), soft_wrap=True)
    say.print()
    photos = f"{photos_given(made)} photos, {len(made.solution.photos)} aligned"
    paragraph(f"{camera_name(made.camera)}, {photos}", "dim")
    say.print()
    print_findings(made.findings, say, width)
    if made.what_to_do:
        say.print()
        say.print(Text("What to do", style="bold"))
        for text in made.what_to_do:
            paragraph(text, indent="  - ", hanging="    ")
    say.print()
    if saved is None:
        paragraph("Not saved as a reference.")
    else:
        paragraph(f"Saved as {saved}: fieldcal check PHOTOS --reference {saved}")
    say.print(Text(f"Report: {path_text(wanted.out / REPORT_HTML)}"), soft_wrap=True)

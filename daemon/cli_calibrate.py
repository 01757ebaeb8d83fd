"""``fieldcal calibrate``: a camera calibrated on site, accepted or not, and kept as a reference."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.text import Text

from calib.check import read_set
from calib.control import MARK_SIGMA_PX, POINT_SIGMA_M, coverage_hint
from calib.control_cameras import Given, calibrate_cameras
from calib.control_files import ControlPoint, Mark, read_marks, read_points
from calib.control_output import mount_words, summary
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
from calib.onsite_rules import reference_limit_percent
from calib.photos import collect, read_photos
from calib.photos.sort import require_block
from calib.reference_file import write_reference_file
from calib.references import check_saving, save_reference
from calib.scan import SCAN_RADIUS_M
from calib.targets import (
    DETECTED_SIGMA_PX,
    Detector,
    board_detector,
    board_points,
    find_targets,
    parse_board,
    tag_detector,
)
from calib.wording import camera_name, path_text, photos_given
from daemon.cli_mark import (
    FocalOption,
    PhotosArgument,
    ScanOption,
    ScanRadiusOption,
    mark_command,
    scanned,
)
from daemon.control_kept import EXPECTED_CSV, KeptControl, keep_campaign
from daemon.output import console, table, write_stdout
from daemon.progress import progress_line
from daemon.terminal import paragraph, print_findings, print_headline

app = typer.Typer(
    help="Calibrate a camera on site: on a flat wall, from any convergent flight or on control points.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
DEFAULT_OUT = Path("fieldcal-out")
REPORT_HTML, REPORT_JSON, REFERENCE_JSON = "calibration.html", "calibration.json", "reference.json"

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


@app.command(
    Kind.ORBIT,
    help="Calibrate from any convergent flight. Exit code 0 accepted, 3 retake, 4 cannot tell.",
)
# Applied from below: the wall is listed first.
@app.command(
    Kind.WALL,
    help="Calibrate on a flat wall, 20-30 convergent photos. Exit code 0 accepted, 3 retake, 4 cannot tell.",
)
def on_site(
    context: typer.Context,
    photos: PhotosArgument,
    name: NameOption = None,
    out: OutOption = DEFAULT_OUT,
    temperature: TemperatureOption = None,
    json_to: JsonOption = None,
    quiet: QuietOption = False,
) -> int:
    """Calibrate without control points, on what the command is named after."""
    kind = Kind(str(context.command.name))
    return _calibrate(photos, kind, _Wanted(name, out, temperature, json_to, quiet))


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
    for note in made.notes:
        paragraph(say, note)
    say.print()
    print_headline(say, made.acceptance.words, made.acceptance.verdict, made.headline)
    say.print()
    photos = f"{photos_given(made)} photos, {len(made.solution.photos)} aligned"
    paragraph(say, f"{camera_name(made.camera)}, {photos}", "dim")
    say.print()
    print_findings(made.findings, say)
    if made.what_to_do:
        say.print()
        say.print(Text("What to do", style="bold"))
        for text in made.what_to_do:
            paragraph(say, text, indent="  - ", hanging="    ")
    say.print()
    if saved is None:
        paragraph(say, "Not saved as a reference.")
    else:
        paragraph(say, f"Saved as {saved}: fieldcal check PHOTOS --reference {saved}")
    say.print(Text(f"Report: {path_text(wanted.out / REPORT_HTML)}"), soft_wrap=True)


app.command("mark")(mark_command)


@app.command()
def control(
    photos: PhotosArgument,
    marks: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Marks: CSV, ODM gcp_list.txt or Metashape markers XML."),
    ] = None,
    board: Annotated[
        str | None,
        typer.Option(
            metavar="COLSxROWS,MM,MM[,TAGS]",
            help="Find the corners of a ChArUco board instead: squares, side of a square and of a tag.",
        ),
    ] = None,
    tags: Annotated[
        str | None,
        typer.Option(metavar="DICTIONARY", help="Find tags instead, as APRILTAG_36h11, 4X4_50."),
    ] = None,
    points: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Points: CSV (default: those in the file of marks)."),
    ] = None,
    scan: ScanOption = None,
    scan_radius: ScanRadiusOption = SCAN_RADIUS_M,
    focal_px: FocalOption = None,
    mark_sigma_px: Annotated[
        float | None,
        typer.Option(
            min=0.01,
            max=20,
            help=f"Precision of a mark, px (default {MARK_SIGMA_PX:g}; found targets {DETECTED_SIGMA_PX:g}).",
        ),
    ] = None,
    point_sigma_m: Annotated[
        float,
        typer.Option(min=0, max=10, help="Precision of a point where none is stated; 0 holds it."),
    ] = POINT_SIGMA_M,
    check_every: Annotated[
        int,
        typer.Option(min=0, max=50, help="Make every so many points a check point, where none is."),
    ] = 0,
    name: NameOption = None,
    out: OutOption = DEFAULT_OUT,
    temperature: TemperatureOption = None,
    json_to: JsonOption = None,
    quiet: QuietOption = False,
) -> int:
    """Calibrate on control points, parameters in steps; two cameras at once are calibrated each for itself.
    Exit code 0 done, 3 if f is too vague to keep."""
    wanted = _Wanted(name, out, temperature, json_to, quiet)
    if name is not None:
        check_saving(name)
    if board is not None and scan is not None:
        raise InputError("A board brings its own points; leave --scan away.")
    found_marks, surveyed, detect = _marks_and_points(marks, points, board, tags)
    hidden = quiet or sys.stderr is None or not sys.stderr.isatty()
    with progress_line(hidden, "reading metadata") as report:
        surveyed, remarks = scanned(surveyed, scan, scan_radius, report)
        files = collect(photos)
        read, bad = read_photos(files, lambda done: report("reading metadata", done, len(files)))
        if not read:
            raise InputError(f"No photo can be read ({bad[0].path}: {bad[0].reason}).")
        if detect is not None:
            found_marks = find_targets(
                read, detect, lambda done: report("looking for targets", done, len(read))
            )
    usual = MARK_SIGMA_PX if detect is None else DETECTED_SIGMA_PX
    sigma_px = mark_sigma_px or usual
    given = Given(surveyed, found_marks, focal_px, sigma_px, point_sigma_m, check_every, remarks=remarks)
    campaign = calibrate_cameras(read, given)
    kept = keep_campaign(campaign, out, name, temperature, json_to)
    alone = len(kept) + len(campaign.failed) == 1
    for one in kept:
        _show_control(one, wanted, alone)
    for photo, why in campaign.failed:
        console(json_to == "-").print(f"{camera_name(photo.camera)} is not calibrated: {why}", soft_wrap=True)
    return 0 if all(one.saved_as for one in kept) and not campaign.failed else 3


def _marks_and_points(
    marks: Path | None, points: Path | None, board: str | None, tags: str | None
) -> tuple[tuple[Mark, ...], tuple[ControlPoint, ...], Detector | None]:
    """Marks of a file, the points' coordinates, and what finds the marks in the photos instead."""
    if sum(given is not None for given in (marks, board, tags)) != 1:
        raise InputError("Give the marks (--marks FILE), or let targets be found: --board or --tags.")
    surveyed = () if points is None else read_points(points)
    if board is not None:
        if points is not None:
            raise InputError("A board brings its own points; leave --points away.")
        return (), board_points(parse_board(board)), board_detector(parse_board(board))
    if marks is not None:
        found = read_marks(marks)
        surveyed = surveyed or found.points
        if not surveyed:
            raise InputError(f"{marks} holds no coordinates; give the points with --points.")
        return found.marks, surveyed, None
    if not surveyed:
        raise InputError("Tags bring no coordinates; give those of their middles or corners with --points.")
    return (), surveyed, tag_detector(str(tags), {point.name for point in surveyed})


def _show_control(kept: KeptControl, wanted: _Wanted, alone: bool) -> None:
    made, saved, sigma = kept.made, kept.saved_as, kept.made.sigma_f_percent
    to_stderr = wanted.json_to == "-"
    say = console(to_stderr)
    headline = f"f {made.camera.f_px:.2f} px, known to {sigma:.4f} % (1 sigma)"
    if not alone:
        headline = f"{camera_name(made.photos[0].camera)}: {headline}"
    if wanted.quiet:
        if not to_stderr:
            # Marks or points that are wrong are part of the result.
            for text in (headline, *made.blunders):
                say.print(text, soft_wrap=True)
        return
    say.print(headline)
    say.print(summary(made), soft_wrap=True)
    numbers = ("sigma0", "control px", "check px", "chance")
    rows = table("step", *numbers, "", numbers=numbers)
    for step in made.steps:
        chance = "" if step.chance is None else f"{step.chance:.2g}"
        check = f"{step.check_rms_px:.2f}" if math.isfinite(step.check_rms_px) else "-"
        answer = "kept" if step.kept else "left out"
        rows.add_row(step.name, f"{step.sigma0:.2f}", f"{step.control_rms_px:.2f}", check, chance, answer)
    say.print(rows)
    for label, check_points in (("control", False), ("check", True)):
        errors = made.rmse_m(check_points)
        if np.isfinite(errors).all():
            x, y, z = 1000 * errors
            say.print(f"{label} points: RMSE x {x:.1f}, y {y:.1f}, z {z:.1f} mm")
    mount = () if made.mounted is None else mount_words(made.mounted)
    for text in (*made.blunders, *made.notes, *mount, *filter(None, [coverage_hint(made)])):
        say.print(text, soft_wrap=True)
    if made.mounted is not None and made.mounted.expected:
        say.print(
            f"Where the points should be in its other photos: {path_text(kept.folder / EXPECTED_CSV)}",
            soft_wrap=True,
        )
    if saved is None:
        limit = f"{reference_limit_percent(made.camera.width):.2g} %"
        say.print(
            f"Not saved: a reference needs {limit}. Mark more points, towards the corners too.",
            soft_wrap=True,
        )
    else:
        say.print(f"Saved as {saved}: fieldcal check PHOTOS --reference {saved}", soft_wrap=True)
    say.print(f"Report: {path_text(kept.folder / 'control.html')}", soft_wrap=True)
    if not alone:
        say.print()

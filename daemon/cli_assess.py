"""``fieldcal assess``: a point cloud or height model held against reference points."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.text import Text

from calib.assess.data import assessment_json
from calib.assess.page import render_assessment
from calib.assess.study import CloudAssessment, Line, assess_cloud
from calib.assess.truth import Truth, check_overlap, chosen, parse_crs, read_truth
from calib.assess.words import elevation_text, offset_text, precision_text, seven_rows, shape_text
from calib.camera import FloatArray
from calib.clouds import load_cloud, open_cloud
from calib.control_files import read_points
from calib.errors import InputError
from calib.files import check_file_writable, output_folder, write_text_atomic
from calib.wording import path_text
from daemon.output import console, table, write_stdout
from daemon.progress import progress_line
from daemon.terminal import paragraph

DEFAULT_OUT = Path("fieldcal-out")
REPORT_HTML, REPORT_JSON = "assessment.html", "assessment.json"


def assess_command(
    cloud: Annotated[
        Path, typer.Argument(metavar="CLOUD", help="LAS, LAZ, PLY, XYZ or CSV, or a GeoTIFF of heights.")
    ],
    truth: Annotated[
        Path, typer.Option("--truth", metavar="POINTS", help="Reference points: CSV with name, x, y, z.")
    ],
    crs: Annotated[
        str | None, typer.Option("--crs", metavar="EPSG", help="Coordinate system of the points.")
    ] = None,
    cloud_crs: Annotated[
        str | None, typer.Option("--cloud-crs", metavar="EPSG", help="The cloud's, where its file has none.")
    ] = None,
    on: Annotated[
        str | None,
        typer.Option("--on", metavar="FILE|NAMES", help="Register on these points only (* for any)."),
    ] = None,
    picked: Annotated[
        Path | None,
        typer.Option("--picked", metavar="FILE", help="The same points as measured in the cloud: CSV."),
    ] = None,
    radius_m: Annotated[
        float | None,
        typer.Option("--radius", metavar="M", help="Radius around a point that gives the cloud's height."),
    ] = None,
    profile: Annotated[
        list[str] | None,
        typer.Option("--profile", metavar="A,B", help="A profile: two names, or x,y,x,y. Repeatable."),
    ] = None,
    width_m: Annotated[float | None, typer.Option("--width", metavar="M", help="Width of profiles.")] = None,
    height_m: Annotated[
        float | None, typer.Option("--height", metavar="M", help="Flying height: errors in percent of it.")
    ] = None,
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Where the report goes.", readable=False)
    ] = DEFAULT_OUT,
    json_to: Annotated[
        str | None,
        typer.Option("--json", metavar="FILE|-", help="Also write assessment.json here, or to stdout."),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Only the result; no progress.")] = False,
) -> None:
    """Shift, turn, scale, precision and dome of a cloud or height model against reference points."""
    for value, name in ((radius_m, "--radius"), (width_m, "--width"), (height_m, "--height")):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise InputError(f"{name} must be a positive number of metres, not {value:g}.")
    file = open_cloud(cloud)
    system = parse_crs(cloud_crs) if cloud_crs is not None else file.crs
    points = read_truth(truth, None if crs is None else parse_crs(crs), system)
    chosen_on = None if on is None else chosen(points.names, on)
    lines = [_line(text, points) for text in profile or []]
    measured = None if picked is None else _picked(picked, points)
    if json_to is not None and json_to != "-":
        check_file_writable(Path(json_to))
    hidden = quiet or sys.stderr is None or not sys.stderr.isatty()
    with output_folder(out):
        with progress_line(hidden, "reading") as report:
            loaded = load_cloud(file, tick=lambda n: report("reading", n, file.count or 0))
            check_overlap(points, loaded)
            made = assess_cloud(
                loaded, points, chosen_on, measured, radius_m, lines, width_m, height_m, tick=report
            )
        text = assessment_json(made)
        write_text_atomic(out / REPORT_HTML, render_assessment(made))
        write_text_atomic(out / REPORT_JSON, text)
    if json_to == "-":
        write_stdout(text)
    elif json_to is not None:
        write_text_atomic(Path(json_to), text)
    _show(made, out, quiet, json_to == "-")


def _line(text: str, points: Truth) -> Line:
    cells = [cell.strip() for cell in text.split(",")]
    if len(cells) == 2:
        ends = []
        for name in cells:
            if name not in points.names:
                raise InputError(f"--profile names {name}, but there is no reference point of that name.")
            ends.append(points.xyz_m[points.names.index(name), :2])
        return Line(f"{cells[0]} to {cells[1]}", ends[0], ends[1])
    try:
        numbers = np.array([float(cell) for cell in cells])
    except ValueError:
        numbers = np.empty(0)
    if numbers.shape != (4,) or not np.isfinite(numbers).all():
        raise InputError(f"--profile {text} is neither two names of points nor x,y,x,y.")
    return Line(text, numbers[:2], numbers[2:])


def _picked(path: Path, points: Truth) -> FloatArray:
    found = {point.name: point.xyz_m for point in read_points(path)}
    if not set(found) & set(points.names):
        raise InputError(f"{path} has no point with a name of the reference points.")
    return np.array([found.get(name, (np.nan,) * 3) for name in points.names])


def _show(made: CloudAssessment, out: Path, quiet: bool, to_stderr: bool) -> None:
    say = console(to_stderr)
    sentences = [offset_text(made), precision_text(made), shape_text(made), elevation_text(made)]
    if quiet:
        if not to_stderr:
            say.print(" ".join(text for text in sentences if text), soft_wrap=True)
        return
    for text in sentences:
        if text:
            paragraph(say, text)
    say.print()
    rows = table("", "", "value", "at the edge", numbers=("at the edge",))
    for row in seven_rows(made):
        rows.add_row(*row)
    say.print(rows)
    for note in made.notes:
        paragraph(say, note, "dim")
    say.print()
    say.print(Text(f"Report: {path_text(out / REPORT_HTML)}"), soft_wrap=True)

"""``fieldcal calibrate mark``: control points marked by hand in photos, on a page in the browser."""

from __future__ import annotations

import contextlib
import shlex
import sys
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from calib.control_files import ControlPoint, read_points
from calib.errors import InputError
from calib.files import check_file_writable
from calib.marking.book import MarkBook
from calib.photos import collect, read_photos
from calib.scan import SCAN_RADIUS_M, points_from_scan
from calib.wording import path_text
from daemon.marking import Desk
from daemon.output import console
from daemon.progress import Report, progress_line
from daemon.web import served

PhotosArgument = Annotated[
    list[Path], typer.Argument(metavar="PHOTOS...", help="Photos, or folders of photos.", readable=False)
]
FocalOption = Annotated[
    float | None, typer.Option(metavar="PX", help="Focal length to start from (default: the photos').")
]
ScanOption = Annotated[
    Path | None,
    typer.Option("--scan", metavar="FILE", help="Laser scan (LAS, LAZ, PLY) to take the coordinates from."),
]
ScanRadiusOption = Annotated[
    float,
    typer.Option("--scan-radius", metavar="M", min=0.001, max=5, help="How much of the scan around a point."),
]


def scanned(
    points: tuple[ControlPoint, ...], scan: Path | None, radius_m: float, report: Report
) -> tuple[tuple[ControlPoint, ...], tuple[str, ...]]:
    """The points on the scan and remarks; as they are where there is no scan."""
    if scan is None:
        return points, ()
    return points_from_scan(
        points, scan, radius_m, lambda done, total: report("reading the scan", done, total)
    )


def mark_command(
    photos: PhotosArgument,
    points: Annotated[Path, typer.Option(metavar="FILE", help="Points to mark: CSV with name, x, y, z.")],
    marks: Annotated[
        Path, typer.Option(metavar="FILE", help="CSV to keep the marks in, for calibrate control.")
    ] = Path("marks.csv"),
    scan: ScanOption = None,
    scan_radius: ScanRadiusOption = SCAN_RADIUS_M,
    focal_px: FocalOption = None,
    open_page: Annotated[bool, typer.Option("--open", help="Open the page in your browser.")] = False,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of the page (default: any free one).")
    ] = 0,
) -> None:
    """Mark control points by hand on a page in your browser."""
    hidden = sys.stderr is None or not sys.stderr.isatty()
    with progress_line(hidden, "reading metadata") as report:
        surveyed, notes = scanned(read_points(points), scan, scan_radius, report)
        files = collect(photos)
        read, bad = read_photos(files, lambda done: report("reading metadata", done, len(files)))
    if not read:
        raise InputError(f"No photo can be read ({bad[0].path}: {bad[0].reason}).")
    check_file_writable(marks)
    desk = Desk(read, {point.name: point for point in surveyed}, marks, focal_px)
    say = console()
    for text in (*notes, *(f"Left out: {path_text(one.path)} ({one.reason})." for one in bad)):
        say.print(text, soft_wrap=True)
    say.print(f"{len(read)} photos, {len(surveyed)} points. {_counted(desk.book, marks)}", soft_wrap=True)
    with served(desk.answer, port) as address:
        say.print("Open this address in a browser on this computer; it is good until you finish:")
        say.print(Text(f"  {address}"), soft_wrap=True)
        say.print("Every mark is saved at once. Press Finish on the page, or Ctrl-C here, to end.")
        if open_page:
            webbrowser.open(address)
        with contextlib.suppress(KeyboardInterrupt):
            desk.finished.wait()
    say.print()
    say.print(_counted(desk.book, marks), soft_wrap=True)
    if desk.book.marks:
        say.print(Text(f"Next: {_next(photos, points, marks, scan, focal_px)}"), soft_wrap=True)


def _counted(book: MarkBook, path: Path) -> str:
    points = {mark.point for mark in book.marks.values()}
    photos = {mark.photo.lower() for mark in book.marks.values()}
    if not points:
        return f"No marks in {path_text(path)} yet."
    return f"{len(book.marks)} marks of {len(points)} points in {len(photos)} photos in {path_text(path)}."


def _next(
    photos: Sequence[Path], points: Path, marks: Path, scan: Path | None, focal_px: float | None
) -> str:
    words = ["fieldcal", "calibrate", "control", *map(str, photos)]
    words += ["--points", str(points), "--marks", str(marks)]
    if scan is not None:
        words += ["--scan", str(scan)]
    if focal_px is not None:
        words += ["--focal-px", f"{focal_px:g}"]
    return shlex.join(words)

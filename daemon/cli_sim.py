"""``fieldcal sim``: surveys that nobody flew, with a known lens and everything else known too."""

from __future__ import annotations

import sys
from dataclasses import replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from calib.errors import InputError, OutputError
from calib.files import output_errors, output_folder
from calib.photos.photo import Processing
from calib.reference_file import write_reference_file
from calib.wording import path_text, printable
from daemon.cli_sim_flight import LARGEST_SEED, LENS_FILE, camera, vehicle
from daemon.output import console, table
from daemon.progress import progress_line
from sim.cameras import CAMERAS, find_camera
from sim.gps import GpsKind
from sim.recipes import RECIPES, Recipe, find_recipe
from sim.survey import (
    TRUTH_FILE,
    SurveyOptions,
    SurveyTruth,
    lens_corrected,
    true_reference,
    write_survey,
)

#: What a correction in the camera leaves, where nothing else is asked for (px at 4000 px width).
LEFT_BY_CORRECTION_PX = 1.5

app = typer.Typer(
    help="Render surveys over invented ground, with the truth beside them.",
    invoke_without_command=True,
    rich_markup_mode=None,
)


class Pixels(StrEnum):
    """What the camera did to its pixels."""

    RAW = "raw"
    CORRECTED = "corrected"


class Tags(StrEnum):
    """Whose tags the photos carry."""

    DJI = "dji"
    MAVLINK = "mavlink"


@app.callback()
def _default(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        list_recipes()


@app.command("list")
def list_recipes() -> None:
    """Surveys that can be rendered."""
    shown = table("recipe", "photos", "what", numbers=("photos",))
    for recipe in RECIPES.values():
        mark = "*" if recipe.countable else " "
        shown.add_row(recipe.name, f"{recipe.photos}{mark}", recipe.summary)
    console().print(shown)
    console().print("* another number with --photos")


app.command("vehicle")(vehicle)
app.command("camera")(camera)


@app.command("survey")
def survey(
    recipe: Annotated[str, typer.Argument(metavar="RECIPE", help="A name of `fieldcal sim list`.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="A new or empty folder.", readable=False)],
    seed: Annotated[
        int, typer.Option(min=0, max=LARGEST_SEED, help="Another seed: other ground, other errors.")
    ] = 1,
    size: Annotated[
        str | None, typer.Option(metavar="WxH|full", help="Size of the photos in px (default: reduced).")
    ] = None,
    photos: Annotated[int | None, typer.Option(metavar="N", help="Fewer or more photos, for orbits.")] = None,
    lens: Annotated[
        str | None, typer.Option(metavar="NAME", help=f"Another camera: {', '.join(CAMERAS)}.")
    ] = None,
    camera: Annotated[
        Pixels | None, typer.Option(help="Photos as the sensor saw them, or corrected in the camera.")
    ] = None,
    pattern_px: Annotated[
        float | None,
        typer.Option(min=0, max=20, help="What no Brown model holds: px at most, at 4000 px width."),
    ] = None,
    gps: Annotated[
        GpsKind, typer.Option(help="How position errors behave from photo to photo.")
    ] = GpsKind.WHITE,
    gps_sigma_m: Annotated[
        float | None, typer.Option(min=0, max=100, help="Their size (default: 2.5, rtk: 0.015).")
    ] = None,
    tags: Annotated[
        Tags | None, typer.Option(help="DJI's tags, or plain EXIF as of a camera on an autopilot.")
    ] = None,
    relief_m: Annotated[
        float, typer.Option(min=0, max=50, help="Rolling ground stays within this of level.")
    ] = 2.0,
    dem: Annotated[Path | None, typer.Option(metavar="FILE", help="GeoTIFF to fly over.")] = None,
    ortho: Annotated[Path | None, typer.Option(metavar="FILE", help="GeoTIFF of how it looks.")] = None,
    rolling_shutter_ms: Annotated[
        float, typer.Option(min=0, max=200, help="Time from the first row to the last.")
    ] = 0.0,
    take_off_photo: Annotated[
        bool, typer.Option("--take-off-photo", help="One on the ground before the flight.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress.")] = False,
) -> int:
    """Render a survey: photos, their truth, and the true lens as a reference for `fieldcal check`."""
    chosen = find_recipe(recipe)
    if lens is not None:
        chosen = replace(chosen, camera=find_camera(lens))
    pixels = chosen.camera.size_of(size)
    chosen.flight(photos=photos)  # What can be refused at once is refused before the folder is made.
    options = SurveyOptions(
        photos=photos, relief_m=relief_m, dem=dem, ortho=ortho, gps=gps, camera_model=lens
    )
    options = _with_lens(options, chosen, pixels, camera, pattern_px)
    if gps_sigma_m is not None and gps is GpsKind.RTK:
        options = replace(options, rtk_sigma_m=gps_sigma_m)
    elif gps_sigma_m is not None:
        options = replace(options, gps_sigma_m=gps_sigma_m)
    if rolling_shutter_ms > 0:
        options = replace(
            options, render=replace(chosen.camera.rendering, readout_s=rolling_shutter_ms / 1000)
        )
    options = replace(
        options, take_off_photo=take_off_photo, dji_tags=None if tags is None else tags is Tags.DJI
    )
    truth = _rendered(chosen, out, seed, pixels, options, quiet)
    if not quiet:
        _tell(chosen, truth, out)
    return 0


def _with_lens(
    options: SurveyOptions,
    recipe: Recipe,
    size: tuple[int, int],
    pixels: Pixels | None,
    pattern_px: float | None,
) -> SurveyOptions:
    """The lens that is asked for: the published one, or what a correction leaves of it."""
    published = recipe.camera.processing
    if pixels is Pixels.RAW and published is not Processing.RAW:
        raise InputError(
            f"What was published of the {recipe.camera.name} is not of raw photos: leave --camera away."
        )
    if pixels is Pixels.CORRECTED and published is Processing.UNKNOWN:
        raise InputError(
            f"Whether photos of the {recipe.camera.name} are corrected was not published: "
            "leave --camera away."
        )
    if pixels is Pixels.CORRECTED and published is Processing.RAW:
        options = replace(options, camera=lens_corrected(recipe.camera.at(*size)), lens_corrected=True)
        pattern_px = LEFT_BY_CORRECTION_PX if pattern_px is None else pattern_px
    return replace(options, pattern_px=pattern_px or 0.0)


def _rendered(
    recipe: Recipe, out: Path, seed: int, size: tuple[int, int], options: SurveyOptions, quiet: bool
) -> SurveyTruth:
    with output_errors(out):
        if out.is_dir() and any(out.iterdir()):
            raise OutputError(f"The folder {out} is not empty; a survey needs a folder of its own.")
    hidden = quiet or sys.stderr is None or not sys.stderr.isatty()
    with output_folder(out):
        try:
            with output_errors(out), progress_line(hidden, "making the ground") as report:
                photos_done = partial(report, "rendering photos")
                truth = write_survey(recipe.name, out, seed, size=size, options=options, progress=photos_done)
        except BaseException:
            _say_incomplete(out)
            raise
        write_reference_file(true_reference(truth, "true-lens"), out / LENS_FILE)
    return truth


def _say_incomplete(out: Path) -> None:
    """What is left of a survey that was not finished; nothing where nothing is."""
    photos = sum(1 for path in out.rglob("*.JPG"))
    if photos and sys.stderr is not None:
        text = f"{photos} photos are in {path_text(out)}, without {TRUTH_FILE}: this survey is incomplete."
        print(f"fieldcal: {printable(text)}", file=sys.stderr)


def _tell(recipe: Recipe, truth: SurveyTruth, out: Path) -> None:
    say = console()
    width, height = truth.camera.width, truth.camera.height
    say.print(f"{recipe.name}: {len(truth.photos)} photos of {width} x {height} px in {path_text(out)}")
    say.print(f"True lens: f {truth.camera.f_px:.2f} px. The rest is in {TRUTH_FILE}.")
    if recipe.notes:
        say.print(recipe.notes)
    say.print("Try:")
    folder = path_text(out)
    say.print(f"  fieldcal check {folder} --reference {folder}/{LENS_FILE}", soft_wrap=True)

"""``fieldcal cameras``: the reference calibrations, bundled and the user's own."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import date as Date
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from calib.camera import BROWN_NAMES, BrownCamera
from calib.equifinal import Radial, profile_deviation
from calib.equifinal_published import radial_of
from calib.errors import InputError
from calib.evidence import reference_sigma_f_px
from calib.files import output_folder, write_text_atomic
from calib.formats import FORMATS, write_calibration
from calib.formats.common import ReadOptions
from calib.photos.photo import Processing
from calib.reference import Reference
from calib.reference_file import write_reference_file
from calib.reference_history import (
    average,
    body_history,
    change,
    changes,
    describe,
    describe_trend,
    entry_of,
    same_body,
    trends,
    verified_camera,
)
from calib.reference_match import convert_reference
from calib.reference_provenance import PROVENANCE_FILE, VERIFIED_FILES, history_dict, provenance_text
from calib.references import (
    bundled_references,
    check_saving,
    history,
    is_bundled,
    load_reference,
    save_reference,
    stored_references,
)
from daemon.output import console, table, write_json

app = typer.Typer(
    help="List, show, compare, import and export reference calibrations.",
    invoke_without_command=True,
    rich_markup_mode=None,
)
#: Export format of our own files, beside those of calib.formats.
OWN_FORMAT = "fieldcal"

NameArgument = Annotated[
    str, typer.Argument(metavar="NAME", help="A reference as `fieldcal cameras` lists it.")
]


@app.callback()
def cameras(context: typer.Context) -> None:
    """List, show, compare, import and export reference calibrations."""
    if context.invoked_subcommand is None:
        list_references()


@app.command("list")
def list_references() -> None:
    """List all reference calibrations, your own first."""
    stored, faults = stored_references()
    rows = table("name", "size", "f px", "photos", "body", "from", numbers=("f px",))
    for reference, origin in [(r, "yours") for r in stored] + [(r, "library") for r in bundled_references()]:
        rows.add_row(
            reference.name,
            _size(reference),
            "-" if reference.f_px is None else f"{reference.f_px:.1f}",
            reference.processing.value,
            reference.serial or "any",
            origin,
        )
    out = console()
    out.print(rows)
    for fault in faults:
        out.print(f"Left out: {fault}")


@app.command()
def show(name: NameArgument) -> None:
    """Show one reference: parameters with sigmas, line, source, history."""
    reference = load_reference(name)
    out = console()
    out.print(f"{reference.name}: {f'{reference.make} {reference.model}'.strip() or 'camera not named'}")
    facts = table("", "")
    facts.show_header = False
    facts.add_row("image", f"{_size(reference)}, {reference.processing.value} photos")
    for label, value in (
        ("body", reference.serial),
        ("signs photos as", ", ".join(reference.exif_models) or None),
        ("focal setting", None if reference.focal_mm is None else f"{reference.focal_mm:g} mm"),
        ("date", reference.date),
        ("temperature", None if reference.temperature_c is None else f"{reference.temperature_c:g} °C"),
        ("source", reference.source),
        ("how", reference.provenance or None),
    ):
        if value:
            facts.add_row(label, value)
    older = history(name) if not is_bundled(name) else ()
    if older:
        facts.add_row("older ones", ", ".join(str(path) for path in older))
    out.print(facts)
    out.print()
    out.print(_parameters(reference))
    if reference.line is not None:
        line = reference.line
        out.print()
        out.print(f"Equifinal line ({line.source}): K2 = {line.slope:.4e} K1 {line.intercept:+.4e},")
        out.print(
            f"K1 {line.k1_min:.2e} to {line.k1_max:.2e}, K2 {line.k2_min:.2e} to {line.k2_max:.2e} (px units)"
        )
    for row in reference.published:
        out.print()
        out.print(f"Published row {row.label}{' (used here)' if row.chosen else ''}:")
        out.print(", ".join(f"{key} {value:g}" for key, value in row.values.items()))


@app.command()
def compare(
    first: NameArgument,
    second: Annotated[str, typer.Argument(metavar="NAME", help="The reference to hold against it.")],
) -> None:
    """Compare two references: focal length and distortion, the second at the first's image size."""
    one, two = load_reference(first), load_reference(second)
    out = console()
    if one.width and two.width:
        two, note = convert_reference(two, one.width, one.height)
        if note:
            out.print(f"{two.name}: {note}")
    if Processing.UNKNOWN not in (one.processing, two.processing) and one.processing is not two.processing:
        out.print(
            f"These cannot stand for each other: {one.name} is for {one.processing.value} photos, "
            f"{two.name} for {two.processing.value} ones."
        )
    rows = table("", one.name, two.name, "difference", numbers=(one.name, two.name, "difference"))
    if one.f_px is not None and two.f_px is not None:
        moved = f"{100 * (two.f_px - one.f_px) / one.f_px:+.3f} %"
        rows.add_row("f, px", f"{one.f_px:.2f}", f"{two.f_px:.2f}", moved)
    a, note_a = radial_of(one)
    b, note_b = radial_of(two)
    for label, x, y in zip(("K1, px^-2", "K2, px^-4", "K3, px^-6"), a.vector, b.vector, strict=True):
        rows.add_row(label, f"{x:.4e}", f"{y:.4e}", f"{y - x:+.2e}")
    out.print(rows)
    if one.width:
        radius = max(one.width, one.height) / 2
        d = profile_deviation(b, a, radius)
        out.print(
            f"Distortion differs by up to {d.raw_px:.2f} px within {radius:g} px of the centre "
            f"({d.linear_removed_px:.2f} px apart from a plain scale)."
        )
    for note in (note_a, note_b):
        if note:
            out.print(note)
    if same_body(one, two) and one.comparable_brown is not None and two.comparable_brown is not None:
        out.print(describe(change(entry_of(one.name), entry_of(two.name))))


@app.command("import")
def import_reference(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A calibration in any known format.")],
    name: Annotated[str | None, typer.Option(help="Name in the store (default: from the file).")] = None,
    make: Annotated[str | None, typer.Option(help="Maker of the camera.")] = None,
    model: Annotated[str | None, typer.Option(help="Model as the photos' EXIF has it.")] = None,
    serial: Annotated[str | None, typer.Option(help="Serial number of the camera body.")] = None,
    processing: Annotated[Processing | None, typer.Option(help="What the camera does to its photos.")] = None,
    date: Annotated[str | None, typer.Option(help="Date of the calibration, as 2024-05-31.")] = None,
    image_size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Image size in px, where the file does not say.")
    ] = None,
    pixel_size_mm: Annotated[
        float | None, typer.Option(help="Pixel size in mm, where the file does not say.")
    ] = None,
) -> None:
    """Take a calibration file into your store."""
    if not file.is_file():
        raise InputError(f"There is no file {file}.")
    reference = load_reference(file, ReadOptions(_image_size(image_size), pixel_size_mm))
    if date is not None:
        try:
            Date.fromisoformat(date)
        except ValueError:
            raise InputError(f"{date} is not a date; write it as 2024-05-31.") from None
    reference = replace(
        reference,
        name=name or _slug(file.stem),
        make=make or reference.make,
        model=model or reference.model,
        exif_models=(model,) if model else reference.exif_models,
        serial=serial or reference.serial,
        processing=processing or reference.processing,
        date=date or reference.date,
    )
    path = save_reference(reference)
    out = console()
    out.print(f"Saved as {reference.name} in {path}")
    if not reference.model:
        out.print("It names no camera, so it is used only when you name it (--reference).")


@app.command()
def export(
    name: NameArgument,
    format_name: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="F",
            help=f"{', '.join(FORMATS)}; {OWN_FORMAT} keeps all of a reference, with sigmas and source.",
        ),
    ],
    out_file: Annotated[Path, typer.Option("--out", metavar="FILE", help="File to write.")],
) -> None:
    """Write a reference in a format of another program."""
    reference = load_reference(name)
    if format_name == OWN_FORMAT:
        write_reference_file(reference, out_file)
    else:
        brown = reference.comparable_brown
        if brown is None:
            raise InputError(
                f"Of {reference.name} only the focal length and lines are known: nothing to export."
            )
        if brown.width == 0:
            raise InputError(f"The image size of {reference.name} is not known, so it cannot be exported.")
        write_calibration(brown, format_name, out_file)
    console().print(f"Wrote {out_file} ({format_name}).")


@app.command("history")
def show_history(
    name: NameArgument,
    json_to: Annotated[
        str | None, typer.Option("--json", metavar="FILE|-", help="Also as JSON, to a file or to stdout.")
    ] = None,
) -> None:
    """Show every calibration of a body over time: temperature, drift of f and profile, significance."""
    entries, faults = body_history(name)
    steps, found = changes(entries), trends(entries)
    if json_to is not None:
        write_json(history_dict(name, entries, steps, found), json_to)
    if json_to == "-":
        return
    out = console()
    rows = table("date", "name", "°C", "f px", "sigma", "change", numbers=("°C", "f px", "sigma", "change"))
    shift = ["", *(f"{step.f_percent:+.4f} %" for step in steps)]
    for entry, moved in zip(entries, shift, strict=True):
        reference = entry.reference
        f, sigma = reference.f_px or 0.0, reference_sigma_f_px(reference)
        rows.add_row(
            reference.date or "-",
            entry.label,
            "-" if reference.temperature_c is None else f"{reference.temperature_c:g}",
            f"{f:.2f}",
            f"{100 * sigma / f:.4f} %" if sigma > 0 else "-",
            moved,
        )
    out.print(rows)
    if len(entries) == 1:
        out.print("There is nothing to compare with: it is the only calibration of this body.")
    for text in (*map(describe, steps), *map(describe_trend, found)):
        out.print(text)
    for entry in entries:
        out.print(f"{entry.label}: {entry.reference.source}; {entry.reference.provenance or 'no details'}")
    for fault in faults:
        out.print(f"Left out: {fault}")


@app.command("average")
def average_references(
    names: Annotated[list[str], typer.Argument(metavar="NAME...", help="Calibrations of one body.")],
    name: Annotated[str, typer.Option(help="Name of the average in your store.")],
) -> None:
    """Average consistent calibrations of one body, with covariance, and keep the mean as a reference."""
    check_saving(name)
    if len(set(names)) < len(names):
        raise InputError("Every calibration counts once: a name is given twice.")
    entries = [entry_of(one) for one in names]
    made = average(entries, name)
    path = save_reference(made)
    sigma = 100 * reference_sigma_f_px(made) / (made.f_px or 1.0)
    out = console()
    out.print(f"f {made.f_px:.2f} px, known to {sigma:.4f} %: {made.provenance}")
    out.print(f"Saved as {name} in {path}")


@app.command("verified")
def verified(
    name: NameArgument,
    out_dir: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the files.")],
) -> None:
    """Write a verified calibration for OpenDroneMap and Metashape, with where it comes from."""
    reference = load_reference(name)
    brown = verified_camera(reference)
    with output_folder(out_dir):
        for format_name, file in VERIFIED_FILES.items():
            write_calibration(brown, format_name, out_dir / file)
        write_text_atomic(out_dir / PROVENANCE_FILE, provenance_text(reference, brown, out_dir))
    console().print(f"Wrote {', '.join(VERIFIED_FILES.values())} and {PROVENANCE_FILE} to {out_dir}.")


def _image_size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"([1-9][0-9]{0,5})x([1-9][0-9]{0,5})", text.strip().lower())
    if found is None:
        raise InputError(f"{text} is not an image size; write it as 4000x3000.")
    return int(found[1]), int(found[2])


def _size(reference: Reference) -> str:
    return f"{reference.width}x{reference.height}" if reference.width else "unknown"


def _parameters(reference: Reference) -> object:
    rows = table("parameter", "value", "sigma", "px units", numbers=("value", "sigma", "px units"))
    brown = reference.comparable_brown
    if brown is None:
        if reference.focal_px is not None:
            rows.add_row("f, px", f"{reference.focal_px:.2f}", _sigma(reference, "f"), "")
        if reference.implied_radial_px is not None:
            radial = Radial(*reference.implied_radial_px)
            for label, value in zip(("K1", "K2", "K3"), radial.vector, strict=True):
                rows.add_row(f"{label} (derived)", "", "", f"{value:.4e}")
        return rows
    for key, value in zip(BROWN_NAMES, brown.vector, strict=True):
        if key in ("f", "cx", "cy"):
            rows.add_row(f"{key}, px", f"{value:.2f}", _sigma(reference, key), "")
        elif value or key in reference.sigma:
            rows.add_row(key.upper(), f"{value:.6g}", _sigma(reference, key), _in_px(brown, key))
    return rows


def _in_px(brown: BrownCamera, key: str) -> str:
    order = {"k1": 2, "k2": 4, "k3": 6, "k4": 8}.get(key)
    return "" if order is None else f"{getattr(brown, key) / np.power(brown.f_px, order):.4e}"


def _sigma(reference: Reference, key: str) -> str:
    sigma = reference.sigma.get(key)
    return "" if sigma is None else f"{sigma:.2g}"


def _slug(text: str) -> str:
    """A name for the store out of a file's name."""
    return re.sub(r"[^a-z0-9._-]+", "-", text.lower()).strip("-._") or "camera"

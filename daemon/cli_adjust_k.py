"""``fieldcal adjust-k``: K1 and K2 forced onto the equifinal line, as the paper advises against."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.text import Text

from calib.camera import BrownCamera, FloatArray
from calib.convert import image_grid_px
from calib.equifinal import Radial, equifinal_region, image_radius_px, profile_deviation
from calib.equifinal_published import clip_to_line, radial_of
from calib.errors import InputError
from calib.files import check_file_writable
from calib.reference import EquifinalLine, Reference
from calib.reference_file import write_reference_file
from calib.references import load_reference
from daemon.output import JsonOption, console, table, write_json
from daemon.terminal import paragraph

SCHEMA = "fieldcal.adjust-k/1"
WARNING = (
    "Not a repair: forcing K1 and K2 onto the line removes a dome and raises the noise of the cloud "
    "([C&D] discussion, fig. 7). Fly convergent photos instead (fieldcal refly)."
)


def adjust_k(
    reference: Annotated[
        str, typer.Argument(metavar="REFERENCE", help="The calibration to change: a name or a file.")
    ],
    line_of: Annotated[
        str | None,
        typer.Option("--line-of", metavar="NAME|FILE", help="Whose equifinal line (default: its own)."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Write the changed calibration (JSON).")
    ] = None,
    json_to: JsonOption = None,
) -> None:
    """Clip K1 into the equifinal domain and recompute K2, as [C&D] advise against; show what it costs."""
    before = load_reference(reference)
    camera = before.comparable_brown
    if camera is None or camera.width == 0:
        raise InputError(
            f"{before.name} holds no whole calibration with its image size, so nothing can be changed."
        )
    if out is not None:
        check_file_writable(out)
    owner = before if line_of is None else load_reference(line_of)
    if owner.width and owner.width != camera.width:
        raise InputError(
            f"The line of {owner.name} is for photos {owner.width} px wide, those of {before.name} are "
            f"{camera.width} px: K in pixel units change with the size; leave --line-of away."
        )
    line = _line(owner)
    radial = Radial.of(camera)
    if not radial.opposite_signs:
        raise InputError(
            f"K1 and K2 of {before.name} do not have opposite signs: the equifinal method does not apply."
        )
    clipped = clip_to_line(radial, line)
    f = camera.f_px
    after = replace(camera, k1=clipped.k1_px * f**2, k2=clipped.k2_px * f**4, k3=0.0, k4=0.0)
    cost = profile_deviation(radial, clipped, image_radius_px(camera))
    raw_rms, felt_rms = _rms_px(camera, after)
    if out is not None:
        write_reference_file(_changed(before, after, line), out)
    if json_to is not None:
        write_json(
            {
                "schema": SCHEMA,
                "camera": before.name,
                "advised_against": WARNING,
                "line": asdict(line),
                "inside_domain": bool(line.k1_min <= radial.k1_px <= line.k1_max),
                "before": asdict(radial),
                "after": asdict(clipped),
                "largest_px": cost.raw_px,
                "largest_felt_px": cost.linear_removed_px,
                "rms_px": raw_rms,
                "rms_felt_px": felt_rms,
            },
            json_to,
        )
    if json_to != "-":
        _show(before, radial, clipped, line, (cost.raw_px, raw_rms), (cost.linear_removed_px, felt_rms), out)


def _line(owner: Reference) -> EquifinalLine:
    """The published line where there is one, as [C&D] used it; else the closed form without K3."""
    if owner.line is not None:
        return owner.line
    if owner.width == 0:
        raise InputError(f"The image size of {owner.name} is not known, so it has no equifinal line.")
    radial, _ = radial_of(owner)
    return equifinal_region(radial, max(owner.width, owner.height) / 2).line


def _rms_px(before: BrownCamera, after: BrownCamera) -> tuple[float, float]:
    """Rms of what the projection changes over the image, as it is, and after the best focal length."""
    pixels = image_grid_px(before.width, before.height)
    rays = before.unproject(pixels)
    seen = np.isfinite(rays).all(axis=1)
    moved: FloatArray = after.project(rays[seen]) - pixels[seen]
    spread = pixels[seen] - [before.cx_px, before.cy_px]
    felt = moved - spread * float(np.sum(moved * spread) / np.sum(spread**2))
    return tuple(float(np.sqrt(np.mean(np.sum(v**2, axis=1)))) for v in (moved, felt))  # type: ignore[return-value]


def _changed(before: Reference, after: BrownCamera, line: EquifinalLine) -> Reference:
    """Without sigmas and residual field: both belonged to the calibration that it was."""
    return replace(
        before,
        name=f"{before.name}-adjusted-k",
        brown=after,
        fitted_brown=None,
        fitted_covariance=None,
        field_px=None,
        sigma={},
        covariance=None,
        source="fieldcal adjust-k",
        provenance=f"K1 and K2 of {before.name} forced onto a line, K3 dropped ({line.source})",
    )


def _show(
    before: Reference,
    radial: Radial,
    clipped: Radial,
    line: EquifinalLine,
    raw_px: tuple[float, float],
    felt_px: tuple[float, float],
    out: Path | None,
) -> None:
    say = console()
    paragraph(say, WARNING, "bold")
    say.print()
    inside = line.k1_min <= radial.k1_px <= line.k1_max
    paragraph(
        say,
        f"{before.name}: K1 {'lies within' if inside else 'was brought into'} the domain of the line "
        f"({line.source}), {line.k1_min:.3g} to {line.k1_max:.3g}; K2 is from the line, K3 is dropped.",
    )
    values = table("pixel units", "before", "after", numbers=("before", "after"))
    for name, one, two in zip(("K1", "K2", "K3"), radial.vector, clipped.vector, strict=True):
        values.add_row(name, f"{one:.4e}", f"{two:.4e}")
    say.print(values)
    say.print()
    columns = ("largest to half the width", "rms over the image")
    costs = table("what it costs, px", *columns, numbers=columns)
    costs.add_row("change of the projection", f"{raw_px[0]:.2f}", f"{raw_px[1]:.2f}")
    costs.add_row("after the best focal length", f"{felt_px[0]:.2f}", f"{felt_px[1]:.2f}")
    say.print(costs)
    paragraph(
        say,
        "The last row is what the photos then fit worse by: compare it with the residual of the alignment, "
        "half a pixel or so.",
    )
    if out is not None:
        say.print(Text(f"Wrote {out}"), soft_wrap=True)

"""``fieldcal perturb``: which (K1, K2) of a camera leave a flat wall flat."""

from __future__ import annotations

import csv
import io
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.progress import Progress

from calib.camera import BrownCamera
from calib.equifinal import STRICT_TOLERANCE_PX, Radial, image_radius_px
from calib.equifinal_montecarlo import cd_box
from calib.equifinal_published import radial_of
from calib.errors import InputError
from calib.files import output_folder, write_text_atomic
from calib.perturb import Perturbation, ZeroTangent, cubic_through, perturb, zero_tangent
from calib.reference import Reference
from calib.references import load_reference
from calib.wall import wall_block
from daemon.output import JsonOption, console, table, write_json

SCHEMA = "fieldcal.perturb/1"
_FEWEST, _MOST = 4, 200
_POINTS = 200


def perturb_command(
    camera: Annotated[
        str, typer.Option("--camera", metavar="NAME|FILE", help="A known camera or a calibration file.")
    ],
    grid: Annotated[int, typer.Option("--grid", metavar="N", help="N x N pairs of K1 and K2.")] = 15,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder for perturb.csv: every pair.")
    ] = None,
    json_target: JsonOption = None,
) -> None:
    """Hold K1 and K2, adjust a simulated flat wall again, and find where its dome vanishes."""
    if not _FEWEST <= grid <= _MOST:
        raise InputError(f"The grid must have from {_FEWEST} to {_MOST} values of K1 and of K2, not {grid}.")
    answer = _answer(load_reference(camera), grid)
    if out is not None:
        with output_folder(out):
            write_text_atomic(out / "perturb.csv", _csv(answer.found))
    if json_target is not None:
        write_json(answer.as_json(), json_target)
    if json_target != "-":
        _print(answer)


@dataclass(frozen=True)
class _Answer:
    reference: Reference
    found: Perturbation
    held: ZeroTangent
    free: ZeroTangent
    note: str

    def as_json(self) -> dict[str, object]:
        line = self.found.zero_line()
        return {
            "schema": SCHEMA,
            "camera": self.reference.name,
            "source": self.reference.source,
            "optimum": asdict(self.held.optimum),
            "applies": self.held.optimum.opposite_signs,
            "zero_line": line.tolist(),
            "cubic": cubic_through(line).tolist() if len(line) >= _FEWEST else None,
            "tangent": _line(self.held),
            "tangent_f_free": _line(self.free),
            "adjustments": int(self.found.x2.size),
            "note": self.note or None,
        }


def _line(tangent: ZeroTangent) -> dict[str, float]:
    return {
        "slope": tangent.slope,
        "intercept": tangent.intercept(tangent.optimum.k3_px),
        "intercept_without_k3": tangent.intercept(0.0),
    }


def _camera(reference: Reference) -> tuple[BrownCamera, str]:
    """The camera of ``reference``, of lines alone where no more was published."""
    if reference.width == 0:
        raise InputError(
            f"The image size of {reference.name} is not known; give a calibration file that has it."
        )
    if reference.comparable_brown is not None:
        return reference.comparable_brown, ""
    radial, note = radial_of(reference)
    f = reference.focal_px
    if f is None:
        raise InputError(f"Reference {reference.name} holds no focal length.")
    ideal = BrownCamera.ideal(reference.width, reference.height, f)
    k = (radial.k1_px * f**2, radial.k2_px * f**4, radial.k3_px * f**6)
    return BrownCamera(ideal.width, ideal.height, f, ideal.cx_px, ideal.cy_px, *k), note


def _answer(reference: Reference, grid: int) -> _Answer:
    camera, note = _camera(reference)
    adjustment, state = wall_block(camera, _POINTS)
    radial = Radial.of(camera)
    box = cd_box(radial, image_radius_px(camera), STRICT_TOLERANCE_PX, radial.k3_px)
    k1, k2 = (np.linspace(*ends, grid) for ends in box)
    # Progress to the terminal alone: stdout may be read by a program.
    with Progress(console=console(to_stderr=True), transient=True) as bar:
        task = bar.add_task("Adjusting the wall", total=grid * grid)
        found = perturb(adjustment, state, k1, k2, tick=lambda: bar.advance(task))
    held, free = (zero_tangent(adjustment, state, free_f=f) for f in (False, True))
    return _Answer(reference, found, held, free, note)


def _csv(found: Perturbation) -> str:
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["k1_px", "k2_px", "x2", "r2"])
    for row, k2 in enumerate(found.k2_px):
        for column, k1 in enumerate(found.k1_px):
            values = (k1, k2, found.x2[row, column], found.r2[row, column])
            rows.writerow([f"{v:.9g}" for v in values])
    return text.getvalue()


def _print(answer: _Answer) -> None:
    out, optimum = console(), answer.held.optimum
    out.print(f"{answer.reference.name}, in pixel units:")
    out.print(f"K1 {optimum.k1_px:.4g}, K2 {optimum.k2_px:.4g}, K3 {optimum.k3_px:.4g}")
    columns = ("slope", "with its K3", "without K3")
    lines = table("K2 = slope K1 + intercept", *columns, numbers=columns)
    for label, one in (("f held", answer.held), ("f free", answer.free)):
        lines.add_row(
            label,
            f"{one.slope:.3e}",
            f"{one.intercept(optimum.k3_px):.3e}",
            f"{one.intercept(0.0):.3e}",
        )
    out.print("No dome of the wall near the calibration:")
    out.print(lines)
    line = answer.found.zero_line()
    if len(line) >= _FEWEST:
        c3, c2, c1, c0 = cubic_through(line)
        out.print(f"By {answer.found.x2.size} adjustments, f held, K3 kept:")
        out.print(f"K2 = {c3:.3e} K1^3 + {c2:.3e} K1^2 + {c1:.3e} K1 + {c0:.3e}")
    else:
        out.print("The dome vanishes at fewer than four values of K1 within the grid: no curve is fitted.")
    if not optimum.opposite_signs:
        out.print("K1 and K2 do not have opposite signs, so they cannot compensate each other.")
    if answer.note:
        out.print(answer.note)

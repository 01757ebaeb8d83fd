"""``fieldcal equifinal``: the family of (K1, K2) that is as good as a camera's calibration."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated

import typer

from calib.equifinal import Radial, best_pair, equifinal_region
from calib.equifinal_montecarlo import MonteCarlo, monte_carlo
from calib.equifinal_published import radial_of
from calib.errors import InputError
from calib.reference import EquifinalLine, Reference
from calib.references import load_reference
from daemon.output import JsonOption, console, table, write_json

SCHEMA = "fieldcal.equifinal/1"


def equifinal(
    camera: Annotated[
        str, typer.Option("--camera", metavar="NAME|FILE", help="A known camera or a calibration file.")
    ],
    tolerance_px: Annotated[
        float, typer.Option("--tolerance-px", help="Largest difference of the distortion, px.")
    ] = 2.0,
    radius_px: Annotated[
        float | None, typer.Option("--radius-px", help="Image radius, px (default: half the longer side).")
    ] = None,
    draws: Annotated[
        int | None, typer.Option("--monte-carlo", metavar="N", help="Check by N random draws as well.")
    ] = None,
    json_target: JsonOption = None,
) -> None:
    """Line, band and domain of the (K1, K2) that give a camera's distortion within a tolerance."""
    answer = _answer(load_reference(camera), tolerance_px, radius_px, draws)
    if json_target is not None:
        write_json(answer.as_json(), json_target)
    if json_target != "-":
        _print(answer)


@dataclass(frozen=True)
class _Answer:
    """What the command found; ``without_k3`` and ``with_k3`` say which K3 the models have."""

    reference: Reference
    radial: Radial
    radius_px: float
    tolerance_px: float
    without_k3: EquifinalLine | None
    with_k3: EquifinalLine | None
    check: MonteCarlo | None
    notes: list[str]

    def as_json(self) -> dict[str, object]:
        def plain(value: EquifinalLine | MonteCarlo | None) -> dict[str, object] | None:
            return None if value is None else asdict(value)

        return {
            "schema": SCHEMA,
            "camera": self.reference.name,
            "source": self.reference.source,
            "radius_px": self.radius_px,
            "tolerance_px": self.tolerance_px,
            "optimum": asdict(self.radial),
            "applies": self.radial.opposite_signs,
            "line": plain(self.without_k3),
            "line_with_k3": plain(self.with_k3),
            "monte_carlo": plain(self.check),
            "published": plain(self.reference.line),
            "notes": self.notes,
        }


def _answer(reference: Reference, tolerance_px: float, radius_px: float | None, draws: int | None) -> _Answer:
    radial, note = radial_of(reference)
    notes = [note] if note else []
    radius = radius_px if radius_px is not None else _image_radius(reference)
    with_k3 = equifinal_region(radial, radius, tolerance_px, radial.k3_px).line
    _, misfit = best_pair(radial, radius)
    reachable = misfit < tolerance_px
    if not radial.opposite_signs:
        notes.append(
            "K1 and K2 do not have opposite signs, so they cannot compensate each other: the equifinal "
            "method does not apply to this lens."
        )
        return _Answer(reference, radial, radius, tolerance_px, None, None, None, notes)
    if not reachable:
        notes.append(
            f"No pair without K3 comes within {tolerance_px:g} px of this lens; the nearest is "
            f"{misfit:.2g} px away."
        )
    without_k3 = equifinal_region(radial, radius, tolerance_px).line if reachable else None
    check = None
    if draws is not None:
        check = monte_carlo(radial, radius, tolerance_px, 0.0 if reachable else radial.k3_px, draws)
    return _Answer(reference, radial, radius, tolerance_px, without_k3, with_k3, check, notes)


def _image_radius(reference: Reference) -> float:
    if reference.width == 0:
        raise InputError(
            f"The image size of {reference.name} is not known: give the radius with --radius-px."
        )
    return max(reference.width, reference.height) / 2


def _print(answer: _Answer) -> None:
    out = console()
    r = answer.radial
    out.print(f"{answer.reference.name}, in pixel units:")
    out.print(f"K1 {r.k1_px:.4g}, K2 {r.k2_px:.4g}, K3 {r.k3_px:.4g}")
    rows: list[tuple[str, EquifinalLine | MonteCarlo | None]] = [
        ("without K3", answer.without_k3),
        ("with its K3", answer.with_k3),
        ("Monte Carlo", answer.check),
        ("published", answer.reference.line),
    ]
    columns = ("slope", "intercept", "K1 from", "to", "K2 from", "to")
    lines = table("", *columns, numbers=columns)
    for label, line in rows:
        if line is not None:
            lines.add_row(
                label,
                f"{line.slope:.3e}",
                f"{line.intercept:.3e}",
                f"{line.k1_min:.2e}",
                f"{line.k1_max:.2e}",
                f"{line.k2_min:.2e}",
                f"{line.k2_max:.2e}",
            )
    if answer.radial.opposite_signs:
        out.print(
            f"Equifinal within {answer.tolerance_px:g} px over a radius of {answer.radius_px:g} px: "
            "K2 = slope K1 + intercept"
        )
        out.print(lines)
    band = answer.without_k3 or answer.with_k3
    if band is not None:
        out.print(f"Band: K2 within {band.band_k2_px:.2e} px^-4 of the line.")
    if answer.check is not None:
        check = answer.check
        out.print(f"Monte Carlo: {check.draws} draws, {100 * check.share:.2g} % of its box within tolerance.")
    for note in answer.notes:
        out.print(note)

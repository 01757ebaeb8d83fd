"""[C&D] Table 5: the signs of K1 and K2 of other cameras, and their lines in three ways."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.align.adjust import Adjustment, State
from calib.camera import BrownCamera
from calib.equifinal import Radial, best_pair, equifinal_region, image_radius_px
from calib.equifinal_montecarlo import monte_carlo
from calib.errors import FieldcalError
from calib.perturb import Perturber, zero_k2_px, zero_tangent
from calib.references import bundled_references
from calib.wall import wall_block
from sim.papers import plots, published
from sim.papers.common import Place, Section, computed
from sim.papers.lines import TOLERANCE_PX

#: A camera whose image size is not known is taken for one of this width in focal lengths, 4:3.
ASSUMED_WIDTH = 1.5


@dataclass(frozen=True)
class Lens:
    """One camera of Table 5."""

    name: str
    points: int = 400
    draws: int = 200_000


def camera_of(name: str) -> tuple[BrownCamera, bool]:
    """The library's camera, and whether its image size had to be assumed."""
    (reference,) = [r for r in bundled_references() if r.name == name]
    assert reference.brown is not None  # all of Table 5 have one
    camera = reference.brown
    if camera.width > 0:
        return camera, False
    width = round(ASSUMED_WIDTH * camera.f_px)
    height = round(0.75 * width)
    return replace(camera, width=width, height=height, cx_px=width / 2, cy_px=height / 2), True


def compared(case: Lens) -> dict[str, Any]:
    """Lines of one lens. Slopes times -R^2 have no unit: the closed form's is the same for every lens."""
    camera, assumed = camera_of(case.name)
    radial, radius = Radial.of(camera), image_radius_px(camera)
    found: dict[str, Any] = {
        "k": [camera.k1, camera.k2, camera.k3],
        "f": camera.f_px,
        "width": camera.width,
        "assumed": assumed,
        "opposite": radial.opposite_signs,
        "without_k3_px": best_pair(radial, radius)[1],
    }
    square = -(radius**2)
    closed = equifinal_region(radial, radius, TOLERANCE_PX, radial.k3_px)
    sampled = monte_carlo(radial, radius, TOLERANCE_PX, radial.k3_px, draws=case.draws)
    found["closed"], found["sampled"] = closed.slope * square, sampled.slope * square
    try:
        adjustment, state = wall_block(camera, case.points)
        held, free = (zero_tangent(adjustment, state, free_f=f) for f in (False, True))
        found["held"], found["free"] = held.slope * square, free.slope * square
        found["left"] = float(np.linalg.norm(free.by_k[:2] / held.by_k[:2]) / np.sqrt(2))
        reached = np.linalg.norm(adjustment.obs.pixels - [camera.cx_px, camera.cy_px], axis=1)
        found["reached"] = float(reached.max() / radius)
        found["roots"] = _roots(adjustment, state, radius) * square
    except FieldcalError as error:
        found["fault"] = str(error)
    return found


def _roots(adjustment: Adjustment, state: State, radius_px: float) -> float:
    """Slope of the zero line from adjustments, K1 moved by half a tolerance either way."""
    tangent, perturber = zero_tangent(adjustment, state), Perturber(adjustment, state)
    optimum, reach = tangent.optimum, 2 * TOLERANCE_PX / radius_px**5
    step = 0.5 * TOLERANCE_PX / radius_px**3
    low, high = (
        zero_k2_px(perturber, state.lens, optimum.k1_px + move, optimum.k2_px + tangent.slope * move, reach)
        for move in (-step, step)
    )
    return (high - low) / (2 * step)


def section(place: Place, points: int = 400, draws: int = 200_000) -> Section:
    """The survey of signs, and the lines of each lens."""
    page = Section("6. Other cameras: [C&D] Table 5")
    cases = [Lens(name, points, draws) for name in published.TABLE_5]
    results = computed("lenses", compared, cases, place)
    opposite = sum(r["opposite"] for r in results)
    page.say(
        f"K1 and K2 have opposite signs in {opposite} of {len(results)} cameras (theirs: all). For each, the "
        "line of equally good pairs in three ways: closed form and Monte Carlo over the half width R with "
        "K3 kept, and the zero line of the flat wall, linearised and by adjustments. To compare lenses the "
        "slopes are multiplied by -R^2. *Radius*: where a closed form would have the zero line's slope, "
        "in R; *reached*: the outermost measurement. *Dome left*: how much of a dome survives when f may "
        "follow. *No K3*: how far the best pair without K3 stays from the lens."
    )
    rows = []
    for case, r in zip(cases, results, strict=True):
        size = f"{r['width']}{' (assumed)' if r['assumed'] else ''}"
        cells = [case.name, size, "{:+.3g} {:+.3g} {:+.3g}".format(*r["k"])]
        cells += [f"{r['without_k3_px']:.2g} px", f"{r['closed']:.3f}", f"{r['sampled']:.3f}"]
        if "fault" in r:
            cells += [r["fault"]] + [""] * 5
        else:
            cells += [f"{r['held']:.3f}", f"{r['roots']:.3f}", _radius(r), f"{r['reached']:.2f}"]
            cells += [f"{r['free']:.2f}", f"{100 * r['left']:.0f} %"]
        rows.append(tuple(cells))
    page.table(
        (
            *("camera", "width px", "K1 K2 K3 (focal units)", "no K3", "closed form", "Monte Carlo"),
            *("wall, f held", "by adjustments", "radius R", "reached R", "wall, f free", "dome left"),
        ),
        rows,
    )
    good = [r for r in results if "fault" not in r]
    near = [r for r in good if r["held"] > 0 and 0.9 < float(np.sqrt(r["closed"] / r["held"])) < 1.25]
    page.say(
        "**What theory says, and what comes out.** The slope of the closed form is -1.054/R^2 for every "
        "lens, "
        "K3 or not: K3 moves the line, it does not turn it, and the Monte Carlo agrees. (Without K3 the "
        "region is cut obliquely and the slope of its regression changes by a percent or two.) The zero line "
        "of the wall weighs a profile by what it does to the wall's shape. Its slope is that of a closed "
        "form over the radius which the measurements reach, somewhat beyond R, in the corners: so in "
        f"{len(near)} of {len(good)} lenses, to within 25 % of R. It need not: of a lens whose K3 bends the "
        "edge of the image strongly (SX170) the outer field pulls the other way. With f free, f takes up "
        "part "
        f"of the dome ({100 * min(r['left'] for r in good):.0f} % is left in the extreme), and where "
        "little is "
        "left its slope says nothing about the lens.",
    )
    page.figure(_figure(place, cases, results), "Slopes of the lines of the eleven cameras, times -R^2.")
    return page


def _radius(result: dict[str, Any]) -> str:
    return f"{np.sqrt(result['closed'] / result['held']):.2f}" if result["held"] > 0 else "none"


def _figure(place: Place, cases: list[Lens], results: list[dict[str, Any]]) -> Path:
    made, (axis,) = plots.figure(1, height=4.2)
    places = np.arange(len(cases))
    for key, label, mark, colour in (
        ("closed", "closed form", "s", plots.THEIRS),
        ("sampled", "Monte Carlo", "x", "#111111"),
        ("held", "flat wall, f held, linearised", "o", plots.OURS),
        ("roots", "flat wall, f held, adjustments", "+", plots.THIRD),
    ):
        values = [r.get(key, np.nan) for r in results]
        axis.plot(values, places, mark, color=colour, label=label, ms=8, mfc="none", mew=1.8)
    axis.set_yticks(places, [case.name for case in cases])
    axis.set_xlabel("-slope x R^2")
    axis.invert_yaxis()
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return plots.save(made, place.figures, "lenses")

"""[C&D] eq. 5 and 6, fig. 4 and 5: profiles and the lines of equifinal K1 and K2."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calib.camera import FloatArray, radial_profile_px
from calib.equifinal import Radial, equifinal_region
from calib.equifinal_montecarlo import monte_carlo
from calib.equifinal_published import (
    CD_BOX,
    CD_RADIUS_PX,
    CUBIC_8,
    LINE_5,
    LINE_6,
    P3P_WALL,
    implied_optimum,
)
from calib.reference import EquifinalLine
from sim.papers import plots
from sim.papers.common import Place, Section, percent_off, sci

TOLERANCE_PX = 2.0
#: Phantom 3: the published wall. Inspire 1: what its two published lines imply (none was printed).
CAMERAS: dict[str, tuple[Radial, EquifinalLine, str]] = {
    "Phantom 3": (P3P_WALL, LINE_5, "(5)"),
    "Inspire 1": (implied_optimum(LINE_6, CUBIC_8), LINE_6, "(6)"),
}


def best_radius_px(optimum: Radial, slope: float) -> float:
    """The radius for which the closed form has this slope: it goes with 1 / R^2."""
    return CD_RADIUS_PX * float(np.sqrt(equifinal_region(optimum, CD_RADIUS_PX, TOLERANCE_PX).slope / slope))


def deviation_px(optimum: Radial, k1_px: FloatArray, k2_px: FloatArray) -> FloatArray:
    """Largest difference of the profile over 0..2000 px for models without K3, (b, a)."""
    r = np.linspace(0, CD_RADIUS_PX, 201)
    target = radial_profile_px(optimum.k1_px, optimum.k2_px, optimum.k3_px, r)
    k1, k2 = np.meshgrid(k1_px, k2_px)
    largest: FloatArray = np.zeros(k1.shape)
    for radius, value in zip(r, target, strict=True):
        largest = np.maximum(largest, np.abs(k1 * radius**3 + k2 * radius**5 - value))
    return largest


def section(place: Place, draws: int = 1_000_000) -> Section:
    """Lines and profiles, ours beside theirs."""
    page = Section("1. Equifinal lines: [C&D] eq. 5 and 6, fig. 4 and 5")
    page.say(
        "The profile over r = 0..2000 px of models without K3 against the wall calibration; within 2 px. "
        "Closed form: the exact regression over the convex region of all such pairs. Monte Carlo: "
        f"{draws} draws from their box."
    )
    rows = []
    for name, (optimum, line, number) in CAMERAS.items():
        region = equifinal_region(optimum, CD_RADIUS_PX, TOLERANCE_PX)
        sampled = monte_carlo(optimum, CD_RADIUS_PX, TOLERANCE_PX, draws=draws, box=CD_BOX)
        radius = best_radius_px(optimum, line.slope)
        closer = equifinal_region(optimum, radius, TOLERANCE_PX).line
        for label, one in (
            (f"theirs {number}", line),
            ("ours, closed form", region.line),
            ("ours, Monte Carlo", sampled),
            (f"ours, closed form, R = {radius:.0f} px", closer),
        ):
            off = "" if one is line else percent_off(one.slope, line.slope)
            off2 = "" if one is line else percent_off(one.intercept, line.intercept)
            rows.append(
                (
                    *(name, label, sci(one.slope), off, sci(one.intercept), off2),
                    f"{one.k1_min * 1e8:.2f} .. {one.k1_max * 1e8:.2f}",
                    f"{one.k2_min * 1e15:.2f} .. {one.k2_max * 1e15:.2f}",
                )
            )
    page.table(("camera", "line", "slope px^-2", "off", "intercept px^-4", "off", "K1 e-8", "K2 e-15"), rows)
    page.say(
        "**Where they differ.** Monte Carlo and closed form agree with each other, so neither is at fault: "
        "over 2000 px our line is flatter than (5). The slope goes with 1/R^2; the last row of each camera "
        "has the radius, a little shorter than the half width, at which it would be theirs. Their domains "
        "are narrower than ours; they read theirs off draws interpolated to a grid, which may lose the "
        "thin ends of the region. The Inspire 1's wall calibration is not printed; ours is the one that "
        "(6) and (8) together imply, so its agreement is partly by construction."
    )
    page.figure(_profiles(place), "Fig. 4 again: the three terms of the Phantom 3's wall calibration.")
    page.figure(_maps(place), "Fig. 5 again: largest deviation in px of models without K3, with both lines.")
    return page


def _profiles(place: Place) -> Path:
    made, (terms, rest) = plots.figure(2, height=3.6)
    r = np.linspace(0, CD_RADIUS_PX, 400)
    o = P3P_WALL
    for label, k, colour, dash in (
        ("K1", (o.k1_px, 0, 0), plots.OURS, "-"),
        ("K2", (0, o.k2_px, 0), plots.THEIRS, "--"),
        ("K3", (0, 0, o.k3_px), plots.THIRD, "-."),
        ("sum", (o.k1_px, o.k2_px, o.k3_px), "#111111", ":"),
    ):
        terms.plot(r, radial_profile_px(k[0], k[1], k[2], r), dash, color=colour, label=label, lw=2)
    terms.set(xlabel="radius px", ylabel="displacement px", title="terms of the profile")
    terms.legend()
    whole = radial_profile_px(o.k1_px, o.k2_px, o.k3_px, r)
    line = equifinal_region(o, CD_RADIUS_PX, TOLERANCE_PX).line
    ends = np.linspace(line.k1_min, line.k1_max, 5)
    for k1 in ends:
        k2 = line.intercept + line.slope * k1
        rest.plot(r, radial_profile_px(float(k1), float(k2), 0, r) - whole, lw=1.5, label=f"K1 {k1:.2e}")
    rest.axhspan(-TOLERANCE_PX, TOLERANCE_PX, color=plots.GRID, alpha=0.5)
    rest.set(xlabel="radius px", ylabel="difference px", title="pairs on our line (no K3) minus the wall")
    rest.legend(fontsize=8)
    return plots.save(made, place.figures, "profiles")


def _maps(place: Place) -> Path:
    made, axes = plots.figure(2, height=4.4)
    (k1_low, k1_high), (k2_low, k2_high) = CD_BOX
    k1, k2 = np.linspace(k1_low, k1_high, 241), np.linspace(k2_low, k2_high, 241)
    for axis, (name, (optimum, line, number)) in zip(axes, CAMERAS.items(), strict=True):
        levels = [0, 2, 5, 10, 20, 40, 80]
        filled = axis.contourf(
            k1 * 1e8, k2 * 1e15, deviation_px(optimum, k1, k2), levels, cmap="viridis_r", extend="max"
        )
        own = equifinal_region(optimum, CD_RADIUS_PX, TOLERANCE_PX).line
        for one, colour, width, label in (
            (own, plots.OURS, 4.0, "ours"),
            (line, "white", 1.6, f"theirs {number}"),
        ):
            ends = np.array([one.k1_min, one.k1_max])
            axis.plot(
                ends * 1e8, (one.intercept + one.slope * ends) * 1e15, color=colour, lw=width, label=label
            )
        axis.plot(optimum.k1_px * 1e8, optimum.k2_px * 1e15, "k+", ms=10, label="wall (has K3)")
        axis.set(xlabel="K1 e-8 px^-2", ylabel="K2 e-15 px^-4", title=name)
        axis.grid(visible=False)
        axis.legend(loc="upper right", facecolor="#999999")
        made.colorbar(filled, ax=axis, label="px")
    return plots.save(made, place.figures, "equifinal")

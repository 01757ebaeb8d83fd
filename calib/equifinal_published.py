"""The equifinal lines that [C&D] publish, and what can be derived from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.camera import FloatArray
from calib.equifinal import MINIMAX_ALPHA, MINIMAX_BETA, Radial
from calib.errors import InputError
from calib.reference import EquifinalLine, Reference

#: Half width of the 4000x3000 images of [C&D], px.
CD_RADIUS_PX = 2000.0
#: Range of the Monte Carlo of [C&D]: K1 in px^-2, K2 in px^-4.
CD_BOX = ((-3.7e-8, -1.9e-8), (1.7e-15, 7.0e-15))

#: Phantom 3 Professional, flat wall, f = 2320.06 px ([C&D] results).
P3P_WALL = Radial(-2.53e-8, 3.96e-15, -1.15e-22)
P3P_WALL_F_PX = 2320.06

LINE_5 = EquifinalLine(
    -2.7364e-7,
    -3.4086e-15,
    -2.56e-8,
    -2.35e-8,
    2.97e-15,
    3.62e-15,
    None,
    "[C&D] eq. 5, Phantom 3 Professional",
)
LINE_6 = EquifinalLine(
    -2.7335e-7, -3.5858e-15, -2.46e-8, -2.25e-8, 2.52e-15, 3.18e-15, None, "[C&D] eq. 6, Inspire 1"
)


@dataclass(frozen=True)
class EquifinalCubic:
    """K2 = c3 K1^3 + c2 K1^2 + c1 K1 + c0 in pixel units: no doming of the flat wall, K3 kept."""

    c3: float
    c2: float
    c1: float
    c0: float
    source: str

    def k2_px(self, k1_px: float) -> float:
        return ((self.c3 * k1_px + self.c2) * k1_px + self.c1) * k1_px + self.c0


CUBIC_7 = EquifinalCubic(-2.392e8, -18.264, -6.924e-7, -5.887e-15, "[C&D] eq. 7, Phantom 3 Professional")
CUBIC_8 = EquifinalCubic(-2.781e8, -19.604, -6.900e-7, -5.362e-15, "[C&D] eq. 8, Inspire 1")


def rescaled(radial: Radial, f_px: float, to_f_px: float) -> Radial:
    """The same distortion in focal units, in the pixel units of another focal length ([C&D] eq. 1-3)."""
    q = (f_px / to_f_px) ** 2
    return Radial(radial.k1_px * q, radial.k2_px * q**2, radial.k3_px * q**3)


def implied_optimum(line: EquifinalLine, cubic: EquifinalCubic, radius_px: float = CD_RADIUS_PX) -> Radial:
    """A wall calibration (K1, K2, K3) from which a published line and cubic would both follow.

    [C&D] print no wall calibration of the Inspire 1. Two things tie it down: without K3 the pair
    nearest to it lies in the middle of the line's domain, on the line; with K3 it lies on the
    cubic. Of the Phantom 3 Professional, where the wall is known, this gives K1 to 0.3 %, K2 to
    4 % and K3 to 30 %, so it is good for drawing the line, not for judging a survey to 0.1 %.

    Raises:
        InputError: line and cubic have no common solution.
    """
    k1_mid = (line.k1_min + line.k1_max) / 2
    k2_mid = line.intercept + line.slope * k1_mid

    def at(k3: float) -> Radial:
        return Radial(
            k1_mid - MINIMAX_ALPHA * k3 * radius_px**4, k2_mid - MINIMAX_BETA * k3 * radius_px**2, k3
        )

    def miss(k3: float) -> float:
        optimum = at(k3)
        return (optimum.k2_px - cubic.k2_px(optimum.k1_px)) * radius_px**5

    # K3 of up to 100 px at the edge, as seen on no rectilinear lens.
    limit = 100 / radius_px**7
    grid: FloatArray = np.linspace(-limit, limit, 401)
    values = [miss(float(k3)) for k3 in grid]
    roots = [i for i in range(len(grid) - 1) if values[i] * values[i + 1] <= 0]
    if not roots:
        raise InputError(f"{line.source} and {cubic.source} have no common wall calibration.")
    nearest = min(roots, key=lambda i: abs(float(grid[i])))
    from scipy.optimize import brentq  # Slow to load.

    return at(float(brentq(miss, float(grid[nearest]), float(grid[nearest + 1]), xtol=limit * 1e-9)))


def clip_to_line(radial: Radial, line: EquifinalLine) -> Radial:
    """K1 forced into the line's domain and K2 recomputed from the line, K3 dropped.

    [C&D] tried it: it removes the dome and raises the noise (fig. 7), so it is no repair. Only
    for those who ask for it all the same.
    """
    k1 = min(max(radial.k1_px, line.k1_min), line.k1_max)
    return Radial(k1, line.intercept + line.slope * k1)


def radial_of(reference: Reference) -> tuple[Radial, str]:
    """K1-K3 of a reference in pixel units, and a note where they are only implied by a line.

    Raises:
        InputError: neither calibration nor implied values are known.
    """
    if reference.comparable_brown is not None:
        return Radial.of(reference.comparable_brown), ""
    if reference.implied_radial_px is not None:
        note = f"K1-K3 of {reference.name} are not published; they are derived from its published lines."
        return Radial(*reference.implied_radial_px), note
    raise InputError(
        f"Reference {reference.name} holds no distortion that an equifinal line could be made from."
    )

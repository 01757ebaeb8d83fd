"""Which (K1, K2) leave a flat thing flat: the perturbation experiment of [C&D] (fig. 6, eq. 7 and 8).

The lens is held at one (K1, K2) after another, all its other parameters as they are; poses and points
are adjusted again; a second-order surface through the points shows the dome by its x2 coefficient.
Where that vanishes lies the zero line. K are in pixel units throughout and f is held, so a K in
pixel units is K f^-2, K f^-4 in focal units.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq

from calib.align.adjust import Adjustment, State
from calib.camera import FloatArray
from calib.equifinal import Radial
from calib.errors import InputError
from calib.field import LENS_NAMES, Lens
from calib.similarity import fit_similarity

_HELD = np.zeros(len(LENS_NAMES), bool)
#: A thirtieth of a sigma from the optimum is near enough; few steps reach it from a neighbour.
_DECREMENT, _STEPS = 1e-3, 40


@dataclass(frozen=True)
class Quadric:
    """z = c0 + cx x + cy y + cxx x2 + cxy x y + cyy y2 of points scaled to -1..1 in x.

    ``coefficients`` (6,) in that order, in half widths of the thing; ``r2``: share of the variance of z
    that it explains.
    """

    coefficients: FloatArray
    r2: float

    @property
    def x2(self) -> float:
        """Height of the edges over the middle, in half widths: positive for a dish."""
        return float(self.coefficients[3])


def _design(xy: FloatArray) -> FloatArray:
    x, y = xy[:, 0], xy[:, 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def quadric(points_m: FloatArray) -> Quadric:
    """Second-order surface through points (m, 3), centred and scaled to half their width in x.

    Raises:
        InputError: fewer than seven points, or all of them at one x.
    """
    middle = (points_m.max(axis=0) + points_m.min(axis=0)) / 2
    half = float(np.ptp(points_m[:, 0])) / 2
    if len(points_m) < 7 or not half > 0:
        raise InputError("A second-order surface needs seven points that are apart from each other.")
    scaled = (points_m - middle) / half
    design = _design(scaled)
    coefficients, *_ = np.linalg.lstsq(design, scaled[:, 2], rcond=None)
    rest = float(np.sum((scaled[:, 2] - design @ coefficients) ** 2))
    total = float(np.sum((scaled[:, 2] - scaled[:, 2].mean()) ** 2))
    return Quadric(coefficients, 1 - rest / total if total > 0 else 1.0)


def held_at(lens: Lens, k1_px: float, k2_px: float, k3_px: float | None = None) -> Lens:
    """``lens`` with other K1, K2 (and K3) in pixel units."""
    f = lens.brown.f_px
    k3 = lens.brown.k3 if k3_px is None else k3_px * f**6
    return replace(lens, brown=replace(lens.brown, k1=k1_px * f**2, k2=k2_px * f**4, k3=k3))


class Perturber:
    """A block whose lens is held at chosen values; every adjustment starts from the one before.

    All measurements weigh the same whatever the lens: robust weights would take a wrong lens's
    residuals for blunders.
    """

    def __init__(self, adjustment: Adjustment, state: State) -> None:
        """``state``: the block as its own calibration gives it; its points are the level ones."""
        self._adjustment = adjustment
        self._level = state.points_m
        self.state = state
        self._weights = (np.ones(len(adjustment.obs)), np.ones(len(state.centres_m)))

    def surface(self, lens: Lens) -> Quadric:
        """The second-order surface through the points with the lens held."""
        adjusted = self._adjustment.run(
            replace(self.state, lens=lens),
            _HELD,
            max_iterations=_STEPS,
            decrement=_DECREMENT,
            weights=self._weights,
            damping=1e-9,
        )
        self.state = adjusted.state
        points = adjusted.state.points_m
        return quadric(fit_similarity(points, self._level).apply(points))


@dataclass(frozen=True)
class Perturbation:
    """x2 coefficient and R2 of the surface over a grid: k1_px (a,), k2_px (b,), x2 and r2 (b, a).

    ``x2`` in half widths of the wall; K in pixel units.
    """

    k1_px: FloatArray
    k2_px: FloatArray
    x2: FloatArray
    r2: FloatArray

    def every(self, step: int) -> Perturbation:
        """The grid thinned to every ``step``-th value of either axis."""
        return Perturbation(
            self.k1_px[::step], self.k2_px[::step], self.x2[::step, ::step], self.r2[::step, ::step]
        )

    def zero_line(self) -> FloatArray:
        """(c, 2): K1 and K2 where x2 vanishes, by linear interpolation along K2 at each K1."""
        found = []
        for column, k1 in enumerate(self.k1_px):
            x2 = self.x2[:, column]
            turns = np.flatnonzero(np.sign(x2[:-1]) * np.sign(x2[1:]) < 0)
            if len(turns):
                # More than one change of sign is noise about zero: the middle one.
                i = turns[len(turns) // 2]
                share = x2[i] / (x2[i] - x2[i + 1])
                found.append((k1, self.k2_px[i] + share * (self.k2_px[i + 1] - self.k2_px[i])))
        return np.array(found).reshape(-1, 2)


def perturb(
    adjustment: Adjustment,
    state: State,
    k1_px: FloatArray,
    k2_px: FloatArray,
    tick: Callable[[], None] | None = None,
) -> Perturbation:
    """Hold (K1, K2) at every pair of k1_px (a,) and k2_px (b,), adjust again, fit the surface.

    Args:
        state: where the block stands with its own calibration; f, principal point and K3 stay.
        tick: called once a pair.
    """
    block = Perturber(adjustment, state)
    x2, r2 = (np.empty((len(k2_px), len(k1_px))) for _ in range(2))
    for column, k1 in enumerate(k1_px):
        # There and back, so that each pair has a neighbour behind it.
        rows = range(len(k2_px)) if column % 2 == 0 else range(len(k2_px) - 1, -1, -1)
        for row in rows:
            surface = block.surface(held_at(state.lens, float(k1), float(k2_px[row])))
            x2[row, column], r2[row, column] = surface.x2, surface.r2
            if tick is not None:
                tick()
    return Perturbation(k1_px, k2_px, x2, r2)


def zero_k2_px(block: Perturber, lens: Lens, k1_px: float, guess_px: float, reach_px: float) -> float:
    """K2 at which the block stays flat for ``k1_px``, between guess - reach and guess + reach.

    Raises:
        InputError: the dome does not vanish in between.
    """

    def x2(share: float) -> float:
        return block.surface(held_at(lens, k1_px, guess_px + share * reach_px)).x2

    try:
        share = float(brentq(x2, -1.0, 1.0, xtol=1e-4))
    except ValueError as error:
        raise InputError("The dome does not vanish between the given values of K2.") from error
    return guess_px + share * reach_px


@dataclass(frozen=True)
class ZeroTangent:
    """How the zero line runs at the calibration itself, to first order.

    ``by_k`` (3,): d x2 / d K1, K2, K3 in half widths per pixel unit; ``slope``: d K2 / d K1 in px^-2;
    ``optimum``: where the line passes through.
    """

    optimum: Radial
    by_k: FloatArray

    @property
    def slope(self) -> float:
        return float(-self.by_k[0] / self.by_k[1])

    def intercept(self, k3_model_px: float) -> float:
        """K2 at K1 = 0 of the line for models whose K3 is ``k3_model_px``."""
        moved = self.by_k[2] / self.by_k[1] * (k3_model_px - self.optimum.k3_px)
        return float(self.optimum.k2_px - self.slope * self.optimum.k1_px - moved)


def zero_tangent(adjustment: Adjustment, state: State, free_f: bool = False) -> ZeroTangent:
    """The zero line's tangent at ``state``, from the adjustment's own linearisation: no sampling.

    Args:
        free_f: whether the focal length follows K ([C&D] held it).
    """
    names = ("f", "k1", "k2", "k3")
    free = np.array([name in names for name in LENS_NAMES])
    weights = (np.ones(len(adjustment.obs)), np.ones(len(state.centres_m)))
    adjusted = adjustment.run(state, free, 0, weights=weights, response=True)
    assert adjusted.point_response is not None  # asked for
    by_lens = adjusted.point_response[:, :, free]
    response = by_lens[:, :, 1:]
    if free_f:
        normal = adjusted.lens_normal
        follow = -normal[0, 1:] / normal[0, 0]
        response = response + by_lens[:, :, :1] * follow
    points = state.points_m
    half = float(np.ptp(points[:, 0])) / 2
    middle = (points.max(axis=0) + points.min(axis=0)) / 2
    by_focal = np.linalg.lstsq(_design((points - middle) / half), response[:, 2] / half, rcond=None)[0][3]
    f = state.lens.brown.f_px
    return ZeroTangent(Radial.of(state.lens.brown), by_focal * np.array([f**2, f**4, f**6]))


def cubic_through(line: FloatArray) -> FloatArray:
    """c3, c2, c1, c0 of K2 = c3 K1^3 + c2 K1^2 + c1 K1 + c0 through (c, 2) pairs ([C&D] eq. 7, 8).

    Raises:
        InputError: fewer than four pairs.
    """
    if len(line) < 4:
        raise InputError("The zero line crosses the grid at fewer than four values of K1.")
    scale1, scale2 = float(np.abs(line[:, 0]).max()), float(np.abs(line[:, 1]).max())
    scaled = np.polynomial.polynomial.polyfit(line[:, 0] / scale1, line[:, 1] / scale2, 3)
    cubic: FloatArray = (scaled * scale2 / scale1 ** np.arange(4))[::-1]
    return cubic

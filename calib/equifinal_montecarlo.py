"""Monte Carlo of [C&D] fig. 5: the check of the closed form in calib.equifinal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.camera import FloatArray
from calib.equifinal import STRICT_TOLERANCE_PX, Radial, best_pair
from calib.equifinal_published import CD_BOX, CD_RADIUS_PX, P3P_WALL
from calib.errors import InputError
from calib.solution import IntArray

Box = tuple[tuple[float, float], tuple[float, float]]

_CHUNK = 2**18
_STEPS = 250
_FEWEST_HITS = 12
#: Sobol' sequences of 30 bits repeat after this many draws.
_MOST_DRAWS = 2**30


@dataclass(frozen=True)
class MonteCarlo:
    """Regression of K2 on K1 over the draws within tolerance; K in pixel units.

    ``sigma_slope``, ``sigma_intercept`` are for independent draws; the draws are evenly spread
    (Sobol'), so the true error is several times smaller.
    """

    slope: float
    intercept: float
    sigma_slope: float
    sigma_intercept: float
    k1_min: float
    k1_max: float
    k2_min: float
    k2_max: float
    draws: int
    #: Draws within tolerance that the regression is over, and the share of the box they stand for.
    within: int
    share: float
    box: Box


def cd_box(
    reference: Radial,
    radius_px: float,
    tolerance_px: float = STRICT_TOLERANCE_PX,
    k3_model_px: float = 0.0,
) -> Box:
    """The range of draws of [C&D], carried over to another lens, radius and tolerance.

    For their Phantom 3 at 2 px and 2000 px this is their box. For another lens the box keeps
    its size in px at the edge of the image per px of tolerance, and its place relative to the
    nearest pair (K1, K2).
    """
    theirs, _ = best_pair(P3P_WALL, CD_RADIUS_PX)
    pair, _ = best_pair(reference, radius_px, k3_model_px)
    grow = tolerance_px / STRICT_TOLERANCE_PX
    by_k1 = grow * (CD_RADIUS_PX / radius_px) ** 3
    by_k2 = grow * (CD_RADIUS_PX / radius_px) ** 5
    (k1_low, k1_high), (k2_low, k2_high) = CD_BOX
    return (
        (pair.k1_px + (k1_low - theirs.k1_px) * by_k1, pair.k1_px + (k1_high - theirs.k1_px) * by_k1),
        (pair.k2_px + (k2_low - theirs.k2_px) * by_k2, pair.k2_px + (k2_high - theirs.k2_px) * by_k2),
    )


def monte_carlo(
    reference: Radial,
    radius_px: float,
    tolerance_px: float = STRICT_TOLERANCE_PX,
    k3_model_px: float = 0.0,
    draws: int = 1_000_000,
    seed: int = 0,
    box: Box | None = None,
) -> MonteCarlo:
    """Draw (K1, K2) uniformly from ``box``, keep those within tolerance, regress K2 on K1.

    Half of the draws covers the box as in [C&D]; only a few in a thousand of them come
    within tolerance. The rest is drawn, as uniformly, from the part of the box where those few
    lie (their oblong, half as large again), and the regression is over its hits: the same
    region at a hundred times the density. The draws are scrambled Sobol' sequences.

    Raises:
        InputError: too few or too many draws, or hardly any of them within the tolerance.
    """
    if not 1000 <= draws <= _MOST_DRAWS:
        raise InputError(f"The Monte Carlo takes from 1000 to {_MOST_DRAWS} draws, not {draws}.")
    box = box or cd_box(reference, radius_px, tolerance_px, k3_model_px)
    low = np.array([box[0][0], box[1][0]])
    span = np.array([box[0][1], box[1][1]]) - low
    rng = np.random.default_rng(seed)

    def hits_in(origin: FloatArray, edges: FloatArray, count: int) -> FloatArray:
        """Hits (h, 2) in units of the box, of draws from origin + u edges[0] + v edges[1]."""
        from scipy.stats import qmc  # Half a second to load, and only this command needs it.

        engine = qmc.Sobol(2, scramble=True, rng=rng)
        kept = []
        for start in range(0, count, _CHUNK):
            # Whole chunks keep the sequence balanced; the surplus of the last one is cut off.
            unit = origin + engine.random(_CHUNK)[: count - start] @ edges
            unit = unit[np.all((unit >= 0) & (unit <= 1), axis=1)]
            k1, k2 = (low + span * unit).T
            kept.append(unit[_within(k1, k2, reference, radius_px, tolerance_px, k3_model_px)])
        return np.concatenate(kept)

    coarse = hits_in(np.zeros(2), np.eye(2), draws // 2)
    if len(coarse) < _FEWEST_HITS:
        raise InputError(
            f"Only {len(coarse)} of {draws // 2} draws come within {tolerance_px:g} px of the reference: "
            "ask for more draws or a larger tolerance."
        )
    _, axes = np.linalg.eigh(np.cov(coarse.T))
    along = coarse @ axes
    middle, half = (along.max(axis=0) + along.min(axis=0)) / 2, np.ptp(along, axis=0) * 0.75
    fine = hits_in((middle - half) @ axes.T, 2 * half[:, None] * axes.T, draws - draws // 2)
    hits = low + span * fine
    mean = hits.mean(axis=0)
    x, y = ((hits - mean) / span).T
    slope = float(x @ y / (x @ x))
    scatter = float(np.sqrt(np.mean((y - slope * x) ** 2) / (x @ x)))
    per_unit = float(span[1] / span[0])
    return MonteCarlo(
        slope=slope * per_unit,
        intercept=float(mean[1] - slope * per_unit * mean[0]),
        sigma_slope=scatter * per_unit,
        sigma_intercept=scatter * per_unit * abs(float(mean[0])),
        k1_min=float(hits[:, 0].min()),
        k1_max=float(hits[:, 0].max()),
        k2_min=float(hits[:, 1].min()),
        k2_max=float(hits[:, 1].max()),
        draws=draws,
        within=len(hits),
        share=len(coarse) / (draws // 2),
        box=box,
    )


def _within(
    k1: FloatArray,
    k2: FloatArray,
    reference: Radial,
    radius_px: float,
    tolerance_px: float,
    k3_model_px: float,
) -> IntArray:
    """Indices of the draws whose profile stays within tolerance at every sampled radius."""
    a = (k1 - reference.k1_px) * radius_px**3
    b = (k2 - reference.k2_px) * radius_px**5
    c = (k3_model_px - reference.k3_px) * radius_px**7
    left = np.arange(len(a))
    # From the edge inwards: the edge rejects most of the draws at once.
    for s in np.linspace(1, 0, _STEPS, endpoint=False):
        good = np.abs(a[left] * s**3 + b[left] * s**5 + c * s**7) <= tolerance_px
        left = left[good]
    return left

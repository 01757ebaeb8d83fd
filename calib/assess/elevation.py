"""What is left against elevation, with a sigma that holds: an error of the vertical scale ([C&D] fig. 9).

A plain regression is too sure of its slope for three reasons.

* The reference heights' own noise is in what is left and, with the other sign, in the elevations: on flat
  ground that alone makes a slope. So the elevation of each half of the points is taken from the other half,
  as an instrument.
* The registration takes part of a stretch for scale. So the seven are left free once more, within what is
  known of them.
* Neighbours share errors, which resemble relief by chance. So a dome is taken out, and what remains is
  weighed by the correlation over distance that it shows, averaged over all lengths and strengths that the
  residuals allow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.linalg import cho_solve, cholesky

from calib.assess.model import ElevationTrend, elevation_trend
from calib.camera import FloatArray
from calib.solution import BoolArray

#: A slope that is not known to this is not told: 3 % of heights, a focal length 3 % off.
TOLD_SIGMA = 0.03
#: Fewer points than this leave nothing to judge a sigma by.
FEWEST_TREND = 20
#: Places that the points of each half are gathered to at most.
_MOST_PLACES = 121
#: Correlation lengths as shares of the site, and shares of the variance that neighbours have in common.
_LENGTHS = np.geomspace(0.03, 1.0, 7)
_SHARES = np.array([0.0, 0.05, 0.2, 0.5, 0.8, 0.94, 0.99])
_NEIGHBOURS = 16
#: Relief must stand out of its own noise so many times.
_STANDS_OUT = 5.0
#: Share of the models that may find no relief.
_DOUBT = 0.05


@dataclass(frozen=True)
class _Places:
    """Means over cells of one half: ``xyz`` (m, 3), ``residual`` (m,), ``open`` (m, 7), ``count`` (m,)."""

    xyz: FloatArray
    residual: FloatArray
    open: FloatArray
    count: FloatArray


def robust_trend(
    points_m: FloatArray, residual_m: FloatArray, derivatives: FloatArray, covariance: FloatArray
) -> ElevationTrend | None:
    """The slope of residuals against elevation; None where there are too few points.

    Its sigma is infinite where the points show no relief beyond their noise; it is not told there.

    Args:
        points_m: (n, 3) the reference points.
        residual_m: (n,) cloud minus reference, vertically, after M7.
        derivatives: (n, 7) of the residuals by the seven.
        covariance: (7, 7) of the seven: how far each may still move in favour of a slope.
    """
    if len(points_m) < FEWEST_TREND:
        return None
    if not float(np.ptp(points_m[:, 2])) > 0:
        return ElevationTrend(0.0, np.inf, 0.0, False)
    plain = elevation_trend(points_m[:, 2], residual_m)
    centred = points_m - points_m.mean(axis=0)
    site = float(np.ptp(centred[:, :2], axis=0).max())
    size, axes = np.linalg.eigh(covariance)
    left_open = derivatives @ (axes * np.sqrt(np.maximum(size, 0)))
    half = other_half(len(centred))
    halves = [_gathered(centred[mine], residual_m[mine], left_open[mine], site) for mine in (half, ~half)]
    slope, sigma = _averaged(halves, site)
    return replace(plain, slope=slope, sigma=sigma, told=sigma <= TOLD_SIGMA)


def _gathered(xyz: FloatArray, residual: FloatArray, left_open: FloatArray, site: float) -> _Places:
    """Means over the cells of a grid, where there are more points than can be treated one by one."""
    if len(xyz) <= _MOST_PLACES:
        return _Places(xyz, residual, left_open, np.ones(len(xyz)))
    across = int(np.sqrt(_MOST_PLACES))
    cell = np.minimum((across * (xyz[:, :2] - xyz[:, :2].min(axis=0)) / site).astype(int), across - 1)
    _, slot = np.unique(cell @ [1, across], return_inverse=True)
    count = np.bincount(slot).astype(float)

    def mean(values: FloatArray) -> FloatArray:
        columns = [np.bincount(slot, column) / count for column in values.T]
        return np.stack(columns, axis=1)

    return _Places(mean(xyz), mean(residual[:, None])[:, 0], mean(left_open), count)


def other_half(count: int) -> BoolArray:
    """Which of so many points (count,) belong to the first of two halves, always the same."""
    chosen: BoolArray = np.random.default_rng(0).permutation(count) % 2 == 0
    return chosen


def elevation_from_others(points_m: FloatArray) -> FloatArray:
    """Elevation of each point (n, 3) from those of the other half, so without its own height's noise (n,)."""
    half = other_half(len(points_m))
    found = np.empty(len(points_m))
    for mine in (half, ~half):
        found[mine] = _from_others(points_m[mine], points_m[~mine])
    return found


def _from_others(places: FloatArray, others: FloatArray) -> FloatArray:
    """Elevation at places (m, 3) from other points (o, 3) alone."""
    surface = RBFInterpolator(
        others[:, :2], others[:, 2], neighbors=min(_NEIGHBOURS, len(others)), kernel="linear", degree=1
    )
    return np.asarray(surface(places[:, :2]))


def _averaged(halves: list[_Places], site: float) -> tuple[float, float]:
    """Slope and sigma, averaged over models of the correlation by how well they explain the residuals."""
    one, two = halves
    instrument = np.concatenate([_from_others(one.xyz, two.xyz), _from_others(two.xyz, one.xyz)])
    xyz = np.concatenate([one.xyz, two.xyz])
    residual = np.concatenate([one.residual, two.residual])
    left_open = np.concatenate([one.open, two.open])
    nugget = 1 / np.concatenate([one.count, two.count])
    x, y = 2 * xyz[:, :2].T / site
    shape = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    with_slope = np.column_stack([shape, instrument])
    parts = slice(0, len(one.xyz)), slice(len(one.xyz), len(xyz))
    apart = np.linalg.norm(xyz[:, None, :2] - xyz[None, :, :2], axis=2) / site
    scale = max(float(np.mean((residual - residual.mean()) ** 2 / nugget)), 1e-12)
    free = len(residual) - with_slope.shape[1]
    likelihood, slopes, spreads = [], [], []
    for length in _LENGTHS:
        ratio = np.sqrt(3) * apart / length
        near = (1 + ratio) * np.exp(-ratio)
        for share in _SHARES:
            errors = (1 - share) * np.diag(nugget) + share * near + left_open @ left_open.T / scale
            rest, size = _cleared(errors, with_slope, residual)
            unit = max(float(residual @ rest) / free, 1e-15)
            likelihood.append(-(size + free * np.log(unit)) / 2)
            weights = np.concatenate(
                [_cleared(errors[mine, mine], shape[mine], instrument[mine])[0] for mine in parts]
            )
            seen = float(weights @ xyz[:, 2])
            noise = float(np.sqrt(unit * (1 - share) * np.sum(nugget * weights**2)))
            stands_out = seen > _STANDS_OUT * noise
            slopes.append(float(weights @ residual) / seen if stands_out else 0.0)
            # What few points leave open of the errors' size comes on top (Student's distribution).
            variance = unit * float(weights @ errors @ weights) * free / (free - 2)
            spreads.append(variance / seen**2 if stands_out else np.inf)
    chance = np.exp(np.array(likelihood) - max(likelihood))
    slope_of, spread_of = np.array(slopes), np.array(spreads)
    settled = np.isfinite(spread_of)
    # Where models that count find no relief above the noise, there is nothing to be told.
    if float(chance[~settled].sum()) > _DOUBT * float(chance.sum()):
        return 0.0, np.inf
    chance = chance[settled] / chance[settled].sum()
    slope = float(chance @ slope_of[settled])
    return slope, float(np.sqrt(chance @ (spread_of[settled] + (slope_of[settled] - slope) ** 2)))


def _cleared(covariance: FloatArray, free: FloatArray, values: FloatArray) -> tuple[FloatArray, float]:
    """Values (m,) weighted by a covariance (m, m), without their part in free terms (m, p).

    And the logarithm of the determinants of the covariance and of the free terms' normal equations.
    """
    lower = cholesky(covariance, lower=True, check_finite=False)
    solved = cho_solve((lower, True), np.column_stack([free, values]), check_finite=False)
    normal = free.T @ solved[:, :-1]
    rest: FloatArray = solved[:, -1] - solved[:, :-1] @ np.linalg.solve(normal, free.T @ solved[:, -1])
    return rest, float(2 * np.log(np.diag(lower)).sum() + np.linalg.slogdet(normal)[1])

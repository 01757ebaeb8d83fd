"""M7 by robust registration: reference points onto a cloud's surface, or onto points picked in the cloud.

Reference points of a survey are not the cloud's points, so each is held against the cloud's height above or
below it (a smooth surface through its points around it). That fixes Tz and the tilts anywhere; Tx, Ty, the
azimuth and the scale only where the ground has relief. What the points do not fix is kept near "no error" by
wide prior knowledge and said to be undetermined, never reported as found.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.assess.elevation import elevation_from_others
from calib.assess.local import Heights, Neighbourhood, Sampler, near_places
from calib.assess.model import Seven, seven_derivatives, seven_parameters, similarity_of
from calib.camera import FloatArray
from calib.clouds import LoadedCloud
from calib.errors import InputError
from calib.similarity import fit_robust
from calib.solution import BoolArray

#: What is known of the seven before any point is looked at: m, degrees, percent ([C&D] Table 4, doubled).
PRIOR_SIGMAS = np.array([10.0, 10.0, 1000.0, 5.0, 5.0, 5.0, 10.0])
NO_ERROR = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 100.0])
#: A value is undetermined where the points leave more than this share of the prior's sigma.
UNDETERMINED = 0.3
#: Points that lie further off than so many robust sigmas are left out and named.
OUTLIER_SIGMAS = 3.5
FEWEST_SURFACE, FEWEST_PICKED = 8, 3
#: Heights of these many radii one after the other, so that metres of shift are found, too.
_LEVELS = (16.0, 8.0, 4.0, 2.0, 1.0)
#: Shift that is looked for horizontally, m.
_SEARCH_M = 15.0
#: Rounds of the adjustment with coarse surfaces, which need not settle, and with the finest.
_COARSE_ROUNDS, _ROUNDS = 3, 15
_CELLS = 6
#: Nothing is looked for further from no error than so many sigmas of the prior.
_FURTHEST = 2.5
#: Elevations from the other half of the points are taken where they differ by less than so many times of
#: what is left, with so many points at least.
_SMOOTH, _FEWEST_HALVES = 4.0, 20
#: Times that the cloud is cut out anew around points that have moved off it.
_CUTS = 4
#: A combination of the seven counts where at least this share of its slopes is relief and not noise.
_RELIEF_SHARE = 0.5
#: What a dome may amount to before any point is looked at; looked for with so many points at least.
_BEND_SIGMA_M, _FEWEST_BEND = 2.0, 20


@dataclass(frozen=True)
class Registration:
    """M7 about ``origin`` (3,), and what it leaves at the reference points.

    ``residual_m`` (n,): cloud minus reference, vertically, NaN where there is no cloud; ``used`` (n,): those
    that M7 rests on; ``outlier`` (n,): those of them that were left out for lying too far off.
    ``determined`` (7,). ``derivatives`` (n, 7): of the residuals. ``correlation``: how many times larger
    variances are because neighbours share their errors (1: they do not). ``radius_m`` of the heights.
    """

    seven: Seven
    origin: FloatArray
    residual_m: FloatArray
    derivatives: FloatArray
    used: BoolArray
    outlier: BoolArray
    determined: BoolArray
    correlation: float
    radius_m: float


def register(
    reference_m: FloatArray,
    cloud: LoadedCloud,
    on: BoolArray,
    radius_m: float | None = None,
    picked_m: FloatArray | None = None,
) -> Registration:
    """M7 of a cloud against reference points (n, 3) in the cloud's coordinates.

    Args:
        on: (n,) which points M7 is to rest on.
        radius_m: of the heights; None: as holds some thirty points.
        picked_m: (n, 3) the same points as measured in the cloud, NaN where they were not; M7 rests on
            these where given.

    Raises:
        InputError: too few points lie on the cloud.
    """
    origin = np.round(reference_m[on].mean(axis=0), -1) + 0.0  # Never minus nought.
    reference = reference_m - origin
    shift = cloud.origin - origin  # From the cloud's own origin to M7's.
    if picked_m is not None:
        seven, used, outlier = _from_picked(reference, picked_m - origin, on)
        level = _finest(cloud, seven.similarity.apply(reference)[:, :2] - shift[:2], radius_m)
        heights, radius = level
        residual, derivatives = _residuals(seven.values, reference, _shifted(heights, shift))
        return Registration(
            seven, origin, residual, derivatives, used, outlier, np.ones(7, bool), 1.0, radius
        )
    coarse = near_places(cloud, reference[:, :2] - shift[:2], _SEARCH_M)
    if coarse is None:
        raise InputError("No reference point lies over the cloud.")
    values = NO_ERROR
    finest = radius_m or coarse.natural_radius_m
    site = float(np.ptp(reference[on, :2], axis=0).max())
    enough = len(reference) >= _FEWEST_HALVES
    others = elevation_from_others(reference) if enough else np.full(len(reference), np.inf)
    radii = [finest * k for k in _LEVELS if finest * k <= max(site / 6, finest)]
    for radius in radii[:-1]:
        sampler = coarse.thinned(radius)
        values = _fit(values, reference, others, on, sampler, shift, _COARSE_ROUNDS).values
    reach = 3 * finest + 0.5
    for _ in range(_CUTS):
        places = _moved_xy(values, reference)
        fine = near_places(cloud, places - shift[:2], reach)
        if fine is None:
            raise InputError("No reference point lies over the cloud.")
        radius = radius_m or fine.natural_radius_m
        found = _fit(values, reference, others, on, fine.thinned(radius), shift, _ROUNDS)
        values = found.values
        if np.linalg.norm(_moved_xy(values, reference) - places, axis=1).max() < reach - radius:
            break
    return _finished(found, reference, on, origin, radius)


@dataclass(frozen=True)
class _Fit:
    """The last state of an adjustment; ``residual``, ``derivatives`` of all n points, NaN where no cloud is.

    ``straight``: residuals without second-order terms; ``information`` (10, 10) of the seven and those three
    at ``variance``; ``prior_sigmas`` (10,).
    """

    values: FloatArray
    used: BoolArray
    residual: FloatArray
    straight: FloatArray
    derivatives: FloatArray
    information: FloatArray
    variance: float
    prior_sigmas: FloatArray


def _moved_xy(values: FloatArray, reference: FloatArray) -> FloatArray:
    moved: FloatArray = similarity_of(values).apply(reference)[:, :2]
    return moved


def _shifted(heights: Heights, shift: FloatArray) -> Heights:
    return Heights(heights.height_m + shift[2], heights.slope, heights.slope_covariance)


def _residuals(values: FloatArray, reference: FloatArray, heights: Heights) -> tuple[FloatArray, FloatArray]:
    """Cloud minus reference (n,) and its derivatives by the seven (n, 7)."""
    moved = similarity_of(values).apply(reference)
    directions = np.column_stack([heights.slope, -np.ones(len(reference))])
    derivatives = np.einsum("nj,njp->np", directions, seven_derivatives(values, reference))
    return heights.height_m - moved[:, 2], derivatives


def _spread(residual: FloatArray) -> float:
    return max(1.4826 * float(np.median(np.abs(residual - np.median(residual)))), 1e-9)


def _bend(reference: FloatArray, on: BoolArray) -> FloatArray:
    """x2, x y and y2 at the points (n, 3), without mean, one at the site's edge; zero where points are few.

    A dome of the cloud would else be taken for scale wherever the ground is curved.
    """
    if int(on.sum()) < _FEWEST_BEND:
        return np.zeros((len(reference), 3))
    x, y = (2 * reference[:, :2] / max(float(np.ptp(reference[on, :2], axis=0).max()), 1e-9)).T
    terms = np.stack([x * x, x * y, y * y], axis=1)
    bend: FloatArray = terms - terms[on].mean(axis=0)
    return bend


def _fit(
    values: FloatArray,
    reference: FloatArray,
    others: FloatArray,
    on: BoolArray,
    sampler: Sampler,
    shift: FloatArray,
    rounds: int,
) -> _Fit:
    """Gauss-Newton with outliers left out; slopes' own noise does not count as information.

    ``others`` (n,): elevations of the points from their neighbours alone; infinite where there are too few.
    """
    bend = _bend(reference, on)
    state = np.concatenate([values, np.zeros(3)])
    sigmas = np.concatenate([PRIOR_SIGMAS, np.full(3, _BEND_SIGMA_M)])
    start = np.concatenate([NO_ERROR, np.zeros(3)])
    prior = np.outer(sigmas, sigmas)
    for round_ in range(rounds):
        values = state[:7]
        heights = _shifted(sampler.heights(_moved_xy(values, reference) - shift[:2]), shift)
        residual, derivatives = _residuals(values, reference, heights)
        there = on & heights.found
        if int(there.sum()) < FEWEST_SURFACE:
            raise _too_few(int(there.sum()), FEWEST_SURFACE)
        straight = residual - bend @ state[7:]
        middle = float(np.median(straight[there]))
        used = there & (np.abs(straight - middle) <= OUTLIER_SIGMAS * _spread(straight[there]))
        rest = straight[used] - middle
        # Neighbours that share an error would else outvote what is known beforehand: on flat ground the
        # points shrink into the middle, where they fit best.
        variance = max(float(np.mean(rest**2)) * correlation(reference[used], rest, len(sigmas)), 1e-12)
        design = np.column_stack([derivatives[used], -bend[used]])
        own = reference[used, 2] - others[used]
        if float(np.mean(own**2)) < _SMOOTH**2 * float(np.mean(rest**2)):
            # The heights' own noise is in what is left and in the derivative by the scale: on flat ground
            # the site would shrink, for that makes the noise smaller.
            by_height = np.column_stack([heights.slope[used], -np.ones(len(own))])
            design[:, 6] -= own * (by_height @ similarity_of(values).rotation[:, 2]) / 100
        # A surface's slopes are noisy; their squares would pass for relief that is not there.
        by_slope = seven_derivatives(values, reference[used])[:, :2]
        noise = np.zeros((10, 10))
        noise[:7, :7] = np.einsum("nip,nij,njq->pq", by_slope, heights.slope_covariance[used], by_slope)
        seen = design.T @ design * prior / variance
        size, axes = np.linalg.eigh(seen - noise * prior / variance)
        real = size > _RELIEF_SHARE * np.einsum("pk,pq,qk->k", axes, seen, axes)
        axes = axes[:, real]
        information = (axes * size[real]) @ axes.T / prior
        pull = (state - start) / sigmas
        right = axes @ (axes.T @ (-sigmas * (design.T @ straight[used]) / variance)) - pull
        step = sigmas * np.linalg.solve(information * prior + np.eye(10), right)
        # A step counts as the largest movement of a point does, in units of what is left.
        movement = np.abs(design @ step).max()
        if round_ and movement < 0.002 * np.sqrt(variance):
            break
        state = np.clip(state + step, start - _FURTHEST * sigmas, start + _FURTHEST * sigmas)
    return _Fit(values, used, residual, straight, derivatives, information, variance, sigmas)


def _finished(
    found: _Fit, reference: FloatArray, on: BoolArray, origin: FloatArray, radius: float
) -> Registration:
    used, prior = found.used, np.outer(found.prior_sigmas, found.prior_sigmas)

    def covariance(information: FloatArray) -> FloatArray:
        inverse: FloatArray = np.linalg.inv(information * prior + np.eye(10)) * prior
        return inverse

    spent = float(np.trace(covariance(found.information) @ found.information))
    rest = found.straight[used]
    factor = correlation(reference[used], rest - rest.mean(), len(found.prior_sigmas))
    variance = float(np.sum(rest**2)) / max(int(used.sum()) - spent, 1.0)
    # The information was weighed with the last round's variance; the prior is no observation of the points.
    left_open = covariance(found.information * found.variance / (variance * factor))[:7, :7]
    determined = np.sqrt(np.diag(left_open)) < UNDETERMINED * PRIOR_SIGMAS
    residual = found.residual
    seven = Seven(
        similarity_of(found.values),
        found.values,
        left_open,
        float(residual[used].mean()),
        float(residual[used].std()),
    )
    outlier = on & np.isfinite(residual) & ~used
    return Registration(seven, origin, residual, found.derivatives, used, outlier, determined, factor, radius)


def correlation(places_m: FloatArray, residual_m: FloatArray, fitted: int) -> float:
    """How many times the variance of a mean is larger than for independent residuals (n,), at least 1.

    Neighbours that share their error count as one: variances go by the cell of a grid over the site. The
    ``fitted`` parameters have taken as many cells' worth out of the residuals.
    """
    low, high = places_m[:, :2].min(axis=0), places_m[:, :2].max(axis=0)
    cell = np.minimum(
        (_CELLS * (places_m[:, :2] - low) / np.maximum(high - low, 1e-9)).astype(int), _CELLS - 1
    )
    slot = cell[:, 1] * _CELLS + cell[:, 0]
    count = np.bincount(slot, minlength=_CELLS**2)
    total = np.bincount(slot, residual_m, minlength=_CELLS**2)
    filled = count > 0
    variance = max(float(np.mean(residual_m**2)), 1e-300)
    cells = int(filled.sum())
    spent = cells / max(cells - fitted, 0.5 * cells)
    return max(1.0, spent * float(np.mean(total[filled] ** 2 / count[filled])) / variance)


def _finest(cloud: LoadedCloud, xy_m: FloatArray, radius_m: float | None) -> tuple[Heights, float]:
    """Heights of the finest radius at places (n, 2) about the cloud's origin."""
    fine: Neighbourhood | None = near_places(cloud, xy_m, 1.0 if radius_m is None else 3 * radius_m)
    if fine is None:
        raise InputError("No reference point lies over the cloud.")
    radius = radius_m or fine.natural_radius_m
    return fine.thinned(radius).heights(xy_m), radius


def _from_picked(
    reference: FloatArray, picked: FloatArray, on: BoolArray
) -> tuple[Seven, BoolArray, BoolArray]:
    """M7 from points measured in the cloud, outliers left out."""
    there = on & np.isfinite(picked).all(axis=1)
    if int(there.sum()) < FEWEST_PICKED:
        raise _too_few(int(there.sum()), FEWEST_PICKED)
    used = there.copy()
    if int(there.sum()) > FEWEST_PICKED + 1:
        ones = np.ones((int(there.sum()), 3))
        for _ in range(3):
            _, rest = fit_robust(reference[there], picked[there], ones)
            ones = ones * max(float(np.median(np.abs(rest))) * 1.4826, 1e-9) / ones[0, 0]
        size = np.abs(rest).max(axis=1)
        used[there] = size <= 1.2 * OUTLIER_SIGMAS * ones[0, 0]
    if int(used.sum()) < FEWEST_PICKED:
        used = there
    return seven_parameters(reference[used], picked[used]), used, there & ~used


def _too_few(there: int, needed: int) -> InputError:
    return InputError(
        f"Only {there} reference points lie on the cloud and can be used; at least {needed} are needed "
        "to find how it is shifted, turned and scaled."
    )

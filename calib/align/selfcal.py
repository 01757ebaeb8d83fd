"""Self-calibration in steps: from a block that roughly fits to the model the verdict rests on.

1. f, principal point, K1, K2; blunders out.
2. K3, decentring and affinity; blunders out by the noise found.
3. Decentring stays where it is significant ([SEN] staged release); K3 always does.
4. The residual field joins, with a weak prior (docs/method.md says why). Where the residuals are
   correlated within photos, the images weigh less against the priors from here on.
5. Precise positions (RTK) keep their weight only where the lens is the same without it.
6. Where the photos ask for a rolling shutter (each camera's way during its readout), all again with it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc, chdtri

from calib.align.adjust import Adjusted, Adjustment, Priors, State
from calib.align.chance import Lengths, beyond_chance
from calib.align.correlation import correlation_factor
from calib.align.georeference import DEFAULT_SIGMA_M
from calib.align.rays import ray_angle_deg
from calib.align.readout import line_directions, way_information
from calib.align.tracks import select
from calib.camera import BROWN_NAMES, FloatArray
from calib.errors import AlignmentError
from calib.field import LENS_NAMES, Lens
from calib.photos.photo import LeftOut, Photo
from calib.similarity import fit_similarity
from calib.solution import Georeference, Observations, Solution

#: Prior of the residual field's coefficients, in px at 4000 px image width.
FIELD_SIGMA_PX = 0.5
#: What a file's nominal focal length is worth, as a share of f: the real ones tried are off by 2-4 %.
NOMINAL_F_SIGMA = 0.05
#: The same where the file names none and an ordinary wide lens is assumed.
UNKNOWN_F_SIGMA = 0.3
#: |t| above which a parameter group counts as significant (99 %, two-sided).
SIGNIFICANT = 2.6
#: Points seen under less parallax say nothing about the lens and slow the adjustment down.
LEAST_ANGLE_DEG = 2.0
#: The significance at which a rolling shutter is believed.
SHUTTER_P = 1e-3
#: Rounds in which measured positions that contradict the block lose weight.
POSITION_ROUNDS = 5
BASIC = ("f", "cx", "cy", "k1", "k2")
NB = len(BROWN_NAMES)


def mask(names: tuple[str, ...], field: bool = False) -> np.ndarray:
    """Boolean (35,): the named Brown parameters, and the residual field if asked for."""
    free = np.array([name in names for name in LENS_NAMES])
    free[NB:] = field
    return free


def lens_priors(
    width: int, nominal_f_px: float, f_share: float = NOMINAL_F_SIGMA
) -> tuple[FloatArray, FloatArray]:
    """Mean and sigma (35,) of a lens of which only the nominal focal length is known.

    The principal point within 1 % of the width, decentring and affinity small, as in any camera
    that is not broken; radial distortion free but for the sixth and eighth order.
    """
    mean = np.zeros(len(LENS_NAMES))
    sigma = np.full(len(LENS_NAMES), np.inf)
    index = {name: i for i, name in enumerate(LENS_NAMES)}
    mean[index["f"]], sigma[index["f"]] = nominal_f_px, f_share * nominal_f_px
    for name, value in (("cx", 0.01 * width), ("cy", 0.01 * width)):
        sigma[index[name]] = value
    for name, value in (("k1", 1.0), ("k2", 2.0), ("k3", 2.0), ("k4", 2.0), ("p1", 0.01), ("p2", 0.01)):
        sigma[index[name]] = value
    for name in ("b1", "b2"):
        sigma[index[name]] = 0.005 * nominal_f_px
    sigma[NB:] = FIELD_SIGMA_PX * width / 4000
    return mean, sigma


def with_lens_priors(
    priors: Priors, width: int, height: int, nominal_f_px: float, f_share: float = NOMINAL_F_SIGMA
) -> Priors:
    """``priors`` with those of :func:`lens_priors`, principal point around the image centre."""
    mean, sigma = lens_priors(width, nominal_f_px, f_share)
    mean[1], mean[2] = width / 2, height / 2
    return replace(priors, lens_mean=mean, lens_sigma=sigma)


@dataclass(frozen=True)
class Calibrated:
    """A self-calibrated block. ``adjustment`` can be run again under other lens models.

    ``point_index`` (m,): index of every remaining point among those given. ``standing`` (k,): photos known
    to be taken standing: an extra pass.
    """

    adjustment: Adjustment
    adjusted: Adjusted
    point_index: np.ndarray
    observation_index: np.ndarray
    standing: np.ndarray | None = None

    @property
    def observations(self) -> Observations:
        return self.adjustment.obs

    def solution(
        self,
        photos: Sequence[Photo],
        georeference: Georeference,
        components: tuple[int, ...],
        photos_used: int | None = None,
        left_out: Sequence[LeftOut] = (),
    ) -> Solution:
        """The block as the solution of an alignment. ``photos_used``: given to it (default: ``photos``)."""
        adjusted, state = self.adjusted, self.adjusted.state
        return Solution(
            photos=tuple(photos),
            lens=state.lens,
            free=adjusted.free,
            covariance=adjusted.covariance,
            rotations_cam_from_world=state.rotations,
            centres_m=state.centres_m,
            points_m=state.points_m,
            observations=self.observations,
            residuals_px=adjusted.residuals_px,
            weights=adjusted.weights,
            sigma0=adjusted.sigma0,
            georeference=georeference,
            left_out=tuple(left_out),
            photos_used=len(photos) if photos_used is None else photos_used,
            components=components,
            converged=adjusted.converged,
            iterations=adjusted.iterations,
        )


def hold(block: Calibrated, lens: Lens, tick: Callable[[], None] | None = None) -> Adjusted:
    """Poses and points of a solved block re-adjusted around another lens."""
    state = block.adjusted.state
    return block.adjustment.run(
        State(lens, state.rotations, state.centres_m, state.points_m),
        np.zeros(len(LENS_NAMES), bool),
        max_iterations=40,
        decrement=0.1,
        reweightings=1,
        tick=tick,
    )


def noise_px(residuals: FloatArray) -> float:
    """Robust standard deviation per coordinate of residuals (n, 2)."""
    return max(float(1.4826 * np.median(np.abs(residuals))), 0.02)


def _redundancy_factor(n_observations: int, n_photos: int, n_points: int) -> float:
    """sqrt(observations / redundancy): residuals are smaller than the noise they come from."""
    redundancy = 2 * n_observations - 6 * n_photos - 3 * n_points
    return float(np.sqrt(2 * n_observations / max(redundancy, 0.2 * n_observations)))


def calibrate(
    obs: Observations,
    start: State,
    priors: Priors,
    tick: Callable[[], None] | None = None,
    blunder_sigmas: float = 4.5,
    standing: np.ndarray | None = None,
) -> Calibrated:
    """Self-calibrate a block (see the module's text).

    Args:
        obs: every photo has observations, every point at least two; sorted by point.
        start: photos in the order in which they were taken, z up.
        priors: positions, attitudes and lens (:func:`with_lens_priors`).
        standing: (k,) photos known to be taken by a camera that stood; None: none.

    Raises:
        AlignmentError: too few observations survive for the number of unknowns.
    """
    found = _in_steps(obs, start, priors, tick, blunder_sigmas)
    ways = _ways(found, standing, tick)
    if ways is not None:
        # What did not fit without the ways is gone, and of the rest too much fits: f leaned on that choice by
        # seven of its sigmas. All that was measured is looked at again.
        priors = replace(priors, way_information=ways)
        found = _in_steps(obs, _from_there(found, start), priors, tick, blunder_sigmas)
    result = found.adjusted
    result = found.adjustment.run(result.state, result.free, reweightings=1, response=True, tick=tick)
    return replace(found, adjusted=result, standing=standing)


def _in_steps(
    obs: Observations,
    start: State,
    priors: Priors,
    tick: Callable[[], None] | None,
    blunder_sigmas: float,
) -> Calibrated:
    """Steps 1 to 5 of the module's text; raises as :func:`calibrate`."""
    k = len(start.rotations)
    point_index = np.arange(len(start.points_m))
    obs_index = np.arange(len(obs))
    state = start
    steps = (BASIC, BASIC, (*BASIC, "k3", "p1", "p2", "b1", "b2"))
    for step, names in enumerate(steps):
        adjustment = Adjustment(obs, k, len(state.points_m), priors)
        last = step == len(steps) - 1
        result = adjustment.run(
            state, mask(names), max_iterations=60 if last else 25, decrement=0.1 if last else 1.0, tick=tick
        )
        state = result.state
        sigma = noise_px(result.residuals_px) * _redundancy_factor(len(obs), k, len(state.points_m))
        size = np.linalg.norm(result.residuals_px, axis=1)
        # The first rounds are lenient: part of a large residual is still the model's.
        keep = size < (10, 6, blunder_sigmas)[step] * sigma
        keep &= adjustment.depths(state) > 0
        keep &= (ray_angle_deg(state.centres_m, state.points_m, obs) > LEAST_ANGLE_DEG)[obs.point]
        obs, obs_index, state, point_index = _kept(obs, obs_index, keep, sigma, state, point_index, k)
        if step > 0:
            priors, state = _honest_positions(obs, state, priors, mask(names), tick)
    names = tuple(n for n in steps[-1] if n in _significant(result))
    adjustment = Adjustment(obs, k, len(state.points_m), priors)
    result = adjustment.run(state, mask(names, field=True), decrement=0.1, tick=tick)
    state = result.state
    sigma = noise_px(result.residuals_px) * _redundancy_factor(len(obs), k, len(state.points_m))
    keep = np.linalg.norm(result.residuals_px, axis=1) < blunder_sigmas * sigma
    factor = block_correlation(adjustment, result)
    sigma *= float(np.sqrt(factor))
    obs, obs_index, state, point_index = _kept(obs, obs_index, keep, sigma, state, point_index, k)
    adjustment = Adjustment(obs, k, len(state.points_m), priors, noise_factor=factor)
    result = adjustment.run(state, result.free, tick=tick)
    adjustment, result = _with_believable_positions(adjustment, result, tick)
    return Calibrated(adjustment, result, point_index, obs_index)


def _from_there(found: Calibrated, start: State) -> State:
    """Where a block stands, as a start for all points that it was given: those left out come along."""
    state = found.adjusted.state
    points = fit_similarity(start.points_m[found.point_index], state.points_m).apply(start.points_m)
    points[found.point_index] = state.points_m
    return replace(state, points_m=points)


def _honest_positions(
    obs: Observations,
    state: State,
    priors: Priors,
    free: np.ndarray,
    tick: Callable[[], None] | None,
) -> tuple[Priors, State]:
    """Positions weigh no more than their misfit to the block allows (late or offset RTK fixes).

    The block bends towards positions that are believed, so the factor is found in rounds.
    """
    k, m = len(state.centres_m), len(state.points_m)
    for _ in range(POSITION_ROUNDS):
        adjustment = Adjustment(obs, k, m, priors)
        state = adjustment.run(state, free, max_iterations=25, decrement=0.1, tick=tick).state
        known = np.isfinite(priors.centre_sigma_m).all(axis=1)
        if 3 * known.sum() <= 7:
            break
        misfit = ((priors.centres_m - state.centres_m) / priors.centre_sigma_m)[known]
        factor = float(np.sqrt(np.sum(misfit**2) / (3 * len(misfit) - 7)))
        if factor < 1.2:
            break
        priors = replace(priors, centre_sigma_m=priors.centre_sigma_m * factor)
    return priors, state


def block_correlation(adjustment: Adjustment, result: Adjusted) -> float:
    """Variance factor from residuals that are correlated within the photos."""
    brown, obs = result.state.lens.brown, adjustment.obs
    return correlation_factor(
        result.residuals_px,
        result.weights,
        obs.photo,
        obs.pixels,
        (brown.width, brown.height),
        adjustment.per_photo,
    )


def _with_believable_positions(
    adjustment: Adjustment, result: Adjusted, tick: Callable[[], None] | None
) -> tuple[Adjustment, Adjusted]:
    """Positions as those of a plain receiver where the precise ones contradict the images about the lens.

    A late clock or an antenna's offset errs alike in every photo: no number of photos averages it out,
    and single misfits need not show it.
    """
    priors = adjustment.priors
    known = np.isfinite(priors.centre_sigma_m).all(axis=1)
    if not known.any() or float(np.median(priors.centre_sigma_m[known])) >= DEFAULT_SIGMA_M:
        return adjustment, result
    loose = np.maximum(priors.centre_sigma_m, DEFAULT_SIGMA_M)
    plain = adjustment.with_priors(replace(priors, centre_sigma_m=loose))
    weights = (result.weights, result.position_weights)
    trial = plain.run(result.state, result.free, 40, decrement=0.05, weights=weights, damping=1e-8, tick=tick)
    move = trial.state.lens.vector - result.state.lens.vector
    if beyond_chance(Lengths.of(result.state.lens), move, trial.covariance, result.covariance):
        return plain, plain.run(trial.state, result.free, tick=tick)
    return adjustment, result


def _ways(
    block: Calibrated, standing: np.ndarray | None, tick: Callable[[], None] | None
) -> FloatArray | None:
    """``Priors.way_information`` where a rolling shutter explains the residuals significantly better."""
    adjustment, result = block.adjustment, block.adjusted
    state, obs = result.state, adjustment.obs
    distance = float(
        np.median(np.linalg.norm(state.points_m[obs.point] - state.centres_m[obs.photo], axis=1))
    )
    # Without positions nothing says where up is.
    upright = bool(np.isfinite(adjustment.priors.centre_sigma_m).all(axis=1).any())
    ways = way_information(state.centres_m, distance, standing, upright)
    moving = adjustment.with_priors(replace(adjustment.priors, way_information=ways))
    weights = (result.weights, result.position_weights)
    trial = moving.run(state, result.free, 20, decrement=1.0, weights=weights, tick=tick)
    # Correlated noise gives way to any smooth motion; what stays correlated afterwards is not the shutter's.
    noise = trial.sigma0**2 / adjustment.noise_factor * block_correlation(moving, trial)
    gain = (result.chi2 - trial.chi2) / noise
    # However narrow the priors: many thousand tie points use up what they leave.
    unknowns = 3 * len(state.rotations)
    if float(chdtrc(unknowns, max(gain, 0.0))) < SHUTTER_P:
        return ways
    # Too weak to be seen photo by photo it may still pull f by several sigmas: they all go forward.
    along = line_directions(state.centres_m)[0]
    if standing is not None:
        along[standing] = 0.0
    mean, variance = moving.mean_way(trial, along)
    return ways if mean**2 > variance * noise * float(chdtri(1, SHUTTER_P)) else None


def _kept(
    obs: Observations,
    obs_index: np.ndarray,
    keep: np.ndarray,
    sigma: float,
    state: State,
    point_index: np.ndarray,
    n_photos: int,
) -> tuple[Observations, np.ndarray, State, np.ndarray]:
    counts = np.bincount(obs.point[keep], minlength=len(state.points_m))
    obs_index = obs_index[keep & (counts[obs.point] >= 2)]
    obs, old = select(obs, keep)
    per_photo = np.bincount(obs.photo, minlength=n_photos)
    if per_photo.min() < 6:
        raise AlignmentError(
            f"Only {int(per_photo.min())} reliable tie points remain in one photo; the photos overlap too "
            "little or show too little texture. Fly with more overlap."
        )
    obs = replace(obs, sigma_px=np.full(len(obs), sigma))
    return obs, obs_index, replace(state, points_m=state.points_m[old]), point_index[old]


def _significant(result: Adjusted) -> set[str]:
    """Names of the parameters to keep: decentring only where it differs from zero.

    K3 stays: without it K2 comes out with a sigma that holds for K3 = 0 only.
    """
    vector = result.state.lens.vector
    covariance = result.covariance
    index = {name: i for i, name in enumerate(LENS_NAMES)}
    kept = set(BASIC) | {"k3", "b1", "b2"}
    pair = [index["p1"], index["p2"]]
    size = vector[pair] @ np.linalg.solve(covariance[np.ix_(pair, pair)], vector[pair])
    if size > SIGNIFICANT**2 + 2.5:  # chi-square of two degrees of freedom at 99 %: 9.2
        kept.update(("p1", "p2"))
    return kept

"""What is truly the matter with a simulated flight: dome, focal length, what its network could know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.align.adjust import Adjustment, State
from calib.align.dome import aligned_difference_m, dome_amplitude_m
from calib.align.readout import way_information
from calib.align.selfcal import Calibrated
from calib.align.tracks import select
from calib.brownfit import fit_brown
from calib.camera import FloatArray
from calib.similarity import fit_similarity
from calib.solution import Observations
from sim.network import SimBlock, smooth_noise
from sim.solve import priors_of

#: Draws of correlated noise from which its share in the sigma of f is taken.
_DRAWS = 6
#: Points farther off the surface than this many robust standard deviations are left out, so often.
_FAR_OFF, _ROUNDS = 4.0, 3


def true_dome_percent(points_m: FloatArray, truth_m: FloatArray, flying_height_m: float) -> float:
    """Dome (positive) or dish of reconstructed points (m, 3) against true ones, % of the flying height.

    The points are laid onto the truth by the best seven-parameter transformation ([C&D] eq. 4);
    the dome is the second-order part of what remains in the heights. Higher orders are not in it,
    and points far off the surface (a mismatch that only two photos saw) are left out.
    """
    kept = np.ones(len(points_m), bool)
    x, y = (truth_m[:, :2] - np.median(truth_m[:, :2], axis=0)).T
    surface = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    surface /= np.abs(surface).max(axis=0)
    for _ in range(_ROUNDS):
        height = (fit_similarity(points_m[kept], truth_m[kept]).apply(points_m) - truth_m)[:, 2]
        rest = height - surface @ np.linalg.lstsq(surface[kept], height[kept], rcond=None)[0]
        kept = np.abs(rest) <= _FAR_OFF * max(1.4826 * float(np.median(np.abs(rest))), 1e-12)
    height = aligned_difference_m(points_m[kept], truth_m[kept])[:, 2]
    return 100 * float(dome_amplitude_m(truth_m[kept], height)) / flying_height_m


def ideal_sigma_f_percent(
    block: SimBlock, calibrated: Calibrated, noise_px: float, correlated_px: float, nominal_f_px: float
) -> float:
    """Standard deviation of f, %, of an adjustment that knows what disturbs the flight.

    From the information of the observations that are no mismatches, at the truth, with the lens
    parameters that the calibration estimated, the true noise, and a rolling shutter where there is
    one. Correlated noise is carried through by trial, one step of the adjustment a draw.
    """
    obs = block.observations
    k = len(block.centres_m)
    good, old = select(obs, ~block.mismatched)
    good = replace(good, sigma_px=np.full(len(good), noise_px))
    priors = priors_of(block, nominal_f_px)
    shutter = None
    if block.readout_s > 0:
        distance = np.linalg.norm(block.points_m[obs.point] - block.centres_m[obs.photo], axis=1)
        ways = way_information(block.centres_m, float(np.median(distance)))
        priors = replace(priors, way_information=ways)
        shutter = block.velocity_m_s * block.readout_s
    truth = State(block.lens, block.rotations_cam_from_world, block.centres_m, block.points_m[old], shutter)
    free = calibrated.adjusted.free
    weights = (np.ones(len(good)), np.ones(k))
    _, to_brown = fit_brown(block.lens)

    def step(pixels: FloatArray) -> tuple[float, float]:
        """Change of f in px for these pixels, and the variance of f for unit variance factor."""
        moved = Adjustment(
            Observations(good.photo, good.point, pixels, good.sigma_px), k, len(old), priors
        ).run(truth, free, max_iterations=1, weights=weights, damping=1e-12)
        change = moved.state.lens.vector - block.lens.vector
        variance = float(to_brown[0] @ moved.covariance @ to_brown[0]) / moved.sigma0**2
        return float(to_brown[0] @ change), variance

    still, variance = step(good.pixels)
    if correlated_px > 0:
        rng = np.random.default_rng([len(good), 24])
        width = block.lens.brown.width
        moves = [
            step(good.pixels + correlated_px * smooth_noise(rng, k, good.photo, good.pixels / width))[0]
            for _ in range(_DRAWS)
        ]
        variance += float(np.mean((np.array(moves) - still) ** 2))
    return 100 * float(np.sqrt(variance)) / block.lens.brown.f_px

"""Self-calibration of a simulated survey, started from what the vehicle measured."""

from __future__ import annotations

import numpy as np

from calib.align.adjust import Priors, State
from calib.align.georeference import GIMBAL_SIGMA_DEG, LEAST_SIGMA_M
from calib.align.selfcal import Calibrated, calibrate, with_lens_priors
from calib.camera import BrownCamera
from calib.field import LENS_NAMES, Lens
from calib.solution import BoolArray
from sim.network import SimBlock

#: Receivers get half the trust that they ask for: 5 m for 2.5 m ([C&D] pre-processing).
_PRIOR_PER_GPS_SIGMA = 2.0


def priors_of(block: SimBlock, nominal_f_px: float) -> Priors:
    """What is known of ``block`` besides its images, weighted as an alignment of real photos does."""
    k = len(block.gps_m)
    camera = block.lens.brown
    priors = Priors(
        centres_m=block.gps_m,
        centre_sigma_m=np.maximum(_PRIOR_PER_GPS_SIGMA * block.gps_sigma_m, LEAST_SIGMA_M),
        rotations=block.gimbal_cam_from_world,
        rotation_sigma_rad=np.full(k, np.radians(GIMBAL_SIGMA_DEG)),
        lens_mean=np.zeros(len(LENS_NAMES)),
        lens_sigma=np.full(len(LENS_NAMES), np.inf),
    )
    return with_lens_priors(priors, camera.width, camera.height, nominal_f_px)


def start_of(block: SimBlock, nominal_f_px: float, seed: int, points_sigma_m: float = 3.0) -> State:
    """Ideal lens, measured poses, and ground points that are off by ``points_sigma_m`` in each axis."""
    camera = block.lens.brown
    wrong = np.random.default_rng([seed, 8]).normal(0.0, points_sigma_m, block.points_m.shape)
    ideal = Lens(BrownCamera.ideal(camera.width, camera.height, nominal_f_px))
    return State(ideal, block.gimbal_cam_from_world, block.gps_m, block.points_m + wrong)


def calibrate_block(
    block: SimBlock, nominal_f_px: float, seed: int, standing: BoolArray | None = None
) -> Calibrated:
    """Self-calibrate a simulated survey as an alignment of its photos would.

    Args:
        nominal_f_px: focal length that the files state; the adjustment starts there.
        seed: of the ground points' errors at the start.
        standing: (k,) photos that are known to be taken standing; None: none.

    Raises:
        AlignmentError: too few observations survive.
    """
    start, priors = start_of(block, nominal_f_px, seed), priors_of(block, nominal_f_px)
    return calibrate(block.observations, start, priors, standing=standing)

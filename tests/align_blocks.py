"""Small simulated blocks and adjustments of them, for the tests of the alignment."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from calib.align.adjust import Adjustment, Priors, State
from calib.align.grow import lens_mask
from calib.align.selfcal import Calibrated
from calib.camera import FloatArray
from calib.field import FIELD_NAMES, LENS_NAMES, Lens
from calib.solution import BoolArray
from sim.network import SimBlock, SimOptions, survey
from sim.solve import calibrate_block

INDEX = {name: i for i, name in enumerate(LENS_NAMES)}
NOMINAL_F_PX = 2320.06 * 1.02
#: Everything that makes a Brown lens but K4.
BROWN = "f cx cy k1 k2 k3 p1 p2 b1 b2"


def truth_of(block: SimBlock) -> State:
    return State(block.lens, block.rotations_cam_from_world, block.centres_m, block.points_m)


def loose_priors(block: SimBlock, centre_sigma_m: float) -> Priors:
    """Nothing known of the lens, positions known to ``centre_sigma_m`` around their true places."""
    k = len(block.centres_m)
    return Priors(
        block.centres_m,
        np.full((k, 3), centre_sigma_m),
        block.rotations_cam_from_world,
        np.full(k, np.inf),
        np.zeros(len(LENS_NAMES)),
        np.full(len(LENS_NAMES), np.inf),
    )


def gps_priors(block: SimBlock, field_sigma_px: float = 0.5) -> Priors:
    """Positions as the receiver gave them, and the residual field near zero."""
    sigma = np.full(len(LENS_NAMES), np.inf)
    sigma[-len(FIELD_NAMES) :] = field_sigma_px
    return replace(
        loose_priors(block, 1.0), centres_m=block.gps_m, centre_sigma_m=block.gps_sigma_m, lens_sigma=sigma
    )


def block_adjustment(block: SimBlock, priors: Priors, huber_sigmas: float = np.inf) -> Adjustment:
    return Adjustment(
        block.observations,
        len(block.centres_m),
        len(block.points_m),
        priors,
        huber_sigmas=huber_sigmas,
        robust_positions=False,
    )


def brown_and_field() -> BoolArray:
    free = lens_mask(BROWN)
    free[-len(FIELD_NAMES) :] = True
    return free


def small(name: str = "demo", seed: int = 1, n_points: int = 200, **options: float) -> SimBlock:
    return survey(name, seed, SimOptions(n_points=n_points, **options))  # type: ignore[arg-type]


def f_error_sigmas(lens: Lens, truth: Lens, covariance: FloatArray) -> FloatArray:
    """Errors of all parameters over their formal sigmas (NaN where held)."""
    sigma = np.sqrt(np.diag(covariance))
    return (lens.vector - truth.vector) / np.where(sigma > 0, sigma, np.nan)


@lru_cache(maxsize=128)
def solved(name: str, seed: int, n_points: int, **options: float) -> tuple[SimBlock, Calibrated]:
    """A simulated block and its self-calibration; made once for all tests that ask for the same."""
    block = small(name, seed, n_points, **options)
    return block, calibrate_block(block, NOMINAL_F_PX, seed)

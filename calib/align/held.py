"""A block whose lens is held at a reference, and what its photos say about that lens all the same."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from calib.align.adjust import Adjusted
from calib.align.dome import second_order_design, site_radius_m
from calib.align.selfcal import Calibrated, hold
from calib.brownfit import fit_brown
from calib.camera import BROWN_NAMES, FloatArray
from calib.field import Lens
from calib.solution import Estimate, HeldFit

#: Rings of the sensor in which radial residuals are averaged, of equal area.
RINGS = 8
#: Rings with fewer tie points say nothing.
LEAST_IN_RING = 30
RADIAL = [BROWN_NAMES.index(name) for name in ("f", "k1", "k2", "k3")]


@dataclass(frozen=True)
class Held:
    """``calibrated``: the block with its lens held."""

    calibrated: Calibrated
    fit: HeldFit


def held_block(
    block: Calibrated,
    estimate: Estimate,
    reference: Lens,
    reference_covariance: FloatArray,
    flying_height_m: float,
    tick: Callable[[], None] | None = None,
) -> Held:
    """Hold the lens at the reference and measure what speaks against it.

    Args:
        block: the self-calibrated block; estimate: its honest calibration.
        reference_covariance: (35, 35) over ``LENS_NAMES``.
    """
    adjusted = hold(block, reference, tick)
    move_percent, move_p = _move(estimate, reference, reference_covariance)
    radius, mean, sigma = _rings(block, adjusted, estimate.correlation_factor)
    bend = _position_dome_m(block, adjusted)
    dome, sigma_dome = (None, None) if bend is None else (100 * b / flying_height_m for b in bend)
    fit = HeldFit(move_percent, move_p, radius, mean, sigma, dome, sigma_dome)
    return Held(replace(block, adjusted=adjusted), fit)


def _move(estimate: Estimate, reference: Lens, reference_covariance: FloatArray) -> tuple[float, float]:
    """f of the free lens over the reference's, percent, and the probability of its f and K1-K3 (chi-square).

    Of Brown's parameters fitted to both mappings, as everywhere: patterns beyond Brown would show in a
    test of the whole lens, and do no harm to the heights.
    """
    brown, by_lens = fit_brown(reference)
    covariance = estimate.covariance + by_lens @ reference_covariance @ by_lens.T
    step = (estimate.brown.vector - brown.vector)[RADIAL]
    scale = 1 / np.sqrt(np.diag(covariance)[RADIAL])
    unit = covariance[np.ix_(RADIAL, RADIAL)] * np.outer(scale, scale)
    square = float((step * scale) @ np.linalg.solve(unit, step * scale))
    return 100 * (estimate.brown.f_px / brown.f_px - 1), float(chdtrc(len(RADIAL), max(square, 0.0)))


def _rings(
    block: Calibrated, held: Adjusted, correlation_factor: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Middle radius, mean radial residual and its sigma of rings of equal area, px."""
    brown, obs = held.state.lens.brown, block.observations
    offset = obs.pixels - [brown.cx_px, brown.cy_px]
    distance = np.linalg.norm(offset, axis=1)
    radial = np.sum(held.residuals_px * offset, axis=1) / np.maximum(distance, 1e-9)
    good = held.weights > 0.1
    edge = np.sqrt(np.linspace(0, 1, RINGS + 1)) * np.hypot(brown.width, brown.height) / 2
    ring = np.clip(np.searchsorted(edge, distance, side="right") - 1, 0, RINGS - 1)
    rows = []
    for i in range(RINGS):
        inside = radial[good & (ring == i)]
        if len(inside) < LEAST_IN_RING:
            continue
        sigma = float(np.std(inside)) * np.sqrt(correlation_factor / len(inside))
        rows.append(((edge[i] + edge[i + 1]) / 2, float(np.mean(inside)), sigma))
    table = np.array(rows).reshape(-1, 3)
    return table[:, 0], table[:, 1], table[:, 2]


def _position_dome_m(block: Calibrated, held: Adjusted) -> tuple[float, float] | None:
    """Bend of the cameras' heights against the measured ones over the radius of the site, and its sigma."""
    priors = block.adjustment.priors
    sigma = priors.centre_sigma_m[:, 2]
    # Positions that only hold the gauge are where the block stood.
    extent = float(np.linalg.norm(held.state.centres_m - held.state.centres_m.mean(axis=0), axis=1).max())
    use = np.isfinite(sigma) & (sigma < extent) & (held.position_weights > 0.1)
    design = second_order_design(held.state.centres_m, site_radius_m(held.state.points_m))[use]
    if len(design) < 12 or np.linalg.matrix_rank(design) < 6:
        return None
    height = (held.state.centres_m[:, 2] - priors.centres_m[:, 2])[use]
    # Tilt, scale and shift are in the design's first terms, so the gauge does not matter.
    found = np.linalg.lstsq(design, height, rcond=None)[0]
    variance = float(np.sum((height - design @ found) ** 2)) / (len(height) - 6)
    spread = np.linalg.inv(design.T @ design)[3, 3]
    return -float(found[3]), float(np.sqrt(variance * spread))

"""Slopes against elevation: their sigmas hold, and what the ground cannot show is not told."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.elevation import Case, bumps_m, cloud_of
from calib.assess.data import assessment_json
from calib.assess.elevation import TOLD_SIGMA, robust_trend
from calib.assess.model import ElevationTrend, elevation_trend, seven_derivatives
from calib.assess.page import render_assessment
from calib.assess.register import NO_ERROR, PRIOR_SIGMAS
from calib.assess.study import assess_cloud
from calib.assess.words import elevation_text
from calib.camera import FloatArray
from sim.relief import Relief

SLOPE, NOISE_M, HALF_M = 0.03, 0.02, 60.0


def _residuals(
    seed: int, relief_m: float, points: int, bump_m: float, length_m: float = 20.0, dome_m: float = 0.2
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points as surveyed, what a cloud with a stretch, a dome and bumps leaves at them, derivatives."""
    rng = np.random.default_rng(seed)
    relief = Relief.random(seed, relief_m)
    xy = rng.uniform(-HALF_M, HALF_M, (points, 2))
    height, east, north = relief.height_and_gradient(*xy.T)
    surveyed = height + NOISE_M * rng.normal(size=points)
    cloud = (1 + SLOPE) * height + dome_m * (1 - np.sum(xy**2, axis=1) / HALF_M**2)
    cloud += bumps_m(xy, bump_m, length_m, rng) + 0.005 * rng.normal(size=points)
    reference = np.column_stack([xy, surveyed])
    directions = np.column_stack([east, north, -np.ones(points)])
    derivatives = np.einsum("nj,njp->np", directions, seven_derivatives(NO_ERROR, reference))
    return reference, cloud - surveyed, derivatives


def _trend(seed: int, relief_m: float, points: int, bump_m: float, length_m: float = 20.0) -> ElevationTrend:
    found = robust_trend(*_residuals(seed, relief_m, points, bump_m, length_m), np.diag(PRIOR_SIGMAS**2))
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("relief_m", "points", "bump_m", "length_m"),
    [(2.0, 120, 0.03, 20.0), (8.0, 120, 0.06, 40.0), (8.0, 60, 0.0, 1.0)],
)
def test_sigma_holds_where_neighbours_share_errors(
    relief_m: float, points: int, bump_m: float, length_m: float
) -> None:
    """Bounds on both sides; a plain regression of the same residuals is far outside."""
    z, plain = [], []
    for seed in range(16):
        found = _trend(seed, relief_m, points, bump_m, length_m)
        z.append((found.slope - SLOPE) / found.sigma)
        reference, residual, _ = _residuals(seed, relief_m, points, bump_m, length_m)
        simple = elevation_trend(reference[:, 2], residual)
        plain.append((simple.slope - SLOPE) / simple.sigma)
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.35
    assert np.mean(np.abs(z) > 2) <= 0.15
    assert np.sqrt(np.mean(np.square(plain))) > 1.8


def test_noise_of_the_survey_makes_no_slope_on_flat_ground() -> None:
    """A hand's breadth of relief, many points: the plain slope is pulled down by the noise's own share."""
    slopes, plain = [], []
    for seed in range(4):
        reference, residual, derivatives = _residuals(seed, 0.25, 1500, 0.0, dome_m=0.0)
        found = robust_trend(reference, residual, derivatives, np.diag(PRIOR_SIGMAS**2))
        assert found is not None
        slopes.append((found.slope - SLOPE) / found.sigma)
        plain.append(elevation_trend(reference[:, 2], residual).slope)
    assert np.sqrt(np.mean(np.square(slopes))) < 1.8
    assert np.mean(plain) < SLOPE - 0.02


def test_what_flat_ground_cannot_show_is_not_told() -> None:
    flat = [_trend(seed, 0.2, 150, 0.03) for seed in range(8)]
    assert not any(found.told for found in flat)
    assert all(found.sigma > TOLD_SIGMA for found in flat)
    steep = [_trend(seed, 8.0, 150, 0.03) for seed in range(8)]
    assert all(found.told and found.sigma < 0.02 for found in steep)


def test_no_relief_and_few_points() -> None:
    reference, residual, derivatives = _residuals(0, 2.0, 40, 0.0)
    free = np.diag(PRIOR_SIGMAS**2)
    assert robust_trend(reference[:19], residual[:19], derivatives[:19], free) is None
    level = reference * [1, 1, 0]
    found = robust_trend(level, residual, derivatives, free)
    assert found is not None
    assert not found.told
    assert np.isinf(found.sigma)


def test_the_report_says_that_the_ground_is_too_flat() -> None:
    made = assess_cloud(*cloud_of(Case("flat", "bumps of 20 m", 0.0, 60, 3)))
    said = elevation_text(made)
    assert said is not None
    assert "the ground is too flat" in said
    assert "the ground is too flat" in render_assessment(made)
    assert json.loads(assessment_json(made))["elevation"]["told"] is False


def test_a_stretch_is_found_that_the_registration_took_for_scale() -> None:
    made = assess_cloud(*cloud_of(Case("steep", "bumps of 20 m", 0.03, 300, 1)))
    assert made.trend is not None
    assert made.trend.told
    assert abs(made.trend.slope - 0.03) < 3 * made.trend.sigma
    assert made.trend.sigma < 0.01

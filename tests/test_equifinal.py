"""Equifinal lines: closed form against Monte Carlo, and both against what [C&D] published."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from table3 import FLIGHTS

from calib.equifinal import (
    MINIMAX_ALPHA,
    MINIMAX_BETA,
    MINIMAX_ERROR,
    Radial,
    best_pair,
    equifinal_region,
    profile_deviation,
    tolerance_px,
)
from calib.equifinal_montecarlo import cd_box, monte_carlo
from calib.equifinal_published import (
    CD_BOX,
    CUBIC_7,
    CUBIC_8,
    LINE_5,
    LINE_6,
    P3P_WALL,
    P3P_WALL_F_PX,
    clip_to_line,
    implied_optimum,
    rescaled,
)
from calib.errors import InputError

I1_IMPLIED = implied_optimum(LINE_6, CUBIC_8)
R = 2000.0


@pytest.mark.parametrize(("optimum", "published"), [(P3P_WALL, LINE_5), (I1_IMPLIED, LINE_6)])
def test_monte_carlo_reproduces_the_published_lines(optimum, published):
    drawn = monte_carlo(optimum, R)
    assert drawn.slope == pytest.approx(published.slope, rel=0.05)
    assert drawn.intercept == pytest.approx(published.intercept, rel=0.08)
    # The published domains are a little narrower than what 2 px allows.
    assert drawn.k1_min < published.k1_min < published.k1_max < drawn.k1_max
    assert drawn.k2_min < published.k2_min < published.k2_max < drawn.k2_max


def test_monte_carlo_draws_from_the_published_box():
    assert np.allclose(cd_box(P3P_WALL, R), CD_BOX, rtol=1e-12)


@pytest.mark.parametrize(
    ("optimum", "radius", "tolerance", "k3_model"),
    [
        (P3P_WALL, 2000.0, 2.0, 0.0),
        (P3P_WALL, 2000.0, 2.0, P3P_WALL.k3_px),
        (P3P_WALL, 2000.0, 10.0, 0.0),
        (P3P_WALL, 1500.0, 0.5, 0.0),
        (P3P_WALL, 2500.0, 3.0, 0.0),
        (I1_IMPLIED, 2000.0, 2.0, 0.0),
        (Radial(-7.5e-10, 2.8e-16, -2.8e-23), 2736.0, 2.0, -2.8e-23),
    ],
)
def test_closed_form_agrees_with_monte_carlo(optimum, radius, tolerance, k3_model):
    region = equifinal_region(optimum, radius, tolerance, k3_model)
    drawn = monte_carlo(optimum, radius, tolerance, k3_model, draws=200_000)
    assert region.slope == pytest.approx(drawn.slope, rel=0.001)
    assert region.intercept == pytest.approx(drawn.intercept, rel=0.003)
    # Domain: the draws fill the region to its tips, and never leave it.
    line = region.line
    width = line.k1_max - line.k1_min
    assert line.k1_min <= drawn.k1_min < line.k1_min + 0.02 * width
    assert line.k1_max - 0.02 * width < drawn.k1_max <= line.k1_max
    # The area of the region is the share of the box that the plain draws hit.
    x, y = (region.corners - region.corners[0]).T
    area = abs(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2
    (a, b), (c, d) = drawn.box
    assert drawn.share == pytest.approx(area / ((b - a) * (d - c)), rel=0.2)


def test_corners_lie_on_the_tolerance_and_the_line_passes_through_the_middle():
    region = equifinal_region(P3P_WALL, R, 2.0)
    for k1, k2 in region.corners[::20]:
        assert profile_deviation(Radial(k1, k2), P3P_WALL, R).raw_px == pytest.approx(2.0, rel=1e-3)
    assert region.offset_k2_px(*region.centroid) == pytest.approx(0, abs=1e-22)
    # A step across the band leaves the tolerance, a step along the line does not.
    k1, k2 = region.centroid
    assert profile_deviation(Radial(k1, k2), P3P_WALL, R).raw_px < 1.0
    assert profile_deviation(Radial(k1, k2 + 1.5 * region.band_k2_px), P3P_WALL, R).raw_px > 2.0
    along = 0.25 * (region.line.k1_max - region.line.k1_min)
    assert profile_deviation(Radial(k1 + along, k2 + along * region.slope), P3P_WALL, R).raw_px < 2.0


def test_the_slope_goes_with_the_inverse_square_of_the_radius():
    kept = P3P_WALL.k3_px
    near = equifinal_region(P3P_WALL, 1000.0, 2.0, kept).slope
    far = equifinal_region(P3P_WALL, 2000.0, 2.0, kept).slope
    assert near / far == pytest.approx(4.0, rel=1e-9)


def test_line_5_follows_for_a_radius_near_1970():
    region = equifinal_region(P3P_WALL, 1970.0, 2.0)
    assert region.slope == pytest.approx(LINE_5.slope, rel=0.005)
    assert region.intercept == pytest.approx(LINE_5.intercept, rel=0.01)


def test_minimax_constants_alternate():
    s = np.linspace(0, 1, 20001)
    error = s**7 - MINIMAX_ALPHA * s**3 - MINIMAX_BETA * s**5
    assert np.abs(error).max() == pytest.approx(MINIMAX_ERROR, rel=1e-4)
    # Three alternations of the same size: no pair of coefficients does better (Chebyshev).
    peaks = error[np.abs(error) > 0.999 * MINIMAX_ERROR]
    assert np.count_nonzero(np.diff(np.sign(peaks))) == 2


def test_a_lens_that_no_pair_can_match_is_refused_in_words():
    wild = Radial(-2.5e-8, 4e-15, -1.5e-21)
    pair, misfit = best_pair(wild, R)
    assert misfit > 2
    assert pair.k3_px == 0
    with pytest.raises(InputError, match="comes within 2 px"):
        equifinal_region(wild, R, 2.0)
    with pytest.raises(InputError, match="draws"):
        monte_carlo(wild, R, 2.0, draws=2000)
    with pytest.raises(InputError, match="radius"):
        equifinal_region(P3P_WALL, float("nan"))
    with pytest.raises(InputError, match="tolerance"):
        equifinal_region(P3P_WALL, R, 0.0)


def test_table_3_follows_from_line_7_in_six_of_eight():
    reproduced = set()
    for name, (f, k1, k2, k3, printed) in FLIGHTS.items():
        radial = Radial(k1 * 1e-8, k2 * 1e-15, k3 * 1e-23)
        if name == "B2":  # printed in pixel units of its own, wrong focal length
            radial = rescaled(radial, f, P3P_WALL_F_PX)
        error = abs(radial.k2_px - CUBIC_7.k2_px(radial.k1_px))
        if abs(error * 1e15 - printed) < 0.03:
            reproduced.add(name)
    assert reproduced == {"A3", "A4", "B1", "B2", "B3", "B4"}


def test_implied_optimum_recovers_the_known_wall_of_the_phantom():
    found = implied_optimum(LINE_5, CUBIC_7)
    assert found.k1_px == pytest.approx(P3P_WALL.k1_px, rel=0.005)
    assert found.k2_px == pytest.approx(P3P_WALL.k2_px, rel=0.05)
    assert found.k3_px == pytest.approx(P3P_WALL.k3_px, rel=0.35)


def test_clipping_to_a_line_ends_on_it():
    for k1 in (-3e-8, -2.45e-8, -2e-8):
        clipped = clip_to_line(Radial(k1, 5e-15, -1e-22), LINE_5)
        assert LINE_5.k1_min <= clipped.k1_px <= LINE_5.k1_max
        assert clipped.k2_px == pytest.approx(LINE_5.slope * clipped.k1_px + LINE_5.intercept)


def test_tolerance_at_the_published_points_and_between():
    assert tolerance_px(10, 50) == 10
    assert tolerance_px(60, 120) == 2
    assert tolerance_px(5, 100) == 10
    assert tolerance_px(None, 100) == tolerance_px(60, None) == 2
    # High above a wide site is not low, whatever the ratio.
    assert tolerance_px(100, 1000) == 2
    assert 2 < tolerance_px(20, 60) < 10


@given(st.floats(1, 500), st.floats(1, 2000), st.floats(1.01, 2))
def test_tolerance_never_grows_with_height(height, width, factor):
    assert 2 <= tolerance_px(height * factor, width) <= tolerance_px(height, width) <= 10


@settings(max_examples=50, deadline=None)
@given(st.floats(-5e-8, 5e-8), st.floats(-8e-15, 8e-15), st.floats(-3e-22, 3e-22))
def test_deviation_is_zero_only_for_the_same_profile_and_scale_is_taken_out(k1, k2, k3):
    a = Radial(k1, k2, k3)
    assert profile_deviation(a, a, R).raw_px == 0
    b = Radial(k1 + 1e-9, k2, k3)
    d = profile_deviation(b, a, R)
    assert d.raw_px == pytest.approx(8.0, rel=1e-9)
    # Of r^3, 2/3 R^2 r is taken out when every pixel counts the same: a third is left at the edge.
    assert d.linear_removed_px == pytest.approx(d.raw_px / 3, rel=0.01)


def test_sigma_of_the_deviation_is_that_of_samples():
    rng = np.random.default_rng(3)
    scale = np.diag([1e-10, 2e-17, 5e-25])
    root = scale @ np.array([[1, 0, 0], [-0.9, 0.4, 0], [0.5, -0.3, 0.2]])
    covariance = root @ root.T
    far = Radial(P3P_WALL.k1_px + 3e-9, P3P_WALL.k2_px, P3P_WALL.k3_px)
    predicted = profile_deviation(far, P3P_WALL, R, covariance)
    drawn = []
    for noise in rng.standard_normal((2000, 3)) @ root.T:
        drawn.append(profile_deviation(Radial(*(far.vector + noise)), P3P_WALL, R).raw_px)
    assert np.std(drawn) == pytest.approx(predicted.sigma_raw_px, rel=0.08)

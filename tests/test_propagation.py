import numpy as np
import pytest
import result_factory

from calib.camera import BrownCamera, radial_profile_px
from calib.propagation import (
    correlations,
    parameter_sigmas,
    profile_px,
    profile_sigma_px,
    radial_px,
    radial_px_covariance,
)


def test_pixel_units_agree_with_the_camera() -> None:
    brown = result_factory.p3p_camera()
    assert radial_px(brown)[:3] == pytest.approx([brown.k1_px, brown.k2_px, brown.k3_px], rel=1e-14)
    radius = np.linspace(0, 2500, 11)
    expected = radial_profile_px(brown.k1_px, brown.k2_px, brown.k3_px, radius)
    assert profile_px(brown, radius) == pytest.approx(expected, abs=1e-9)


def test_sigmas_match_a_sample() -> None:
    brown = result_factory.p3p_camera()
    covariance = result_factory.brown_covariance()
    # A large sigma of f shows whether its part of the Jacobian is there.
    covariance[0, :] *= 8
    covariance[:, 0] *= 8
    rng = np.random.default_rng(1)
    vectors = rng.multivariate_normal(brown.vector, covariance, 4000, method="eigh")
    cameras = [BrownCamera.from_vector(brown.width, brown.height, v) for v in vectors]
    sampled = np.cov(np.array([radial_px(c)[:3] for c in cameras]).T)
    predicted = radial_px_covariance(brown, covariance)[:3, :3]
    assert np.sqrt(np.diag(predicted)) == pytest.approx(np.sqrt(np.diag(sampled)), rel=0.06)
    radius = np.array([800.0, 1500.0, 2400.0])
    spread = np.std([profile_px(c, radius) for c in cameras], axis=0)
    assert profile_sigma_px(brown, covariance, radius) == pytest.approx(spread, rel=0.06)


def test_without_the_focal_length_the_sigma_of_k1_would_be_wrong() -> None:
    brown = result_factory.p3p_camera()
    covariance = np.zeros((11, 11))
    covariance[0, 0] = 10.0**2
    sigma_k1 = np.sqrt(radial_px_covariance(brown, covariance)[0, 0])
    assert sigma_k1 == pytest.approx(2 * abs(brown.k1_px) * 10 / brown.f_px, rel=1e-12)


def test_sigmas_tell_held_from_unknown() -> None:
    result = result_factory.build(points=200)
    sigmas = parameter_sigmas(result.estimate)
    assert sigmas["f_px"] == pytest.approx(0.55)
    assert sigmas["k4"] == 0
    unknown = parameter_sigmas(result_factory.with_nan_sigmas(result).estimate)
    assert all(np.isnan(v) for v in unknown.values())


def test_correlations_leave_out_what_was_held() -> None:
    keys, matrix = correlations(result_factory.brown_covariance())
    assert keys == ("f_px", "cx_px", "cy_px", "k1", "k2", "k3", "p1", "p2")
    assert np.diag(matrix) == pytest.approx(1)
    assert matrix[3, 4] == pytest.approx(-0.96)
    assert correlations(np.full((11, 11), np.nan))[0] == ()

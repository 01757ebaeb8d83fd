"""Seven-parameter transformations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from calib.camera import FloatArray
from calib.similarity import Similarity, fit_robust, fit_similarity, mean_rotation


def random_similarity(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=rng).as_matrix()
    return Similarity(float(np.exp(rng.normal(0, 2))), rotation, rng.normal(0, 500, 3))


def cloud(seed: int, n: int = 30) -> FloatArray:
    points: FloatArray = np.random.default_rng([seed, 1]).normal(0, [40, 30, 5], (n, 3))
    return points


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000), st.integers(3, 40))
def test_exact_points_give_the_transformation_back(seed: int, n: int) -> None:
    true, points = random_similarity(seed), cloud(seed, n)
    found = fit_similarity(points, true.apply(points))
    assert found.scale == pytest.approx(true.scale, rel=1e-9)
    assert np.allclose(found.rotation, true.rotation, atol=1e-7)
    assert np.allclose(found.apply(points), true.apply(points), rtol=1e-9, atol=1e-6)
    assert np.linalg.det(found.rotation) == pytest.approx(1)


def test_mirrored_points_are_not_mirrored_back() -> None:
    points = cloud(1)
    found = fit_similarity(points, points * [1, 1, -1])
    assert np.linalg.det(found.rotation) == pytest.approx(1)
    assert np.allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-12)


def test_noise_leaves_a_small_error() -> None:
    true, errors = random_similarity(4), []
    for seed in range(30):
        points = cloud(seed)
        noise = np.random.default_rng(seed).normal(0, 0.1, points.shape)
        found = fit_similarity(points, true.apply(points) + noise)
        errors.append(np.log(found.scale / true.scale))
    # Scale: noise over the size of the cloud.
    expected = 0.1 / true.scale / np.sqrt(30 * (40**2 + 30**2 + 5**2))
    assert 0.7 < np.std(errors) / expected < 1.4


def test_weights_choose_the_points() -> None:
    points, true = cloud(2), random_similarity(2)
    target = true.apply(points)
    target[:5] += 1000
    weights = np.r_[np.zeros(5), np.ones(25)]
    found = fit_similarity(points, target, weights)
    assert np.allclose(found.apply(points[5:]), target[5:], atol=1e-6)


def test_robust_fit_ignores_a_minority() -> None:
    points, true = cloud(3), Similarity(2.0, np.eye(3), np.array([10.0, 20.0, 30.0]))
    rng = np.random.default_rng(0)
    sigma = np.full(points.shape, 0.5)
    target = true.apply(points) + rng.normal(0, 0.5, points.shape)
    target[:8] += [120.0, -60.0, 40.0]
    found, residual = fit_robust(points, target, sigma)
    plain = fit_similarity(points, target)
    away = np.abs(found.apply(points) - true.apply(points)).max()
    assert away < 1.5
    assert np.abs(plain.apply(points) - true.apply(points)).max() > 20
    assert np.linalg.norm(residual[:8], axis=1).min() > 100
    assert 0.3 < np.sqrt(np.mean(residual[8:] ** 2)) < 0.8
    assert np.allclose(residual, target - found.apply(points))


def test_mean_rotation_is_in_the_middle() -> None:
    base = Rotation.from_euler("xyz", [10, -40, 130], degrees=True)
    axis = np.array([0.3, -0.5, 0.8])
    pair = np.stack([(Rotation.from_rotvec(s * axis) * base).as_matrix() for s in (0.4, -0.4)])
    assert np.allclose(mean_rotation(pair), base.as_matrix(), atol=1e-9)
    many = np.stack(
        [
            (Rotation.from_rotvec(v) * base).as_matrix()
            for v in np.random.default_rng(0).normal(0, 0.05, (400, 3))
        ]
    )
    error = Rotation.from_matrix(mean_rotation(many) @ base.as_matrix().T).magnitude()
    assert error < 4 * 0.05 / np.sqrt(400) * np.sqrt(3)

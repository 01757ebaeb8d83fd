"""Errors of receivers: of the size and behaviour that they state, bounds on both sides."""

from __future__ import annotations

import numpy as np
import pytest

from calib.camera import FloatArray
from sim.gps import GpsKind, position_errors

SIGMA = (2.5, 4.0)
FLIGHTS, PHOTOS = 400, 40
SECONDS = 10.0 * np.arange(PHOTOS)


def sampled(kind: GpsKind, **options: float) -> FloatArray:
    """Errors of many flights, (flights, photos, 3)."""
    rng = np.random.default_rng(4)
    return np.stack(
        [
            position_errors(kind, rng.normal(size=(PHOTOS, 3)), SECONDS, SIGMA, **options)
            for _ in range(FLIGHTS)
        ]
    )


def correlation(errors: FloatArray, lag: int) -> float:
    a, b = errors[:, :-lag] / [2.5, 2.5, 4.0], errors[:, lag:] / [2.5, 2.5, 4.0]
    return float(np.mean(a * b))


@pytest.mark.parametrize("kind", [GpsKind.WHITE, GpsKind.RTK])
def test_white_errors(kind: GpsKind) -> None:
    errors = sampled(kind)
    assert errors.std(axis=(0, 1)) == pytest.approx([2.5, 2.5, 4.0], rel=0.02)
    assert errors.mean(axis=(0, 1)) == pytest.approx([0, 0, 0], abs=0.1)
    assert abs(correlation(errors, 1)) < 0.02


def test_drift_keeps_its_size_and_forgets_with_its_time_constant() -> None:
    errors = sampled(GpsKind.DRIFT, time_constant_s=100.0)
    for photo in (0, 1, PHOTOS // 2, PHOTOS - 1):
        assert errors[:, photo].std(axis=0) == pytest.approx([2.5, 2.5, 4.0], rel=0.12)
    for lag in (1, 5, 10):
        assert correlation(errors, lag) == pytest.approx(np.exp(-lag / 10), abs=0.06)
    # Neighbours differ by much less than their size.
    step = np.diff(errors[..., 0], axis=1).std()
    assert step == pytest.approx(2.5 * np.sqrt(2 * (1 - np.exp(-0.1))), rel=0.03)


def test_a_drift_that_never_forgets_is_constant() -> None:
    errors = sampled(GpsKind.DRIFT, time_constant_s=float("inf"))
    assert np.ptp(errors, axis=1).max() == 0
    assert errors[:, 0].std(axis=0) == pytest.approx([2.5, 2.5, 4.0], rel=0.12)


def test_walk_grows_with_the_root_of_time() -> None:
    errors = sampled(GpsKind.WALK)
    assert np.abs(errors[:, 0]).max() == 0
    for photo in (6, 24):  # one and four minutes
        wanted = np.array([2.5, 2.5, 4.0]) * np.sqrt(SECONDS[photo] / 60)
        assert errors[:, photo].std(axis=0) == pytest.approx(wanted, rel=0.12)


def test_offset_is_one_vector_of_the_stated_size() -> None:
    errors = sampled(GpsKind.OFFSET)
    assert np.ptp(errors, axis=1).max() == 0
    assert np.hypot(errors[..., 0], errors[..., 1]) == pytest.approx(2.5)
    assert np.abs(errors[..., 2]) == pytest.approx(4.0)
    # In all directions.
    assert np.abs(errors[:, 0, :2].mean(axis=0)).max() < 0.3

"""M7 and eta against known similarities and known domes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from calib.assess import Surface, assess, elevation_trend, profile, seven_parameters
from calib.camera import FloatArray
from calib.errors import InputError

ANGLE = st.floats(-80, 80)
SHIFT = st.floats(-50, 50)


def _site(seed: int, n: int = 400) -> FloatArray:
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-60, 60, (n, 2))
    return np.column_stack([xy, 3 * np.sin(xy[:, 0] / 25) + xy[:, 1] / 30])


@settings(max_examples=60, deadline=None)
@given(st.lists(SHIFT, min_size=3, max_size=3), st.lists(ANGLE, min_size=3, max_size=3), st.floats(0.5, 2))
def test_a_known_similarity_comes_back(shift: list[float], angles: list[float], scale: float) -> None:
    points = _site(1)
    # First about z, then x, then y ([C&D] results).
    turn = Rotation.from_euler("zxy", angles, degrees=True).as_matrix()
    moved = scale * points @ turn.T + shift
    found = seven_parameters(points, moved)
    assert found.values == pytest.approx([*shift, *angles, 100 * scale], abs=1e-7)
    assert found.sigmas.max() < 1e-6


def test_the_order_of_the_rotations_is_the_papers() -> None:
    x, y, z = np.eye(3)
    about_z_then_x = seven_parameters(
        _site(2), _site(2) @ Rotation.from_euler("z", 90, degrees=True).as_matrix().T
    )
    assert about_z_then_x.similarity.rotation @ x == pytest.approx(y)
    assert about_z_then_x.values[3:6] == pytest.approx([90, 0, 0], abs=1e-9)
    assert z @ about_z_then_x.similarity.rotation @ z == pytest.approx(1)


def test_sigmas_are_the_spread_of_repeated_registrations() -> None:
    points = _site(3, 60)
    found = [
        seven_parameters(points, points + np.random.default_rng(s).normal(0, 0.05, points.shape))
        for s in range(300)
    ]
    spread = np.std([f.values for f in found], axis=0)
    told = np.mean([f.sigmas for f in found], axis=0)
    assert np.all((told / spread > 0.85) & (told / spread < 1.17))


@settings(max_examples=30, deadline=None)
@given(st.floats(-2, 2), st.floats(0, 0.2))
def test_eta_of_a_known_dome(dome: float, noise: float) -> None:
    reference = _site(4, 3000)
    rng = np.random.default_rng(5)
    bent = reference.copy()
    r2 = np.sum(reference[:, :2] ** 2, axis=1) / 60**2
    bent[:, 2] += dome * (1 - r2) + noise * rng.normal(size=len(bent))
    # Registered on an undisturbed copy, so that M7 takes nothing of the dome.
    found = assess(bent, reference, (reference, reference))
    expected = np.hypot(dome * r2.std(), noise)
    assert found.eta_p_m == pytest.approx(expected, rel=0.06, abs=1e-9)
    _, mean, spread = profile(found.points_m, found.eta_m, np.array([-60, 0]), np.array([60, 0]), 12, 12)
    assert mean[5:7] == pytest.approx([dome, dome], abs=0.03 * abs(dome) + 0.8 * noise + 1e-9)
    assert mean[0] == pytest.approx(dome * (1 - (55 / 60) ** 2), abs=0.06 * abs(dome) + 0.8 * noise + 1e-9)
    assert np.nanmax(spread) <= 2 * noise + 0.2 * abs(dome) + 1e-9


def test_vertical_scale_shows_against_elevation() -> None:
    reference = _site(6)
    stretched = reference * [1, 1, 1.05]
    found = assess(stretched, reference, (reference, reference))
    trend = elevation_trend(found.points_m[:, 2] / 1.05, found.eta_m)
    assert trend.slope == pytest.approx(0.05, abs=1e-9)
    assert trend.correlation == pytest.approx(1)
    assert trend.sigma < 1e-9


def test_surface_is_signed_and_ends_at_its_hull() -> None:
    surface = Surface(np.array([[0, 0, 0], [1, 0, 1], [0, 1, 0], [1, 1, 1.0]]))
    above, below, outside = surface.signed_distance_m(np.array([[0.5, 0.5, 1], [0.5, 0.2, 0], [2, 2, 0.0]]))
    assert above == pytest.approx(0.5)
    assert below == pytest.approx(-0.5)
    assert np.isnan(outside)


@pytest.mark.parametrize(
    ("reference", "model"),
    [
        (np.zeros((2, 3)), np.zeros((2, 3))),
        (np.arange(9.0).reshape(3, 3) * [1, 0, 0], np.zeros((3, 3))),
        (np.zeros((5, 3)), np.zeros((4, 3))),
        (np.full((5, 3), np.nan), np.zeros((5, 3))),
        (np.zeros((0, 3)), np.zeros((0, 3))),
    ],
)
def test_what_cannot_be_registered_is_refused(reference: FloatArray, model: FloatArray) -> None:
    with pytest.raises(InputError):
        seven_parameters(reference, model)


def test_a_model_beside_its_reference_is_refused() -> None:
    reference = _site(7)
    with pytest.raises(InputError, match="No point"):
        assess(reference + np.array([500, 0, 0]), reference, (reference, reference))
    with pytest.raises(InputError, match="no surface"):
        Surface(np.zeros((5, 3)))

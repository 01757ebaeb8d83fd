"""Rotations from gimbal angles, local frames, UTM."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.frames import (
    LocalFrame,
    gimbal_from_downward_body,
    gimbal_from_rotation,
    heights_m,
    local_positions,
    project,
    rotation_cam_from_world,
    rotation_tilt_deg,
    tilt_deg,
    utm_crs,
)
from calib.photos.photo import GimbalAngles, Position

EAST, NORTH, UP = np.eye(3)
angle = st.floats(-180, 180)


def axes(gimbal: GimbalAngles) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World directions of image right, image top and the optical axis."""
    right, down, forward = rotation_cam_from_world(gimbal)
    return right, -down, forward


@pytest.mark.parametrize(
    ("angles", "right", "top", "forward"),
    [
        ((0, -90, 0), EAST, NORTH, -UP),
        ((90, -90, 0), -NORTH, EAST, -UP),
        ((0, 0, 0), EAST, UP, NORTH),
        ((90, 0, 0), -NORTH, UP, EAST),
        ((180, 0, 0), -EAST, UP, -NORTH),
        # Roll to the right: the image top leans to the right.
        ((0, 0, 90), -UP, EAST, NORTH),
        # Upside down at nadir: image top looks south.
        ((0, -90, 180), -EAST, -NORTH, -UP),
        ((0, -45, 0), EAST, (NORTH + UP) / np.sqrt(2), (NORTH - UP) / np.sqrt(2)),
    ],
)
def test_known_attitudes(angles, right, top, forward):
    for got, want in zip(axes(GimbalAngles(*angles)), (right, top, forward), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-12)


@given(angle, st.floats(-180, 180), angle)
def test_round_trip_through_the_rotation(yaw, pitch, roll):
    rotation = rotation_cam_from_world(GimbalAngles(yaw, pitch, roll))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    back = gimbal_from_rotation(rotation)
    assert -90 <= back.pitch_deg <= 90
    # Where the axis is vertical to 1e-9, yaw and roll share an axis and one of them is dropped.
    np.testing.assert_allclose(rotation_cam_from_world(back), rotation, atol=3e-9)


@given(angle, st.floats(-89, 89), st.floats(-179, 179))
def test_round_trip_through_the_angles(yaw, pitch, roll):
    back = gimbal_from_rotation(rotation_cam_from_world(GimbalAngles(yaw, pitch, roll)))
    assert back.pitch_deg == pytest.approx(pitch, abs=1e-9)
    assert back.roll_deg == pytest.approx(roll, abs=1e-7)
    assert (back.yaw_deg - yaw + 180) % 360 - 180 == pytest.approx(0, abs=1e-7)


@given(angle, st.floats(-180, 180), angle)
def test_tilt_is_the_angle_between_axis_and_down(yaw, pitch, roll):
    gimbal = GimbalAngles(yaw, pitch, roll)
    forward = rotation_cam_from_world(gimbal)[2]
    assert tilt_deg(gimbal) == pytest.approx(np.degrees(np.arccos(np.clip(-forward[2], -1, 1))), abs=2e-6)
    assert rotation_tilt_deg(rotation_cam_from_world(gimbal)) == tilt_deg(gimbal)


@pytest.mark.parametrize(("pitch", "tilt"), [(-90, 0), (-60, 30), (-120, 30), (0, 90), (-15, 75), (90, 180)])
def test_tilt_of_pitches(pitch, tilt):
    assert tilt_deg(GimbalAngles(33.0, pitch, 0.0)) == pytest.approx(tilt, abs=1e-9)


def test_pix4d_examples():
    """The examples of Pix4D's article on yaw, pitch and roll."""
    nadir_north = axes(gimbal_from_downward_body(0, 0, 0))
    np.testing.assert_allclose(nadir_north[1], NORTH, atol=1e-9)
    np.testing.assert_allclose(nadir_north[2], -UP, atol=1e-9)
    forward_north = axes(gimbal_from_downward_body(0, 90, 0))
    np.testing.assert_allclose(forward_north[2], NORTH, atol=1e-9)
    np.testing.assert_allclose(forward_north[1], UP, atol=1e-9)
    nadir_east = axes(gimbal_from_downward_body(90, 0, 0))
    np.testing.assert_allclose(nadir_east[1], EAST, atol=1e-9)
    # Right wing down: the camera below looks to the left of the nose.
    banked = axes(gimbal_from_downward_body(0, 0, 20))
    np.testing.assert_allclose(banked[2], [-np.sin(np.radians(20)), 0, -np.cos(np.radians(20))], atol=1e-9)


@given(st.floats(-85, 85), st.floats(-180, 180), st.floats(-400, 5000))
def test_local_frame_round_trip(latitude, longitude, altitude):
    frame = LocalFrame(latitude, longitude, 100.0)
    enu = np.array([[120.0, -340.0, altitude - 100], [0.0, 0.0, 0.0]])
    geodetic = frame.geodetic(enu)
    np.testing.assert_allclose(frame.enu(*geodetic.T), enu, atol=1e-6)


def test_local_frame_axes():
    frame = LocalFrame(46.84, -91.99, 200.0)
    step = 1e-3  # a thousandth of a degree: 111.2 m along the meridian, times cos(latitude) across
    enu = frame.enu(np.array([46.84 + step, 46.84]), np.array([-91.99, -91.99 + step]), np.full(2, 200.0))
    np.testing.assert_allclose(enu[0, :2], [0, 111.17], atol=0.05)
    np.testing.assert_allclose(enu[1, :2], [76.2, 0], atol=0.1)
    above = frame.enu(np.array([46.84]), np.array([-91.99]), np.array([250.0]))
    np.testing.assert_allclose(above, [[0, 0, 50]], atol=1e-6)


@pytest.mark.parametrize(
    ("latitude", "longitude", "crs"),
    [
        (46.84, -91.99, "EPSG:32615"),
        (-33.9, 151.2, "EPSG:32756"),
        (0.0, -180.0, "EPSG:32601"),
        (0.0, 180.0, "EPSG:32601"),
        (51.5, -0.1, "EPSG:32630"),
        (51.5, 0.1, "EPSG:32631"),
        (5.0, 179.9, "EPSG:32660"),
        (-0.1, -72.5, "EPSG:32718"),
        (85.0, 10.0, "EPSG:32661"),
        (-81.0, 10.0, "EPSG:32761"),
    ],
)
def test_utm_zones(latitude, longitude, crs):
    assert utm_crs(latitude, longitude) == crs


def test_projection_on_the_central_meridian():
    east_north = project("EPSG:32615", np.array([46.84]), np.array([-93.0]))
    assert east_north[0, 0] == pytest.approx(500000, abs=1e-3)
    assert east_north[0, 1] == pytest.approx(5187396, abs=1000)


def test_heights_prefer_the_barometer_but_not_over_rtk():
    def at(altitude: float, height: float | None, sigma: float | None = None) -> Position:
        return Position(46.0, 8.0, altitude, height, sigma_vertical_m=sigma)

    np.testing.assert_allclose(heights_m([at(203, 50), at(200, 50), at(204, 51)]), [203, 203, 204])
    np.testing.assert_allclose(heights_m([at(203, 50, 0.02), at(200, 50, 0.02)]), [203, 200])
    np.testing.assert_allclose(heights_m([at(203, 50), at(200, None), None]), [203, 200, np.nan])
    assert heights_m([]).shape == (0,)


def test_local_positions_across_the_date_line_and_with_gaps():
    positions = [
        Position(10.0, 179.9999, 20.0),
        None,
        Position(10.0, -179.9999, 20.0),
        Position(10.0, 180.0, None),
    ]
    result = local_positions(positions)
    assert result is not None
    _, enu = result
    assert np.isnan(enu[1]).all()
    assert np.ptp(enu[[0, 2, 3], 0]) == pytest.approx(21.9, abs=0.2)
    assert np.ptp(enu[[0, 2, 3], 2]) < 0.01
    assert local_positions([None, None]) is None


def test_a_frame_takes_numpy_scalars_for_what_they_are() -> None:
    plain, scalar = LocalFrame(50.5, -3.25, 80.0), LocalFrame(*np.array([50.5, -3.25, 80.0]))
    away = (np.array([50.501]), np.array([-3.24]), np.array([95.0]))
    assert scalar.enu(*away) == pytest.approx(plain.enu(*away), abs=1e-9)
    assert np.linalg.norm(plain.enu(*away)) == pytest.approx(718.32, abs=0.05)

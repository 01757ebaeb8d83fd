"""Camera positions at exposure times against a path known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.frames import LocalFrame
from daemon.capture.position import LeverArm, Track, TrackSample

FRAME = LocalFrame(47.0, 8.0, 400.0)


def circle(rate_hz: float = 5.0, speed: float = 8.0, radius: float = 30.0, start_yaw: float = 350.0) -> Track:
    """A level circle flown clockwise, the nose along the path."""
    samples = []
    for t in np.arange(0, 20, 1 / rate_hz):
        yaw = np.radians(start_yaw) + speed * t / radius
        enu = np.array([[-radius * np.cos(yaw), radius * np.sin(yaw), 60.0]])
        latitude, longitude, altitude = FRAME.geodetic(enu)[0]
        samples.append(
            TrackSample(
                float(t),
                latitude,
                longitude,
                altitude,
                yaw_deg=float(np.degrees(yaw) % 360),
                sigma_horizontal_m=0.02,
            )
        )
    return Track(samples)


CIRCLE = circle()


@given(st.floats(0, 19.7))
def test_interpolated_within_its_sigma_and_yaw_across_north(time_s: float) -> None:
    got = CIRCLE.at(time_s)
    assert got is not None
    yaw = np.radians(350.0) + 8 * time_s / 30
    enu = FRAME.enu(np.array([got.latitude_deg]), np.array([got.longitude_deg]), np.array([got.altitude_m]))[
        0
    ]
    assert np.hypot(enu[0] + 30 * np.cos(yaw), enu[1] - 30 * np.sin(yaw)) < 3 * got.sigma_horizontal_m
    assert enu[2] == pytest.approx(60.0, abs=0.01)
    assert abs((got.yaw_deg - np.degrees(yaw) + 180) % 360 - 180) < 0.2
    assert got.speed_m_s == pytest.approx(8.0, rel=0.01)


def test_time_sigma_costs_speed_times_sigma() -> None:
    track = CIRCLE
    sharp, vague = track.at(5.0), track.at(5.0, 0.5)
    assert sharp is not None
    assert vague is not None
    assert vague.sigma_horizontal_m == pytest.approx(np.hypot(sharp.sigma_horizontal_m, 4.0), rel=0.01)


@pytest.mark.parametrize(
    ("yaw", "roll", "lever", "expected"),
    [
        (0.0, 0.0, (1.0, 0.0, 0.0), (0, 1, 0)),
        (90.0, 0.0, (1.0, 0.0, 0.0), (1, 0, 0)),
        (0.0, 0.0, (0.0, 1.0, 0.5), (1, 0, -0.5)),
        (0.0, 90.0, (0.0, 1.0, 0.0), (0, 0, -1)),
    ],
)
def test_lever_arm(
    yaw: float, roll: float, lever: tuple[float, float, float], expected: tuple[float, float, float]
) -> None:
    track = Track([TrackSample(t, 47.0, 8.0, 400.0, roll, 0.0, yaw) for t in (0.0, 1.0)])
    got = track.at(0.5, lever=LeverArm(*lever))
    assert got is not None
    enu = FRAME.enu(np.array([got.latitude_deg]), np.array([got.longitude_deg]), np.array([got.altitude_m]))[
        0
    ]
    assert enu == pytest.approx(expected, abs=1e-4)


def test_nothing_is_made_up() -> None:
    track = CIRCLE
    assert track.at(-0.9) is not None
    assert track.at(-1.1) is None
    assert track.at(20.9) is None
    assert Track([]).at(1.0) is None
    assert track.at(float("nan")) is None
    hole = Track([TrackSample(t, 47.0, 8.0, 400.0) for t in (0.0, 0.2, 9.0, 9.2)])
    assert hole.at(0.9) is not None
    assert hole.at(4.0) is None
    one = Track([TrackSample(0.0, 47.0, 8.0, 400.0)])
    close, far = one.at(0.0), one.at(0.8)
    assert close is not None
    assert far is not None
    assert far.sigma_horizontal_m > close.sigma_horizontal_m + 3

"""Angles and quaternions of MAVLink: w, x, y, z; north-east-down; yaw, then pitch, then roll."""

from __future__ import annotations

import math
from collections.abc import Sequence

from daemon.link.events import AngleFrame, Angles, GimbalAttitude

Quaternion = tuple[float, float, float, float]


def angles_of(quaternion: Sequence[float]) -> Angles | None:
    """Degrees, yaw in [0, 360); None for no rotation at all (NaN, zeros, another length).

    Straight down yaw and roll turn about one axis: all of it is yaw then.
    """
    if len(quaternion) != 4 or not all(map(math.isfinite, quaternion)):
        return None
    size = math.sqrt(sum(v * v for v in quaternion))
    if size < 0.5:
        return None
    w, x, y, z = (v / size for v in quaternion)
    sine = max(-1.0, min(1.0, 2 * (w * y - z * x)))
    if abs(sine) > 1 - 1e-7:
        yaw, roll = -2 * math.copysign(1, sine) * math.atan2(x, w), 0.0
    else:
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return Angles(math.degrees(roll), math.degrees(math.asin(sine)), math.degrees(yaw) % 360)


def quaternion_of(angles: Angles) -> Quaternion:
    """Inverse of :func:`angles_of`."""
    half = [math.radians(v) / 2 for v in (angles.roll_deg, angles.pitch_deg, angles.yaw_deg)]
    (sr, sp, sy), (cr, cp, cy) = map(math.sin, half), map(math.cos, half)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def earth_angles(gimbal: GimbalAttitude, vehicle: Angles) -> Angles | None:
    """The camera's angles from horizon and north, given the vehicle's at the same time.

    None where the frame is unsure: a guess could be wrong by the whole pitch of the vehicle.
    """
    if gimbal.frame is AngleFrame.EARTH:
        return gimbal.angles
    if gimbal.frame is AngleFrame.LEVEL:
        found = gimbal.angles
        return Angles(found.roll_deg, found.pitch_deg, (found.yaw_deg + vehicle.yaw_deg) % 360)
    if gimbal.frame is AngleFrame.BODY:
        return angles_of(_product(quaternion_of(vehicle), quaternion_of(gimbal.angles)))
    return None


def between(one: Angles, other: Angles, share: float) -> Angles:
    """The attitude on the shortest way from one to the other, ``share`` (0-1) of it done.

    By quaternions, normalised afterwards: angles jump near straight down, quaternions do not.
    """
    a, b = quaternion_of(one), quaternion_of(other)
    sign = 1.0 if sum(x * y for x, y in zip(a, b, strict=True)) >= 0 else -1.0
    mixed = [(1 - share) * x + share * sign * y for x, y in zip(a, b, strict=True)]
    return angles_of(mixed) or one


def _product(one: Quaternion, other: Quaternion) -> Quaternion:
    a, b, c, d = one
    e, f, g, h = other
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )

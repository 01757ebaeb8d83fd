"""Flights over outlines that are not squares, around buildings and along walls.

World and camera as in :mod:`sim.flights`.
"""

from __future__ import annotations

import numpy as np

from calib.camera import FloatArray
from sim.flights import Flight, rotation_looking


def block(
    corners_m: FloatArray,
    height_m: float,
    *,
    between_lines_m: float,
    along_line_m: float,
    heading_deg: float = 0.0,
    off_nadir_deg: float = 0.0,
) -> Flight:
    """Parallel lines there and back over a convex outline, (n, 2) corners east and north.

    Lines are at most ``between_lines_m`` apart, photos on a line at most ``along_line_m``; lines start
    and end on the outline. Oblique cameras look ahead, so that neighbouring lines look against each
    other.
    """
    h = np.radians(heading_deg)
    right, ahead = np.array([np.cos(h), -np.sin(h)]), np.array([np.sin(h), np.cos(h)])
    a, b = corners_m @ right, corners_m @ ahead
    lines = int(np.ceil((a.max() - a.min()) / between_lines_m - 1e-9))
    across = a.min() + (np.arange(lines) + 0.5) / lines * (a.max() - a.min())
    places, yaws = [], []
    for number, position in enumerate(across):
        low, high = _crossing(a, b, float(position))
        count = int(np.ceil((high - low) / along_line_m - 1e-9)) + 1
        along = np.linspace(low, high, count)[:: 1 if number % 2 == 0 else -1]
        places.append(position * right + along[:, None] * ahead)
        yaws.append(np.full(count, heading_deg + (0.0 if number % 2 == 0 else 180.0)))
    flat, yaw = np.concatenate(places), np.concatenate(yaws)
    centres = np.column_stack([flat, np.full(len(flat), height_m)])
    return Flight(rotation_looking(yaw, np.full(len(yaw), off_nadir_deg)), centres, _level(yaw))


def _crossing(a: FloatArray, b: FloatArray, at: float) -> tuple[float, float]:
    """Where the line a = ``at`` enters and leaves a convex outline with corners (a, b)."""
    a2, b2 = np.roll(a, -1), np.roll(b, -1)
    cut = (a - at) * (a2 - at) < 0
    crossed = b[cut] + (at - a[cut]) / (a2[cut] - a[cut]) * (b2[cut] - b[cut])
    return float(crossed.min()), float(crossed.max())


def ring(
    count: int, radius_m: float, height_m: float, aim_m: FloatArray, *, first_azimuth_deg: float = 0.0
) -> Flight:
    """``count`` photos on a level circle about ``aim_m`` (3,), all looking at it."""
    azimuth = first_azimuth_deg + np.arange(count) * 360.0 / count
    a = np.radians(azimuth)
    outwards = radius_m * np.stack([np.sin(a), np.cos(a)], axis=-1)
    centres = np.column_stack([np.asarray(aim_m)[:2] + outwards, np.full(count, height_m)])
    return Flight(looking_at(centres, np.asarray(aim_m)), centres, _level(azimuth + 90.0))


def wall_pairs(count: int, distance_m: float, half_width_m: float, height_m: float) -> Flight:
    """Convergent pairs in front of the wall in the plane y = 0 that faces south (-y).

    The optical axes of each of ``count`` pairs meet on the wall at +-45 degrees; the meeting points
    are spread over ``half_width_m`` to either side of the middle. (2 count) photos, pair after pair.
    """
    meet = np.linspace(-half_width_m, half_width_m, count)
    east = np.stack([meet - distance_m, meet + distance_m], axis=-1).ravel()
    centres = np.column_stack([east, np.full(2 * count, -distance_m), np.full(2 * count, height_m)])
    yaw = np.tile([45.0, -45.0], count)
    return Flight(rotation_looking(yaw, np.full(2 * count, 90.0)), centres, _level(np.full(2 * count, 90.0)))


def looking_at(centres_m: FloatArray, aim_m: FloatArray) -> FloatArray:
    """cam_from_world (k, 3, 3) of level cameras at ``centres_m`` (k, 3) that look at ``aim_m`` (3,)."""
    to = aim_m - centres_m
    yaw = np.degrees(np.arctan2(to[:, 0], to[:, 1]))
    off_nadir = np.degrees(np.arctan2(np.hypot(to[:, 0], to[:, 1]), -to[:, 2]))
    return rotation_looking(yaw, off_nadir)


def _level(yaw_deg: FloatArray) -> FloatArray:
    yaw = np.radians(yaw_deg)
    return np.stack([np.sin(yaw), np.cos(yaw), np.zeros_like(yaw)], axis=-1)

"""Campaigns on control points at observation level: photos, points and marks as a user would have them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calib.align.rotations import rotation_exp
from calib.camera import BrownCamera, FloatArray
from calib.control_files import ControlPoint, Mark
from calib.photos.photo import CameraIdentity, Photo
from calib.targets import Board, board_points
from sim.papers.orbit import Orbit
from sim.pattern import random_pattern

#: A surveyor's coordinates are far from zero.
_FAR_M = np.array([4e5, 5.6e6, 100.0])
#: Photos of a board: up to so far off head-on; at one to so many times the distance at which it fills them.
_TILT_DEG, _FARTHEST = 40.0, 1.4

Campaign = tuple[tuple[Photo, ...], tuple[ControlPoint, ...], tuple[Mark, ...]]


def campaign(orbit: Orbit, sigma_m: float) -> Campaign:
    """Photos, points of the stated ``sigma_m`` and marks by name, coordinates far from the origin."""
    points = tuple(
        ControlPoint(f"T{i:03d}", _xyz(place + _FAR_M), (sigma_m,) * 3, not control)
        for i, (place, control) in enumerate(zip(orbit.targets_m, orbit.control, strict=True))
    )
    photos = _photos(orbit.camera, len(orbit.centres_m))
    marks = tuple(
        Mark(photos[p].path.name, points[t].name, *map(float, uv))
        for p, t, uv in zip(orbit.photo, orbit.target, orbit.pixels, strict=True)
    )
    return photos, points, marks


def board_campaign(
    board: Board, camera: BrownCamera, count: int, noise_px: float, pattern_px: float, seed: int
) -> Campaign:
    """Corners of a printed board as found in ``count`` photos as the manual asks for them.

    From all sides, 0 to 40 degrees off head-on, every other one upright, near enough to reach the picture's
    corners. The print is wrong by the sigma that the board's points state. ``pattern_px``: largest part of
    the lens that is not Brown's.
    """
    rng = np.random.default_rng([seed, 31])
    points = board_points(board)
    stated = np.array([point.xyz_m for point in points])
    true = stated + np.array([point.sigmas_m for point in points], float) * rng.normal(size=stated.shape)
    middle, size = (stated.min(axis=0) + stated.max(axis=0)) / 2, np.ptp(stated, axis=0)
    fills_m = float(size.max()) * camera.f_px / camera.width
    photos, marks = _photos(camera, count), []
    for i, photo in enumerate(photos):
        azimuth, tilt = 2 * np.pi * i * 3 / 8, np.radians(_TILT_DEG) * (i % 5) / 4
        # x right, y down, z into the board: photos are taken from below zero.
        away = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])
        at = middle + np.append(rng.uniform(-0.25, 0.25, 2), 0.0) * size
        centre = at + fills_m * rng.uniform(1.0, _FARTHEST) * away
        local = (true - centre) @ _facing(away, np.pi / 2 * (i % 2) + 0.1 * rng.normal()).T
        rays = local[:, :2] / local[:, 2:]
        pixels = camera.project(rays)
        if pattern_px > 0:
            pixels = pixels + random_pattern(seed, camera, pattern_px)(pixels)
        pixels = pixels + noise_px * rng.normal(size=pixels.shape)
        # Rays far outside are left out before the radial polynomial can fold them back in.
        seen = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(axis=1)
        seen &= np.abs(rays).max(axis=1) < 0.6 * camera.width / camera.f_px
        marks += [Mark(photo.path.name, points[j].name, *map(float, pixels[j])) for j in np.flatnonzero(seen)]
    return photos, points, tuple(marks)


def _facing(away: FloatArray, roll: float) -> FloatArray:
    """cam_from_world (3, 3) of a camera that looks against the unit vector ``away`` (3,)."""
    right = np.cross([0.0, 1.0, 0.0], -away)
    right /= np.linalg.norm(right)
    level = np.stack([right, np.cross(-away, right), -away])
    turned: FloatArray = rotation_exp(np.array([[0.0, 0.0, roll]]))[0] @ level
    return turned


def _photos(camera: BrownCamera, count: int) -> tuple[Photo, ...]:
    identity = CameraIdentity("DJI", "FC6310", "S1", camera.width, camera.height)
    return tuple(Photo(Path(f"IMG_{i:03d}.JPG"), identity) for i in range(count))


def _xyz(place: FloatArray) -> tuple[float, float, float]:
    x, y, z = place.tolist()
    return x, y, z

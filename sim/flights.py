"""Camera poses of the flights that the papers flew, and of some others.

World: x east, y north, z up (metres), the site's middle at the origin. Camera: x right, y down,
z forward.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.camera import BrownCamera, FloatArray

#: DJI Phantom 3 Professional on a flat wall: f and K1-K3 in px units ([C&D], text and eq. 7).
_P3P_F_PX, _P3P_K_PX = 2320.06, (-2.53e-8, 3.96e-15, -1.15e-22)


def phantom3(width: int = 4000, height: int = 3000) -> BrownCamera:
    """The papers' Phantom 3 Professional (4000 x 3000), resampled to another size if asked."""
    f = _P3P_F_PX
    k1, k2, k3 = (k * f**power for k, power in zip(_P3P_K_PX, (2, 4, 6), strict=True))
    full = BrownCamera(4000, 3000, f, 2000.0, 1500.0, k1=k1, k2=k2, k3=k3)
    return full if (width, height) == (4000, 3000) else full.scaled(width, height)


@dataclass(frozen=True)
class Flight:
    """Poses of k photos: rotations_cam_from_world (k, 3, 3), centres_m (k, 3), and the direction of
    flight while each was taken, track (k, 3), unit vectors."""

    rotations_cam_from_world: FloatArray
    centres_m: FloatArray
    track: FloatArray

    def __len__(self) -> int:
        return len(self.centres_m)

    def __add__(self, other: Flight) -> Flight:
        return Flight(
            np.concatenate([self.rotations_cam_from_world, other.rotations_cam_from_world]),
            np.concatenate([self.centres_m, other.centres_m]),
            np.concatenate([self.track, other.track]),
        )


def rotation_looking(yaw_deg: FloatArray, off_nadir_deg: FloatArray) -> FloatArray:
    """cam_from_world (k, 3, 3) of cameras that look towards the compass direction ``yaw_deg`` (k,),
    ``off_nadir_deg`` (k,) away from straight down; the image's upper edge is ahead."""
    yaw, tilt = np.radians(yaw_deg), np.radians(off_nadir_deg)
    forward = np.stack([np.sin(yaw) * np.sin(tilt), np.cos(yaw) * np.sin(tilt), -np.cos(tilt)], axis=-1)
    right = np.stack([np.cos(yaw), -np.sin(yaw), np.zeros_like(yaw)], axis=-1)
    return np.stack([right, np.cross(forward, right), forward], axis=-2)


def small_rotation(vectors_rad: FloatArray) -> FloatArray:
    """Rotation matrices (k, 3, 3) of rotation vectors (k, 3) (Rodrigues)."""
    angle = np.linalg.norm(vectors_rad, axis=-1)[:, None, None]
    zero = np.zeros(len(vectors_rad))
    x, y, z = vectors_rad.T
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    first, second = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    turn: FloatArray = np.eye(3) + first * cross + second * (cross @ cross)
    return turn


def grid(
    lines: int,
    per_line: int,
    height_m: float,
    site_m: float,
    *,
    heading_deg: float = 0.0,
    off_nadir_deg: float = 0.0,
) -> Flight:
    """Parallel lines flown there and back over a square site, first and last photo inside its edge."""
    across = (np.arange(lines) + 0.5) / lines - 0.5
    along = (np.arange(per_line) + 0.5) / per_line - 0.5
    sign = np.where(np.arange(lines) % 2 == 0, 1.0, -1.0)
    a = np.repeat(across, per_line) * site_m
    b = (sign[:, None] * along).ravel() * site_m
    yaw = heading_deg + np.repeat(np.where(sign > 0, 0.0, 180.0), per_line)
    h = np.radians(heading_deg)
    centres = np.stack(
        [a * np.cos(h) + b * np.sin(h), -a * np.sin(h) + b * np.cos(h), np.full(len(a), height_m)], axis=-1
    )
    return Flight(rotation_looking(yaw, np.full(len(a), off_nadir_deg)), centres, _heading_vector(yaw))


def convergent(
    count: int, off_nadir_deg: float, height_m: float, *, first_azimuth_deg: float = 0.0
) -> Flight:
    """``count`` photos on a circle, all looking at the site's middle ``off_nadir_deg`` off nadir."""
    azimuth = first_azimuth_deg + np.arange(count) * 360.0 / count
    radius = height_m * np.tan(np.radians(off_nadir_deg))
    a = np.radians(azimuth)
    centres = np.stack([radius * np.sin(a), radius * np.cos(a), np.full(count, height_m)], axis=-1)
    rotations = rotation_looking(azimuth + 180.0, np.full(count, off_nadir_deg))
    return Flight(rotations, centres, _heading_vector(azimuth + 90.0))


def _heading_vector(yaw_deg: FloatArray) -> FloatArray:
    yaw = np.radians(yaw_deg)
    return np.stack([np.sin(yaw), np.cos(yaw), np.zeros_like(yaw)], axis=-1)


def jittered(flight: Flight, seed: int, position_m: float, height_m: float, attitude_deg: float) -> Flight:
    """The flight as wind and gimbal leave it: normal errors of the stated standard deviations."""
    rng = np.random.default_rng([seed, 3])
    k = len(flight)
    shift = rng.normal(size=(k, 3)) * [position_m, position_m, height_m]
    turn = small_rotation(np.radians(attitude_deg) * rng.normal(size=(k, 3)))
    return Flight(turn @ flight.rotations_cam_from_world, flight.centres_m + shift, flight.track)


def flight_plan(name: str, site_m: float = 120.0) -> Flight:
    """A flight by name, undisturbed. Heights go with the site: 60 m over the papers' 120 m.

    ``A1`` nadir at one height (32 photos); ``A2`` at two (50); ``A3``, ``A4`` the same and 8
    convergent at 40 degrees ([C&D] fig. 2); ``nadir_one_height`` a short nadir block (18);
    ``crosshatch`` two grids at right angles, 15 degrees off nadir (64); ``crosshatch_nadir`` the
    same straight down; ``demo_crosshatch`` 24 photos of such a kind;
    ``orbit`` a circle looking inwards at 40 degrees (36); ``demo_nadir`` 12
    nadir photos; ``demo`` the same and 8 convergent.

    Raises:
        KeyError: no flight of that name.
    """
    low, high = site_m / 2, site_m / 1.5
    a1 = grid(4, 8, low, site_m)
    oblique = convergent(8, 40.0, low)
    demo = grid(3, 4, low, 0.9 * site_m)
    plans = {
        "A1": a1,
        "A2": a1 + grid(3, 6, high, site_m),
        "A3": a1 + oblique,
        "A4": a1 + grid(3, 6, high, site_m) + oblique,
        "nadir_one_height": grid(3, 6, low, site_m),
        "crosshatch": _two_grids(low, site_m, 15.0),
        "crosshatch_nadir": _two_grids(low, site_m, 0.0),
        "orbit": convergent(36, 40.0, low),
        "demo_nadir": demo,
        "demo_crosshatch": demo + grid(3, 4, low, 0.9 * site_m, heading_deg=90.0),
        "demo": demo + oblique,
    }
    return plans[name]


def _two_grids(height_m: float, site_m: float, off_nadir_deg: float) -> Flight:
    first, second = (
        grid(4, 8, height_m, site_m, heading_deg=heading, off_nadir_deg=off_nadir_deg)
        for heading in (0.0, 90.0)
    )
    return first + second

"""Surveys at observation level: exact truth, chosen disturbances, no images.

block = survey("A3", seed=1, options=SimOptions(pattern_px=1.5))
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.camera import BrownCamera, FloatArray
from calib.field import Lens
from calib.solution import Observations
from sim.flights import Flight, flight_plan, jittered, phantom3, small_rotation
from sim.pattern import random_pattern
from sim.relief import Relief


@dataclass(frozen=True)
class SimOptions:
    """What disturbs a simulated survey; the defaults are an ordinary good flight.

    ``n_points`` ground points are spread over the site and ``margin_m`` around it; those that
    fewer than two photos keep are dropped. ``match_share``: probability that a view of a point is
    kept. ``mismatch_rate``: share of observations that are somewhere else, up to 40 px away.
    ``pattern_px``: largest length of a non-Brown pattern at 4000 px image width. Rolling shutter:
    rows are read over ``readout_s`` at ``speed_m_s`` along the track; the pose is the middle
    row's. ``aspect``: fx / fy - 1 to first order (b1 / f). ``correlated_px``: rms per coordinate of
    noise that is smooth over each photo. ``max_incidence_deg``: views flatter than that are not
    matched. ``pattern_seed``: None takes the survey's; two surveys of one camera share a pattern;
    ``pattern_shortest``: its shortest wave in image widths (at 0.8 about a tenth of its rms is beyond
    what Legendre products of degree 2 to 4 can follow).
    """

    n_points: int = 3000
    noise_px: float = 0.5
    match_share: float = 0.7
    mismatch_rate: float = 0.0
    gps_sigma_m: float = 2.5
    gimbal_sigma_deg: float = 1.0
    relief_m: float = 2.0
    pattern_px: float = 0.0
    pattern_seed: int | None = None
    pattern_shortest: float = 0.8
    readout_s: float = 0.0
    speed_m_s: float = 0.0
    aspect: float = 0.0
    correlated_px: float = 0.0
    site_m: float = 120.0
    margin_m: float = 40.0
    max_incidence_deg: float = 70.0
    position_jitter_m: float = 1.0
    height_jitter_m: float = 0.5
    attitude_jitter_deg: float = 1.5


@dataclass(frozen=True)
class SimBlock:
    """A survey with its truth: k photos, m points, n observations.

    ``lens``: the true Brown lens (its field is zero). ``pattern``: brown pixels (..., 2) -> shift
    in px, on top of it. rotations_cam_from_world (k, 3, 3), centres_m (k, 3), points_m (m, 3):
    truth; ``velocity_m_s`` (k, 3) while a rolling shutter reads. ``observations``: noisy pixels,
    sigma as stated to the adjustment. ``mismatched`` (n,): which of them are blunders.
    Measured by the vehicle: ``gps_m`` (k, 3) with standard deviations ``gps_sigma_m`` (k, 3), and
    ``gimbal_cam_from_world`` (k, 3, 3), off by ``gimbal_sigma_deg`` about each axis.
    """

    name: str
    lens: Lens
    pattern: Callable[[FloatArray], FloatArray]
    rotations_cam_from_world: FloatArray
    centres_m: FloatArray
    points_m: FloatArray
    observations: Observations
    mismatched: NDArray[np.bool_]
    gps_m: FloatArray
    gps_sigma_m: FloatArray
    gimbal_cam_from_world: FloatArray
    gimbal_sigma_deg: float
    velocity_m_s: FloatArray
    readout_s: float

    def total_px(self, rays: FloatArray) -> FloatArray:
        """Rays (..., 2) -> pixels (..., 2): the true total mapping, without noise."""
        brown_px = self.lens.project(rays)
        return brown_px + self.pattern(brown_px)

    def true_pixels(self) -> FloatArray:
        """Where the observations would be without noise and mismatches, (n, 2)."""
        return seen(self, self.observations.photo, self.points_m[self.observations.point])


def no_pattern(pixels: FloatArray) -> FloatArray:
    """The pattern of a lens that is Brown's."""
    return np.zeros_like(pixels)


def survey(
    name: str, seed: int = 0, options: SimOptions | None = None, *, camera: BrownCamera | None = None
) -> SimBlock:
    """A simulated flight by name (:func:`sim.flights.flight_plan`), the same for the same seed.

    ``camera`` is the true lens (default: the papers' Phantom 3 at 4000 x 3000).

    Raises:
        KeyError: no flight of that name.
    """
    options = options or SimOptions()
    flight = jittered(
        flight_plan(name, options.site_m),
        seed,
        options.position_jitter_m,
        options.height_jitter_m,
        options.attitude_jitter_deg,
    )
    return observe(name, flight, camera or phantom3(), seed, options)


def observe(name: str, flight: Flight, camera: BrownCamera, seed: int, options: SimOptions) -> SimBlock:
    """What ``camera`` measures on ``flight`` over random ground."""
    rng = np.random.default_rng([seed, 4])
    ground = draw_ground(rng, options)
    truth = truth_of(name, flight, camera, seed, options, ground, rng.normal(size=(2, len(flight), 3)))
    point, photo = candidates(truth, np.cos(np.radians(options.max_incidence_deg)))
    kept = rng.random(len(point)) < options.match_share
    point, photo = point[kept], photo[kept]
    pixels = seen(truth, photo, truth.points_m[point])
    size = np.array([camera.width, camera.height], dtype=float)
    inside = np.all((pixels >= 0) & (pixels <= size), axis=-1)
    inside &= (np.bincount(point[inside], minlength=len(truth.points_m)) >= 2)[point]
    point, photo, pixels = point[inside], photo[inside], pixels[inside]

    n = len(point)
    noisy = pixels + options.noise_px * rng.normal(size=(n, 2))
    if options.correlated_px > 0:
        noisy += options.correlated_px * smooth_noise(rng, len(flight), photo, pixels / camera.width)
    mismatched = rng.random(n) < options.mismatch_rate
    noisy[mismatched] = np.clip((noisy + blunders_px(rng.random((2, n)), camera.width))[mismatched], 0, size)
    return measured(truth, photo, point, noisy, mismatched, options.noise_px)


def blunders_px(unit: FloatArray, width: int) -> FloatArray:
    """Shifts (n, 2) of mismatches, up to 40 px at 4000 px image width, from uniform numbers (2, n)."""
    reach, angle = 40 * np.sqrt(unit[0]) * width / 4000, 2 * np.pi * unit[1]
    return np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=-1)


def measured(
    truth: SimBlock,
    photo: NDArray[np.intp],
    point: NDArray[np.intp],
    pixels: FloatArray,
    mismatched: NDArray[np.bool_],
    noise_px: float,
) -> SimBlock:
    """The survey with what was seen (n, sorted by point); ground points without views are dropped."""
    used, renumbered = np.unique(point, return_inverse=True)
    sigma = np.full(len(point), noise_px if noise_px > 0 else 0.5)
    return replace(
        truth,
        points_m=truth.points_m[used],
        observations=Observations(photo, renumbered, pixels, sigma),
        mismatched=mismatched,
    )


def draw_ground(rng: np.random.Generator, options: SimOptions) -> FloatArray:
    """Places (n_points, 2) over the site and its margin."""
    half = options.site_m / 2 + options.margin_m
    return rng.uniform(-half, half, (options.n_points, 2))


def truth_of(
    name: str,
    flight: Flight,
    camera: BrownCamera,
    seed: int,
    options: SimOptions,
    ground: FloatArray,
    normals: FloatArray,
) -> SimBlock:
    """A survey before anything is seen in its photos.

    Args:
        ground: places (m, 2) of its points.
        normals: standard normal numbers (2, k, 3), of the gimbal's and of the receiver's errors.
    """
    k = len(flight)
    camera = replace(camera, b1_px=camera.b1_px + options.aspect * camera.f_px)
    pattern: Callable[[FloatArray], FloatArray] = no_pattern
    if options.pattern_px > 0:
        pattern_seed = seed if options.pattern_seed is None else options.pattern_seed
        largest = options.pattern_px * camera.width / 4000
        pattern = random_pattern(pattern_seed, camera, largest, options.pattern_shortest)
    relief = Relief.random(seed, options.relief_m)
    turns = small_rotation(np.radians(options.gimbal_sigma_deg) * normals[0])
    nothing = Observations(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), np.zeros(0))
    return SimBlock(
        name=name,
        lens=Lens(camera),
        pattern=pattern,
        rotations_cam_from_world=flight.rotations_cam_from_world,
        centres_m=flight.centres_m,
        points_m=np.column_stack([ground, relief.height_m(ground[:, 0], ground[:, 1])]),
        observations=nothing,
        mismatched=np.zeros(0, bool),
        gps_m=flight.centres_m + options.gps_sigma_m * normals[1],
        gps_sigma_m=np.full((k, 3), options.gps_sigma_m),
        gimbal_cam_from_world=turns @ flight.rotations_cam_from_world,
        gimbal_sigma_deg=options.gimbal_sigma_deg,
        velocity_m_s=options.speed_m_s * flight.track,
        readout_s=options.readout_s,
    )


def candidates(block: SimBlock, least_cosine: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Point and photo of the views that can fall into the image, sorted by point."""
    camera = block.lens.brown
    corners = np.array([[0, 0], [0, 1], [1, 0], [1, 1], [0.5, 0], [0, 0.5], [1, 0.5], [0.5, 1]])
    edge = camera.unproject(corners * [camera.width, camera.height])
    # Rays far outside are left out before the radial polynomial can fold them back in; the
    # margin is for pattern and rolling shutter.
    limit = 1.06 * np.abs(edge).max(axis=0)
    offset = block.points_m[:, None, :] - block.centres_m[None, :, :]
    x, y, z = np.moveaxis(np.einsum("kij,mkj->mki", block.rotations_cam_from_world, offset), -1, 0)
    seen = (z > 0) & (np.abs(x) < limit[0] * z) & (np.abs(y) < limit[1] * z)
    seen &= -offset[..., 2] > least_cosine * np.linalg.norm(offset, axis=-1)
    point, photo = np.nonzero(seen)
    return point, photo


def seen(block: SimBlock, photo: NDArray[np.intp], points_m: FloatArray) -> FloatArray:
    """Exact pixels (n, 2) of ``points_m`` (n, 3) in ``photo`` (n,)."""
    rotations = block.rotations_cam_from_world[photo]
    at_middle = np.einsum("nij,nj->ni", rotations, points_m - block.centres_m[photo])
    pixels = block.total_px(at_middle[:, :2] / at_middle[:, 2:])
    if block.readout_s == 0 or not block.velocity_m_s.any():
        return pixels
    drift = np.einsum("nij,nj->ni", rotations, block.velocity_m_s[photo])  # m/s in the camera frame
    for _ in range(12):  # each round gains two digits: drift over one readout is about 1 % of the image
        time_s = (pixels[:, 1] / block.lens.brown.height - 0.5) * block.readout_s
        local = at_middle - drift * time_s[:, None]
        before, pixels = pixels, block.total_px(local[:, :2] / local[:, 2:])
        if np.abs(pixels - before).max(initial=0.0) < 1e-10:
            break
    return pixels


def smooth_noise(
    rng: np.random.Generator, photos: int, photo: NDArray[np.intp], where: FloatArray
) -> FloatArray:
    """Noise (n, 2) of unit variance that is smooth over each photo (waves of 0.3 to 1 image width)."""
    waves = 6
    number = 2 * np.pi / rng.uniform(0.3, 1.0, (photos, waves, 2))
    azimuth = rng.uniform(0, 2 * np.pi, (photos, waves, 2))
    phase = rng.uniform(0, 2 * np.pi, (photos, waves, 2))
    total = np.zeros((len(photo), 2))
    for w in range(waves):
        turn = azimuth[photo, w]
        along = where[:, :1] * np.cos(turn) + where[:, 1:] * np.sin(turn)
        total += np.sqrt(2 / waves) * np.sin(number[photo, w] * along + phase[photo, w])
    return total

"""The renderer: truth points appear where the lens puts them, at speed."""

from __future__ import annotations

import time

import cv2
import numpy as np
import pytest

from calib.camera import FloatArray
from calib.field import Lens
from sim.flights import Flight, flight_plan, jittered, phantom3
from sim.pattern import Pattern, random_pattern
from sim.relief import Relief
from sim.render import RenderOptions, lens_rays, render
from sim.world import World, make_world

WIDTH, HEIGHT = 1000, 750
CLEAN = RenderOptions(blur_px=0.5, noise_levels=0.0, vignetting=0.0)


@pytest.fixture(scope="module")
def dots() -> tuple[World, FloatArray]:
    """Relief of 5 m with a dot about every 8 m."""
    ticks = np.arange(-96, 97, 8.0)
    where = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    where += np.random.default_rng(0).uniform(-1, 1, where.shape)
    bare = World(Relief.random(3, 5.0), (np.zeros((4096, 4096, 3), np.uint8),), 0.05)
    return bare.with_dots(where, 0.13), where


@pytest.fixture(scope="module")
def lens() -> Lens:
    return Lens(phantom3(WIDTH, HEIGHT))


@pytest.fixture(scope="module")
def pattern() -> Pattern:
    """Six pixels at full size, so that an error of sign or place would be seen."""
    return random_pattern(1, phantom3(), 6.0).scaled(WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def flight() -> Flight:
    return jittered(flight_plan("demo"), 1, 1.0, 1.0, 1.5)


def centroids(image: FloatArray, near: FloatArray) -> FloatArray:
    """Centres of the dots that are within a pixel or two of ``near`` (n, 2): weighted means."""
    found = []
    reach = 8
    for u, v in near:
        column, row = int(u), int(v)
        patch = image[row - reach : row + reach + 1, column - reach : column + reach + 1]
        weight = np.maximum(patch - 62.0, 0)
        rows, columns = np.mgrid[row - reach : row + reach + 1, column - reach : column + reach + 1]
        # (0.5, 0.5) is the centre of the first pixel.
        found.append(
            [(weight * (columns + 0.5)).sum() / weight.sum(), (weight * (rows + 0.5)).sum() / weight.sum()]
        )
    return np.array(found)


@pytest.mark.parametrize("photo", [1, 6, 13, 18])
@pytest.mark.parametrize("readout_s", [0.0, 0.05])
def test_dots_are_where_the_lens_puts_them(
    dots: tuple[World, FloatArray],
    lens: Lens,
    pattern: Pattern,
    flight: Flight,
    photo: int,
    readout_s: float,
) -> None:
    world, where = dots
    rotation, centre = flight.rotations_cam_from_world[photo], flight.centres_m[photo]
    velocity = 12.0 * flight.track[photo]
    image = render(
        world,
        lens_rays(lens, pattern),
        rotation,
        centre,
        velocity_m_s=velocity,
        options=RenderOptions(blur_px=0.5, noise_levels=0.0, vignetting=0.0, readout_s=readout_s),
    )
    points = world.points_m(where)
    moved = np.broadcast_to(centre, points.shape)
    for _ in range(6):
        local = (points - moved) @ rotation.T
        brown = lens.project(local[:, :2] / local[:, 2:])
        expected = brown + pattern(brown)
        moved = centre + ((expected[:, 1] / HEIGHT - 0.5) * readout_s)[:, None] * velocity
    # Far dots are too small for a centroid; those beyond the image's diagonal may be folded in.
    usable = (local[:, 2] > 0) & (np.linalg.norm(local, axis=1) < 90)
    usable &= (np.abs(local[:, :2]) < 0.95 * local[:, 2:]).all(axis=1)
    usable &= (expected > 12).all(axis=1) & (expected < [WIDTH - 12, HEIGHT - 12]).all(axis=1)
    assert usable.sum() > 40
    error = centroids(image[..., 1].astype(float), expected[usable]) - expected[usable]
    assert np.abs(error).max() < 0.05
    assert np.abs(error.mean(axis=0)).max() < 0.01


def test_pixel_rays_invert_lens_and_pattern(lens: Lens, pattern: Pattern) -> None:
    rays = lens_rays(lens, pattern)
    assert rays.shape == (HEIGHT, WIDTH, 2)
    brown = lens.project(rays)
    centres = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1)
    assert np.abs(brown + pattern(brown) - centres).max() < 0.002


@pytest.fixture(scope="module")
def farmland() -> World:
    return make_world(1, half_m=110.0, texel_m=0.08)


def test_ground_has_features_and_speed(farmland: World, lens: Lens, flight: Flight) -> None:
    rays = lens_rays(lens)
    started = time.process_time()
    image = render(farmland, rays, flight.rotations_cam_from_world[5], flight.centres_m[5])
    seconds = time.process_time() - started
    assert image.shape == (HEIGHT, WIDTH, 3)
    assert WIDTH * HEIGHT / 1e6 / seconds > 1.0
    points = cv2.SIFT_create().detect(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    assert len(points) > 2000
    cells = {(int(p.pt[0] * 4 / WIDTH), int(p.pt[1] * 4 / HEIGHT)) for p in points}
    assert len(cells) == 16


def test_worlds_are_the_same_for_a_seed_and_differ_between_seeds() -> None:
    one, two, other = (make_world(seed, half_m=20.0) for seed in (4, 4, 5))
    assert np.array_equal(one.pyramid[0], two.pyramid[0])
    difference = one.pyramid[0].astype(float) - other.pyramid[0]
    assert np.abs(difference).mean() > 10


def test_ground_does_not_repeat(farmland: World) -> None:
    """No shift makes the texture match itself: the correlation has a single peak."""
    grey = farmland.pyramid[2].mean(axis=2)
    grey = grey - cv2.GaussianBlur(grey, (0, 0), 8)
    power = np.abs(np.fft.rfft2(grey)) ** 2
    correlation = np.fft.irfft2(power, grey.shape) / power.sum() * power.size
    correlation /= correlation[0, 0]
    correlation[np.ix_(range(-20, 21), range(-20, 21))] = 0
    assert correlation.max() < 0.2


def test_options_do_what_they_say(farmland: World, lens: Lens, flight: Flight) -> None:
    rays, pose = lens_rays(lens), (flight.rotations_cam_from_world[5], flight.centres_m[5])
    clean = render(farmland, rays, *pose, options=CLEAN).astype(float)
    noisy = render(farmland, rays, *pose, options=RenderOptions(0.5, 3.0, 0.0)).astype(float)
    middle = (clean > 20) & (clean < 235)
    assert (noisy - clean)[middle].std() == pytest.approx(3.0, rel=0.05)
    dark = render(farmland, rays, *pose, options=RenderOptions(0.5, 0.0, 0.4)).astype(float)
    corner = (slice(0, 30), slice(0, 30))
    assert dark[corner].mean() / clean[corner].mean() == pytest.approx(0.63, abs=0.03)
    soft = render(farmland, rays, *pose, options=RenderOptions(2.0, 0.0, 0.0)).astype(float)
    assert cv2.Laplacian(soft, cv2.CV_64F).std() < 0.4 * cv2.Laplacian(clean, cv2.CV_64F).std()


def test_above_the_horizon_is_sky(farmland: World, lens: Lens) -> None:
    level = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # looking north
    image = render(farmland, lens_rays(lens), level, np.array([0.0, 0, 60]), options=CLEAN)
    assert (image[:300] == image[0, 0]).all()
    assert image[-100:].std() > 5

"""The observation-level simulator: exact truth, stated disturbances."""

from __future__ import annotations

import time

import numpy as np
import pytest

from sim.flights import flight_plan, phantom3, small_rotation
from sim.network import SimOptions, survey
from sim.pattern import pixel_grid, random_pattern, tangent_space
from sim.relief import Relief

QUIET = SimOptions(noise_px=0.0, pattern_px=1.5, aspect=0.005)


def test_phantom_has_the_published_calibration() -> None:
    camera = phantom3()
    assert camera.k1_px == pytest.approx(-2.53e-8)
    assert camera.k2_px == pytest.approx(3.96e-15)
    assert camera.k3_px == pytest.approx(-1.15e-22)


@pytest.mark.parametrize(
    ("name", "photos"),
    [("A1", 32), ("A2", 50), ("A3", 40), ("A4", 58), ("demo", 20), ("nadir_one_height", 18)],
)
def test_flights_have_the_photos_they_state(name: str, photos: int) -> None:
    flight = flight_plan(name)
    assert len(flight) == photos
    r = flight.rotations_cam_from_world
    assert np.allclose(r @ r.transpose(0, 2, 1), np.eye(3), atol=1e-14)
    assert np.allclose(np.linalg.det(r), 1)


def test_convergent_photos_look_at_the_middle() -> None:
    flight = flight_plan("A3")
    tilt = np.degrees(np.arccos(-flight.rotations_cam_from_world[:, 2, 2]))
    assert np.allclose(tilt[:32], 0, atol=1e-6)
    assert np.allclose(tilt[32:], 40, atol=1e-9)
    middle = np.einsum("kij,kj->ki", flight.rotations_cam_from_world[32:], -flight.centres_m[32:])
    assert np.allclose(middle[:, :2] / middle[:, 2:], 0, atol=1e-12)


def test_nadir_photo_shows_flight_direction_up_and_right_side_right() -> None:
    flight = flight_plan("A1")
    first = flight.rotations_cam_from_world[0]  # flown north
    assert np.allclose(first @ [0, 1, 0], [0, -1, 0])
    assert np.allclose(first @ [1, 0, 0], [1, 0, 0])


def test_pixels_are_the_projection_of_the_points() -> None:
    block = survey("A3", 5, QUIET)
    seen = block.observations
    local = np.einsum(
        "nij,nj->ni",
        block.rotations_cam_from_world[seen.photo],
        block.points_m[seen.point] - block.centres_m[seen.photo],
    )
    brown = block.lens.brown.project(local[:, :2] / local[:, 2:])
    assert np.abs(brown + block.pattern(brown) - seen.pixels).max() < 1e-9
    assert seen.pixels.min() >= 0
    assert (seen.pixels <= [4000, 3000]).all()
    assert block.lens.brown.fy_px == pytest.approx(2320.06 * 0.995)


def test_observations_are_sorted_and_every_point_is_seen_twice() -> None:
    seen = survey("A4", 2).observations
    assert (np.diff(seen.point) >= 0).all()
    assert np.bincount(seen.point).min() >= 2
    assert len(np.unique(seen.point * 1000 + seen.photo)) == len(seen)


def test_same_seed_same_survey() -> None:
    one, two, other = survey("A2", 7), survey("A2", 7), survey("A2", 8)
    assert np.array_equal(one.observations.pixels, two.observations.pixels)
    assert not np.array_equal(one.centres_m, other.centres_m)


def test_disturbances_have_the_stated_size() -> None:
    options = SimOptions(noise_px=0.5, mismatch_rate=0.05, gps_sigma_m=2.5, gimbal_sigma_deg=2.0)
    block = survey("crosshatch", 3, options)
    error = block.observations.pixels - block.true_pixels()
    assert pytest.approx(block.mismatched.mean(), abs=0.005) == 0.05
    assert error[~block.mismatched].std() == pytest.approx(0.5, rel=0.02)
    assert 5 < np.linalg.norm(error[block.mismatched], axis=1).mean() < 40
    assert (block.gps_m - block.centres_m).std() == pytest.approx(2.5, rel=0.2)
    turn = block.gimbal_cam_from_world @ block.rotations_cam_from_world.transpose(0, 2, 1)
    angle = np.degrees(np.arccos((np.trace(turn, axis1=1, axis2=2) - 1) / 2))
    assert np.sqrt(np.mean(angle**2) / 3) == pytest.approx(2.0, rel=0.2)


def test_correlated_noise_is_smooth_and_of_the_stated_rms() -> None:
    block = survey("A1", 4, SimOptions(noise_px=0.0, correlated_px=0.4, n_points=6000))
    error = block.observations.pixels - block.true_pixels()
    assert np.sqrt(np.mean(error**2)) == pytest.approx(0.4, rel=0.1)
    photo = block.observations.photo == 7
    where, what = block.observations.pixels[photo], error[photo]
    distance = np.linalg.norm(where[:, None] - where[None], axis=-1) + 1e9 * np.eye(len(where))
    near = distance.argmin(axis=1)
    close = distance.min(axis=1) < 100
    assert np.abs(what - what[near])[close].mean() < 0.5 * np.abs(what).mean()


def test_rolling_shutter_moves_rows_by_the_track() -> None:
    """A nadir photo over flat ground: rows move by speed * time * f / height, exactly."""
    options = SimOptions(
        noise_px=0.0,
        relief_m=0.0,
        readout_s=0.03,
        speed_m_s=10.0,
        attitude_jitter_deg=0.0,
        height_jitter_m=0.0,
        position_jitter_m=0.0,
    )
    moving = survey("A1", 6, options)
    seen = moving.observations
    time_s = (seen.pixels[:, 1] / 3000 - 0.5) * 0.03
    centre = moving.centres_m[seen.photo] + time_s[:, None] * moving.velocity_m_s[seen.photo]
    local = np.einsum(
        "nij,nj->ni", moving.rotations_cam_from_world[seen.photo], moving.points_m[seen.point] - centre
    )
    assert np.abs(moving.lens.project(local[:, :2] / local[:, 2:]) - seen.pixels).max() < 1e-7
    still = np.einsum(
        "nij,nj->ni",
        moving.rotations_cam_from_world[seen.photo],
        moving.points_m[seen.point] - moving.centres_m[seen.photo],
    )
    shift = seen.pixels - moving.lens.project(still[:, :2] / still[:, 2:])
    assert 4 < np.abs(shift).max() < 8  # 10 m/s * 0.015 s * 2320 px / 60 m = 5.8 px


@pytest.mark.parametrize("seed", range(5))
def test_pattern_has_its_maximum_and_hides_from_brown(seed: int) -> None:
    camera = phantom3()
    pattern = random_pattern(seed, camera, 1.5)
    fine = pixel_grid(4000, 3000, 200, 150)
    assert 1.2 < np.linalg.norm(pattern(fine), axis=-1).max() <= 1.5 + 1e-6
    grid = pixel_grid(4000, 3000)
    tangent = tangent_space(camera, grid).reshape(-1, 13)
    shift = pattern(grid).reshape(-1)
    cosine = tangent.T @ shift / np.linalg.norm(tangent, axis=0) / np.linalg.norm(shift)
    assert np.abs(cosine).max() < 1e-9
    # What least squares makes of the total mapping: f stays, to second order in the pattern.
    coefficients, *_ = np.linalg.lstsq(tangent_space(camera, fine).reshape(-1, 13), pattern(fine).ravel())
    assert abs(coefficients[0]) < 0.0002 * camera.f_px


def test_pattern_scales_with_the_image() -> None:
    pattern = random_pattern(3, phantom3(), 1.5)
    pixels = pixel_grid(4000, 3000)
    assert np.allclose(pattern.scaled(1000, 750)(pixels / 4), pattern(pixels) / 4)


def test_small_rotation_of_a_quarter_turn() -> None:
    assert np.allclose(small_rotation(np.array([[0, 0, np.pi / 2]])) @ [1, 0, 0], [[0, 1, 0]])


def test_relief_gradient_is_the_slope_of_its_height() -> None:
    relief = Relief.random(1, 4.0)
    rng = np.random.default_rng(0)
    e, n = rng.uniform(-100, 100, (2, 500))
    height, by_e, by_n = relief.height_and_gradient(e, n)
    assert np.array_equal(height, relief.height_m(e, n))
    step = 1e-4
    assert np.allclose(
        (relief.height_m(e + step, n) - relief.height_m(e - step, n)) / (2 * step), by_e, atol=1e-7
    )
    assert np.allclose(
        (relief.height_m(e, n + step) - relief.height_m(e, n - step)) / (2 * step), by_n, atol=1e-7
    )
    assert np.abs(relief.height_m(e, n)).max() <= relief.bound_m + 1e-12
    assert relief.bound_m == pytest.approx(4.0)


def test_a_block_is_simulated_quickly() -> None:
    survey("A3", 0)
    started = time.process_time()
    survey("A3", 1)
    assert time.process_time() - started < 0.4

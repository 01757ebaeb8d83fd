"""What is known of a camera's way while its rows are read, and that sigmas with it are honest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from align_blocks import NOMINAL_F_PX

from calib.align.readout import ASIDE, CLIMB_M, WAY, line_directions, open_way_m, way_information
from calib.align.uncertainty import estimate
from calib.camera import FloatArray
from calib.flown import flown_network
from sim.flights import Flight, convergent, grid, phantom3
from sim.network import SimBlock, SimOptions, observe
from sim.solve import calibrate_block


def sigmas_along(information: FloatArray, direction: FloatArray) -> float:
    return float(np.sqrt(direction @ np.linalg.inv(information) @ direction))


def test_lines_are_found_and_their_ends() -> None:
    flight = grid(3, 5, 60.0, 80.0, heading_deg=30.0)
    along, inner = line_directions(flight.centres_m)
    assert np.flatnonzero(~inner).tolist() == [0, 4, 5, 9, 10, 14]
    assert np.abs(np.sum(along * flight.track, axis=1)) == pytest.approx(1.0, abs=1e-6)


def test_turns_pauses_and_circles_are_no_lines() -> None:
    fan = convergent(8, 30.0, 60.0)
    assert not line_directions(fan.centres_m)[0].any()
    bent = np.array([[0.0, 0, 60], [20, 0, 60], [40, 12, 60], [50, 30, 60]])
    assert not line_directions(bent)[0].any()
    uneven = np.array([[0.0, 0, 60], [20, 0, 60], [60, 0, 60], [62, 0, 60]])
    assert not line_directions(uneven)[0].any()
    for k in range(3):
        assert not line_directions(bent[:k])[0].any()


def test_what_is_open_and_what_is_not() -> None:
    """Along a line as on any vehicle; aside, up and standing hardly."""
    flight = grid(2, 4, 60.0, 60.0, heading_deg=0.0) + convergent(4, 35.0, 60.0)
    standing = np.arange(len(flight)) >= len(flight) - 2
    found = way_information(flight.centres_m, 60.0, standing)
    north, east, up = np.array([0.0, 1, 0]), np.array([1.0, 0, 0]), np.array([0.0, 0, 1])
    inside = found[1]
    assert sigmas_along(inside, north) == pytest.approx(60 * WAY * np.sqrt(10), rel=0.01)
    # However many there are, their mean is as open.
    assert open_way_m(1000, 60.0) / np.sqrt(1000) == pytest.approx(60 * WAY)
    assert sigmas_along(inside, east) == pytest.approx(60 * ASIDE, rel=1e-6)
    assert sigmas_along(inside, up) == pytest.approx(CLIMB_M, rel=1e-6)
    assert sigmas_along(found[0], east) > 2 * sigmas_along(inside, east)
    # On no line and not known to stand: any way over the ground.
    assert sigmas_along(found[8], east) == pytest.approx(open_way_m(10, 60.0))
    assert sigmas_along(found[-1], east) == pytest.approx(60 * ASIDE)
    nowhere = way_information(flight.centres_m, 60.0, upright=False)
    assert np.allclose(nowhere, np.eye(3) / open_way_m(12, 60.0) ** 2)
    # Close to a wall nothing is known better than along.
    near = way_information(flight.centres_m, 3.0)
    assert np.sqrt(np.linalg.inv(near[8])[2, 2]) == pytest.approx(3 * WAY)


def flown_unevenly(seed: int, noise_px: float = 0.5) -> tuple[SimBlock, int]:
    """Straight down at 2 to 11 m/s in gusts, then eight photos from aside, standing in gusts."""
    rng = np.random.default_rng([seed, 77])
    survey = grid(4, 7, 60.0, 100.0, heading_deg=20.0)
    plan = survey + convergent(8, 32.0, 70.0)
    track = plan.track * rng.uniform(2.0, 11.0, (len(plan), 1))
    track[len(survey) :] = 0.0
    track += rng.normal(size=track.shape) * [0.2, 0.2, 0.3]
    flight = Flight(plan.rotations_cam_from_world, plan.centres_m, track)
    options = SimOptions(n_points=700, readout_s=0.03, speed_m_s=1.0, noise_px=noise_px)
    return observe("uneven", flight, phantom3(), seed, options), len(survey)


def test_sigmas_are_honest_however_unevenly_it_flew() -> None:
    errors, sigmas, wider = [], [], []
    for seed in range(7):
        block, first = flown_unevenly(seed)
        standing = np.arange(len(block.centres_m)) >= first
        solved = calibrate_block(block, NOMINAL_F_PX, seed, standing)
        assert solved.adjustment.priors.way_information is not None
        found = estimate(solved)
        errors.append(found.brown.f_px - block.lens.brown.f_px)
        sigmas.append(np.sqrt(found.covariance[0, 0]))
        # Planning takes the same ways for known.
        flown = flown_network(solved, found.correlation_factor)
        assert flown.known.way_information is solved.adjustment.priors.way_information
        if seed < 3:
            moving = calibrate_block(block, NOMINAL_F_PX, seed)
            assert moving.adjustment.priors.way_information is not None
            wider.append(np.sqrt(estimate(moving).covariance[0, 0]))
    ratio = np.array(errors) / np.array(sigmas)
    assert np.abs(ratio).max() < 3.0
    assert 0.4 < np.sqrt(np.mean(ratio**2)) < 1.5
    # Knowing that they stood is of some use, and of no harm.
    assert np.all(np.array(wider) > 0.95 * np.array(sigmas[:3]))


def test_what_fits_only_with_the_ways_is_not_left_out() -> None:
    """Sharp images: without the ways most of the oblique photos' measurements are taken for blunders."""
    errors = []
    for seed in range(4):
        block, first = flown_unevenly(seed, noise_px=0.1)
        solved = calibrate_block(block, NOMINAL_F_PX, seed, np.arange(len(block.centres_m)) >= first)
        kept = np.zeros(len(block.observations), bool)
        kept[solved.observation_index] = True
        photo = block.observations.photo
        share = np.bincount(photo, kept) / np.bincount(photo)
        assert share.min() > 0.95
        found = estimate(solved)
        errors.append((found.brown.f_px - block.lens.brown.f_px) / np.sqrt(found.covariance[0, 0]))
    assert np.abs(errors).max() < 3.0
    assert 0.2 < np.sqrt(np.mean(np.square(errors))) < 1.7


def test_a_global_shutter_is_not_taken_for_another() -> None:
    for seed in range(4):
        block, first = flown_unevenly(seed)
        flight = Flight(block.rotations_cam_from_world, block.centres_m, np.zeros((len(block.centres_m), 3)))
        still = observe("still", flight, phantom3(), seed, SimOptions(n_points=700, noise_px=0.5))
        standing = np.arange(len(still.centres_m)) >= first
        assert calibrate_block(still, NOMINAL_F_PX, seed, standing).adjustment.priors.way_information is None


def test_a_block_that_only_stood_has_no_ways_to_find() -> None:
    block, _ = flown_unevenly(0)
    everywhere = np.ones(len(block.centres_m), bool)
    found = way_information(block.centres_m, 60.0, everywhere)
    assert np.sqrt(np.linalg.inv(found)[:, [0, 1, 2], [0, 1, 2]]).max() == pytest.approx(CLIMB_M)
    solved = calibrate_block(block, NOMINAL_F_PX, 0, everywhere)
    assert np.isfinite(solved.adjusted.sigma0)


def test_a_common_way_is_found_where_single_ones_drown() -> None:
    """Few tie points and noise: photo by photo nothing is certain, and f is several sigmas off."""
    errors, found = [], 0
    for seed in range(4):
        rng = np.random.default_rng([seed, 78])
        survey = grid(5, 8, 60.0, 120.0, heading_deg=20.0)
        plan = survey + convergent(12, 40.0, 75.0) + convergent(6, 20.0, 75.0, first_azimuth_deg=45.0)
        track = plan.track * 6.0
        track[len(survey) :] = 0.0
        track += rng.normal(size=track.shape) * 0.1
        flight = Flight(plan.rotations_cam_from_world, plan.centres_m, track)
        options = SimOptions(n_points=350, readout_s=0.03, speed_m_s=1.0, noise_px=1.2)
        block = observe("faint", flight, phantom3(), seed, options)
        standing = np.arange(len(flight)) >= len(survey)
        solved = calibrate_block(block, NOMINAL_F_PX, seed, standing)
        found += solved.adjustment.priors.way_information is not None
        estimated = estimate(solved)
        errors.append((estimated.brown.f_px - block.lens.brown.f_px) / np.sqrt(estimated.covariance[0, 0]))
    assert found >= 3
    assert np.abs(errors).max() < 3.2


def test_noise_in_the_rows_is_not_taken_for_a_way() -> None:
    """Oblique and straight photos that all moved, affinity open: a mean way hangs on the rows."""
    means = []
    for seed in range(6):
        plan = grid(4, 6, 60.0, 100.0, heading_deg=0.0) + grid(
            2, 5, 60.0, 100.0, heading_deg=0.0, off_nadir_deg=35.0
        )
        block = observe("still", plan, phantom3(), seed, SimOptions(n_points=900, noise_px=0.8))
        solved = calibrate_block(block, NOMINAL_F_PX, seed)
        assert solved.adjustment.priors.way_information is None
        state = solved.adjusted.state
        ways = way_information(state.centres_m, 60.0)
        moving = solved.adjustment.with_priors(replace(solved.adjustment.priors, way_information=ways))
        with_ways = moving.run(state, solved.adjusted.free, decrement=1e-2)
        mean, variance = moving.mean_way(with_ways, line_directions(state.centres_m)[0])
        means.append(mean / np.sqrt(variance))
    assert abs(np.mean(means)) < 1.2
    assert np.abs(means).max() < 3.0

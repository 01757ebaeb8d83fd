"""The adjustment: derivatives, normal equations, covariance, robustness."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from align_blocks import (
    BROWN,
    INDEX,
    block_adjustment,
    brown_and_field,
    f_error_sigmas,
    gps_priors,
    loose_priors,
    small,
    truth_of,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from calib.align.adjust import Adjustment, State
from calib.align.dome import aligned_difference_m
from calib.align.grow import lens_mask
from calib.align.normal import Topology
from calib.align.rays import ray_angle_deg, triangulate
from calib.align.readout import WAY, way_information
from calib.align.rotations import rotation_exp, rotation_log, similarity_tangent
from calib.camera import BrownCamera, FloatArray
from calib.field import LENS_NAMES, Lens
from calib.solution import BoolArray, Observations
from sim.flights import grid, phantom3
from sim.network import SimBlock, SimOptions, observe

MISMATCHES = {"mismatch_rate": 0.05}


def rich_lens(seed: int) -> Lens:
    """A lens in which every one of the 35 parameters does something."""
    rng = np.random.default_rng(seed)
    vector = Lens(phantom3()).vector + 0.0
    vector[[INDEX["cx"], INDEX["cy"]]] += rng.normal(0, 30, 2)
    vector[[INDEX["k4"], INDEX["p1"], INDEX["p2"]]] = rng.normal(0, 2e-3, 3)
    vector[[INDEX["b1"], INDEX["b2"]]] = rng.normal(0, 8, 2)
    vector[11:] = rng.normal(0, 0.7, 24)
    return Lens(BrownCamera.ideal(4000, 3000, 1.0)).with_vector(vector)


# -- derivatives -----------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_lens_derivatives_are_those_of_its_projection(seed: int) -> None:
    lens = rich_lens(seed)
    rays = np.random.default_rng(seed).uniform([-0.8, -0.6], [0.8, 0.6], (60, 2))
    pixels, by_ray, by_lens = lens.derivatives(rays)
    assert np.allclose(pixels, lens.project(rays), rtol=0, atol=1e-9)

    for axis in range(2):
        step = np.zeros(2)
        step[axis] = 1e-5
        numeric = (lens.project(rays + step) - lens.project(rays - step)) / 2e-5
        assert np.allclose(by_ray[:, :, axis], numeric, rtol=1e-7, atol=1e-4)
    for index, name in enumerate(LENS_NAMES):
        size = 1e-2 if name in ("f", "cx", "cy", "b1", "b2") or index >= 11 else 1e-5
        up, down = lens.vector, lens.vector
        up[index] += size
        down[index] -= size
        numeric = (lens.with_vector(up).project(rays) - lens.with_vector(down).project(rays)) / (2 * size)
        assert np.allclose(by_lens[:, :, index], numeric, rtol=1e-6, atol=1e-5), name
        assert np.abs(by_lens[:, :, index]).max() > 1e-3, name


def test_lens_comes_back_through_unprojection() -> None:
    lens = rich_lens(1)
    pixels = np.random.default_rng(0).uniform([0, 0], [4000, 3000], (300, 2))
    assert np.allclose(lens.project(lens.unproject(pixels)), pixels, rtol=0, atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-3.1, 3.1), min_size=3, max_size=3), st.floats(0, 3.1))
def test_rotation_vectors_come_back(direction: list[float], angle: float) -> None:
    axis = np.array(direction)
    if np.linalg.norm(axis) < 1e-3:
        axis = np.array([0.0, 0.0, 1.0])
    omega = (angle * axis / np.linalg.norm(axis))[None]
    rotation = rotation_exp(omega)
    assert np.allclose(rotation[0] @ rotation[0].T, np.eye(3), atol=1e-13)
    assert np.linalg.det(rotation[0]) == pytest.approx(1)
    assert np.allclose(rotation_log(rotation), omega, atol=1e-7)


def test_similarity_tangent_is_the_derivative_of_a_similarity() -> None:
    points = np.random.default_rng(0).normal(0, 20, (30, 3))
    design = similarity_tangent(points)

    def moved(vector: FloatArray) -> FloatArray:
        turn = rotation_exp(vector[None, 3:6])[0]
        result: FloatArray = np.exp(vector[6]) * points @ turn.T + vector[:3]
        return result

    for column in range(7):
        step = np.zeros(7)
        step[column] = 1e-6
        numeric = (moved(step) - moved(-step)) / 2e-6
        assert np.allclose(design[:, :, column], numeric, atol=1e-7)


# -- normal equations ------------------------------------------------------------------------------


def brute_force(
    block: SimBlock, adjustment: Adjustment, state: State, free: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Covariance of the free lens parameters, and d points / d lens, from the whole normal matrix.

    The Jacobian is numeric; unknowns in the order lens, poses, points.
    """
    priors = adjustment.priors
    k, m, p = len(state.centres_m), len(state.points_m), int(free.sum())
    q = 6 if priors.way_information is None else 9
    steps = np.where(np.isin(np.arange(35), [0, 1, 2, 9, 10]), 1e-2, 1e-6)[free]
    sizes = np.concatenate([steps, np.tile([1e-6] * 3 + [1e-4] * (q - 3), k), np.full(3 * m, 1e-4)])

    def residual(vector: FloatArray) -> FloatArray:
        lens_vector = state.lens.vector
        lens_vector[free] += vector[:p]
        pose = vector[p : p + q * k].reshape(k, q)
        turned = rotation_exp(pose[:, :3]) @ state.rotations
        centres = state.centres_m + pose[:, 3:6]
        points = state.points_m + vector[p + q * k :].reshape(m, 3)
        way = None if state.shutter_m is None else state.shutter_m + pose[:, 6:]
        moved = State(state.lens.with_vector(lens_vector), turned, centres, points, way)
        image = adjustment.residuals_px(moved) / block.observations.sigma_px[:, None]
        position = (priors.centres_m - centres) / priors.centre_sigma_m
        attitude = (
            rotation_log(priors.rotations @ turned.transpose(0, 2, 1)) / priors.rotation_sigma_rad[:, None]
        )
        known = np.isfinite(priors.lens_sigma)
        lens = (priors.lens_mean - lens_vector)[known] / priors.lens_sigma[known]
        shutter = np.zeros(0)
        if way is not None and priors.way_information is not None:
            roots = np.linalg.cholesky(priors.way_information)
            shutter = np.einsum("kji,kj->ki", roots, way).ravel()
        return np.concatenate([image.ravel(), position.ravel(), attitude.ravel(), lens, shutter])

    columns = []
    for i, size in enumerate(sizes):
        step = np.zeros(len(sizes))
        step[i] = size
        columns.append((residual(step) - residual(-step)) / (2 * size))
    jacobian = np.stack(columns, axis=1)
    scale = 1 / np.linalg.norm(jacobian, axis=0)
    normal = (jacobian * scale).T @ (jacobian * scale)
    covariance = np.linalg.inv(normal) * np.outer(scale, scale)
    # Everything else re-adjusted around a lens that is moved.
    rest = normal[p:, p:]
    response = -np.linalg.solve(rest, normal[p:, :p]) * scale[p:, None] / scale[None, :p]
    return covariance[:p, :p], response[q * k :].reshape(m, 3, p)


@pytest.mark.parametrize("moving", [False, True])
def test_covariance_and_response_are_those_of_the_whole_normal_matrix(moving: bool) -> None:
    block = small("demo", 2, 70)
    priors = replace(
        gps_priors(block),
        rotations=block.gimbal_cam_from_world,
        rotation_sigma_rad=np.full(len(block.gps_m), np.radians(2.0)),
        way_information=way_information(block.centres_m, 60.0) if moving else None,
    )
    adjustment = block_adjustment(block, priors)
    free = brown_and_field()
    result = adjustment.run(truth_of(block), free, decrement=1e-6, response=True)
    covariance, response = brute_force(block, adjustment, result.state, free)
    ours = result.covariance[np.ix_(free, free)] / result.sigma0**2
    scale = np.sqrt(np.diag(covariance))
    assert np.allclose(ours / np.outer(scale, scale), covariance / np.outer(scale, scale), rtol=0, atol=1e-4)
    assert result.point_response is not None
    # In metres for one sigma of each parameter.
    assert np.allclose(result.point_response[:, :, free] * scale, response * scale, rtol=0, atol=1e-4)
    assert np.abs(response * scale).max() > 0.01
    assert not result.covariance[INDEX["k4"]].any()


def test_point_response_is_what_readjustment_with_a_moved_lens_gives() -> None:
    # Without misfits nothing is left of the curvature that the normal equations leave out.
    block = small("demo", 3, 150, noise_px=0.0)
    adjustment = block_adjustment(block, loose_priors(block, 2.5))
    free = lens_mask("f cx cy k1 k2")
    base = adjustment.run(truth_of(block), free, decrement=1e-8, response=True)
    assert base.point_response is not None
    weights = base.weights, base.position_weights
    held = np.zeros(len(LENS_NAMES), bool)
    for column, name in enumerate(("f", "cx", "cy", "k1", "k2")):
        delta = 0.3 * np.sqrt(np.linalg.inv(base.lens_normal)[column, column])
        moved = []
        for sign in (1, -1):
            vector = base.state.lens.vector
            vector[INDEX[name]] += sign * delta
            start = replace(base.state, lens=base.state.lens.with_vector(vector))
            moved.append(adjustment.run(start, held, decrement=1e-9, weights=weights).state.points_m)
        numeric = (moved[0] - moved[1]) / (2 * delta)
        scale = np.abs(numeric).max()
        assert scale * delta > 1e-4, name
        assert np.abs(base.point_response[:, :, column] - numeric).max() < 0.01 * scale, name


def test_both_ways_to_the_pose_matrix_agree() -> None:
    # Many photos that see few common points are where pairs of observations pay.
    flight = grid(6, 14, 60.0, 400.0)
    block = observe("large", flight, phantom3(), 1, SimOptions(n_points=500, site_m=400.0))
    adjustment = block_adjustment(block, gps_priors(block))
    assert not adjustment.topology.dense
    free = lens_mask("f cx cy k1 k2")
    by_pairs = adjustment.run(truth_of(block), free, max_iterations=5, response=True)
    adjustment.topology.dense = True
    dense = adjustment.run(truth_of(block), free, max_iterations=5, response=True)
    assert by_pairs.chi2 == pytest.approx(dense.chi2, rel=1e-9)
    assert np.allclose(by_pairs.lens_normal, dense.lens_normal, rtol=1e-6)
    sigma = np.sqrt(np.diag(dense.covariance)[free])
    assert np.abs((by_pairs.state.lens.vector - dense.state.lens.vector)[free] / sigma).max() < 1e-4
    assert np.abs(by_pairs.state.points_m - dense.state.points_m).max() < 1e-4
    few = small("demo", 1, 100)
    assert block_adjustment(few, gps_priors(few)).topology.dense


@pytest.mark.parametrize(
    ("photo", "point", "photos", "points"),
    [
        ([], [], 1, 1),
        ([0, 1, 0, 1], [1, 1, 0, 0], 2, 2),
        ([0, 1, 0], [0, 0, 1], 2, 2),
        ([0, 1], [0, 0], 3, 1),
    ],
    ids=["empty", "unsorted", "single view", "photo without any"],
)
def test_topology_refuses_what_cannot_be_adjusted(
    photo: list[int], point: list[int], photos: int, points: int
) -> None:
    obs = Observations(
        np.array(photo, int), np.array(point, int), np.zeros((len(photo), 2)), np.ones(len(photo))
    )
    with pytest.raises(ValueError, match="observations"):
        Topology(obs, photos, points)


# -- what the numbers mean -------------------------------------------------------------------------


def test_formal_sigmas_are_the_scatter() -> None:
    errors, sigma0 = [], []
    for seed in range(24):
        block = small("demo", seed, 200)
        result = block_adjustment(block, gps_priors(block), huber_sigmas=2.5).run(
            truth_of(block), lens_mask(BROWN)
        )
        assert result.converged
        errors.append(f_error_sigmas(result.state.lens, block.lens, result.covariance))
        sigma0.append(result.sigma0)
    ratio = np.sqrt(np.mean(np.square(errors), axis=0))
    for name in BROWN.split():
        assert 0.7 < ratio[INDEX[name]] < 1.4, (name, ratio[INDEX[name]])
    assert 0.95 < np.mean(sigma0) < 1.05


def test_chi_square_is_what_noise_gives() -> None:
    """Square sum of measurements and priors against their redundancy, over seeds."""
    total, redundancy = 0.0, 0
    for seed in range(6):
        block = small("demo", seed, 200)
        result = block_adjustment(block, gps_priors(block)).run(truth_of(block), lens_mask(BROWN))
        total += result.chi2
        # The field is held: its prior counts nothing.
        redundancy += result.redundancy
    low, high = (float(chi2.ppf(p, redundancy)) for p in (0.0005, 0.9995))
    assert low < total < high


def test_without_noise_the_truth_comes_back() -> None:
    block = small("demo", 1, 200, noise_px=0.0, gps_sigma_m=0.0)
    start = truth_of(block)
    rng = np.random.default_rng(0)
    start = State(
        Lens(BrownCamera.ideal(4000, 3000, 2400.0)),
        block.gimbal_cam_from_world,
        block.centres_m + rng.normal(0, 2, block.centres_m.shape),
        block.points_m + rng.normal(0, 3, block.points_m.shape),
    )
    result = block_adjustment(block, loose_priors(block, 5.0)).run(start, lens_mask(BROWN), decrement=1e-9)
    assert result.converged
    assert np.abs(result.residuals_px).max() < 1e-3
    assert result.state.lens.brown.f_px == pytest.approx(2320.06, abs=0.01)
    assert np.abs(result.state.points_m - block.points_m).max() < 1e-2


def test_turning_the_block_costs_no_more_than_its_geotags_say() -> None:
    """A block far off its place is turned and scaled back without being torn."""
    block = small("demo", 1, 150, noise_px=0.0, gps_sigma_m=0.0)
    turn = rotation_exp(np.radians([[2.0, -3.0, 60.0]]))[0]
    start = State(
        block.lens,
        block.rotations_cam_from_world @ turn.T,
        1.3 * block.centres_m @ turn.T + [20.0, -10.0, 5.0],
        1.3 * block.points_m @ turn.T + [20.0, -10.0, 5.0],
    )
    result = block_adjustment(block, loose_priors(block, 2.5)).run(start, lens_mask("f"), decrement=1e-6)
    assert result.converged
    assert result.iterations < 40
    assert np.abs(result.state.centres_m - block.centres_m).max() < 1e-2
    assert np.abs(aligned_difference_m(result.state.points_m, block.points_m)).max() < 1e-2


def test_given_weights_stay() -> None:
    block = small("demo", 2, 150, **MISMATCHES)
    adjustment = block_adjustment(block, gps_priors(block), huber_sigmas=2.5)
    free = lens_mask("f cx cy k1 k2")
    rng = np.random.default_rng(0)
    weights = rng.uniform(0.2, 1.0, len(block.observations)), rng.uniform(0.2, 1.0, len(block.gps_m))
    result = adjustment.run(truth_of(block), free, weights=weights, decrement=1e-6)
    assert np.array_equal(result.weights, weights[0])
    assert np.array_equal(result.position_weights, weights[1])
    # Its own weights give another answer, and running again under them gives that one again.
    own = adjustment.run(truth_of(block), free, decrement=1e-6)
    assert not np.array_equal(own.weights, weights[0])
    again = adjustment.run(truth_of(block), free, weights=(own.weights, own.position_weights), decrement=1e-6)
    sigma = np.sqrt(own.covariance[0, 0])
    assert abs(again.state.lens.brown.f_px - own.state.lens.brown.f_px) < 0.01 * sigma
    assert abs(result.state.lens.brown.f_px - own.state.lens.brown.f_px) > 0.1 * sigma


def test_mismatches_get_small_weights_and_move_little() -> None:
    moves = []
    for seed in range(5):
        block = small("demo", seed, 250, **MISMATCHES)
        result = block_adjustment(block, gps_priors(block), huber_sigmas=2.5).run(
            truth_of(block), lens_mask(BROWN)
        )
        assert np.median(result.weights[block.mismatched]) < 0.3
        assert np.median(result.weights[~block.mismatched]) == 1.0
        moves.append(f_error_sigmas(result.state.lens, block.lens, result.covariance)[0])
        naive = block_adjustment(block, gps_priors(block)).run(truth_of(block), lens_mask(BROWN))
        assert naive.sigma0 > 3 * result.sigma0
    assert np.abs(moves).max() < 3


def test_one_wrong_geotag_does_not_move_the_block() -> None:
    block = small("demo", 3, 150)
    wrong = block.gps_m.copy()
    wrong[4] += [200.0, 0.0, 0.0]
    priors = gps_priors(block)
    told = replace(priors, centres_m=wrong)
    sound, misled = (
        Adjustment(block.observations, 20, len(block.points_m), p).run(
            truth_of(block), lens_mask("f cx cy k1 k2")
        )
        for p in (priors, told)
    )
    moved = np.linalg.norm(misled.state.centres_m - sound.state.centres_m, axis=1)
    assert moved.max() < 1.5
    assert misled.position_weights[4] < 0.1


def test_progress_is_told_and_can_cancel() -> None:
    class Enough(Exception):
        pass

    block = small("demo", 1, 100)
    count = 0

    def tick() -> None:
        nonlocal count
        count += 1
        if count == 3:
            raise Enough

    with pytest.raises(Enough):
        block_adjustment(block, gps_priors(block)).run(
            truth_of(block), lens_mask(BROWN), decrement=1e-12, tick=tick
        )
    assert count == 3


# -- points ----------------------------------------------------------------------------------------


def test_triangulation_finds_the_points() -> None:
    exact = small("demo", 1, 150, noise_px=0.0)
    found = triangulate(
        exact.lens, exact.rotations_cam_from_world, exact.centres_m, exact.observations, len(exact.points_m)
    )
    assert np.abs(found - exact.points_m).max() < 1e-6
    noisy = small("demo", 1, 150)
    found = triangulate(
        noisy.lens, noisy.rotations_cam_from_world, noisy.centres_m, noisy.observations, len(noisy.points_m)
    )
    error = np.sqrt(np.mean((found - noisy.points_m) ** 2, axis=0))
    # Half a pixel is 13 mm on the ground; points that two photos see are a few times weaker.
    assert (error > 0.01).all()
    assert (error < 0.15).all()


def test_parallel_rays_give_no_point() -> None:
    lens = Lens(BrownCamera.ideal(400, 300, 400.0))
    obs = Observations(np.array([0, 1]), np.array([0, 0]), np.full((2, 2), [200.0, 150.0]), np.ones(2))
    down = np.tile(np.diag([1.0, -1.0, -1.0]), (2, 1, 1))
    points = triangulate(lens, down, np.array([[0, 0, 10.0], [1.0, 0, 10.0]]), obs, 1)
    assert np.isnan(points).all()


def test_ray_angle() -> None:
    centres = np.array([[-1.0, 0, 1], [1.0, 0, 1], [0, 0, 5.0]])
    points = np.array([[0.0, 0, 0], [0.0, 0, 0]])
    obs = Observations(np.array([0, 1, 0, 2]), np.array([0, 0, 1, 1]), np.zeros((4, 2)), np.ones(4))
    assert ray_angle_deg(centres, points, obs) == pytest.approx([90.0, 45.0])


# -- rolling shutter -------------------------------------------------------------------------------


def test_way_during_the_readout_is_found() -> None:
    """8 m/s over 30 ms are 24 cm along the track; held still, the same block does not fit."""
    block = small("demo", 2, 250, readout_s=0.03, speed_m_s=8.0)
    priors = gps_priors(block)
    moving = block_adjustment(
        block, replace(priors, way_information=way_information(block.centres_m, 0.5 / WAY, upright=False))
    )
    result = moving.run(truth_of(block), lens_mask(BROWN))
    still = block_adjustment(block, priors).run(truth_of(block), lens_mask(BROWN))
    assert result.converged
    assert 0.9 < result.sigma0 < 1.1
    # Sixty unknowns more; chance alone would gain as many.
    assert still.chi2 - result.chi2 > 200
    assert result.state.shutter_m is not None
    way = block.velocity_m_s * block.readout_s
    assert np.linalg.norm(way, axis=1) == pytest.approx(0.24)
    # Across the track and up it is told from attitude and lens only weakly; along, fairly well.
    along = np.sum(result.state.shutter_m * way, axis=1) / 0.24
    assert np.median(along) == pytest.approx(0.24, abs=0.08)
    error = f_error_sigmas(result.state.lens, block.lens, result.covariance)
    assert np.nanmax(np.abs(error)) < 3.5


def test_block_with_a_rolling_shutter_is_turned_as_a_whole() -> None:
    """A step that turns and scales the block carries the ways along, once and not twice."""
    block = small("demo", 2, 150, readout_s=0.03, speed_m_s=8.0, noise_px=0.0, gps_sigma_m=0.0)
    priors = replace(
        loose_priors(block, 2.5), way_information=way_information(block.centres_m, 5.0 / WAY, upright=False)
    )
    way = block.velocity_m_s * block.readout_s
    turn = rotation_exp(np.radians([[2.0, -3.0, 50.0]]))[0]
    start = State(
        block.lens,
        block.rotations_cam_from_world @ turn.T,
        1.2 * block.centres_m @ turn.T + [20.0, -10.0, 5.0],
        1.2 * block.points_m @ turn.T + [20.0, -10.0, 5.0],
        1.2 * way @ turn.T,
    )
    adjustment = block_adjustment(block, priors)
    fixed = np.zeros(len(LENS_NAMES), bool)
    result = adjustment.run(start, fixed, decrement=1e-6)
    assert result.converged
    assert result.iterations < 42
    assert np.abs(result.state.centres_m - block.centres_m).max() < 1e-2
    assert result.state.shutter_m is not None
    assert np.abs(result.state.shutter_m - way).max() < 0.02

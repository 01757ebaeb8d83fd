"""Domes: sign, size, sigma."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from align_blocks import INDEX, block_adjustment, loose_priors, small, solved, truth_of

from calib.align.dome import (
    aligned_difference_m,
    dome_amplitude_m,
    of_the_site,
    predict_dome,
    site_radius_m,
)
from calib.align.grow import lens_mask
from calib.align.selfcal import Calibrated
from calib.camera import FloatArray
from calib.field import LENS_NAMES
from calib.solution import BoolArray, Dome, Observations
from sim.flights import rotation_looking
from sim.network import SimBlock


def flat_site(seed: int, m: int = 400) -> FloatArray:
    return np.column_stack([np.random.default_rng(seed).uniform(-60, 60, (m, 2)), np.zeros(m)])


def held_at(block: SimBlock, k1_error: float) -> Calibrated:
    """The block adjusted with K1 nailed to a wrong value, f free."""
    vector = block.lens.vector
    vector[INDEX["k1"]] += k1_error
    sigma = np.full(len(LENS_NAMES), np.inf)
    sigma[INDEX["k1"]] = 1e-9
    priors = replace(loose_priors(block, 2.5), lens_mean=vector, lens_sigma=sigma)
    adjustment = block_adjustment(block, priors)
    start = replace(truth_of(block), lens=block.lens.with_vector(vector))
    result = adjustment.run(start, lens_mask("f k1"), response=True)
    return Calibrated(adjustment, result, np.arange(len(block.points_m)), np.arange(len(block.observations)))


def dome_of(block: SimBlock, points_m: FloatArray) -> float:
    """What a comparison with the true points shows."""
    return float(dome_amplitude_m(block.points_m, aligned_difference_m(points_m, block.points_m)[:, 2]))


def test_amplitude_is_the_middle_over_the_edge() -> None:
    points = flat_site(0)
    radius = site_radius_m(points)
    assert 65 < radius < 85  # 95 % of a square of 120 m
    middle = np.median(points[:, :2], axis=0)
    r2 = np.sum((points[:, :2] - middle) ** 2, axis=1) / radius**2
    tilt = 0.3 + points[:, :2] @ [0.01, -0.02]
    saddle = (points[:, 0] ** 2 - points[:, 1] ** 2) * 1e-3
    assert dome_amplitude_m(points, -0.25 * r2 + tilt + saddle) == pytest.approx(0.25)
    assert dome_amplitude_m(points, 0.25 * r2 + tilt) == pytest.approx(-0.25)
    both = dome_amplitude_m(points, np.stack([-r2, 3 * r2], axis=1))
    assert both == pytest.approx([1.0, -3.0])


@pytest.mark.parametrize("k1_error", [0.003, -0.003])
def test_wrong_k1_bends_the_site_as_predicted(k1_error: float) -> None:
    block = small("A1", 1, 250, noise_px=0.0, gps_sigma_m=0.0, relief_m=0.5)
    wrong = held_at(block, k1_error)
    points = wrong.adjusted.state.points_m
    true = dome_of(block, points)
    dome = predict_dome(wrong, wrong.adjusted.covariance, block.lens, 60.0)
    assert dome.amplitude_m is not None
    assert dome.amplitude_m == pytest.approx(true, rel=0.02)
    # A nadir block over 120 m: half a metre, and too much K1 lifts the middle.
    assert 0.3 < dome.amplitude_m * np.sign(k1_error) < 0.8
    assert dome.amplitude_percent == pytest.approx(100 * dome.amplitude_m / 60)

    # Convergent photos hold the site down.
    strong = small("demo", 1, 250, noise_px=0.0, gps_sigma_m=0.0, relief_m=0.5)
    less = dome_of(strong, held_at(strong, k1_error).adjusted.state.points_m)
    assert 0.02 < less / true < 0.4


def test_a_point_that_hangs_in_the_air_does_not_count() -> None:
    """One point whose rays hardly cross would leave every dome open, and hide every one."""
    block = small("A1", 1, 250, noise_px=0.0, gps_sigma_m=0.0, relief_m=0.5)
    good = held_at(block, 0.003)
    response = good.adjusted.point_response
    assert response is not None
    wild = response.copy()
    wild[17] *= 1e6
    hanging = replace(good, adjusted=replace(good.adjusted, point_response=wild))
    covariance = np.diag(np.where(good.adjusted.free, 1e-6, 0.0))
    domes = [predict_dome(one, covariance, block.lens, 60.0) for one in (good, hanging)]
    assert domes[1].sigma_m == pytest.approx(domes[0].sigma_m, rel=0.05)
    assert domes[1].amplitude_m == pytest.approx(domes[0].amplitude_m, rel=0.05)


def test_map_shows_the_dome() -> None:
    block = small("A1", 1, 300, noise_px=0.0, gps_sigma_m=0.0, relief_m=0.5)
    wrong = held_at(block, 0.003)
    dome = predict_dome(wrong, wrong.adjusted.covariance, block.lens, 60.0)
    assert dome.grid_difference_m is not None
    assert dome.grid_east_m is not None
    assert dome.grid_north_m is not None
    east, north = np.meshgrid(dome.grid_east_m, dome.grid_north_m)
    r = np.hypot(east - np.median(east), north - np.median(north)) / dome.site_radius_m
    inner = np.nanmean(dome.grid_difference_m[r < 0.3])
    outer = np.nanmean(dome.grid_difference_m[(r > 0.8) & (r < 1.0)])
    assert inner - outer == pytest.approx(dome.amplitude_m, rel=0.35)
    assert np.isfinite(dome.grid_difference_m[r < 0.6]).all()


def test_sigma_is_the_scatter_of_the_difference() -> None:
    ratios = []
    for seed in range(20):
        block, calibrated = solved("demo", seed, 200)
        dome = predict_dome(calibrated, calibrated.adjusted.covariance, block.lens, 60.0)
        assert dome.amplitude_m is not None
        ratios.append(dome.amplitude_m / dome.sigma_m)
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.4
    assert np.abs(ratios).max() < 3.5


def nadir_dome(name: str) -> Dome:
    _, calibrated = solved(name, 2, 200)
    return predict_dome(calibrated, calibrated.adjusted.covariance, None, 60.0)


def test_network_decides_what_is_left_open() -> None:
    nadir, strong = nadir_dome("A1"), nadir_dome("A3")
    assert nadir.amplitude_m is None
    assert nadir.amplitude_percent is None
    # 0.1 % of the flying height is 6 cm.
    assert nadir.sigma_m > 0.06
    assert 0.001 < strong.sigma_m < 0.02


def test_block_without_response_is_refused() -> None:
    block = small("demo", 1, 100)
    adjustment = block_adjustment(block, loose_priors(block, 2.5))
    bare = adjustment.run(truth_of(block), lens_mask("f"))
    bare_block = Calibrated(
        adjustment, bare, np.arange(len(block.points_m)), np.arange(len(block.observations))
    )
    with pytest.raises(ValueError, match="response"):
        predict_dome(bare_block, bare.covariance, None, 60.0)


def test_ground_that_only_oblique_photos_see_is_not_the_sites() -> None:
    """Photos that look down see points 0 to 5, the oblique ones alone 6 and 7; point 8 has one of each."""
    seen = [(photo, point) for point in range(6) for photo in (0, 1, 2)]
    seen += [(photo, point) for point in (6, 7) for photo in (3, 4)] + [(0, 8), (3, 8)]
    photo, point = np.array(seen).T
    obs = Observations(photo, point, np.zeros((len(seen), 2)), np.ones(len(seen)))

    def site(*off_nadir_deg: float) -> list[int]:
        tilt = np.array(off_nadir_deg)
        return np.flatnonzero(of_the_site(rotation_looking(70.0 * np.arange(5), tilt), obs, 9)).tolist()

    assert site(0, 3, 8, 30, 40) == list(range(6))
    # Where most photos are oblique, what they see was meant.
    assert site(0, 3, 35, 30, 40) == list(range(9))
    assert site(0, 0, 0, 0, 0) == list(range(9))


def test_ground_that_only_an_extra_pass_sees_is_not_the_sites() -> None:
    """As many oblique photos as straight ones, and they see more ground than these."""
    survey = [(photo, point) for point in range(40) for photo in (0, 1)]
    survey += [(photo, point) for point in range(40, 140) for photo in (2, 3)]
    photo, point = np.array(survey).T
    obs = Observations(photo, point, np.zeros((len(survey), 2)), np.ones(len(survey)))
    passes = np.array([False, False, True, True])

    def count(rotations: FloatArray, standing: BoolArray | None) -> int:
        return int(of_the_site(rotations, obs, 140, standing).sum())

    nadir_first = rotation_looking(70.0 * np.arange(4), np.array([0.0, 3, 35, 40]))
    assert count(nadir_first, passes) == 40
    assert count(nadir_first, None) == 140
    # Of a survey that is oblique itself all the ground counts, of its pass none.
    assert count(rotation_looking(70.0 * np.arange(4), np.full(4, 35.0)), passes) == 40
    # All photos from standing: there is no pass to tell from a survey.
    assert count(nadir_first, np.ones(4, bool)) == 140


def test_a_move_of_a_parameter_that_the_model_holds_bends_no_ground_of_its_own() -> None:
    """K4 instead of K1 to K3: the lens's terms move far, each bends the model, together they do not."""
    _, base = solved("A3", 4, 300)
    free = base.adjusted.free.copy()
    assert not free[INDEX["k4"]]
    free[INDEX["k4"]] = True
    weights = (base.adjusted.weights, base.adjusted.position_weights)
    other = base.adjustment.run(base.adjusted.state, free, weights=weights)
    move = other.state.lens.vector - base.adjusted.state.lens.vector
    dome = predict_dome(base, np.outer(move, move), None, 60.0)
    true_m = abs(dome_amplitude_m(
        base.adjusted.state.points_m,
        aligned_difference_m(other.state.points_m, base.adjusted.state.points_m)[:, 2],
    ))  # fmt: skip
    without_k4 = np.where(np.arange(len(move)) == INDEX["k4"], 0.0, move)
    apart_m = predict_dome(base, np.outer(without_k4, without_k4), None, 60.0).sigma_m
    # Second-order terms of a move of thousands of sigmas of single terms remain.
    assert dome.sigma_m == pytest.approx(true_m, abs=0.005 * apart_m)
    assert apart_m > 100 * dome.sigma_m

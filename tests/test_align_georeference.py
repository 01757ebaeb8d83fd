"""From an arbitrary frame to the world, and which geotags deserve belief."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from align_blocks import small

from calib import frames
from calib.align.georeference import DEFAULT_SIGMA_M, LEAST_SIGMA_M, Placement, Tags, place, read_tags
from calib.align.rotations import rotation_exp
from calib.camera import FloatArray
from calib.photos.photo import CameraIdentity, Photo, Position
from sim.flights import grid, phantom3
from sim.network import SimBlock, SimOptions, observe

#: The frame that a block grows in has nothing to do with the world's.
SCRAMBLE = rotation_exp(np.array([[0.4, -1.1, 2.0]]))[0]
SCALE, SHIFT = 0.13, np.array([1.0, 2.0, 3.0])


@pytest.fixture(scope="module")
def block() -> SimBlock:
    return small("A1", 1, 300)


def tags_of(positions_m: FloatArray, rotations: FloatArray | None, sigma_m: float = 2.5) -> Tags:
    k = len(positions_m)
    turns = np.tile(np.eye(3), (k, 1, 1)) if rotations is None else rotations
    sigma = np.full((k, 3), sigma_m)
    return Tags(None, "EPSG:32630", positions_m, sigma, turns, np.full(k, rotations is not None))


def placed(block: SimBlock, tags: Tags) -> Placement:
    return place(
        block.rotations_cam_from_world @ SCRAMBLE.T,
        SCALE * block.centres_m @ SCRAMBLE.T + SHIFT,
        SCALE * block.points_m @ SCRAMBLE.T + SHIFT,
        tags,
    )


def away_m(block: SimBlock, placement: Placement) -> float:
    """Largest distance of a camera from its true place."""
    moved = placement.transform.apply(SCALE * block.centres_m @ SCRAMBLE.T + SHIFT)
    return float(np.linalg.norm(moved - block.centres_m, axis=1).max())


def tilt_deg(placement: Placement) -> float:
    """How far the block's up axis ends up from the world's."""
    up = (placement.transform.rotation @ SCRAMBLE)[2, 2]
    return float(np.degrees(np.arccos(np.clip(up, -1, 1))))


# -- tags that are right ---------------------------------------------------------------------------


@pytest.mark.parametrize("gimbal", [True, False])
def test_exact_block_is_recovered(block: SimBlock, gimbal: bool) -> None:
    turns = block.gimbal_cam_from_world if gimbal else None
    placement = placed(block, tags_of(block.centres_m, turns))
    assert placement.georeference.trusted
    assert placement.georeference.fault is None
    assert placement.georeference.crs == "EPSG:32630"
    assert away_m(block, placement) < 1e-6
    assert placement.transform.scale == pytest.approx(1 / SCALE)
    assert placement.georeference.rms_xy_m == pytest.approx(0, abs=1e-6)


def test_noise_of_the_receiver_is_reported(block: SimBlock) -> None:
    placement = placed(block, tags_of(block.gps_m, block.gimbal_cam_from_world))
    found = placement.georeference
    assert found.trusted
    assert found.rms_xy_m == pytest.approx(2.5 * np.sqrt(2), rel=0.25)
    assert found.rms_z_m == pytest.approx(2.5, rel=0.35)
    assert away_m(block, placement) < 3
    assert found.tilt_conflict_deg is not None
    assert 0 < found.tilt_conflict_deg < 5


def test_photos_without_position_do_not_matter(block: SimBlock) -> None:
    some = block.centres_m.copy()
    some[5:20] = np.nan
    placement = placed(block, tags_of(some, block.gimbal_cam_from_world))
    assert placement.georeference.trusted
    assert away_m(block, placement) < 1e-6


def test_stray_geotags_do_not_spoil_the_rest(block: SimBlock) -> None:
    stray = block.gps_m.copy()
    stray[:3] += [250.0, -80.0, 0.0]
    placement = placed(block, tags_of(stray, block.gimbal_cam_from_world))
    assert placement.georeference.trusted
    assert away_m(block, placement) < 4
    assert placement.georeference.rms_xy_m is not None
    assert 2 < placement.georeference.rms_xy_m < 6
    stray[3:9] += [0.0, 300.0, 0.0]
    assert not placed(block, tags_of(stray, block.gimbal_cam_from_world)).georeference.trusted


# -- tags that are wrong ---------------------------------------------------------------------------


def test_shuffled_geotags_are_refused_in_a_sentence(block: SimBlock) -> None:
    wrong = block.gps_m[np.random.default_rng(1).permutation(len(block.gps_m))]
    placement = placed(block, tags_of(wrong, block.gimbal_cam_from_world))
    found = placement.georeference
    assert not found.trusted
    assert found.fault is not None
    assert "do not fit the photos" in found.fault
    assert "m rms remain" in found.fault
    assert tilt_deg(placement) < 2  # up comes from the gimbal


@pytest.mark.parametrize("axis", [0, 1, 2], ids=["east", "north", "height"])
def test_the_worst_axis_is_named(block: SimBlock, axis: int) -> None:
    rng = np.random.default_rng(2)
    wrong = block.gps_m.copy()
    wrong[:, axis] += rng.normal(0, 40, len(wrong))
    found = placed(block, tags_of(wrong, block.gimbal_cam_from_world)).georeference
    assert not found.trusted
    assert found.fault is not None
    assert f"in {('east', 'north', 'height')[axis]} after" in found.fault


def test_heights_that_ramp_are_refused_by_the_gimbal(block: SimBlock) -> None:
    """A drifting barometer: every photo 1.5 m higher than the one before it fits a tilted block."""
    ramp = block.gps_m.copy()
    ramp[:, 2] += 1.5 * np.arange(len(ramp))
    placement = placed(block, tags_of(ramp, block.gimbal_cam_from_world))
    found = placement.georeference
    assert not found.trusted
    assert found.fault is not None
    assert "against the gimbal angles" in found.fault
    assert found.tilt_conflict_deg is not None
    assert 15 < found.tilt_conflict_deg < 35
    assert tilt_deg(placement) < 2


def test_late_geotags_are_refused(block: SimBlock) -> None:
    """The clock runs two seconds behind: there and back, 16 m each way."""
    forward = np.sign(block.rotations_cam_from_world[:, 1, 1])[:, None]
    late = block.gps_m + [0.0, 16.0, 0.0] * forward
    found = placed(block, tags_of(late, block.gimbal_cam_from_world)).georeference
    assert not found.trusted
    assert found.fault is not None
    assert "in north after" in found.fault


def test_gimbal_conflict_is_refused_and_the_gimbal_kept(block: SimBlock) -> None:
    lean = rotation_exp(np.radians([[25.0, 0.0, 0.0]]))[0]
    placement = placed(block, tags_of(block.centres_m @ lean.T, block.gimbal_cam_from_world))
    found = placement.georeference
    assert not found.trusted
    assert found.fault is not None
    assert found.fault.startswith("The geotags tilt the block by 25 degrees against the gimbal angles.")
    assert found.tilt_conflict_deg == pytest.approx(25, abs=1)
    assert tilt_deg(placement) < 1


# -- tags that do not say enough -------------------------------------------------------------------


@pytest.mark.parametrize("gimbal", [True, False])
def test_cameras_on_a_line_take_their_up_from_elsewhere(gimbal: bool) -> None:
    block = observe("line", grid(1, 9, 60.0, 90.0), phantom3(), 1, SimOptions(n_points=300, gps_sigma_m=1.0))
    turns = block.gimbal_cam_from_world if gimbal else None
    placement = placed(block, tags_of(block.gps_m, turns, 1.0))
    assert placement.georeference.trusted
    assert tilt_deg(placement) < 2.5
    assert placement.transform.scale * SCALE == pytest.approx(1, rel=0.05)
    assert away_m(block, placement) < 4


@pytest.mark.parametrize("gimbal", [True, False])
def test_without_positions_the_block_is_levelled(block: SimBlock, gimbal: bool) -> None:
    nowhere = np.full((len(block.gps_m), 3), np.nan)
    placement = placed(block, tags_of(nowhere, block.gimbal_cam_from_world if gimbal else None))
    found = placement.georeference
    assert not found.trusted
    assert (found.fault, found.origin_wgs84, found.crs, found.rms_xy_m) == (None, None, None, None)
    assert tilt_deg(placement) < 1.5
    # Unit: the distance to the ground, which lies at the origin.
    centres = placement.transform.apply(SCALE * block.centres_m @ SCRAMBLE.T + SHIFT)
    assert 0.5 < np.median(np.linalg.norm(centres, axis=1)) < 1.5
    assert centres[:, 2].min() > 0


def test_oblique_cameras_do_not_tilt_the_ground() -> None:
    orbit = small("orbit", 1, 300)
    nowhere = np.full((36, 3), np.nan)
    assert tilt_deg(placed(orbit, tags_of(nowhere, None))) < 1.5


@pytest.mark.parametrize("count", [1, 2])
def test_a_few_positions_are_too_few(block: SimBlock, count: int) -> None:
    few = np.full((len(block.gps_m), 3), np.nan)
    few[:count] = block.gps_m[:count]
    found = placed(block, tags_of(few, block.gimbal_cam_from_world)).georeference
    assert not found.trusted
    assert found.fault == "The photos' positions are too few or too close together to place the block."


def test_all_positions_at_one_spot(block: SimBlock) -> None:
    spot = np.tile([[10.0, 20.0, 60.0]], (len(block.gps_m), 1))
    found = placed(block, tags_of(spot, block.gimbal_cam_from_world)).georeference
    assert not found.trusted
    assert found.fault is not None
    assert "too close together" in found.fault


# -- reading them ----------------------------------------------------------------------------------


def photo(position: Position | None, gimbal: FloatArray | None = None) -> Photo:
    camera = CameraIdentity("DJI", "FC300X", None, 4000, 3000)
    angles = None if gimbal is None else frames.gimbal_from_rotation(gimbal)
    return Photo(Path("a.JPG"), camera, position=position, gimbal=angles)


def test_tags_are_read_from_photos(block: SimBlock) -> None:
    world = frames.LocalFrame(50.83, -0.14, 75.0)
    geodetic = world.geodetic(block.centres_m)
    photos = [
        photo(Position(float(a), float(b), float(c)), r)
        for (a, b, c), r in zip(geodetic, block.gimbal_cam_from_world, strict=True)
    ]
    tags = read_tags(photos)
    assert tags.crs == "EPSG:32630"
    assert tags.has_rotation.all()
    assert np.allclose(tags.rotations, block.gimbal_cam_from_world, atol=1e-9)
    offset = tags.positions_m - block.centres_m
    assert np.abs(offset - offset.mean(axis=0)).max() < 0.01
    assert np.all(tags.sigma_m == DEFAULT_SIGMA_M)
    placement = placed(block, tags)
    assert placement.georeference.trusted
    assert placement.georeference.origin_wgs84 is not None
    assert placement.georeference.origin_wgs84[:2] == pytest.approx((50.83, -0.14), abs=1e-3)


def test_stated_accuracies_are_taken_with_a_grain_of_salt() -> None:
    rtk = Position(50.0, 8.0, 100.0, sigma_horizontal_m=0.01, sigma_vertical_m=0.02)
    phone = replace(rtk, sigma_horizontal_m=12.0, sigma_vertical_m=None)
    tags = read_tags([photo(rtk), photo(phone), photo(None)])
    assert tags.sigma_m[0].tolist() == [LEAST_SIGMA_M] * 3
    assert tags.sigma_m[1].tolist() == [12.0, 12.0, DEFAULT_SIGMA_M]
    assert np.isnan(tags.positions_m[2]).all()
    assert not tags.has_rotation.any()
    assert read_tags([photo(None)]).frame is None

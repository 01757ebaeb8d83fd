"""Rendered surveys as files: what a reader finds in them agrees with the truth."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from calib.field import Lens
from calib.frames import LocalFrame, rotation_cam_from_world, rotation_tilt_deg
from calib.photos.photo import GimbalAngles, Processing
from calib.photos.read import read_photo
from sim.flights import flight_plan, phantom3, rotation_looking, small_rotation
from sim.photo_writer import PhotoTags, level_gimbal, write_photo
from sim.relief import Relief
from sim.survey import SurveyOptions, SurveyTruth, lens_corrected, read_truth, write_survey

SIZE = (400, 300)
OPTIONS = SurveyOptions(apart=True, texel_m=0.25, pattern_px=1.5, aspect=0.002)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SurveyTruth, list[tuple[int, int]]]:
    folder = tmp_path_factory.mktemp("survey")
    calls: list[tuple[int, int]] = []
    truth = write_survey(
        "demo", folder, 3, size=SIZE, options=OPTIONS, progress=lambda done, of: calls.append((done, of))
    )
    return folder, truth, calls


def test_photos_and_progress(made: tuple[Path, SurveyTruth, list[tuple[int, int]]]) -> None:
    folder, truth, calls = made
    assert calls == [(i, 20) for i in range(1, 21)]
    assert len(list((folder / "nadir").glob("*.JPG"))) == 12
    assert len(list((folder / "convergent").glob("*.JPG"))) == 8
    assert all((folder / name).is_file() for name in truth.photos)


def test_truth_comes_back_from_its_file(made: tuple[Path, SurveyTruth, list[tuple[int, int]]]) -> None:
    folder, truth, _ = made
    again = read_truth(folder)
    assert again.camera == truth.camera
    assert again.photos == truth.photos
    assert np.array_equal(again.centres_m, truth.centres_m)
    rays = np.random.default_rng(0).uniform(-0.7, 0.7, (50, 2))
    assert np.array_equal(again.total_px(rays), truth.total_px(rays))
    assert np.abs(truth.total_px(rays) - truth.camera.project(rays)).max() > 0.02


def test_files_say_what_the_vehicle_believed(
    made: tuple[Path, SurveyTruth, list[tuple[int, int]]],
) -> None:
    folder, truth, _ = made
    frame = LocalFrame(*truth.origin_wgs84)
    photos = [read_photo(folder / name) for name in truth.photos]
    errors, turns, times = [], [], []
    for photo, centre, rotation in zip(photos, truth.centres_m, truth.rotations_cam_from_world, strict=True):
        assert (photo.camera.make, photo.camera.model) == ("DJI", "FC300X")
        assert photo.camera.processing is Processing.RAW
        assert photo.camera.serial == "FIELDCALSIM0001"
        assert (photo.camera.width, photo.camera.height) == SIZE
        assert photo.focal_px == pytest.approx(232.0, rel=0.01)
        assert photo.position is not None
        assert photo.gimbal is not None
        assert photo.time is not None
        where = photo.position
        assert where.altitude_m is not None
        assert where.height_above_launch_m == pytest.approx(where.altitude_m - 75.0, abs=0.02)
        at = frame.enu(
            np.array([where.latitude_deg]), np.array([where.longitude_deg]), np.array([where.altitude_m])
        )
        errors.append(at[0] - centre)
        turn = rotation_cam_from_world(photo.gimbal) @ rotation.T
        turns.append(np.degrees(np.arccos((np.trace(turn) - 1) / 2)))
        times.append(photo.time.timestamp())
    spread = np.std(errors, axis=0)
    assert spread[:2] == pytest.approx(2.5, rel=0.45)
    assert spread[2] == pytest.approx(0.5, rel=0.45)
    assert 0.5 < np.mean(turns) < 3.5
    assert np.diff(times).min() > 1.9


@pytest.mark.parametrize("pair", [(4, 5), (5, 9), (5, 12)])
def test_matches_agree_with_the_truth(
    made: tuple[Path, SurveyTruth, list[tuple[int, int]]], pair: tuple[int, int]
) -> None:
    """Features found in one photo, put on the true ground, are found where the truth sees them from the
    other: neighbours, photos upside down to each other, nadir against oblique. No bias is left."""
    folder, truth, _ = made
    assert truth.pattern is not None
    found = []
    for i in pair:
        grey = np.asarray(Image.open(folder / truth.photos[i]).convert("L"))
        # Without precise upscaling OpenCV's SIFT is a quarter of a pixel off.
        sift = cv2.SIFT_create(contrastThreshold=0.02, enable_precise_upscale=True)
        points, descriptors = sift.detectAndCompute(grey, None)
        # OpenCV's (0, 0) is the centre of the first pixel.
        found.append((np.array([p.pt for p in points]) + 0.5, descriptors))
    matches = cv2.BFMatcher(crossCheck=True).match(found[0][1], found[1][1])
    one = found[0][0][[m.queryIdx for m in matches]]
    two = found[1][0][[m.trainIdx for m in matches]]

    first, second = pair
    behind = one
    for _ in range(20):
        behind = one - truth.pattern(behind)
    flat = truth.camera.unproject(behind)
    direction = np.column_stack([flat, np.ones(len(flat))]) @ truth.rotations_cam_from_world[first]
    distance = -truth.centres_m[first, 2] / direction[:, 2]
    relief = Relief.random(truth.seed, OPTIONS.relief_m)
    for _ in range(30):
        ground = truth.centres_m[first] + distance[:, None] * direction
        height = relief.height_m(ground[:, 0], ground[:, 1])
        distance = (height - truth.centres_m[first, 2]) / direction[:, 2]
    local = (ground - truth.centres_m[second]) @ truth.rotations_cam_from_world[second].T
    error = two - truth.total_px(local[:, :2] / local[:, 2:])
    good = np.linalg.norm(error, axis=1) < 2
    assert good.sum() > 100
    assert np.median(np.linalg.norm(error[good], axis=1)) < 0.4
    assert np.abs(np.median(error[good], axis=0)).max() < 0.06


@pytest.mark.parametrize(("yaw", "tilt"), [(0.0, 0.0), (77.0, 0.0), (-120.0, 40.0), (180.0, 15.0)])
def test_gimbal_angles_are_those_of_the_rotation(yaw: float, tilt: float) -> None:
    rotation = rotation_looking(np.array([yaw]), np.array([tilt]))[0]
    assert np.allclose(rotation_cam_from_world(level_gimbal(rotation)), rotation, atol=1e-12)
    shaken = small_rotation(np.radians([[1.0, -0.7, 0.5]]))[0] @ rotation
    turn = rotation_cam_from_world(level_gimbal(shaken)) @ shaken.T
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) < 1.5


@pytest.mark.parametrize(("latitude", "longitude"), [(50.5, -0.25), (-33.9, 151.2), (0.0001, -179.9999)])
def test_tags_round_trip(tmp_path: Path, latitude: float, longitude: float) -> None:
    tags = PhotoTags(
        time=datetime(2026, 3, 4, 5, 6, 7, 89_000),
        latitude_deg=latitude,
        longitude_deg=longitude,
        altitude_m=-12.25,
        height_above_launch_m=40.5,
        gimbal=GimbalAngles(200.0, -45.5, 0.0),
        flight=GimbalAngles(200.0, -3.0, 1.0),
        serial=None,
        lens_corrected=True,
    )
    path = tmp_path / "DJI_0001.JPG"
    write_photo(path, np.zeros((30, 40, 3), np.uint8), tags)
    photo = read_photo(path)
    assert photo.position is not None
    assert photo.position.latitude_deg == pytest.approx(latitude, abs=3e-8)
    assert photo.position.longitude_deg == pytest.approx(longitude, abs=3e-8)
    assert photo.position.altitude_m == pytest.approx(-12.25)
    assert photo.position.height_above_launch_m == pytest.approx(40.5)
    assert photo.time == tags.time
    assert photo.gimbal == GimbalAngles(-160.0, -45.5, 0.0)
    assert photo.camera.serial is None
    assert photo.camera.processing is Processing.LENS_CORRECTED


def test_lens_corrected_camera_has_little_left() -> None:
    left = lens_corrected(phantom3(1000, 750))
    assert left.k1 == -0.01
    rays = Lens(left).unproject(np.array([[0.0, 0.0], [500.0, 375.0]]))
    assert np.isfinite(rays).all()


def test_convergent_photos_are_those_apart(made: tuple[Path, SurveyTruth, list[tuple[int, int]]]) -> None:
    _, truth, _ = made
    tilts = [rotation_tilt_deg(r) for r in truth.rotations_cam_from_world]
    oblique = [name.startswith("convergent/") for name in truth.photos]
    assert [tilt > 30 for tilt in tilts] == oblique


def test_unknown_recipe() -> None:
    with pytest.raises(KeyError):
        flight_plan("A9")

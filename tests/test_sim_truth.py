"""Tags and truth of rendered surveys: what is written, read back by those who use it."""

from __future__ import annotations

import json
from datetime import timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.polynomial import legendre
from PIL import Image

from calib.camera import FloatArray
from calib.errors import InputError
from calib.frames import LocalFrame, project, rotation_cam_from_world
from calib.photos import collect, read_photo, read_photos, sort_photos
from calib.photos.photo import AltitudeDatum, Photo, Processing
from calib.reference_file import read_reference_file, write_reference_file
from sim.gps import GpsKind
from sim.options import SurveyOptions
from sim.recipes import find_recipe
from sim.render import RenderOptions
from sim.survey import SurveyTruth, read_truth, true_reference, write_survey

SMALL = (200, 150)


def made(
    folder: Path, recipe: str = "demo", seed: int = 5, **options: Any
) -> tuple[SurveyTruth, list[Photo]]:
    truth = write_survey(
        recipe, folder, seed, size=SMALL, options=SurveyOptions(texel_m=0.5, **options), workers=1
    )
    return truth, [read_photo(folder / name) for name in truth.photos]


def position_error_m(truth: SurveyTruth, photos: list[Photo]) -> FloatArray:
    """Written positions less the true ones, (k, 3)."""
    frame = LocalFrame(*truth.origin_wgs84)
    where = [p.position for p in photos]
    written = frame.enu(
        np.array([w.latitude_deg for w in where if w]),
        np.array([w.longitude_deg for w in where if w]),
        np.array([w.altitude_m for w in where if w], dtype=float),
    )
    error: FloatArray = written - truth.centres_m
    return error


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SurveyTruth]:
    """Site A with everything that truth.json can hold."""
    folder = tmp_path_factory.mktemp("a3")
    options = {"pattern_px": 4.0, "aspect": 0.003, "render": RenderOptions(readout_s=0.03)}
    return folder, made(folder, "A3", 2, take_off_photo=True, **options)[0]


# -- tags -------------------------------------------------------------------------------------------


def test_rtk_is_read_as_rtk(tmp_path: Path) -> None:
    truth, photos = made(tmp_path, gps=GpsKind.RTK, rtk_sigma_m=0.02)
    error = position_error_m(truth, photos)
    assert error[:, :2].std() == pytest.approx(0.02, rel=0.35)
    assert error[:, 2].std() == pytest.approx(0.03, rel=0.5)
    for photo in photos:
        assert photo.position is not None
        assert photo.position.sigma_horizontal_m == pytest.approx(0.02)
        assert photo.position.sigma_vertical_m == pytest.approx(0.03)
        assert photo.position.altitude_datum is AltitudeDatum.ELLIPSOID
        assert photo.position.height_above_launch_m is not None
    # The barometer goes on being one.
    heights = [p.position.height_above_launch_m or 0.0 for p in photos if p.position]
    assert (np.array(heights) - truth.centres_m[:, 2]).std() == pytest.approx(0.5, rel=0.45)


def test_an_offset_moves_all_positions_alike(tmp_path: Path) -> None:
    truth, photos = made(tmp_path, gps=GpsKind.OFFSET, gps_sigma_m=8.0, height_sigma_m=3.0)
    error = position_error_m(truth, photos)
    assert np.hypot(error[:, 0], error[:, 1]) == pytest.approx(8.0, abs=0.02)
    assert np.abs(error[:, 2]) == pytest.approx(3.0, abs=0.02)
    assert np.ptp(error, axis=0).max() < 0.03


def test_a_drift_is_smooth(tmp_path: Path) -> None:
    truth, photos = made(tmp_path, gps=GpsKind.DRIFT, drift_time_s=600.0)
    error = position_error_m(truth, photos)[:, :2]
    assert 0.02 < np.diff(error, axis=0).std() < 1.0
    assert 0.3 < np.sqrt(np.mean(error**2)) < 6.0


def test_mavlink_photos_have_a_place_and_no_angles(tmp_path: Path) -> None:
    truth, photos = made(tmp_path, dji_tags=False, gps=GpsKind.RTK)
    assert all(name.startswith("IMG_") for name in truth.photos)
    for photo in photos:
        assert photo.gimbal is None
        assert photo.aircraft is None
        assert photo.camera.processing is Processing.UNKNOWN
        assert photo.position is not None
        assert photo.position.height_above_launch_m is None
        assert photo.position.sigma_horizontal_m == pytest.approx(0.015)
        assert photo.focal_px == pytest.approx(truth.camera.f_px, rel=0.02)
    assert np.abs(position_error_m(truth, photos)).max() < 0.1
    assert truth.identity == photos[0].camera


@pytest.mark.parametrize(
    ("camera", "model", "processing", "size"),
    [
        ("inspire-1", "FC350", Processing.RAW, (200, 150)),
        ("phantom-4-pro", "FC6310", Processing.LENS_CORRECTED, (228, 152)),
        ("wiris-pro", "WIRIS Pro", Processing.UNKNOWN, (320, 256)),
    ],
)
def test_cameras_sign_with_their_names(
    tmp_path: Path, camera: str, model: str, processing: Processing, size: tuple[int, int]
) -> None:
    options = SurveyOptions(texel_m=0.5, camera_model=camera, photos=4)
    truth = write_survey("orbit", tmp_path, 1, size=size, options=options, workers=1)
    photo = read_photo(tmp_path / truth.photos[0])
    assert (photo.camera.model, photo.camera.processing) == (model, processing)
    assert (photo.camera.width, photo.camera.height) == size
    assert photo.focal_px == pytest.approx(truth.camera.f_px, rel=0.025)
    assert truth.identity == photo.camera
    grey = np.ptp(np.asarray(Image.open(photo.path)).astype(int), axis=2).mean() < 4
    assert grey == (camera == "wiris-pro")


def test_gimbal_errors_have_their_size(tmp_path: Path) -> None:
    truth, photos = made(tmp_path, gimbal_sigma_deg=3.0, attitude_jitter_deg=0.0)
    oblique = [i for i, p in enumerate(photos) if p.gimbal and p.gimbal.pitch_deg > -70]
    pitch, yaw = [], []
    for i in oblique:
        gimbal = photos[i].gimbal
        assert gimbal is not None
        forward, truly = rotation_cam_from_world(gimbal)[2], truth.rotations_cam_from_world[i][2]
        pitch.append(np.degrees(np.arcsin(forward[2]) - np.arcsin(truly[2])))
        yaw.append(np.degrees(np.arctan2(*forward[:2]) - np.arctan2(*truly[:2])))
    errors = (np.array([pitch, yaw]) + 180) % 360 - 180
    assert errors.std() == pytest.approx(3.0, rel=0.4)


def test_take_off_photo_is_left_out_by_a_check(survey: tuple[Path, SurveyTruth]) -> None:
    folder, truth = survey
    assert truth.take_off == truth.photos[:1]
    photos, bad = read_photos(collect([folder]))
    assert not bad
    found = sort_photos(photos)
    assert [out.path.name for out in found.left_out] == list(truth.take_off)
    assert "take-off" in found.left_out[0].reason
    assert len(found.used) == find_recipe("A3").photos
    first = photos[0].position
    assert first is not None
    assert abs(first.height_above_launch_m or 0) < 2.5
    # Heights above launch count from there, although the site slopes.
    heights = [p.position.height_above_launch_m or 0 for p in found.used if p.position]
    truly = truth.centres_m[1:, 2] - truth.centres_m[0, 2]
    assert np.array(heights) == pytest.approx(truly, abs=2.5)


# -- truth ------------------------------------------------------------------------------------------


def test_truth_comes_back(survey: tuple[Path, SurveyTruth]) -> None:
    folder, truth = survey
    again = read_truth(folder)
    assert again.heights is not None
    assert truth.heights is not None
    assert again.heights.z_m == pytest.approx(truth.heights.z_m, abs=6e-4)
    assert again.check_points_m == pytest.approx(truth.check_points_m, abs=6e-5)
    for name in ("camera", "photos", "take_off", "identity", "origin_wgs84", "readout_s", "recipe", "seed"):
        assert getattr(again, name) == getattr(truth, name)
    for name in ("centres_m", "rotations_cam_from_world", "velocity_m_s"):
        assert np.array_equal(getattr(again, name), getattr(truth, name))


def test_truth_file_alone_projects_as_the_simulator_does(survey: tuple[Path, SurveyTruth]) -> None:
    """With what truth.json says of its frames, and none of our code."""
    folder, truth = survey
    content = json.loads((folder / "truth.json").read_text())
    camera = content["camera"]
    assert truth.check_points_m is not None
    compared = 0
    for i, pose in enumerate(content["poses"]):
        points = np.array(content["check_points"]["enu_m"])
        local = (points - pose["centre_m"]) @ np.array(pose["rotation_cam_from_world"]).T
        x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
        r2 = x * x + y * y
        near = (local[:, 2] > 0) & (r2 < 0.7)
        radial = 1 + camera["k1"] * r2 + camera["k2"] * r2**2 + camera["k3"] * r2**3 + camera["k4"] * r2**4
        xd = x * radial + 2 * camera["p1"] * x * y + camera["p2"] * (r2 + 2 * x**2)
        yd = y * radial + camera["p1"] * (r2 + 2 * y**2) + 2 * camera["p2"] * x * y
        u = camera["cx_px"] + camera["f_px"] * xd + camera["b2_px"] * yd
        v = camera["cy_px"] + (camera["f_px"] - camera["b1_px"]) * yd
        s = np.clip(2 * u / camera["width"] - 1, -1.05, 1.05)
        t = np.clip(2 * v / camera["height"] - 1, -1.05, 1.05)
        shift = legendre.legval2d(s, t, np.array(content["pattern"]))
        mine = np.column_stack([u + shift[0], v + shift[1]])
        exact = (truth.check_points_m - truth.centres_m[i]) @ truth.rotations_cam_from_world[i].T
        theirs = truth.total_px(exact[:, :2] / exact[:, 2:])
        assert mine[near] == pytest.approx(theirs[near], abs=2e-3)
        compared += int(near.sum())
    assert compared > 2000


def test_places_agree_in_all_frames(survey: tuple[Path, SurveyTruth]) -> None:
    folder, truth = survey
    content = json.loads((folder / "truth.json").read_text())
    frame = LocalFrame(*truth.origin_wgs84)
    wgs84 = np.array([pose["wgs84"] for pose in content["poses"]])
    assert frame.enu(*wgs84.T) == pytest.approx(truth.centres_m, abs=1e-4)
    points, utm = content["check_points"], content["utm"]
    enu, place = np.array(points["enu_m"]), np.array(points["wgs84"])
    assert frame.enu(*place.T) == pytest.approx(enu, abs=1e-3)
    assert project(utm["crs"], place[:, 0], place[:, 1]) == pytest.approx(
        np.array(points["utm_m"])[:, :2], abs=1e-3
    )
    # Turning and scaling as stated takes the local frame into the grid.
    turn = np.radians(utm["meridian_convergence_deg"])
    east, north = enu[:, 0] * utm["scale"], enu[:, 1] * utm["scale"]
    easting = utm["origin_easting_m"] + east * np.cos(turn) - north * np.sin(turn)
    northing = utm["origin_northing_m"] + east * np.sin(turn) + north * np.cos(turn)
    assert np.column_stack([easting, northing]) == pytest.approx(np.array(points["utm_m"])[:, :2], abs=0.01)


def test_heights_are_those_of_the_site(survey: tuple[Path, SurveyTruth], tmp_path: Path) -> None:
    _, truth = survey
    grid = truth.heights
    assert grid is not None
    assert truth.check_points_m is not None
    assert grid.z_m.shape == (len(grid.north_m), len(grid.east_m))
    # Site A falls eastwards by metres.
    fall = grid.z_m[:, :10].mean() - grid.z_m[:, -10:].mean()
    assert 4 < fall < 10
    column = np.rint((truth.check_points_m[:, 0] - grid.east_m[0]) / np.diff(grid.east_m)[0]).astype(int)
    row = np.rint((truth.check_points_m[:, 1] - grid.north_m[0]) / np.diff(grid.north_m)[0]).astype(int)
    assert np.abs(grid.z_m[row, column] - truth.check_points_m[:, 2]).max() < 0.3
    assert len(truth.check_points_m) == 300
    # Site B is flat up to its levee in the north.
    levee = made(tmp_path, "B1", 1)[0].heights
    assert levee is not None
    assert np.abs(levee.z_m[levee.north_m < 20]).max() < 0.15
    assert levee.z_m[levee.north_m > 29].max() == pytest.approx(1.0, abs=0.15)


def test_true_lens_is_a_reference(survey: tuple[Path, SurveyTruth], tmp_path: Path) -> None:
    _, truth = survey
    write_reference_file(true_reference(truth, "true-lens"), tmp_path / "lens.json")
    reference = read_reference_file(tmp_path / "lens.json")
    assert reference.brown == truth.camera
    assert reference.processing is Processing.RAW
    assert reference.lens is not None
    rays = truth.camera.unproject(np.random.default_rng(0).uniform([0, 0], SMALL, (200, 2)))
    # The field follows the pattern, up to what its degree cannot.
    left = np.linalg.norm(reference.lens.project(rays) - truth.total_px(rays), axis=1)
    without = np.linalg.norm(truth.camera.project(rays) - truth.total_px(rays), axis=1)
    assert np.sqrt(np.mean(left**2)) < 0.35 * np.sqrt(np.mean(without**2))


def test_photos_are_a_flight_in_time(survey: tuple[Path, SurveyTruth]) -> None:
    folder, truth = survey
    times = [read_photo(folder / name).time for name in truth.photos]
    gaps = [b - a for a, b in pairwise(times) if a and b]
    assert min(gaps) >= timedelta(seconds=1.99)
    assert sum(gaps, timedelta()) < timedelta(minutes=25)


def test_an_old_truth_does_not_outlive_its_photos(tmp_path: Path) -> None:
    made(tmp_path, "orbit", photos=4)

    class Enough(Exception):
        pass

    def stop(*_: int) -> None:
        raise Enough

    with pytest.raises(Enough):
        write_survey("orbit", tmp_path, 2, size=SMALL, options=SurveyOptions(texel_m=0.5), progress=stop)
    with pytest.raises(FileNotFoundError):
        read_truth(tmp_path)
    # Those that had not begun were given up.
    assert len(list(tmp_path.glob("*.JPG"))) < 12


def test_options_that_make_no_survey(tmp_path: Path) -> None:
    for options, why in (
        (SurveyOptions(ortho=tmp_path / "o.tif"), "needs the DEM"),
        (SurveyOptions(camera_model="brownie"), "no camera named brownie"),
    ):
        with pytest.raises(InputError, match=why):
            write_survey("A1", tmp_path / "x", 1, size=SMALL, options=options)
    with pytest.raises(InputError, match="structure of its own"):
        write_survey("wall", tmp_path / "x", 1, size=SMALL, options=SurveyOptions(dem=tmp_path / "d.tif"))
    assert not (tmp_path / "x").exists()


def test_a_survey_over_a_dem_lies_where_the_dem_does(tmp_path: Path) -> None:
    north, east = np.mgrid[0:200, 0:220]
    heights = 320 + 6 * np.sin(east / 25) + 4 * np.cos(north / 30)
    middle = (563_000.0, 5_632_000.0)
    place = rasterio.transform.from_origin(middle[0] - 220, middle[1] + 200, 2.0, 2.0)
    with rasterio.open(
        tmp_path / "dem.tif", "w", driver="GTiff", height=200, width=220, count=1, dtype="float32",
        crs="EPSG:32630", transform=place,
    ) as file:  # fmt: skip
        file.write(heights.astype(np.float32), 1)
    truth, photos = made(tmp_path / "x", "A1", dem=tmp_path / "dem.tif", gps=GpsKind.RTK)
    latitude, longitude, altitude = truth.origin_wgs84
    assert project("EPSG:32630", np.array([latitude]), np.array([longitude]))[0] == pytest.approx(
        middle, abs=1
    )
    assert altitude == pytest.approx(heights[100, 110], abs=1)
    assert np.abs(position_error_m(truth, photos)).max() < 0.15
    # Check points have the DEM's heights at their places in the DEM's own grid.
    content = json.loads((tmp_path / "x" / "truth.json").read_text())
    assert content["utm"]["crs"] == "EPSG:32630"
    easting, northing, z = np.array(content["check_points"]["utm_m"]).T
    column = (easting - place.c) / 2 - 0.5
    row = (place.f - northing) / 2 - 0.5
    wanted = 320 + 6 * np.sin(column / 25) + 4 * np.cos(row / 30)
    assert z == pytest.approx(wanted, abs=0.05)

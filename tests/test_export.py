import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import result_factory
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from calib.convert import mapping_difference_px
from calib.export import (
    CALIBRATIONS,
    EXPORT_FILES,
    metashape_angles_deg,
    metashape_reference,
    odm_geo,
    write_exports,
)
from calib.export_colmap import colmap_lens, image_names, write_colmap
from calib.field import Lens
from calib.findings import Verdict
from calib.formats import ReadOptions, read_calibration
from calib.formats.common import NOMINAL_PIXEL_SIZE_MM
from calib.frames import rotation_cam_from_world
from calib.photos.photo import GimbalAngles
from calib.result import CheckResult


@pytest.fixture(scope="module")
def result() -> CheckResult:
    return result_factory.build(points=800)


def _pycolmap_residuals(folder: Path) -> dict[tuple[str, float, float], np.ndarray]:
    """Residual of every observation in the model, as COLMAP itself projects it."""
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(str(folder))
    out = {}
    for image in model.images.values():
        for point in image.points2D:
            seen = image.project_point(model.points3D[point.point3D_id].xyz)
            out[_key(image.name, point.xy)] = point.xy - seen
    return out


def _key(name: str, pixel: np.ndarray) -> tuple[str, float, float]:
    u, v = (round(float(f"{x:.7f}"), 4) for x in pixel)
    return name, u, v


def test_colmap_model_reprojects_as_ours(result: CheckResult, tmp_path: Path) -> None:
    plain = replace(result, solution=replace(result.solution, lens=Lens(result.estimate.brown)))
    write_colmap(plain, tmp_path)
    residuals = _pycolmap_residuals(tmp_path)
    observations = plain.solution.observations
    assert len(residuals) == len(observations)
    world = plain.solution.points_m[observations.point] - plain.solution.centres_m[observations.photo]
    in_camera = np.einsum("nij,nj->ni", plain.solution.rotations_cam_from_world[observations.photo], world)
    projected = plain.estimate.brown.project(in_camera[:, :2] / in_camera[:, 2:])
    names = image_names(plain.solution)
    for k, pixels, at in zip(observations.photo, observations.pixels, projected, strict=True):
        assert residuals[_key(names[k], pixels)] == pytest.approx(pixels - at, abs=1e-6)


def test_without_the_residual_field_the_rms_stays_close(result: CheckResult, tmp_path: Path) -> None:
    write_colmap(result, tmp_path)
    residuals = np.array(list(_pycolmap_residuals(tmp_path).values()))
    rms = np.sqrt(np.mean(np.sum(residuals**2, axis=1)))
    assert result.solution.rms_px * 0.98 < rms < result.solution.rms_px * 1.1


def test_colmap_model_is_whole(result: CheckResult, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    weights = np.ones(len(result.solution.observations))
    weights[::5] = 0.0
    write_colmap(replace(result, solution=replace(result.solution, weights=weights)), tmp_path)
    model = pycolmap.Reconstruction(str(tmp_path))
    assert model.num_reg_images() == 26
    assert min(point.track.length() for point in model.points3D.values()) >= 2
    kept = sum(image.num_points3D for image in model.images.values())
    assert 0.78 * len(weights) < kept <= 0.8 * len(weights) + 1
    for image in model.images.values():
        for point in image.points2D:
            assert any(e.image_id == image.image_id for e in model.points3D[point.point3D_id].track.elements)
    for name, centre in zip(image_names(result.solution), result.solution.centres_m, strict=True):
        assert model.find_image_with_name(name).projection_center() == pytest.approx(centre, abs=1e-9)


@pytest.mark.parametrize(
    ("changes", "least_px", "most_px"),
    [
        ({}, 0.0, 1e-9),
        ({"b1_px": -1.5}, 0.0, 1e-9),
        ({"k4": 0.002}, 0.0, 0.01),
        # A skew over poses that stay can only be kept small.
        ({"k4": 0.002, "b2_px": 0.8}, 0.05, 1.0),
    ],
)
def test_colmap_lens_is_the_nearest_that_colmap_can_hold(
    changes: dict[str, float], least_px: float, most_px: float
) -> None:
    brown = replace(result_factory.p3p_camera(), **changes)
    u, v = np.meshgrid(np.linspace(0, 4000, 21), np.linspace(0, 3000, 16))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    miss = np.linalg.norm(colmap_lens(brown).project(brown.unproject(pixels)) - pixels, axis=1)
    assert least_px <= miss.max() <= most_px


def test_image_names_are_unique_below_the_common_folder(result: CheckResult) -> None:
    photos = tuple(
        replace(photo, path=Path(f"/media/my card/DCIM/10{i % 2}MEDIA/DJI {i // 2:04d}.JPG"))
        for i, photo in enumerate(result.solution.photos)
    )
    names = image_names(replace(result.solution, photos=photos))
    assert names[:2] == ("100MEDIA/DJI_0000.JPG", "101MEDIA/DJI_0000.JPG")
    assert len(set(names)) == len(names)


def _read_like_odm(text: str) -> dict[str, list[float]]:
    """ODM's reading of geo.txt: comments skipped, fields split at blanks, by image name."""
    lines = text.strip().split("\n")
    assert lines[0] == "EPSG:4326"
    rows = [line.split() for line in lines[1:] if line and not line.startswith("#")]
    return {row[0]: [float(cell) for cell in row[1:]] for row in rows}


def test_geo_holds_the_geotags_as_read(result: CheckResult) -> None:
    entries = _read_like_odm(odm_geo(result.solution.photos))
    assert len(entries) == len(result.solution.photos)
    for photo in result.solution.photos:
        assert photo.position is not None
        p = photo.position
        expected = [p.longitude_deg, p.latitude_deg, p.altitude_m, 0, 0, 0, 1.5, 3.0]
        assert entries[photo.path.name] == pytest.approx(expected, abs=1e-4)
        # A nanodegree is a tenth of a millimetre.
        assert entries[photo.path.name][:2] == pytest.approx(expected[:2], abs=1e-9)


def test_geo_leaves_out_names_that_odm_would_misread(result: CheckResult) -> None:
    first, second, third, *_ = result.solution.photos
    assert third.position is not None
    bare = replace(third.position, altitude_m=None, sigma_horizontal_m=None)
    photos = (
        replace(first, path=Path("a b.JPG")),
        replace(second, path=Path("x/same.JPG")),
        replace(second, path=Path("y/same.JPG")),
        replace(third, path=Path("bare.JPG"), position=bare),
        replace(third, path=Path("none.JPG"), position=None),
    )
    text = odm_geo(photos)
    entries = _read_like_odm(text)
    assert set(entries) == {"same.JPG", "bare.JPG"}
    assert len(entries["bare.JPG"]) == 2
    assert text.count("# left out") == 2


def test_metashape_reference_reads_back(result: CheckResult) -> None:
    bare = replace(result.solution.photos[0], path=Path('odd, "name".JPG'), position=None, gimbal=None)
    text = metashape_reference((*result.solution.photos, bare))
    rows = list(csv.DictReader(text.splitlines()))
    assert len(rows) == 27
    assert rows[-1]["#Label"] == 'odd, "name".JPG'
    assert rows[-1]["Longitude"] == rows[-1]["Yaw"] == rows[-1]["Accuracy_Z"] == ""
    for photo, row in zip(result.solution.photos, rows, strict=False):
        assert photo.position is not None
        assert photo.gimbal is not None
        assert float(row["Latitude"]) == pytest.approx(photo.position.latitude_deg, abs=1e-9)
        assert float(row["Altitude"]) == pytest.approx(photo.position.altitude_m, abs=1e-4)
        assert float(row["Pitch"]) == pytest.approx(photo.gimbal.pitch_deg + 90, abs=1e-3)
        turn = (float(row["Yaw"]) - photo.gimbal.yaw_deg + 180) % 360 - 180
        assert turn == pytest.approx(0, abs=1e-3)


@settings(max_examples=200, deadline=None)
@given(st.floats(-180, 180), st.floats(-90, -1), st.floats(-180, 180))
def test_metashape_angles_are_the_same_rotation(yaw: float, pitch: float, roll: float) -> None:
    gimbal = GimbalAngles(yaw, pitch, roll)
    angles = metashape_angles_deg(gimbal)
    # Metashape's convention written anew: intrinsic yaw, pitch, roll of a north-east-down body,
    # the camera looking along the body's z axis with the image's top towards its x axis.
    ned_from_body = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
    forward, up, right = ned_from_body[:, 2], ned_from_body[:, 0], ned_from_body[:, 1]
    world_from_ned = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    cam_from_world = np.stack([right, -up, forward]) @ world_from_ned.T
    assert cam_from_world == pytest.approx(rotation_cam_from_world(gimbal), abs=1e-6)


def test_straight_down_to_the_north_is_zero() -> None:
    assert metashape_angles_deg(GimbalAngles(0, -90, 0)) == pytest.approx((0, 0, 0), abs=1e-9)
    yaw, pitch, roll = metashape_angles_deg(GimbalAngles(30, -60, 0))
    assert (yaw, pitch, roll) == pytest.approx((30, 30, 0), abs=1e-9)


def test_exports_are_there_and_named(result: CheckResult, tmp_path: Path) -> None:
    written = write_exports(result, tmp_path / "exports")
    assert set(written) == {*CALIBRATIONS, "colmap", "odm_geo", "metashape_reference"}
    for target in written.values():
        assert (tmp_path / "exports" / target).exists()
    files = {p.relative_to(tmp_path / "exports").as_posix() for p in tmp_path.rglob("*") if p.is_file()}
    assert files == set(EXPORT_FILES) - {"not_written.txt"}


def test_calibrations_read_back_to_the_same_lens(result: CheckResult, tmp_path: Path) -> None:
    written = write_exports(result, tmp_path)
    size = (result.camera.width, result.camera.height)
    for name, (format_name, _) in CALIBRATIONS.items():
        options = ReadOptions(image_size=size, pixel_size_mm=NOMINAL_PIXEL_SIZE_MM)
        found, camera = read_calibration(tmp_path / written[name], options)
        assert found == format_name
        assert mapping_difference_px(result.estimate.brown, camera) < 0.011
    assert "v2 dji fc300x 4000 3000 brown" in (tmp_path / "cameras.json").read_text()


def test_a_lens_that_cannot_be_held_is_said(result: CheckResult, tmp_path: Path) -> None:
    skewed = replace(result.estimate, brown=replace(result.estimate.brown, b2_px=2.5))
    written = write_exports(replace(result, estimate=skewed), tmp_path)
    assert "calibration" in written
    assert "odm_cameras" not in written
    reasons = (tmp_path / written["not_written"]).read_text()
    assert reasons.startswith("cameras.json: ODM's cameras.json cannot hold this lens")


def test_geotags_that_were_not_believed_are_not_handed_on(tmp_path: Path) -> None:
    base = result_factory.build(Verdict.CANNOT_TELL, points=200)
    doubted = replace(base.solution.georeference, trusted=False, fault="They do not fit the block.")
    written = write_exports(replace(base, solution=replace(base.solution, georeference=doubted)), tmp_path)
    assert "odm_geo" not in written
    assert not (tmp_path / "geo.txt").exists()
    assert "colmap" in written
    assert "They do not fit the block." in (tmp_path / written["not_written"]).read_text()


def test_photos_without_positions_still_give_a_model(tmp_path: Path) -> None:
    written = write_exports(result_factory.build(gps=False, points=200), tmp_path)
    assert set(written) == {*CALIBRATIONS, "colmap", "not_written"}
    assert "The photos carry no positions." in (tmp_path / "not_written.txt").read_text()

"""Targets found in photos of a known lens, and the calibration on them against OpenCV's and Ceres'."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.interpolate import RectBivariateSpline

from calib.camera import BROWN_NAMES, BrownCamera, FloatArray
from calib.control import prepare
from calib.control_adjust import Fit, MarkSet, adjust, resected
from calib.control_output import ControlReport
from calib.errors import InputError
from calib.photos import read_photo, read_photos
from calib.targets import (
    Board,
    board_detector,
    board_points,
    dictionaries,
    find_targets,
    parse_board,
    tag_detector,
)
from daemon import cli

BOARD = "9x7,60,45,5X5_100"
LENS = replace(
    BrownCamera.ideal(1000, 750, 800.0),
    cx_px=506.3, cy_px=371.8, k1=-0.12, k2=0.09, k3=-0.02, p1=4e-4, p2=-3e-4,
)  # fmt: skip
FREE = ("f", "k1", "k2", "k3", "cx", "cy", "p1", "p2")
#: Pixels of the board's picture per metre, and rays per pixel each way.
DENSE, FINE = 6000, 3


@lru_cache(maxsize=1)
def _rays() -> FloatArray:
    """Rays of the parts of all pixels, (750 FINE, 1000 FINE, 2)."""
    step = 8
    u, v = np.arange(0, LENS.width + 1, step, float), np.arange(0, LENS.height + 1, step, float)
    v = np.append(v, LENS.height) if v[-1] < LENS.height else v
    grid = LENS.unproject(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)).reshape(len(v), len(u), 2)
    at_u = (np.arange(LENS.width * FINE) + 0.5) / FINE
    at_v = (np.arange(LENS.height * FINE) + 0.5) / FINE
    return np.stack([RectBivariateSpline(v, u, grid[..., i])(at_v, at_u) for i in (0, 1)], axis=-1)


def photo_of(picture: np.ndarray, pose: tuple[FloatArray, FloatArray], seed: int) -> np.ndarray:
    """A photo of a flat picture (DENSE px a metre, x right, y down, from its corner) on a grey wall."""
    rotation, centre = pose
    rays = _rays()
    world = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1) @ rotation
    far = -centre[2] / world[..., 2]
    spot = (centre[:2] + world[..., :2] * far[..., None]) * DENSE - 0.5
    fine = cv2.remap(
        picture, spot.astype(np.float32), None, cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT, borderValue=128,
    )  # fmt: skip
    photo = cv2.resize(fine, (LENS.width, LENS.height), interpolation=cv2.INTER_AREA).astype(float)
    photo += np.random.default_rng(seed).normal(0, 2, photo.shape)
    return np.clip(photo.round(), 0, 255).astype(np.uint8)


def look(at_m: FloatArray, from_m: FloatArray, roll_deg: float) -> tuple[FloatArray, FloatArray]:
    """cam_from_world rotation and centre of a camera that looks at a point; z points into the board."""
    forward = (at_m - from_m) / np.linalg.norm(at_m - from_m)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    turn = np.radians(roll_deg)
    roll = np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    return roll @ rotation, from_m


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten photos of the board, from all sides, upright and turned."""
    folder = tmp_path_factory.mktemp("board")
    board = cv2.aruco.CharucoBoard(
        (9, 7), 0.06, 0.045, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    )
    width, height = round(0.54 * DENSE), round(0.42 * DENSE)
    picture = np.full((height + 600, width + 600), 255, np.uint8)
    picture[300:-300, 300:-300] = board.generateImage((width, height))
    middle = np.array([0.27 + 0.05, 0.21 + 0.05, 0.0])
    for i in range(10):
        azimuth, tilt = 2 * np.pi * i / 10, np.radians(12 + 28 * (i % 2))
        way = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])
        aside = 0.08 * np.array([np.cos(3 * azimuth), np.sin(2 * azimuth), 0.0])
        pose = look(middle + aside, middle + 0.72 * way, 90.0 * (i % 4))
        Image.fromarray(photo_of(picture, pose, i)).save(folder / f"B{i:02d}.png")
    return folder


@pytest.fixture(scope="module")
def marks(photos: Path) -> MarkSet:
    board = parse_board(BOARD)
    read, _ = read_photos(sorted(photos.iterdir()))
    found = find_targets(read, board_detector(board))
    return prepare(read, board_points(board), found, 0.1)[0]


def fitted(marks: MarkSet) -> Fit:
    """All of Brown's model but the affinity, points held."""
    held = replace(marks, sigmas_m=np.zeros_like(marks.sigmas_m))
    block, used = resected(held, BrownCamera.ideal(1000, 750, 760.0))
    assert used.all()
    block = adjust(held, block, ("f", "k1"), used).block
    return adjust(held, block, FREE, used)


def test_corners_of_the_board_are_where_the_lens_puts_them(marks: MarkSet) -> None:
    assert marks.photos == 10
    assert len(marks) > 400  # of 480
    fit = fitted(marks)
    assert 0.02 < np.sqrt(np.mean(fit.residuals_px**2)) < 0.15
    sigma = np.sqrt(np.diag(fit.covariance))
    off = (fit.block.camera.vector - LENS.vector)[sigma > 0] / sigma[sigma > 0]
    assert np.abs(off).max() < 5
    assert fit.block.camera.f_px == pytest.approx(LENS.f_px, rel=1e-3)


def test_opencv_finds_the_same_lens(marks: MarkSet) -> None:
    fit = fitted(marks)
    mine = [np.flatnonzero(marks.photo == i) for i in range(marks.photos)]
    _, matrix, distortion, _, _ = cv2.calibrateCamera(
        [marks.points_m[marks.point[m]].astype(np.float32) for m in mine],
        [(marks.pixels[m] - 0.5).astype(np.float32) for m in mine],
        (1000, 750),
        np.array([[760.0, 0, 499.5], [0, 760.0, 374.5], [0, 0, 1]]),
        np.zeros(5),
        flags=cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 500, 1e-12),
    )
    k1, k2, p1, p2, k3 = distortion.ravel()
    theirs = {"f": matrix[0, 0], "cx": matrix[0, 2] + 0.5, "cy": matrix[1, 2] + 0.5}
    theirs |= {"k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2}
    sigma = dict(zip(BROWN_NAMES, np.sqrt(np.diag(fit.covariance)), strict=True))
    found = dict(zip(BROWN_NAMES, fit.block.camera.vector, strict=True))
    for name in FREE:
        assert abs(found[name] - theirs[name]) < 0.1 * sigma[name], name


def test_ceres_finds_the_same_lens(marks: MarkSet) -> None:
    """Held points, OpenCV's model: f, fy, principal point, K1, K2, P1, P2."""
    ceres = pytest.importorskip("ceres_peer")
    fit = fitted(marks)
    held = replace(marks, sigmas_m=np.zeros_like(marks.sigmas_m))
    start = replace(fit.block, camera=replace(fit.block.camera, k3=0.0))
    every = np.ones(len(marks), bool)
    ours = adjust(held, start, ("f", "cx", "cy", "k1", "k2", "p1", "p2", "b1"), every)
    made = ceres.reconstruction(
        BrownCamera.ideal(1000, 750, 790.0),
        "OPENCV",
        (fit.block.rotations, fit.block.centres_m),
        marks.points_m,
        marks.photo,
        marks.point,
        marks.pixels,
    )
    summary, _ = ceres.solve_with_ceres(made, points_held=True)
    assert summary.is_solution_usable()
    sigma = dict(zip(BROWN_NAMES, np.sqrt(np.diag(ours.covariance)), strict=True))
    found = dict(zip(BROWN_NAMES, ours.block.camera.vector, strict=True))
    found["fy"], sigma["fy"] = ours.block.camera.fy_px, sigma["f"]
    for name, value in zip(ceres.MODELS["OPENCV"], made.cameras[1].params, strict=True):
        assert abs(found[name] - value) < 0.1 * sigma[name], name


def test_tags_are_found_by_number(tmp_path: Path) -> None:
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    picture = np.full((1800, 2600), 255, np.uint8)
    at = {3: (300, 400), 17: (1400, 900), 101: (800, 1100)}
    for number, (x, y) in at.items():
        picture[y : y + 400, x : x + 400] = cv2.aruco.generateImageMarker(tags, number, 400)
    pose = look(np.array([0.2, 0.15, 0.0]), np.array([0.28, 0.1, -0.45]), 0.0)
    Image.fromarray(photo_of(picture, pose, 1)).save(tmp_path / "T.png")
    found = find_targets([read_photo(tmp_path / "T.png")], tag_detector("apriltag_36H11", {"17.1"}))
    assert {mark.point for mark in found} == {"3", "17", "101", "17.1"}
    for mark in found:
        x, y = at[int(mark.point.split(".")[0])]
        shift = 0 if "." in mark.point else 200
        spot = np.array([(x + shift) / DENSE, (y + shift) / DENSE, 0.0])
        local = pose[0] @ (spot - pose[1])
        assert (mark.u_px, mark.v_px) == pytest.approx(LENS.project(local[:2] / local[2]), abs=0.35)


def test_calibrating_on_a_board_from_the_command_line(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))
    words = ["calibrate", "control", str(photos), "--board", BOARD, "--focal-px", "760", "--name", "board"]
    code = cli.run([*words, "--out", str(tmp_path / "out"), "--json", "-"])
    report = ControlReport.model_validate_json(capsys.readouterr().out)
    assert code in (0, 3)
    assert abs(report.parameters["f_px"] - LENS.f_px) < 4 * report.sigma["f_px"]
    assert report.parameters["f_px"] == pytest.approx(LENS.f_px, rel=1e-3)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("9 by 7", "is no board"),
        ("2x7,60,45", "three squares"),
        ("9x7,45,60", "smaller than the squares"),
        ("9x7,60,45,8X8_50", "no dictionary"),
        ("90x70,60,45", "needs 3150 tags"),
    ],
)
def test_boards_that_cannot_be(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        board_points(parse_board(text))


def test_names_and_nothing_found(tmp_path: Path) -> None:
    assert parse_board(BOARD) == Board(9, 7, 0.06, 0.045, "5X5_100")
    assert len(board_points(parse_board(BOARD))) == 48
    assert "APRILTAG_36h11" in dictionaries()
    Image.new("L", (640, 480), 90).save(tmp_path / "grey.png")
    with pytest.raises(InputError, match="No target was found in 1 photos"):
        find_targets([read_photo(tmp_path / "grey.png")], board_detector(parse_board(BOARD)))

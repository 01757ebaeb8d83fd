"""Coordinates from a laser scan: onto its surface, with its spread, and what is said where there is none."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest

from calib.camera import FloatArray
from calib.control_files import ControlPoint
from calib.errors import InputError
from calib.scan import points_from_scan
from daemon import cli

#: A wall that leans and is turned: its unit normal, and two directions in it.
NORMAL = np.array([0.6, 0.64, 0.48])
ALONG = np.array([-0.64, 0.6, 0.0]) / np.hypot(0.64, 0.6)
ACROSS = np.cross(NORMAL, ALONG)
MIDDLE = np.array([412_000.0, 5_630_000.0, 55.0])
NOISE_M = 0.003


def _scan(path: Path, seed: int = 0) -> Path:
    """10 000 points a square metre of 4 m x 4 m, every fiftieth a stray one in front; LAS in millimetres."""
    random = np.random.default_rng(seed)
    at = random.uniform(-2, 2, (160_000, 2))
    off = random.normal(0, NOISE_M, len(at))
    off[::50] += random.uniform(0.02, 0.3, len(off[::50]))
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales, header.offsets = np.full(3, 0.0001), MIDDLE
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = (MIDDLE + at @ np.stack([ALONG, ACROSS]) + off[:, None] * NORMAL).T
    cloud.write(path)
    return path


def _point(name: str, along: float, across: float, off: float, **more: object) -> ControlPoint:
    x, y, z = (MIDDLE + along * ALONG + across * ACROSS + off * NORMAL).tolist()
    return ControlPoint(name, (x, y, z), **more)  # type: ignore[arg-type]


def _off(xyz: tuple[float, float, float] | FloatArray) -> float:
    return float((np.array(xyz) - MIDDLE) @ NORMAL)


def test_points_come_onto_the_surface(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    scan = _scan(tmp_path / "wall.las")
    given = [
        _point(f"T{i}", *random.uniform(-1.9, 1.9, 2), random.uniform(-0.015, 0.015), check=i % 3 == 0)
        for i in range(30)
    ]
    seen: list[tuple[int, int]] = []
    found, notes = points_from_scan(given, scan, tick=lambda done, total: seen.append((done, total)))
    assert [p.name for p in found] == [p.name for p in given]
    assert [p.check for p in found] == [p.check for p in given]
    assert seen[-1] == (160_000, 160_000)
    off = np.array([_off(p.xyz_m) for p in found])
    assert 1e-5 < np.sqrt(np.mean(off**2)) < NOISE_M / 3  # Far better than a point of the scan alone.
    for before, after in zip(given, found, strict=True):
        moved = np.array(after.xyz_m) - before.xyz_m
        assert np.linalg.norm(np.cross(moved, NORMAL)) < 0.1 * 0.02  # At right angles to the wall.
        assert after.sigmas_m is not None
        # Across: the spread; along: half the 10 mm between the scan's points.
        assert 0.7 * NOISE_M < min(after.sigmas_m) < max(after.sigmas_m) < 0.007
    assert notes == (notes[0],)
    assert notes[0].startswith("30 points were taken from wall.las: moved by ")
    (kept,), _ = points_from_scan([_point("A", 0, 0, 0.01, sigmas_m=(0.0, 0.0, 0.0))], scan)
    assert kept.sigmas_m is not None
    assert 0.0005 < min(kept.sigmas_m) < max(kept.sigmas_m) < 1.3 * NOISE_M


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    scan = _scan(tmp_path / "wall.las")
    random = np.random.default_rng(5)
    with laspy.open(scan, mode="a") as file:
        bush = laspy.ScaleAwarePointRecord.zeros(400, header=file.header)
        bush.x, bush.y, bush.z = (MIDDLE + 3 * ALONG + random.uniform(-0.1, 0.1, (400, 3))).T
        file.append_points(bush)
    given = [_point("on", 0.2, 0.3, 0.0), _point("bush", 3, 0, 0), _point("air", 0, 0, 0.8)]
    found, notes = points_from_scan(given, scan)
    assert [p.name for p in found] == ["on", "bush"]
    assert "within 50 mm of air: left out" in notes[1]
    assert "no even surface at bush" in notes[2]
    assert found[1].xyz_m == given[1].xyz_m
    assert found[1].sigmas_m is not None
    assert 0.01 < min(found[1].sigmas_m) < 0.06
    elsewhere = [_point("far", 500, 0, 0), _point("too", 501, 0, 0)]
    with pytest.raises(
        InputError, match=r"same coordinate system \(their middles are apart by 36[0-9].* m in x"
    ):
        points_from_scan(elsewhere, scan)


def test_options_that_do_not_go_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan = _scan(tmp_path / "wall.las")
    words = ["calibrate", "control", str(tmp_path), "--board", "9x7,60,45", "--scan", str(scan)]
    assert cli.run(words) == 2
    assert "leave --scan away" in capsys.readouterr().err
    (tmp_path / "points.csv").write_text("name,x,y,z\nA,1,2,3\nB,4,5,6\n", encoding="utf-8")
    words = ["calibrate", "mark", str(tmp_path), "--points", str(tmp_path / "points.csv"), "--scan"]
    assert cli.run([*words, str(scan)]) == 2
    assert "same coordinate system" in capsys.readouterr().err
    assert cli.run([*words, str(tmp_path / "none.las")]) == 2
    assert "cannot be read" in capsys.readouterr().err

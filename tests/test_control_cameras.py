"""Thermal and RGB over the same control: separate verdicts, the mount, photos placed through it."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.camera import BrownCamera, FloatArray
from calib.mount import Poses, same_moment, solve_mount
from calib.onsite_rules import reference_limit_percent
from daemon import cli
from sim.buildings import LODGE_M
from sim.flights import Flight
from sim.options import SurveyOptions
from sim.photo_writer import write_photo
from sim.recipes import find_recipe
from sim.survey import identity_of
from sim.tags import seconds_of, tags_of

#: Of the thermal camera in the RGB camera's axes.
TURN_DEG, OFFSET_M = np.array([0.8, -1.5, 0.4]), np.array([0.045, -0.02, 0.03])
_TURN = Rotation.from_rotvec(np.radians(TURN_DEG)).as_matrix()


@dataclass(frozen=True)
class Site:
    """Targets on the lodge's walls and the ground around (t, 3), normals (t, 3), and the photos' poses."""

    targets_m: FloatArray
    normals: FloatArray
    flight: Flight


def site(photos: int = 18, targets: int = 40, ground: int = 30) -> Site:
    rng = np.random.default_rng(4)
    long, wide, _ = LODGE_M
    side = np.arange(targets) % 4
    normal = np.array([[0, -1, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0]], float)[side]
    half, depth = np.where(side % 2 == 0, long, wide) / 2, np.where(side % 2 == 0, wide, long) / 2
    along = np.column_stack([-normal[:, 1], normal[:, 0], np.zeros(targets)])
    spots = normal * depth[:, None] + along * (half * rng.uniform(-0.95, 0.95, targets))[:, None]
    spots[:, 2] = rng.uniform(0.2, 6.0, targets)
    angle, away = rng.uniform(0, 2 * np.pi, ground), rng.uniform(8, 15, ground)
    around = np.column_stack([away * np.cos(angle), away * np.sin(angle), np.zeros(ground)])
    spots = np.concatenate([spots, around])
    normal = np.concatenate([normal, np.tile([0.0, 0, 1], (ground, 1))])
    return Site(spots, normal, find_recipe("building-rgb").flight(1.0, photos))


def seen(
    camera: BrownCamera, flight: Flight, at: Site, rng: np.random.Generator
) -> list[tuple[int, int, float, float]]:
    """Marks: photo, target, pixels with 0.3 px of noise."""
    offset = at.targets_m[None] - flight.centres_m[:, None]
    local = np.einsum("kij,ktj->kti", flight.rotations_cam_from_world, offset)
    facing = -np.einsum("kti,ti->kt", offset, at.normals) / np.linalg.norm(offset, axis=-1)
    pixels = camera.project(local[..., :2] / np.maximum(local[..., 2:], 1e-6))
    inside = ((pixels > 2) & (pixels < [camera.width - 2, camera.height - 2])).all(axis=-1)
    # Rays far outside are left out before the radial polynomial can fold them back in.
    rays = np.abs(local[..., :2]) / np.maximum(local[..., 2:], 1e-6) * camera.f_px
    inside &= (rays < 0.6 * np.array([camera.width, camera.height])).all(axis=-1)
    photo, target = np.nonzero(inside & (local[..., 2] > 1) & (facing > 0.25))
    noisy = pixels[photo, target] + 0.3 * rng.normal(size=(len(photo), 2))
    return [(int(p), int(t), float(u), float(v)) for p, t, (u, v) in zip(photo, target, noisy, strict=True)]


def campaign(home: Path, mounted: bool = True) -> tuple[Site, dict[str, BrownCamera]]:
    """Folders rgb and thermal as the simulator's recipes name and tag them, points.csv and marks.csv.

    Of the thermal photos one has 4 marks on control points and one has 2.
    """
    at, cameras = site(), {}
    options = SurveyOptions()
    rows = []
    for name, recipe, seed in (("rgb", "building-rgb", 1), ("thermal", "building-thermal", 2)):
        model = find_recipe(recipe).camera
        camera = cameras[name] = model.lens() if name == "thermal" else model.at(2736, 1824)
        flight = at.flight
        if name == "thermal" and mounted:
            turn = flight.rotations_cam_from_world
            flight = replace(
                flight,
                rotations_cam_from_world=_TURN @ turn,
                centres_m=flight.centres_m + np.einsum("kji,j->ki", turn, OFFSET_M),
            )
        elif name == "thermal":
            flight = Flight(*(np.roll(part, 3, axis=0) for part in vars(flight).values()))
        identity = identity_of(model, camera, model.dji_tags, options)
        tags = tags_of(
            flight, seconds_of(at.flight, 2.0, 3.0), 0.0, identity, (model.focal_mm, model.focal_35mm),
            model.dji_tags, seed, options,
        )  # fmt: skip
        (home / name).mkdir(parents=True)
        grey = np.full((camera.height, camera.width, 3), 90, np.uint8)
        for i, one in enumerate(tags):
            write_photo(home / name / f"{name}_{i:03d}.JPG", grey, one, quality=20)
        found = seen(camera, flight, at, np.random.default_rng([seed, 7]))
        if name == "thermal":
            # Every fifth target is a check point.
            few = {5: 4, 9: 2}
            mine = {p: [m for m in found if m[0] == p and m[1] % 5 != 4][:n] for p, n in few.items()}
            found = [m for m in found if m[0] not in few] + [m for marks in mine.values() for m in marks]
        rows += [(f"{name}_{p:03d}.JPG", f"T{t:02d}", f"{u:.3f}", f"{v:.3f}") for p, t, u, v in found]
    with (home / "marks.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("photo", "point", "u_px", "v_px"), *rows])
    scanned = at.targets_m + 0.002 * np.random.default_rng(5).normal(size=at.targets_m.shape)
    with (home / "points.csv").open("w", newline="") as file:
        lines = [
            (f"T{i:02d}", f"{x + 4e5:.4f}", f"{y + 5.6e6:.4f}", f"{z + 70:.4f}", 0.002)
            for i, (x, y, z) in enumerate(scanned.tolist())
        ]
        csv.writer(file).writerows([("name", "x", "y", "z", "sigma_m"), *lines])
    return at, cameras


def command(home: Path, *more: str) -> list[str]:
    return [
        "calibrate", "control", str(home / "rgb"), str(home / "thermal"), "--points",
        str(home / "points.csv"),
        "--marks", str(home / "marks.csv"), "--out", str(home / "out"), "--check-every", "5",
        "--mark-sigma-px", "0.3", *more,
    ]  # fmt: skip


def test_two_cameras_in_one_campaign(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))
    at, cameras = campaign(tmp_path)
    assert cli.run(command(tmp_path, "--name", "may", "--json", str(tmp_path / "both.json"))) == 0
    said = capsys.readouterr().out
    both = json.loads((tmp_path / "both.json").read_text())
    assert both["schema"] == "fieldcal.controls/1"
    assert both["failed"] == []
    by_width = {one["camera"]["width"]: one for one in both["cameras"]}
    for camera in cameras.values():
        one = by_width[camera.width]
        # Each within its own sigmas, judged in its own pixels.
        assert abs(one["parameters"]["f_px"] - camera.f_px) < 3.5 * one["sigma"]["f_px"]
        assert 0.8 < one["sigma0"] < 1.2
        assert one["saved_as"] is not None
        assert one["saved_as"].startswith("may-")
        assert one["sigma_limit_percent"] == pytest.approx(reference_limit_percent(camera.width))
    thermal = by_width[640]
    assert thermal["sigma_limit_percent"] > 4 * by_width[2736]["sigma_limit_percent"]
    # The mount, within three and a half sigma.
    mount = thermal["mount"]
    assert mount["on"] == "DJI FC6310"
    assert mount["pairs"] >= 14
    off = Rotation.from_matrix(_TURN.T @ np.array(mount["rotation"])).as_rotvec(degrees=True)
    assert np.all(np.abs(off) < 3.5 * np.array(mount["sigma_deg"]))
    assert np.all(np.abs(np.array(mount["offset_m"]) - OFFSET_M) < 3.5 * np.array(mount["sigma_m"]))
    # The lenses' errors, which all pairs share, are in it.
    assert mount["sigma_deg"][0] > 2 * mount["scatter_deg"][0] / np.sqrt(mount["pairs"])
    assert 0 < max(mount["sigma_m"]) < 0.05
    assert 0.3 < mount["miss_px"] < 3
    # The photo with 4 marks takes part; that with 2 is told where its points should be.
    assert mount["placed"] == ["thermal_005.JPG"]
    assert "thermal_005.JPG" in thermal["photos"]
    assert "thermal_009.JPG" not in thermal["photos"]
    (expected,) = (tmp_path / "out").glob("*/expected-marks.csv")
    with expected.open() as file:
        rows = [row for row in csv.DictReader(file) if row["photo"] == "thermal_009.JPG"]
    turn = at.flight.rotations_cam_from_world[9]
    flight = Flight(
        (_TURN @ turn)[None], (at.flight.centres_m[9] + turn.T @ OFFSET_M)[None], at.flight.track[9:10]
    )
    truth = {t: (u, v) for _, t, u, v in seen(cameras["thermal"], flight, at, np.random.default_rng(0))}
    misses = [
        np.hypot(float(row["u_px"]) - truth[t][0], float(row["v_px"]) - truth[t][1])
        for row in rows
        if (t := int(row["point"][1:])) in truth
    ]
    assert len(misses) == len(truth) > 5
    assert max(misses) < 6
    assert "Mounted on DJI FC6310" in said
    assert "WIRIS" in said
    assert len(list((tmp_path / "out").glob("*/control.html"))) == 2


def test_cameras_flown_apart_are_not_mounted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))
    campaign(tmp_path, mounted=False)
    assert cli.run(command(tmp_path, "--json", "-")) == 0
    both = json.loads(capsys.readouterr().out)
    assert [one["mount"] for one in both["cameras"]] == [None, None]
    assert any("Not mounted together" in note for note in both["cameras"][1]["notes"])


def test_one_camera_that_fails_does_not_take_the_other_along(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))
    campaign(tmp_path)
    rows = (tmp_path / "marks.csv").read_text().splitlines()
    kept = [row for row in rows if not row.startswith("thermal") or row.split(",")[0] < "thermal_002.JPG"]
    (tmp_path / "marks.csv").write_text("\n".join(kept) + "\n")
    assert cli.run(command(tmp_path)) == 3
    said = capsys.readouterr().out
    assert "WIRIS Pro" in said
    assert "is not calibrated: 2 photos have 5 marks" in said
    assert "Saved as" in said
    # Two photos of one name: the marks do not say which.
    (tmp_path / "thermal" / "thermal_003.JPG").rename(tmp_path / "thermal" / "rgb_003.JPG")
    assert cli.run(command(tmp_path)) == 2
    assert "There are 2 photos named rgb_003.JPG" in capsys.readouterr().err


def test_pairs_are_nearest_in_time_and_mounts_robust() -> None:
    from datetime import datetime, timedelta

    zero = datetime(2026, 5, 1)
    first = [zero + timedelta(seconds=3.0 * i) for i in range(6)]
    second = [zero + timedelta(seconds=s) for s in (0.2, 3.4, 3.1, 8.0, 12.0)]
    assert same_moment([*first, None], second) == [(0, 0), (1, 2), (4, 4)]
    assert same_moment([None], second) == []
    rng = np.random.default_rng(0)
    k = 20
    turns = Rotation.random(k, rng=0).as_matrix()
    centres = rng.normal(size=(k, 3)) * 20
    noise = Rotation.from_rotvec(np.radians(0.1) * rng.normal(size=(k, 3))).as_matrix()
    beside = centres + np.einsum("kji,j->ki", turns, OFFSET_M) + 0.02 * rng.normal(size=(k, 3))
    moved = noise @ _TURN @ turns
    moved[3] = Rotation.from_rotvec([0.5, 0, 0]).as_matrix() @ moved[3]
    beside[7] += 3.0
    mount = solve_mount(Poses(turns, centres), Poses(moved, beside), 20.0)
    assert mount is not None
    assert mount.pairs == 18
    assert np.all(np.abs(mount.offset_m - OFFSET_M) < 4 * 0.02 / np.sqrt(18))
    assert np.all((mount.scatter_m > 0.01) & (mount.scatter_m < 0.035))
    placed = mount.place(Poses(turns, centres))
    assert np.median(np.linalg.norm(placed.centres_m - beside, axis=1)) < 0.06
    assert solve_mount(Poses(turns[:2], centres[:2]), Poses(moved[:2], beside[:2]), 20.0) is None
    shuffled = Poses(moved[::-1], beside[::-1])
    assert solve_mount(Poses(turns, centres), shuffled, 20.0) is None

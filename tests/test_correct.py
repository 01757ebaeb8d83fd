"""Clouds put right by a point, bars, levels and height models; K1 and K2 forced onto the line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from calib.assess.model import similarity_of
from calib.camera import FloatArray
from calib.clouds import load_cloud, open_cloud
from calib.equifinal_published import LINE_5
from calib.reference_file import read_reference_file
from daemon import cli
from tests.cloud_cases import OFFSET, ground_m, made, write_las, write_points

#: True places: one known point, a bar of 20 m, two levels of 30 m at a right angle.
TRUE = np.array(
    [[0, 0, 1], [-10, 5, 2], [10, 5, 2], [-15, -15, 3], [15, -15, 3], [20, -10, 3], [20, 20, 3.0]]
)
VALUES = np.array([3, -2, 4, 0.0, 0.6, -0.8, 102.0])


@pytest.fixture
def wrong(tmp_path: Path) -> tuple[Path, FloatArray]:
    """A cloud with shift, tilt and scale, and the places as they are in it."""
    case = made(30, 0.0, values=VALUES)
    write_las(tmp_path / "wrong.laz", case.cloud.xyz + OFFSET)
    picked = similarity_of(VALUES).apply(TRUE) + OFFSET
    write_points(tmp_path / "picked.csv", picked)
    return tmp_path, picked


def _run(folder: Path, *more: str) -> int:
    return cli.run(["correct", str(folder / "wrong.laz"), "--out", str(folder / "right.laz"), *more])


def _text(place: FloatArray) -> str:
    return ",".join(f"{v:.6f}" for v in place)


def test_point_bar_and_levels_put_a_cloud_right(
    wrong: tuple[Path, FloatArray], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = wrong
    more = ["--measured", str(folder / "picked.csv"), "--point", f"P0={_text(TRUE[0] + OFFSET)}"]
    more += ["--bar", "P1:P2=20", "--level", "P3:P4", "--level", "P5:P6", "--json", "-"]
    assert _run(folder, *more) == 0
    told = json.loads(capsys.readouterr().out)
    right = load_cloud(open_cloud(folder / "right.laz"))
    xyz = right.xyz + right.origin - OFFSET
    assert xyz[:, 2] == pytest.approx(ground_m(*xyz[:, :2].T), abs=0.02)
    assert told["scale"] == pytest.approx(1 / 1.02, abs=1e-4)
    remains = {row["name"]: row for row in told["remains"]}
    assert [name for name, row in remains.items() if row["fixed_by"] is None] == ["Rphi"]
    # Reading errors of 2 cm at both ends.
    assert remains["S"]["sigma"] == pytest.approx(100 * np.sqrt(2) * 0.02 / 20, rel=0.05)
    assert remains["Rtheta"]["sigma"] == pytest.approx(np.degrees(np.sqrt(2) * 0.02 / 30), rel=0.05)


def test_remaining_errors_are_as_said() -> None:
    """Reading errors drawn as stated scatter scale and tilt as stated."""
    from calib.assess.remedy import Bar, correction

    cloud = made(31, 0.0, points=2000).cloud
    rng = np.random.default_rng(0)
    scales, tilts = [], []
    for _ in range(300):
        at = TRUE + OFFSET + 0.02 * rng.normal(size=TRUE.shape)
        bars = [Bar("b", at[1], at[2], 20.0)]
        levels = [Bar("l", at[3], at[4]), Bar("m", at[5], at[6])]
        made_ = correction(cloud, None, bars, levels, None, 0.02)
        scales.append(100 * made_.moved.scale)
        tilts.append(np.degrees([made_.moved.rotation[2, 1], -made_.moved.rotation[2, 0]]))
    said = {row.name: row.sigma for row in made_.remains}
    assert 0.85 < np.std(scales) / said["S"] < 1.15
    spread = np.std(tilts, axis=0)
    assert 0.85 < spread[0] / said["Rtheta"] < 1.15
    assert 0.85 < spread[1] / said["Rpsi"] < 1.15


def test_height_model_takes_out_tilt_and_height(
    wrong: tuple[Path, FloatArray], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = wrong
    case = made(32, 0.0, values=np.array([0, 0, 4, 0, 0.6, -0.8, 100.0]))
    write_las(folder / "wrong.laz", case.cloud.xyz + OFFSET)
    x, y = np.meshgrid(np.arange(-100.5, 100), np.arange(100.5, -100, -1.0))
    with rasterio.open(
        folder / "dem.tif", "w", driver="GTiff", width=x.shape[1], height=x.shape[0], count=1,
        dtype="float32", crs="EPSG:32630", transform=from_origin(OFFSET[0] - 101, OFFSET[1] + 101, 1, 1),
    ) as file:  # fmt: skip
        file.write((ground_m(x, y) + OFFSET[2]).astype(np.float32), 1)
    assert _run(folder, "--dem", str(folder / "dem.tif")) == 0
    assert "height model" in capsys.readouterr().out
    right = load_cloud(open_cloud(folder / "right.laz"))
    xyz = right.xyz + right.origin - OFFSET
    error = xyz[:, 2] - ground_m(*xyz[:, :2].T)
    slopes = np.linalg.lstsq(np.column_stack([np.ones(len(xyz)), xyz[:, :2]]), error, rcond=None)[0]
    assert abs(np.median(error)) < 0.05
    assert np.degrees(np.abs(slopes[1:])).max() < 0.06


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ((), "Nothing to correct by"),
        (("--point", "1,2,3"), "both places"),
        (("--point", "P9=1,2,3"), "nor a name"),
        (("--bar", "P1:P2"), "P:P=LENGTH"),
        (("--bar", "P1:P2=-3"), "no length"),
        (("--bar", "P1:P1=3"), "same place"),
        (("--bar", "P1:P2=60"), "check units"),
        (("--level", "P3:P4"), "along itself only"),
        (("--level", "P3:P4", "--level", "P1:P2"), "nearly parallel"),
        (("--reading-sigma", "0", "--bar", "P1:P2=20"), "positive"),
        (("--sparse", "x", "--bar", "P1:P2=20"), "belong together"),
    ],
)  # fmt: skip
def test_mistakes_are_said(
    more: tuple[str, ...], says: str, wrong: tuple[Path, FloatArray], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = wrong
    assert _run(folder, "--measured", str(folder / "picked.csv"), *more) == 2
    assert says in capsys.readouterr().err
    assert not (folder / "right.laz").exists()


def test_the_cloud_itself_is_never_overwritten(
    wrong: tuple[Path, FloatArray], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = wrong
    path = folder / "wrong.laz"
    before = path.read_bytes()
    assert cli.run(["correct", str(path), "--out", str(path), "--bar", "0,0,0:1,0,0=1"]) == 2
    assert cli.run(["correct", str(path), "--out", str(folder / "a.ply"), "--bar", "0,0,0:1,0,0=1"]) == 2
    assert path.read_bytes() == before
    assert "never changed" in capsys.readouterr().err


# --- adjust-k --------------------------------------------------------------------------------------


def test_adjust_k_forces_onto_the_line_and_says_what_it_costs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))
    out = tmp_path / "forced.json"
    assert cli.run(["adjust-k", "dji-phantom-3-professional", "--out", str(out), "--json", "-"]) == 0
    told = json.loads(capsys.readouterr().out)
    after = told["after"]
    assert told["inside_domain"]
    assert after["k1_px"] == told["before"]["k1_px"]
    assert after["k2_px"] == pytest.approx(LINE_5.intercept + LINE_5.slope * after["k1_px"])
    assert after["k3_px"] == 0
    # K3 alone is worth 14.7 px at the edge of the half width; the line takes up most of it.
    assert 0.5 < told["largest_px"] < 3
    assert told["rms_felt_px"] <= told["rms_px"]
    written = read_reference_file(out)
    assert written.brown is not None
    assert written.brown.k2_px == pytest.approx(after["k2_px"])
    assert written.covariance is None
    assert "forced" in written.provenance


def test_adjust_k_is_labelled_and_refuses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))
    assert cli.run(["adjust-k", "dji-phantom-3-professional"]) == 0
    assert capsys.readouterr().out.startswith("Not a repair")
    assert cli.run(["adjust-k", "dji-inspire-1"]) == 2
    capsys.readouterr()
    assert cli.run(["adjust-k", "dji-phantom-3-professional", "--line-of", "workswell-wiris-pro"]) == 2
    assert "K in pixel units change with the size" in capsys.readouterr().err
    assert cli.run(["adjust-k", "no-such-camera"]) == 2
    assert "no-such-camera" in capsys.readouterr().err

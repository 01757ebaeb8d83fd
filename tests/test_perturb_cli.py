"""``fieldcal perturb``: what it prints and writes, and what it refuses."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from calib.equifinal_published import P3P_WALL
from daemon import cli


def test_json_and_csv(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    arguments = ["perturb", "--camera", "dji-phantom-3-professional", "--grid", "4"]
    assert cli.run([*arguments, "--out", str(out), "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["schema"] == "fieldcal.perturb/1"
    assert found["applies"]
    assert found["adjustments"] == 16
    tangent = found["tangent"]
    at_wall = tangent["slope"] * P3P_WALL.k1_px + tangent["intercept"]
    assert at_wall == pytest.approx(P3P_WALL.k2_px, rel=1e-6)
    assert -3.0e-7 < tangent["slope"] < -2.4e-7
    for k1, k2 in found["zero_line"]:
        assert k2 == pytest.approx(tangent["intercept"] + tangent["slope"] * k1, rel=0.03)
    rows = list(csv.DictReader((out / "perturb.csv").open(encoding="utf-8")))
    assert len(rows) == 16
    assert {float(row["x2"]) > 0 for row in rows} == {True, False}


@pytest.mark.parametrize(
    ("camera", "grid", "says"),
    [
        ("dji-phantom-3-professional", "3", "from 4 to 200"),
        ("microdrone-2-hd", "4", "image size"),
        ("no-such-camera", "4", "no-such-camera"),
    ],
)
def test_refusals(camera: str, grid: str, says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["perturb", "--camera", camera, "--grid", grid]) == 2
    assert says in capsys.readouterr().err

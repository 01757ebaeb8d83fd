"""``fieldcal plan`` from the shell: files, JSON, limits, and every mistake one sentence and exit code 2."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.camera import BrownCamera
from calib.formats import write_calibration
from daemon import cli
from mission.encode import SUFFIXES, read

CAMERA = "dji-phantom-3-professional"
BASE = ["--camera", CAMERA, "--height", "60", "--area", "54.77,-1.58,45", "--launch", "54.7696,-1.58"]
SITE = f"""
area = "field.kml"
launch = [54.7690, -1.5800]
camera = "{CAMERA}"
height_m = 50
side_overlap = 60
ceiling_m = 120

[vehicle]
endurance_s = 1500

[wind]
speed_m_s = 4
from_deg = 250

[[fence]]
keep = "in"
outline = "54.77,-1.58,250"

[[fence]]
keep = "out"
outline = [[54.7704, -1.5795], [54.7706, -1.5795], [54.7706, -1.5791]]

[[structure]]
name = "barn"
outline = "54.7702,-1.5812,6"
height_m = 8
"""
KML = (
    "<kml><Placemark><Polygon><outerBoundaryIs><LinearRing><coordinates>-1.581,54.7696 -1.579,54.7696 "
    "-1.579,54.7703 -1.581,54.7703 -1.581,54.7696</coordinates></LinearRing></outerBoundaryIs></Polygon>"
    "</Placemark></kml>"
)


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))


def _json(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    assert cli.run(["plan", *arguments, "--json", "-"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_a_plan_in_every_format_and_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    outputs = [tmp_path / f"mission{suffix}" for suffix in SUFFIXES] + [
        tmp_path / "sheet.html",
        tmp_path / "sheet.png",
    ]
    out = [word for path in outputs for word in ("--out", str(path))]
    found = _json(capsys, "cd3", *BASE, *out)
    assert all(path.stat().st_size > 100 for path in outputs)
    assert found["schema"] == "fieldcal.plan/1"
    assert found["photos"] == len(found["stations"])
    assert sum(s["pattern"] == "fan" for s in found["stations"]) == 8
    assert found["gsd_m"] == pytest.approx(60 / 2320.06)
    assert set(found["predicted"]) >= {"sigma_f_percent", "dome_percent", "convergent_share", "verdict"}
    assert {"rule", "hard", "ok", "value", "limit", "unit", "message"} == set(found["findings"][0])
    back = read(tmp_path / "mission.plan")
    assert len(back.stations) == found["photos"]


def test_site_file_and_options_over_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "sites"
    folder.mkdir()
    (folder / "site.toml").write_text(SITE)
    (folder / "field.kml").write_text(KML)
    kept = _json(capsys, "nadir+orbit", "--site", str(folder / "site.toml"))
    assert kept["name"] == "field"
    assert {round(s["height_m"]) for s in kept["stations"]} == {50}
    assert all(f["ok"] for f in kept["findings"] if f["hard"])
    other = _json(capsys, "nadir", "--site", str(folder / "site.toml"), "--gsd", "3", "--side-overlap", "80")
    assert {round(s["height_m"]) for s in other["stations"]} == {round(0.03 * 2320.06)}


def test_a_broken_hard_limit_is_not_written_but_forced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mission, sheet = tmp_path / "m.plan", tmp_path / "sheet.html"
    arguments = ["plan", "nadir", *BASE, "--endurance", "2", "--out", str(mission), "--out", str(sheet)]
    assert cli.run(arguments) == 2
    captured = capsys.readouterr()
    assert not mission.exists()
    assert "DO NOT FLY" in sheet.read_text()
    assert "not written: The flight takes" in captured.err
    assert "✗" in captured.out
    assert cli.run([*arguments, "--force"]) == 0
    assert mission.exists()


def test_a_long_plan_is_split_when_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path / "m.plan")]
    arguments = ["nadir+fan", *BASE, "--endurance", "6"]
    assert cli.run(["plan", *arguments, *out]) == 2
    assert "--split" in capsys.readouterr().err
    found = _json(capsys, *arguments, "--split", *out)
    assert not (tmp_path / "m.plan").exists()
    assert len(found["parts"]) >= 2
    assert sum(part["photos"] for part in found["parts"]) == found["photos"]
    assert all(f["ok"] for f in found["findings"] if f["hard"])
    for number, part in enumerate(found["parts"], 1):
        back = read(tmp_path / f"m-{number}.plan")
        assert len(back.stations) == len(part["stations"]) == part["photos"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["spiral", *BASE], "no pattern named spiral"),
        (["nadir", *BASE, "--camera", "phantom-33"], "no reference or file named phantom-33"),
        (["nadir", *BASE[2:]], "no camera"),
        (["nadir", *BASE[:4]], "no area"),
        (["nadir", *BASE[:2], *BASE[4:]], "--height or --gsd"),
        (["nadir", *BASE, "--gsd", "2"], "Both height_m and gsd_cm"),
        (["nadir", *BASE, "--height", "-4"], "option --height"),
        (["nadir", *BASE, "--height", "4000"], "heights above ground go from"),
        (["nadir", *BASE, "--ceiling", "50"], "10 m above the ceiling"),
        (["nadir", *BASE, "--launch", "54.8"], "--launch takes 2 numbers"),
        (["nadir", *BASE, "--launch", "14.8,3"], "km away from the launch"),
        (["nadir", *BASE, "--launch", "54.772,-1.58", "--keep-in", "54.77,-1.58,100"], "outside the fence"),
        (["nadir", *BASE, "--keep-in", "54.77,-1.58,100", "--keep-in", "54.79,-1.58,100"], "no place to fly"),
        (["nadir", *BASE, "--keep-out", "54.77,-1.58,200"], "fence leaves no photo"),
        (["nadir", *BASE, "--dem", "missing.tif"], "no terrain model"),
        (["nadir", *BASE, "--structure", "54.77,-1.58,20"], "--structure takes"),
        (["nadir", *BASE, "--side-overlap", "120"], "option --side-overlap"),
        (["nadir", *BASE, "--wind", "strong"], "--wind takes"),
        (["nadir", *BASE, "--wind", "25"], "a wind of 25 m/s is more than the aircraft flies (15 m/s)"),
        (["nadir", *BASE, "--endurance", "1", "--split"], "Splitting does not help"),
        (["nadir+fan", *BASE, "--gimbal=-90,-60"], "8 photos need the camera at up to -50 degrees"),
        (["nadir", *BASE, "--clearance", "70"], "10 m less than the clearance of 70 m"),
        (["orbit", *BASE, "--tilt", "85"], "option --tilt"),
        (["wall", *BASE], "no wall"),
        (["nadir", *BASE, "--site", "missing.toml"], "site file missing.toml cannot be read"),
        (["nadir", *BASE, "--out", "mission.doc"], "no format with that ending"),
        (["nadir", *BASE, "--out", "no/folder/m.plan"], "Cannot write"),
    ],
)
def test_mistakes_are_one_sentence(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(["plan", *arguments]) == 2
    said = capsys.readouterr().err
    assert words in said, said
    assert said.count("\n") == 1


def test_inputs_are_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    area = tmp_path / "field.kml"
    area.write_text(KML)
    assert cli.run(["plan", "nadir", *BASE, "--area", str(area), "--out", "field.kml"]) == 2
    assert "would be overwritten" in capsys.readouterr().err
    assert area.read_text() == KML


def test_a_camera_file_will_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "camera.xml"
    write_calibration(BrownCamera.ideal(4000, 3000, 2500.0), "metashape", path)
    found = _json(capsys, "fan", *BASE, "--camera", str(path))
    assert found["gsd_m"] == pytest.approx(60 / 2500)
    pitches = np.array([s["pitch_deg"] for s in found["stations"]])
    assert pitches == pytest.approx(-50)

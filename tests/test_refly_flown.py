"""The whole way at small size: a nadir flight, REFLY, the pass that is recommended flown, TRUST."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from check_process import OPTIONS, check, findings, report_of, true_lens
from refly_flights import flight_of

from daemon import cli
from mission.encode import read
from sim.survey import write_survey

SIZE = (640, 480)
#: One ground for both flights.
FLOWN = replace(OPTIONS, apart=False, texel_m=0.16)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Nadir photos, their check, the pass, its photos, and the check of both."""
    home = tmp_path_factory.mktemp("refly")
    truth = write_survey("demo_nadir", home / "old", 3, size=SIZE, options=FLOWN, workers=1)
    lens = true_lens(truth, home / "lens.json")
    first = check(home, "old", "--reference", lens, "--out", "first", "--quiet", timeout_s=1200)
    files = [home / f"pass{suffix}" for suffix in (".plan", ".waypoints", ".kmz", ".csv", ".kml", ".html")]
    words = [word for path in files for word in ("--out", str(path))]
    code = cli.run(["refly", str(home / "first"), *words, "--json", str(home / "pass.json")])
    wanted = json.loads((home / "pass.json").read_text(encoding="utf-8"))
    later = replace(
        FLOWN, start=FLOWN.start + timedelta(minutes=15), position_jitter_m=2.0, attitude_jitter_deg=2.0
    )
    flight = flight_of(wanted["stations"], later)
    write_survey("demo_nadir", home / "new", 3, size=SIZE, options=later, workers=1, instead=flight)
    both = check(home, "old", "new", "--reference", lens, "--out", "both", "--quiet", timeout_s=1200)
    return {"home": home, "first": first, "code": code, "pass": wanted, "both": both, "files": files}


def test_a_nadir_flight_is_to_be_reflown(flown: dict[str, Any]) -> None:
    assert flown["first"].code == 3
    assert findings(report_of(flown["home"], "first"))["focal-sigma"]["state"] != "pass"


def test_the_pass_is_short_and_promises_a_cure(flown: dict[str, Any]) -> None:
    found = flown["pass"]
    assert flown["code"] == 0
    assert found["schema"] == "fieldcal.refly/1"
    assert found["cures"]
    assert found["binding_limit"] is None
    assert 5 <= found["photos"] == len(found["stations"]) <= 12
    assert 30 < found["duration_s"] < 240
    assert found["before"]["sigma_f_percent"] > 0.1
    assert 0.001 < found["after"]["sigma_f_percent"] < 0.03
    assert 0.0 < found["after"]["dome_percent"] < 0.05
    assert found["reason"].startswith(f"{found['photos']} photos, ")


def test_every_file_is_written(flown: dict[str, Any]) -> None:
    for path in flown["files"]:
        assert path.stat().st_size > 200, path
    plan = read(Path(flown["files"][0]))
    assert len(plan.stations) == flown["pass"]["photos"]


def test_flown_as_recommended_it_is_trusted(flown: dict[str, Any]) -> None:
    """With 2 m and 2 degrees of error in the flying."""
    report = report_of(flown["home"], "both")
    assert report["verdict"] == "TRUST", report["headline"]
    assert flown["both"].code == 0
    sigma = findings(report)["focal-sigma"]["value"]
    # What happened against what was predicted: within a factor of three on either side.
    assert 1 / 3 < sigma / flown["pass"]["after"]["sigma_f_percent"] < 3

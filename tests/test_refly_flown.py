"""The whole way at small size: a nadir flight, REFLY, the pass that is recommended flown, TRUST."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from check_process import OPTIONS, check, findings, report_of, true_lens

from benchmarks.refly_rendered import flight_of
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
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FIELDCAL_STORE", str(home / "store"))
        code = cli.run(["refly", str(home / "first"), *words, "--json", str(home / "told.json")])
    wanted = json.loads((home / "told.json").read_text(encoding="utf-8"))
    later = replace(
        FLOWN, start=FLOWN.start + timedelta(minutes=15), position_jitter_m=2.0, attitude_jitter_deg=2.0
    )
    flight = flight_of(wanted["stations"], later)
    write_survey("demo_nadir", home / "new", 3, size=SIZE, options=later, workers=1, instead=flight)
    # Only the new photos are given: the pass is known again, and the survey's are taken along.
    both = check(home, "new", "--reference", lens, "--out", "both", timeout_s=1200)
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


def test_its_photos_are_known_again(flown: dict[str, Any]) -> None:
    report, count = report_of(flown["home"], "both"), flown["pass"]["photos"]
    brought = report["extra_pass"]
    assert [path is not None for path in brought["photos"]] == [True] * count
    assert brought["not_used"] == []
    assert brought["before"] == pytest.approx(flown["pass"]["before"])
    assert brought["predicted"] == pytest.approx(flown["pass"]["after"])
    assert brought["now"]["sigma_f_percent"] == pytest.approx(findings(report)["focal-sigma"]["value"])
    assert report["alignment"]["photos"] == 12 + count
    said = " ".join(flown["both"].out.split())
    assert f"{count} of the {count} photos of the recommended pass were found" in said
    assert "The 12 photos of the survey that the pass completes were taken along" in said
    assert report_of(flown["home"], "first")["extra_pass"] is None


def test_flown_as_recommended_it_is_trusted(flown: dict[str, Any]) -> None:
    """With 2 m and 2 degrees of error in the flying."""
    report = report_of(flown["home"], "both")
    assert report["verdict"] == "TRUST", report["headline"]
    assert flown["both"].code == 0
    sigma = findings(report)["focal-sigma"]["value"]
    # What happened against what was predicted: within a factor of three on either side.
    assert 1 / 3 < sigma / flown["pass"]["after"]["sigma_f_percent"] < 3

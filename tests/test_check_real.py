"""`fieldcal check` on real photo sets: what an honest check says of each (FIELDCAL_DATA)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from check_process import Ran, check, findings, left_out, report_of, untouched

pytestmark = pytest.mark.slow


def _checked(folder: Path, home: Path) -> tuple[Ran, dict[str, Any]]:
    with untouched(folder):
        ran = check(home, folder)
    assert ran.err == ""
    return ran, report_of(home)


def _sigma_percent(report: dict[str, Any]) -> float:
    calibration = report["calibration"]
    return float(100 * calibration["sigma"]["f_px"] / calibration["f_px"])


def test_brighton_beach_asks_for_the_missing_geometry(data_dir: Path, tmp_path: Path) -> None:
    """18 nadir photos from one height: f cannot be determined, whatever the adjustment makes of it."""
    ran, report = _checked(data_dir / "brighton_beach", tmp_path)
    assert ran.code == 3
    assert report["verdict"] == "REFLY"
    assert report["alignment"]["aligned"] == 18
    assert report["alignment"]["left_out"] == []
    assert report["alignment"]["reprojection_rms_px"] < 1
    assert _sigma_percent(report) > 1
    assert "All photos look straight down from one height" in report["headline"]
    found = findings(report)
    assert found["convergent-share"]["state"] == "flag"
    assert found["convergent-share"]["value"] == 0
    assert found["focal-sigma"]["state"] == "flag"
    for rule in ("focal-drift", "equifinal-deviation", "equifinal-line"):
        assert found[rule]["state"] == "unknown"
    assert report["camera"]["processing"] == "lens-corrected"
    assert report["camera"]["model"] == "FC300S"
    assert len(report["network"]["heights_agl_m"]) == 1
    assert re.search(r"Fly one circle .* 8 photos", report["what_to_fly"])
    assert report["georeference"]["trusted"]
    # The nominal focal length is not contradicted.
    calibration = report["calibration"]
    assert abs(calibration["f_px"] - 2311) < 4 * calibration["sigma"]["f_px"]


def test_lewis_oblique_is_well_known_but_unconfirmed(data_dir: Path, tmp_path: Path) -> None:
    """Strongly oblique photos of a camera without reference: f is known, nothing to hold it against."""
    ran, report = _checked(data_dir / "lewis_oblique", tmp_path)
    assert ran.code == 4
    assert report["verdict"] == "CANNOT_TELL"
    assert report["alignment"]["aligned"] == 22
    assert _sigma_percent(report) < 0.3
    assert report["network"]["convergent"] == 22
    assert report["reference"] is None
    found = findings(report)
    assert "flag" not in {finding["state"] for finding in found.values()}
    for rule in ("focal-drift", "equifinal-deviation", "equifinal-line"):
        assert found[rule]["state"] == "unknown"
        assert found[rule]["value"] is None
        assert "no reference calibration of Canon PowerShot S100 is known" in found[rule]["message"]
    assert report["what_to_fly"] is None
    assert "No photo has camera angles in its metadata." in ran.out


def test_caliterra_names_the_geotags_and_sells_no_cure_for_them(data_dir: Path, tmp_path: Path) -> None:
    """All photos align, but their positions are wrong: said, not believed, and not for flying to repair."""
    ran, report = _checked(data_dir / "caliterra_slice", tmp_path)
    assert ran.code in (3, 4)
    assert report["verdict"] != "TRUST"
    assert report["alignment"]["aligned"] == 18
    assert not report["georeference"]["trusted"]
    assert report["georeference"]["rms_xy_m"] > 10
    alignment = findings(report)["alignment"]
    assert alignment["state"] == "flag"
    assert "The geotags do not fit the photos: " in alignment["message"]
    assert alignment["message"].lower().count("more photos do not cure this") == 1
    assert "geotags do not fit" in report["headline"]
    if report["what_to_fly"] is not None:
        assert "cures nothing about the geotags" in report["what_to_fly"]
        assert not re.search(r"\d m\b", report["what_to_fly"])
    # Lengths would come from the positions that nobody believes.
    assert report["network"]["heights_agl_m"] == []
    assert report["network"]["gsd_m"] is None
    assert "odm_geo" not in report["exports"]
    missing = (tmp_path / "fieldcal-out" / report["exports"]["not_written"]).read_text()
    assert "The geotags were not believed" in missing


def test_three_photos_of_brighton(data_dir: Path, tmp_path: Path) -> None:
    photos = sorted((data_dir / "brighton_beach").glob("*.JPG"))[:3]
    ran = check(tmp_path, *photos, "--quiet")
    # Three in a row may just be enough to be joined, never to be trusted.
    assert ran.code in (2, 3, 4), ran
    if ran.code == 2:
        assert "overlap" in ran.sentence
    else:
        report = report_of(tmp_path)
        assert report["alignment"]["aligned"] == 3
        assert findings(report)["focal-sigma"]["state"] == "flag"


def test_two_sets_in_one_command_are_kept_apart(data_dir: Path, tmp_path: Path) -> None:
    """Five photos of one camera and three of another: the larger group is checked, the other named."""
    lewis = sorted((data_dir / "lewis_oblique").glob("*.jpg"))[:5]
    brighton = sorted((data_dir / "brighton_beach").glob("*.JPG"))[:3]
    ran = check(tmp_path, *brighton, *lewis)
    assert ran.code in (2, 3, 4), ran
    if ran.code == 2:
        pytest.fail(ran.err)
    report = report_of(tmp_path)
    assert report["camera"]["model"] == "Canon PowerShot S100"
    assert report["alignment"]["photos"] == 8
    assert report["alignment"]["used"] == 5
    assert report["alignment"]["aligned"] >= 3
    reasons = left_out(report)
    for path in brighton:
        assert "taken by another camera (DJI FC300S, 4000 x 2250)" in reasons[path.name]
    assert "To check another, give its photos alone." in " ".join(ran.out.split())

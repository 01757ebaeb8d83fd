"""`fieldcal check` as its users and other programs meet it: verdicts, exit codes, report.json, references."""

from __future__ import annotations

import json
import os
import re
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from check_process import (
    MODEL,
    OPTIONS,
    Ran,
    Survey,
    check,
    command,
    environment,
    findings,
    report_of,
    true_lens,
    untouched,
)
from PIL import Image

from calib.photos.photo import Processing

pytest_plugins = ("check_fixtures",)

#: The keys of report.json that other programs rely on, and of what they are.
SCHEMA: dict[str, Any] = {
    "schema": str,
    "verdict": str,
    "findings": [
        {
            "rule": str,
            "state": str,
            "value": (float, None),
            "sigma": (float, None),
            "unit": str,
            "threshold": (float, None),
            "source": str,
            "message": str,
        }
    ],
    "camera": {
        "make": str,
        "model": str,
        "serial": (str, None),
        "width": int,
        "height": int,
        "processing": str,
    },
    "calibration": {
        **dict.fromkeys(
            ("f_px", "cx_px", "cy_px", "k1", "k2", "k3", "p1", "p2", "k1_px", "k2_px", "k3_px"), float
        ),
        "sigma": dict,
        "correlation": dict,
    },
    "alignment": {
        "photos": int,
        "used": int,
        "aligned": int,
        "components": list,
        "points": int,
        "observations": int,
        "reprojection_rms_px": float,
        "left_out": list,
    },
    "network": {"nadir": int, "convergent": int, "heights_agl_m": list, "gsd_m": (float, None)},
    "georeference": {"crs": (str, None), "rms_xy_m": (float, None), "rms_z_m": (float, None)},
    "dome": {"amplitude_m": (float, None), "amplitude_percent": (float, None), "sigma_m": (float, None)},
    "timing": {"wall_s": float, "cpu_s": float, "photos_per_s": float},
    "exports": dict,
}
RULES = [
    "focal-drift",
    "equifinal-deviation",
    "equifinal-line",
    "opposite-signs",
    "convergent-share",
    "predicted-dome",
    "focal-sigma",
    "cross-validation",
    "model-sensitivity",
    "coverage",
    "alignment",
]


def conforms(value: Any, wanted: Any, where: str = "report") -> None:
    if isinstance(wanted, dict):
        assert isinstance(value, dict), where
        for key, part in wanted.items():
            assert key in value, f"{where}.{key}"
            conforms(value[key], part, f"{where}.{key}")
    elif isinstance(wanted, list):
        assert isinstance(value, list), where
        for item in value:
            conforms(item, wanted[0], f"{where}[]")
    else:
        kinds = wanted if isinstance(wanted, tuple) else (wanted,)
        if value is None:
            assert None in kinds, where
        else:
            accepted = tuple(kind for kind in kinds if kind is not None)
            accepted += (int,) if float in accepted else ()
            assert isinstance(value, accepted), (where, value)


# -- with the convergent photos: kept as a reference, trusted by it -------------------------------------


@pytest.fixture(scope="session")
def saved(survey: Survey, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Ran]:
    """The first flight, held against its true lens, kept as a reference."""
    home = tmp_path_factory.mktemp("saved")
    lens = true_lens(survey.truth, home / "true-lens.json")
    with untouched(survey.folder):
        ran = check(
            home,
            survey.folder,
            *("--reference", lens, "--save-reference", "sim-spring", "--json", "-", "--out", "a/b"),
        )
    return home, ran


@pytest.mark.slow
def test_trusted_with_the_true_reference(saved: tuple[Path, Ran], survey: Survey) -> None:
    home, ran = saved
    assert ran.code == 0, ran.err
    report = json.loads(ran.out)
    assert report == report_of(home, "a/b")
    conforms(report, SCHEMA)
    assert report["schema"] == "fieldcal.check/1"
    assert report["verdict"] == "TRUST"
    assert [finding["rule"] for finding in report["findings"]] == RULES
    assert {finding["state"] for finding in report["findings"]} <= {"pass", "unknown"}
    assert report["reference"]["name"] == "true-lens"
    assert report["camera"] == {
        "make": "DJI",
        "model": MODEL,
        "serial": OPTIONS.serial,
        "width": 1000,
        "height": 750,
        "processing": "raw",
    }
    alignment, network = report["alignment"], report["network"]
    assert (alignment["photos"], alignment["used"], alignment["aligned"]) == (20, 20, 20)
    assert alignment["components"] == [20]
    assert alignment["left_out"] == []
    assert (network["nadir"], network["convergent"]) == (12, 8)
    assert network["heights_agl_m"] == pytest.approx([60], abs=4)
    assert network["gsd_m"] == pytest.approx(60 / survey.truth.camera.f_px, rel=0.3)
    assert report["georeference"]["crs"] == "EPSG:32630"
    assert 0.5 < report["georeference"]["rms_xy_m"] < 6
    calibration = report["calibration"]
    f, sigma = calibration["f_px"], calibration["sigma"]["f_px"]
    assert abs(f / survey.truth.camera.f_px - 1) < 1e-3
    assert 0 < sigma < 5e-4 * f
    assert set(calibration["sigma"]) >= set(SCHEMA["calibration"]) - {"sigma", "correlation"}
    assert calibration["correlation"]["f_px"]["f_px"] == pytest.approx(1)
    assert calibration["k1_px"] == pytest.approx(calibration["k1"] / f**2)
    assert abs(report["dome"]["amplitude_percent"]) < 0.1
    assert report["dome"]["amplitude_m"] == pytest.approx(
        report["dome"]["amplitude_percent"] / 100 * 60, rel=0.1, abs=1e-4
    )
    assert report["what_to_fly"] is None
    for target in report["exports"].values():
        assert (home / "a/b" / target).exists()


@pytest.mark.slow
def test_json_on_stdout_leaves_the_words_to_stderr(saved: tuple[Path, Ran]) -> None:
    _, ran = saved
    assert ran.out.startswith("{\n")
    assert ran.out.endswith("}\n")
    assert " TRUST   The calibration can be trusted" in ran.err
    assert ran.err.splitlines()[-1].startswith("fieldcal: saved as reference sim-spring (")


@pytest.mark.slow
def test_a_saved_reference_is_found_and_trusted_on_the_next_flight(
    saved: tuple[Path, Ran], second_survey: Survey
) -> None:
    """Named, and looked up by the camera: the same answer, and f within the 0.1 % rule."""
    home, _ = saved
    assert [path.stem for path in (home / "store").glob("*.json")] == ["sim-spring"]
    with untouched(second_survey.folder, home / "store"):
        ran = check(home, second_survey.folder, "--reference", "sim-spring", "--out", "next", "--quiet")
    assert ran.code == 0, ran
    assert ran.err == ""
    assert re.fullmatch(r"TRUST: The calibration can be trusted: .*sim-spring.*\n", ran.out)
    report = report_of(home, "next")
    assert report["reference"]["name"] == "sim-spring"
    drift = findings(report)["focal-drift"]
    assert drift["state"] == "pass"
    assert abs(drift["value"]) < 0.1
    assert abs(report["calibration"]["f_px"] / second_survey.truth.camera.f_px - 1) < 1e-3


# -- straight down only -------------------------------------------------------------------------------


def test_straight_down_only_is_refly_and_nothing_is_saved(home: Path, small: Survey) -> None:
    lens = true_lens(small.truth, home / "true-lens.json")
    ran = check(
        home,
        *small.nadir[:6],
        "--reference",
        lens,
        "--save-reference",
        "weak",
        "--json",
        "o/r.json",  # a folder that the check itself makes
        "--out",
        "o",
    )
    assert ran.code == 3
    report = json.loads((home / "o/r.json").read_text())
    assert report == report_of(home, "o")
    assert report["verdict"] == "REFLY"
    assert findings(report)["convergent-share"]["state"] == "flag"
    assert findings(report)["focal-sigma"]["state"] == "flag"
    assert "All photos look straight down from one height" in report["headline"]
    assert "8 photos" in report["what_to_fly"]
    sigma = 100 * report["calibration"]["sigma"]["f_px"] / report["calibration"]["f_px"]
    assert sigma > 0.3
    assert ran.err == (
        f"fieldcal: not saved as reference weak: its focal length is known to {sigma:.2f} % only, "
        "and 0.05 % is needed.\n"
    )
    assert not (home / "store").exists()


def test_words_on_the_terminal(home: Path, card: Path) -> None:
    """80 columns, the verdict first, no control characters where the output is no terminal."""
    ran = check(home, card, "--out", "somewhere")
    assert ran.code == 3
    assert ran.err == ""
    lines = ran.out.splitlines()
    assert max(map(len, lines)) <= 80
    assert [line for line in lines if line != line.rstrip()] == []
    assert lines[1].startswith(" REFLY   All photos look straight down")
    assert lines[-1] == "Report: somewhere/report.html"
    assert "\x1b" not in ran.out
    assert f"No reference calibration of DJI {MODEL}" not in lines[1]
    assert f"not compared: no reference calibration of DJI {MODEL} is known" in " ".join(ran.out.split())


def test_on_a_terminal_there_are_colours_and_progress(home: Path, card: Path) -> None:
    controller, terminal = os.openpty()
    with subprocess.Popen(
        command(card, "--out", "o"),
        cwd=home,
        env=environment(home, TERM="xterm-256color"),
        stdin=terminal,
        stdout=terminal,
        stderr=terminal,
    ) as process:
        os.close(terminal)
        shown = b""
        with suppress(OSError):  # A terminal without users ends with an error, not with an end of file.
            while chunk := os.read(controller, 65536):
                shown += chunk
    os.close(controller)
    assert process.returncode == 3
    text = shown.decode()
    for stage in ("reading metadata", "matching", "self-calibration", "comparing models"):
        assert stage in text
    # The progress line is gone when the verdict stands there, and the cursor is back.
    verdict = text[text.rindex("comparing models") :]
    assert "\x1b[2K" in verdict
    assert verdict.index("\x1b[?25h") < verdict.index("REFLY")
    assert re.search(r"\x1b\[1;37;41m REFLY ", verdict)


# -- references that do not fit -----------------------------------------------------------------------


def test_raw_reference_against_corrected_photos_is_refused_and_said(
    home: Path, card: Path, small: Survey
) -> None:
    for path in card.iterdir():
        data = path.read_bytes()
        assert data.count(b'DewarpFlag="0"') == 1
        path.write_bytes(data.replace(b'DewarpFlag="0"', b'DewarpFlag="1"'))
    lens = true_lens(small.truth, home / "raw-lens.json", name="raw-lens")
    ran = check(home, card, "--reference", lens)
    assert ran.code in (3, 4)
    report = report_of(home)
    assert report["camera"]["processing"] == "lens-corrected"
    assert report["reference"] is None
    assert (
        "raw-lens is for raw files and these photos are files that the camera corrected"
        in (report["reference_note"])
    )
    for rule in ("focal-drift", "equifinal-deviation", "equifinal-line"):
        assert findings(report)[rule]["state"] == "unknown"
    assert "their distortion cannot be compared" in " ".join(ran.out.split())


def test_a_reference_of_another_size_is_converted_and_said(home: Path, card: Path, small: Survey) -> None:
    big = small.truth.camera.scaled(1600, 1200)
    lens = true_lens(small.truth, home / "big.json", name="big-lens", width=1600, height=1200, brown=big)
    ran = check(home, card, "--reference", lens)
    assert ran.code == 3
    report = report_of(home)
    assert report["reference"]["f_px"] == pytest.approx(small.truth.camera.f_px)
    assert "made at 1600x1200 px, the images 400x300 px" in report["reference_note"]
    assert "scaled by 0.25" in " ".join(ran.out.split())
    assert findings(report)["equifinal-deviation"]["value"] < 1


def test_a_reference_of_another_processing_may_be_tried_by_name_only_if_unknown(
    home: Path, card: Path, small: Survey
) -> None:
    lens = true_lens(small.truth, home / "who-knows.json", processing=Processing.UNKNOWN)
    ran = check(home, card, "--reference", lens)
    assert ran.code == 3
    assert "whether the camera corrected the lens is not known" in report_of(home)["reference_note"]


# -- photos that say little ------------------------------------------------------------------------------


@pytest.mark.slow
def test_photos_without_metadata_still_work_but_nothing_is_in_metres(home: Path, small: Survey) -> None:
    """Matched by appearance; angles and shares of the height remain, lengths do not."""
    bare = home / "bare"
    bare.mkdir()
    for path in [*small.nadir[:8], *small.convergent[::2]]:
        with Image.open(path) as image:
            Image.fromarray(np.asarray(image)).save(bare / path.name, quality=95)
    lens = true_lens(small.truth, home / "true-lens.json")
    with untouched(bare):
        ran = check(home, bare, "--reference", lens)
    assert ran.code in (0, 3, 4)
    assert ran.err == ""
    words = " ".join(ran.out.split())
    for missing in ("a position", "camera angles", "a time"):
        assert f"No photo has {missing} in its metadata." in words
    report = report_of(home)
    conforms(report, SCHEMA)
    assert report["alignment"]["aligned"] == 12
    assert report["network"]["heights_agl_m"] == []
    assert report["network"]["gsd_m"] is None
    assert (report["network"]["nadir"], report["network"]["convergent"]) == (8, 4)
    assert report["georeference"] == {
        "crs": None,
        "rms_xy_m": None,
        "rms_z_m": None,
        "trusted": False,
        "fault": None,
    }
    assert report["dome"]["amplitude_m"] is None
    assert report["dome"]["sigma_m"] is None
    assert abs(report["dome"]["amplitude_percent"]) < 1
    sigma = report["calibration"]["sigma"]["f_px"]
    assert abs(report["calibration"]["f_px"] - small.truth.camera.f_px) < 4 * sigma
    in_metres = re.compile(r"\d (m|cm|km)\b")
    assert not [f["message"] for f in report["findings"] if in_metres.search(f["message"])]
    assert not in_metres.search(words)
    page = (home / "fieldcal-out" / "report.html").read_text(encoding="utf-8")
    body = page[page.index("<main>") : page.index("</main>")]
    assert not re.search(r"m above ground|cm per pixel|east \(m\)|difference \(cm\)", body)
    assert "flying heights" in body
    assert "geo.txt" in (home / "fieldcal-out" / "exports" / "not_written.txt").read_text()

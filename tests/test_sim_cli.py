"""`fieldcal sim` as its users meet it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from check_process import without_superpowers

from calib.photos import collect, read_photos
from calib.photos.photo import Processing
from calib.reference_file import read_reference_file
from daemon import cli
from daemon.cli_sim import LENS_FILE
from sim.recipes import RECIPES
from sim.survey import read_truth

SMALL = ("--size", "160x120")


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one sentence of a command that ends with exit code 2 and leaves nothing behind."""
    before = sorted(Path.cwd().rglob("*"))
    assert cli.run(["sim", "survey", *arguments]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    (line,) = said.err.splitlines()
    assert "Traceback" not in line
    assert line.startswith("fieldcal: ")
    assert sorted(Path.cwd().rglob("*")) == before
    return line


def test_list_names_every_recipe_in_80_columns(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["sim", "list"]) == 0
    out = capsys.readouterr().out
    assert cli.run(["sim"]) == 0
    assert capsys.readouterr().out == out
    lines = out.splitlines()
    assert max(map(len, lines)) <= 80
    assert len(lines) == len(RECIPES) + 2  # one line each, a heading and a note
    for name, recipe in RECIPES.items():
        (line,) = [line for line in lines if line.split()[0] == name]
        assert str(recipe.photos) in line.split()[1]


def test_a_survey_from_end_to_end(capsys: pytest.CaptureFixture[str], home: Path) -> None:
    assert cli.run(["sim", "survey", "A3", "--out", "a3", *SMALL, "--seed", "4", "--gps", "rtk"]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    assert "fieldcal check a3 --reference a3/true-lens.json" in said.out
    truth = read_truth(home / "a3")
    assert (truth.recipe, truth.seed, truth.camera.width) == ("A3", 4, 160)
    photos, bad = read_photos(collect([home / "a3"]))
    assert (len(photos), bad) == (RECIPES["A3"].photos, [])
    assert all(p.position is not None and p.position.sigma_horizontal_m == 0.015 for p in photos)
    reference = read_reference_file(home / "a3" / LENS_FILE)
    assert reference.brown == truth.camera
    options = json.loads((home / "a3" / "truth.json").read_text())["options"]
    assert options["gps"] == "rtk"
    assert options["rtk_sigma_m"] == 0.015


def test_options_reach_the_survey(home: Path) -> None:
    arguments = [
        "--photos",
        "6",
        "--camera",
        "corrected",
        "--gps-sigma-m",
        "1",
        "--relief-m",
        "0.5",
        "--quiet",
    ]
    more = ["--rolling-shutter-ms", "20", "--take-off-photo", "--tags", "mavlink", "--lens", "inspire-1"]
    assert cli.run(["sim", "survey", "orbit", "--out", "o", *SMALL, *arguments, *more]) == 0
    content = json.loads((home / "o" / "truth.json").read_text())
    options = content["options"]
    assert (options["gps"], options["gps_sigma_m"], options["relief_m"]) == ("white", 1.0, 0.5)
    truth = read_truth(home / "o")
    assert len(truth.photos) == 7
    assert truth.photos[0] == "IMG_0001.JPG"
    assert truth.take_off == truth.photos[:1]
    assert truth.readout_s == 0.02
    assert truth.camera.k1 == -0.01
    assert truth.camera.f_px == pytest.approx(2326.07 * 160 / 4000)
    assert truth.pattern is not None  # what a correction leaves is not Brown's
    assert truth.identity is not None
    assert truth.identity.processing is Processing.UNKNOWN  # plain EXIF does not say it


def test_the_same_seed_makes_the_same_photos(home: Path) -> None:
    for folder, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        arguments = ["--photos", "4", "--seed", seed, "--quiet"]
        assert cli.run(["sim", "survey", "orbit", "--out", folder, *SMALL, *arguments]) == 0
    a, b, c = ((home / folder / "DJI_0001.JPG").read_bytes() for folder in "abc")
    assert a == b
    assert a != c


def test_refusals(capsys: pytest.CaptureFixture[str], home: Path) -> None:
    assert "Did you mean A3" in refused(capsys, "a3", "--out", "x")
    assert "sim list" in refused(capsys, "qqq", "--out", "x")
    for size, why in (
        ("1000", "is no size"),
        ("axb", "such as 1000x750"),
        ("0x0", "not possible"),
        ("-4x3", "is no size"),
        ("1000x1000", "another shape"),
        ("99999x74999", "4000x3000"),
    ):
        assert why in refused(capsys, "A3", "--out", "x", f"--size={size}")
    assert "fixed (37)" in refused(capsys, "A3", "--out", "x", "--photos", "5")
    assert "from 4 to 200" in refused(capsys, "orbit", "--out", "x", "--photos", "100000")
    assert "no camera named" in refused(capsys, "orbit", "--out", "x", "--lens", "brownie")
    assert "not of raw photos" in refused(capsys, "building-rgb", "--out", "x", "--camera", "raw")
    assert "not published" in refused(capsys, "building-thermal", "--out", "x", "--camera", "corrected")
    assert "gps" in refused(capsys, "A3", "--out", "x", "--gps", "perfect")
    assert "out" in refused(capsys, "A3")
    assert "needs the DEM" in refused(capsys, "A3", "--out", "x", "--ortho", "o.tif", *SMALL)
    (home / "full").mkdir()
    (home / "full" / "mine.txt").write_text("keep")
    assert "not empty" in refused(capsys, "A3", "--out", "full")
    assert "a file" in refused(capsys, "A3", "--out", "full/mine.txt", *SMALL)
    assert (home / "full" / "mine.txt").read_text() == "keep"


def test_a_folder_that_may_not_be_written(home: Path) -> None:
    (home / "locked").mkdir(mode=0o500)
    ran = subprocess.run(
        [sys.executable, "-m", "daemon.cli", "sim", "survey", "A3", "--out", "locked/x", *SMALL],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=without_superpowers,
    )
    assert (ran.returncode, ran.stdout) == (2, "")
    (line,) = ran.stderr.splitlines()
    assert "may not write there" in line


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interrupted_leaves_no_truth_and_says_so(home: Path, number: signal.Signals, code: int) -> None:
    arguments = ["sim", "survey", "crosshatch", "--out", "x", "--size", "400x300"]
    process = subprocess.Popen(
        [sys.executable, "-m", "daemon.cli", *arguments], stderr=subprocess.PIPE, stdout=subprocess.PIPE
    )
    give_up = time.monotonic() + 60
    while not list((home / "x").glob("DJI_0003.JPG")):
        assert process.poll() is None
        assert time.monotonic() < give_up
        time.sleep(0.02)
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert process.returncode == code
    assert out == b""
    assert b"without truth.json: this survey is incomplete" in err
    assert b"Traceback" not in err
    photos = list((home / "x").glob("*.JPG"))
    assert 3 <= len(photos) < 64
    assert {p.suffix for p in (home / "x").iterdir()} == {".JPG"}

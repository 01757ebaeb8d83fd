"""The command line: what it prints, what it writes, and how it ends."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from calib.equifinal_published import LINE_5, LINE_6
from daemon import cli


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.delenv("NO_COLOR", raising=False)
    return tmp_path


def test_plain_cameras_lists_them_in_80_columns(capsys):
    assert cli.run(["cameras"]) == 0
    plain = capsys.readouterr().out
    assert cli.run(["cameras", "list"]) == 0
    assert capsys.readouterr().out == plain
    lines = plain.splitlines()
    assert max(len(line) for line in lines) <= 80
    (phantom,) = [line for line in lines if line.startswith("dji-phantom-3-professional")]
    assert "4000x3000" in phantom
    assert "2320.1" in phantom
    assert "raw" in phantom


@pytest.mark.parametrize("name", ["dji-phantom-3-professional", "dji-inspire-1", "workswell-wiris-pro"])
def test_show_fits_80_columns_and_names_the_source(capsys, name):
    assert cli.run(["cameras", "show", name]) == 0
    out = capsys.readouterr().out
    assert max(len(line) for line in out.splitlines()) <= 80
    assert "Carbonneau" in out or "Senn" in out


def test_compare_says_how_far_apart_and_what_cannot_be_compared(capsys):
    assert cli.run(["cameras", "compare", "dji-phantom-3-professional", "dji-inspire-1"]) == 0
    out = capsys.readouterr().out
    assert "+0.259 %" in out
    assert "Distortion differs by up to" in out
    assert cli.run(["cameras", "compare", "dji-phantom-4-pro", "workswell-wiris-pro"]) == 2
    assert "cannot be converted" in capsys.readouterr().err


def test_export_and_import_bring_the_same_camera_back(capsys, tmp_path):
    from calib.references import load_reference

    out = tmp_path / "p3p.json"
    arguments = ["--format", "fieldcal", "--out", str(out)]
    assert cli.run(["cameras", "export", "dji-phantom-3-professional", *arguments]) == 0
    assert cli.run(["cameras", "import", str(out), "--name", "mine", "--serial", "B7"]) == 0
    assert "mine" in capsys.readouterr().out
    mine = load_reference("mine")
    assert mine.serial == "B7"
    assert mine.brown == load_reference("dji-phantom-3-professional").brown
    assert cli.run(["cameras"]) == 0
    assert "yours" in capsys.readouterr().out


def test_every_foreign_format_can_be_exported_and_imported(tmp_path):
    from calib.convert import mapping_difference_px
    from calib.formats import FORMATS
    from calib.references import load_reference

    truth = load_reference("dji-phantom-3-professional").brown
    tried = 0
    for name in FORMATS:
        out = tmp_path / f"exported.{name}"
        code = cli.run(
            ["cameras", "export", "dji-phantom-3-professional", "--format", name, "--out", str(out)]
        )
        if code != 0:
            continue
        tried += 1
        if cli.run(["cameras", "import", str(out), "--name", "back"]) == 0:
            assert mapping_difference_px(truth, load_reference("back").brown) < 0.05, name
    assert tried >= 4


@pytest.mark.parametrize(
    ("camera", "published"), [("dji-phantom-3-professional", LINE_5), ("dji-inspire-1", LINE_6)]
)
def test_equifinal_json_reproduces_the_published_line(capsys, camera, published):
    assert cli.run(["equifinal", "--camera", camera, "--monte-carlo", "100000", "--json", "-"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["schema"] == "fieldcal.equifinal/1"
    drawn, line = report["monte_carlo"], report["line"]
    assert drawn["slope"] == pytest.approx(published.slope, rel=0.05)
    assert drawn["intercept"] == pytest.approx(published.intercept, rel=0.08)
    assert line["slope"] == pytest.approx(drawn["slope"], rel=0.005)
    assert line["intercept"] == pytest.approx(drawn["intercept"], rel=0.005)
    assert report["published"]["slope"] == published.slope


def test_equifinal_prints_a_table_in_80_columns(capsys):
    assert cli.run(["equifinal", "--camera", "dji-phantom-3-professional"]) == 0
    out = capsys.readouterr().out
    assert max(len(line) for line in out.splitlines()) <= 80
    assert "-2.66" in out
    assert "published" in out


def test_equifinal_says_where_it_does_not_apply(capsys, tmp_path):
    from calib.camera import BrownCamera
    from calib.reference_file import write_reference_file
    from calib.references import reference_from_camera

    same_signs = BrownCamera(4000, 3000, 2300.0, 2000.0, 1500.0, 0.01, 0.002)
    path = tmp_path / "same.json"
    write_reference_file(reference_from_camera("same", same_signs, "made up"), path)
    assert cli.run(["equifinal", "--camera", str(path), "--json", "-"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["applies"] is False
    assert report["line"] is None
    assert "does not apply" in report["notes"][0]


@pytest.mark.parametrize(
    "arguments",
    [
        ["equifinal"],
        ["equifinal", "--camera", "no-such-camera"],
        ["equifinal", "--camera", "dji-phantom-3-professional", "--tolerance-px", "0"],
        ["equifinal", "--camera", "dji-phantom-3-professional", "--tolerance-px", "two"],
        ["equifinal", "--camera", "dji-phantom-3-professional", "--radius-px", "-5"],
        ["equifinal", "--camera", "dji-phantom-3-professional", "--monte-carlo", "3"],
        ["equifinal", "--camera", "microdrone-2-hd"],
        ["equifinal", "--camera", "dji-phantom-3-professional", "--json", "/no/such/folder/x.json"],
        ["cameras", "show", "no-such-camera"],
        ["cameras", "import", "no-such-file"],
        ["cameras", "export", "dji-phantom-3-professional", "--format", "nonsense", "--out", "x"],
        ["cameras", "export", "dji-inspire-1", "--format", "fieldcal"],
        ["cameras", "export", "microdrone-2-hd", "--format", "odm", "--out", "x"],
        ["nonsense"],
        ["--nonsense"],
        [],
    ],
)
def test_unusable_input_is_one_sentence_and_exit_2(capsys, arguments):
    assert cli.run(arguments) == 2
    err = capsys.readouterr().err
    assert "Traceback" not in err
    if arguments:
        assert len(err.strip().splitlines()) == 1


def test_a_folder_for_import_is_refused(capsys, tmp_path):
    assert cli.run(["cameras", "import", str(tmp_path)]) == 2
    assert "no file" in capsys.readouterr().err


def test_an_interrupt_ends_with_130_and_one_line(capsys, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("daemon.cli_equifinal.load_reference", interrupted)
    assert cli.run(["equifinal", "--camera", "x"]) == 130
    assert capsys.readouterr().err.strip() == "fieldcal: Interrupted."


def test_a_defect_ends_with_1_and_leaves_details(capsys, monkeypatch, home):
    def broken(*_):
        raise ZeroDivisionError("inside")

    monkeypatch.setattr("daemon.cli_equifinal.load_reference", broken)
    assert cli.run(["equifinal", "--camera", "x"]) == 1
    err = capsys.readouterr().err
    assert "defect" in err
    assert "Traceback" not in err
    (details,) = (home / "state").rglob("defect-*.txt")
    assert "ZeroDivisionError: inside" in details.read_text()
    assert str(details) in err


def test_the_installed_program_ends_with_the_code_and_keeps_stdout_clean():
    environment = {**os.environ, "COLUMNS": "80"}
    command = [sys.executable, "-m", "daemon.cli", "equifinal", "--camera", "dji-inspire-1", "--json", "-"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0
    assert json.loads(done.stdout)["camera"] == "dji-inspire-1"
    assert done.stderr == ""
    done = subprocess.run(
        [*command[:-3], "nobody"], capture_output=True, text=True, env=environment, check=False
    )
    assert done.returncode == 2
    assert done.stdout == ""

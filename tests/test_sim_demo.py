"""The demonstration's own thinking: reuse of photos, reference file, verdicts against exit codes."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from rich.console import Console

import sim.demo as demo
from calib.findings import Verdict
from calib.reference_file import read_reference_file, write_reference_file
from sim.survey import SurveyTruth

SIZE = (320, 240)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SurveyTruth]:
    folder = tmp_path_factory.mktemp("demo") / "photos"
    return folder, demo.photographed(folder, SIZE, Console(quiet=True))


def test_photos_are_rendered_once(rendered: tuple[Path, SurveyTruth]) -> None:
    folder, truth = rendered
    before = (folder / truth.photos[0]).stat().st_mtime_ns
    again = demo.photographed(folder, SIZE, Console(quiet=True))
    assert again.photos == truth.photos
    assert (folder / truth.photos[0]).stat().st_mtime_ns == before


def test_half_rendered_photos_are_rendered_again(rendered: tuple[Path, SurveyTruth]) -> None:
    folder, truth = rendered
    (folder / truth.photos[3]).unlink()
    demo.photographed(folder, SIZE, Console(quiet=True))
    assert (folder / truth.photos[3]).is_file()


def test_reference_is_the_true_lens(rendered: tuple[Path, SurveyTruth], tmp_path: Path) -> None:
    _, truth = rendered
    write_reference_file(demo.reference_of(truth), tmp_path / "true.json")
    assert read_reference_file(tmp_path / "true.json").brown == truth.camera


@pytest.mark.parametrize(
    ("verdict", "code", "right"),
    [("REFLY", 3, True), ("TRUST", 0, False), ("REFLY", 1, False), ("CANNOT_TELL", 4, False)],
)
def test_only_the_expected_verdict_is_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verdict: str, code: int, right: bool
) -> None:
    """A checker of the same command line stands in for the real one."""
    (tmp_path / "daemon").mkdir()
    (tmp_path / "daemon" / "__init__.py").touch()
    (tmp_path / "daemon" / "cli.py").write_text(
        "import json, pathlib, sys\n"
        "words = sys.argv[1:]\n"
        "assert words[0] == 'check' and words[1].endswith('nadir')\n"
        "out = pathlib.Path(words[words.index('--json') + 1])\n"
        "out.parent.mkdir(parents=True, exist_ok=True)\n"
        f"out.write_text(json.dumps({{'verdict': {verdict!r}}}))\n"
        f"sys.exit({code})\n",
        encoding="utf-8",
    )
    monkeypatch.chdir(tmp_path)  # python -m looks in the working directory first
    step = demo.Step("nadir-only", "nadir", ("nadir",), Verdict.REFLY)
    got = demo.check(step, tmp_path, tmp_path / "r.json", tmp_path / "out", Console(quiet=True))
    assert got is right
    assert json.loads((tmp_path / "out" / "report.json").read_text())["verdict"] == verdict


def test_no_report_is_not_right(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "daemon").mkdir()
    (tmp_path / "daemon" / "__init__.py").touch()
    (tmp_path / "daemon" / "cli.py").write_text("raise SystemExit(3)\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    step = demo.Step("nadir-only", "nadir", ("nadir",), Verdict.REFLY)
    assert not demo.check(step, tmp_path, tmp_path / "r.json", tmp_path / "out", Console(quiet=True))


def test_width_is_checked(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        demo.main(["--width", "10"])
    assert stop.value.code == 2
    assert "--width must be" in capsys.readouterr().err


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write anywhere")
def test_unwritable_folder_is_a_sentence(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(demo.OutputError, match="cannot write"):
        demo.main(["--out", str(tmp_path / "x"), "--width", "320"])

"""The demonstration: the whole loop in both flavours, with real processes, links and files; its map."""

from __future__ import annotations

import io
import json
import os
from pathlib import Path

import pytest
from rich.console import Console

pytest.importorskip("pymavlink", reason="pip install fieldcal[flight]")

import sim.demo as demo
from mission.encode import FLAVOURS, Flavour
from sim.cameras import PHANTOM_3
from sim.demo_map import DRONE, HOME, OBLIQUE, PLANNED, TAKEN, Flown, drawn

SIZE = (640, 480)


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_refly_then_trust(tmp_path: Path, flavour: Flavour) -> None:
    """Planned, flown, REFLY, the pass computed, uploaded and flown, TRUST: the lens is the true one."""
    said = io.StringIO()
    demo.prepared(tmp_path)
    reference = demo.reference_of(SIZE)
    assert reference.brown is not None
    demo.write_reference_file(reference, tmp_path / demo.LENS)
    assert demo.flown(demo.Demo(tmp_path, SIZE, Console(file=said, width=200), flavour, area_m=10.0)), (
        said.getvalue()
    )
    first, second = (json.loads((tmp_path / step.name / "report.json").read_text()) for step in demo.STEPS)
    assert (first["verdict"], second["verdict"]) == ("REFLY", "TRUST")
    assert second["calibration"]["f_px"] == pytest.approx(reference.brown.f_px, rel=1e-3)
    assert second["alignment"]["photos"] > first["alignment"]["photos"]
    truth = json.loads((tmp_path / "tether" / "truth.json").read_text())
    assert truth["camera"]["f_px"] == pytest.approx(reference.brown.f_px)
    # The photos are those that the vehicle was told to take.
    assert len(list((tmp_path / "tether").glob("*.JPG"))) == second["alignment"]["photos"]
    assert "The pilot has armed" in said.getvalue()
    # The vehicle's missions before the survey (none) and before the pass (the survey's).
    assert len(list((tmp_path / "kept-missions").glob("*.json"))) == 2
    assert len(list((tmp_path / "kept-missions").glob("*.waypoints"))) == 1


def test_a_map_of_characters() -> None:
    flown = Flown([(-20.0, 0.0), (20.0, 0.0), (20.0, 15.0)], [(-20.0, 0.0)], [(0.0, 15.0)], (20.0, 15.0))
    lines = drawn(flown, 41, 11).splitlines()
    assert len(lines) == 12
    assert max(map(len, lines)) <= 41
    signs = {sign: [(r, line.index(sign)) for r, line in enumerate(lines) if sign in line]
             for sign in (HOME, PLANNED, TAKEN, OBLIQUE, DRONE)}  # fmt: skip
    assert signs[DRONE][0][0] < signs[HOME][0][0]  # north is up
    assert signs[TAKEN] == [(signs[HOME][0][0], 0)]  # west is left, and taken covers planned
    assert signs[PLANNED] == [(signs[HOME][0][0], 40)]
    assert signs[DRONE][0][1] == 40
    assert len(signs[OBLIQUE]) == 1
    assert lines[-1].endswith(" m")
    one = drawn(Flown([], [], [], (0.0, 0.0)))
    assert DRONE in one


def test_reference_is_the_true_lens() -> None:
    assert demo.reference_of(SIZE).brown == PHANTOM_3.at(*SIZE)


def test_only_its_own_files_are_cleared_away(tmp_path: Path) -> None:
    (tmp_path / "tether").mkdir()
    (tmp_path / "tether" / "IMG_0001.JPG").write_bytes(b"old")
    (tmp_path / "mine.txt").write_text("keep")
    demo.prepared(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize(("verdict", "right"), [("REFLY", True), ("TRUST", False), ("CANNOT_TELL", False)])
def test_only_the_expected_verdict_is_right(tmp_path: Path, verdict: str, right: bool) -> None:
    told = demo.Demo(tmp_path, SIZE, Console(quiet=True))
    step = demo.STEPS[0]
    assert not told.judged(step, demo.Told())
    (tmp_path / step.name).mkdir()
    report = {"verdict": verdict, "headline": "So it is."}
    (tmp_path / step.name / "report.json").write_text(json.dumps(report))
    assert told.judged(step, demo.Told()) is right


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

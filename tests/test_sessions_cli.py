"""The library of flights and ``fieldcal sessions``."""

from __future__ import annotations

import json
import sqlite3
import subprocess
import zipfile
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import result_factory

from calib.errors import InputError, OutputError
from calib.findings import Verdict
from calib.report_json import report_dict
from daemon import cli
from daemon.session import export as export_module
from daemon.session import library
from daemon.session.database import DATABASE
from daemon.session.reader import SessionReader
from daemon.session.rows import (
    ClockName,
    Event,
    Pair,
    Pairing,
    PhotoFile,
    Plan,
    Stamp,
    Trigger,
    VerdictRecord,
)

NOON = datetime(2026, 5, 31, 12, 4, tzinfo=UTC)


def at(days: int = 0):
    return lambda: NOON + timedelta(days=days)


def take_photos(session, count: int, triggers: int) -> None:
    with session.batch():
        for n in range(triggers):
            session.add_trigger(Trigger(f"1/{n}", Stamp(n, ClockName.BOOT), n))
        for n in range(count):
            session.add_photo(PhotoFile(Path(f"photos/{n}.jpg"), f"{n:064x}", 1000 + n))


def judge(session, photos: int, verdict=Verdict.TRUST, final=True) -> None:
    session.add_verdict(VerdictRecord(report_dict(result_factory.build(verdict, points=50)), photos, final))


def pair(session, photos: int, triggers: int, pairs: int) -> None:
    made = tuple(Pair(n, n, 0.99, True) for n in range(1, pairs + 1))
    session.add_pairing(Pairing(made, photos, triggers))


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("FIELDCAL_SESSIONS", str(tmp_path / "flights"))
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))
    monkeypatch.setenv("COLUMNS", "80")
    return tmp_path / "flights"


@pytest.fixture
def flights(folder):
    """One finished, one that was cut off."""
    with library.begin("Levee, north", at()) as session:
        session.add_plan(Plan("levee.plan", b"{}"))
        session.add_plan(Plan("../../evil plan", b"\x00"))
        take_photos(session, 3, 3)
        pair(session, 3, 3, 3)
        judge(session, 3)
        library.finish(session, at())
        (session.folder / "report.html").write_text("<p>report</p>")
        (session.folder / "exports" / "colmap").mkdir(parents=True)
        (session.folder / "exports" / "colmap" / "images.txt").write_text("images")
        (session.folder / "exports" / "passwd").symlink_to("/etc/passwd")
    with library.begin("levee north", at(1)) as session:
        take_photos(session, 5, 6)
        pair(session, 4, 6, 3)
        judge(session, 2, Verdict.REFLY, final=False)
    return folder


# --- Library -------------------------------------------------------------------------------------


def test_where_flights_live(folder, monkeypatch):
    assert library.sessions_folder() == folder
    assert library.names() == ()
    monkeypatch.delenv("FIELDCAL_SESSIONS")
    assert library.sessions_folder().parts[-2:] == ("fieldcal", "sessions")


def test_names_are_slugs_and_get_numbers(folder):
    for label, name in (
        ("Große Höhe / 3", "2026-05-31-1204-groe-hohe-3"),
        ("..", "2026-05-31-1204-flight"),
        ("飛行", "2026-05-31-1204-flight-2"),
    ):
        with library.begin(label, at()) as session:
            assert session.folder == folder / name


@pytest.mark.usefixtures("flights")
def test_found_by_name_or_the_beginning_of_it():
    assert library.find("2026-05-31").name == "2026-05-31-1204-levee-north"
    with pytest.raises(InputError, match="Several flights begin with 2026"):
        library.find("2026")
    with pytest.raises(InputError, match="Did you mean 2026-05-31-1204-levee-north"):
        library.find("2026-05-13-1204-levee-north")
    for name in ("", "..", "../flights", "/etc"):
        with pytest.raises(InputError):
            library.find(name)
    with library.begin("levee", at()):
        assert library.find("2026-05-31-1204-levee").name == "2026-05-31-1204-levee"


@pytest.mark.usefixtures("flights")
def test_what_is_unfinished():
    (newer, older), faults = library.list_sessions()
    assert faults == ()
    assert older.unfinished == library.Unfinished(True, 0, 0, 0, 0, True)
    assert not older.unfinished.resumable
    assert older.unfinished.sentences() == ()
    assert newer.unfinished == library.Unfinished(False, 1, 1, 3, 3, False)
    assert newer.unfinished.sentences() == (
        "The flight was not ended.",
        "1 photo came after the last pairing.",
        "1 photo without trigger.",
        "3 triggers without photo.",
        "There is no final verdict.",
    )


@pytest.mark.usefixtures("flights")
def test_resume_takes_the_newest_unfinished_one():
    with library.resume(clock=at(2)) as session:
        assert session.folder.name == "2026-06-01-1204-levee-north"
        with pytest.raises(InputError, match="no unfinished flight"):
            library.resume()
        with pytest.raises(InputError, match="is held by process"):
            library.resume("2026-06-01")
        pair(session, 5, 6, 5)
        judge(session, 5)
        library.finish(session, at(2))
    with pytest.raises(InputError, match="no unfinished flight"):
        library.resume()
    with library.resume("2026-05-31") as session:
        take_photos(session, 4, 3)
        assert library.unfinished(session).resumable
        assert (
            "The verdict does not know the last 1 of the photos." in library.unfinished(session).sentences()
        )


def test_one_bad_flight_does_not_hide_the_others(flights, capsys):
    (flights / "2026-05-31-1204-levee-north" / DATABASE).write_bytes(b"rubbish" * 1000)
    (flights / ".fieldcal-half").mkdir()
    (flights / "notes").mkdir()
    assert cli.run(["sessions"]) == 0
    out = capsys.readouterr().out
    assert "2026-06-01-1204-levee-north" in out
    assert "Left out: The record of flight 2026-05-31-1204-levee-north" in out


# --- Command line --------------------------------------------------------------------------------


@pytest.mark.usefixtures("flights")
def test_list(capsys):
    assert cli.run(["sessions"]) == 0
    plain = capsys.readouterr().out
    assert cli.run(["sessions", "list"]) == 0
    assert capsys.readouterr().out == plain
    lines = [line.rstrip() for line in plain.splitlines()]
    assert max(map(len, lines)) <= 80
    assert lines[1:] == [
        "2026-06-01-1204-levee-north  2026-06-01       5  REFLY (so far)  unfinished",
        "2026-05-31-1204-levee-north  2026-05-31       3  TRUST           finished",
    ]
    with library.resume():
        assert cli.run(["sessions", "list"]) == 0
    assert "recording" in capsys.readouterr().out


def test_list_of_nothing_makes_nothing(folder, capsys):
    assert cli.run(["sessions", "list"]) == 0
    assert capsys.readouterr().out.startswith("No flight is recorded in")
    assert not folder.exists()


@pytest.mark.usefixtures("flights")
def test_show(capsys):
    assert cli.run(["sessions", "show", "2026-06"]) == 0
    out = capsys.readouterr().out
    assert max(len(line) for line in out.splitlines() if not line.startswith("Folder")) <= 80
    assert "REFLY (so far): " in out
    assert "Unfinished: 3 triggers without photo." in out
    assert cli.run(["sessions", "show", "2026-05"]) == 0
    out = capsys.readouterr().out
    assert "TRUST: " in out
    assert "levee.plan" in out
    assert "Unfinished" not in out
    assert cli.run(["sessions", "show", "nothing"]) == 2
    assert "There is no flight named nothing" in capsys.readouterr().err


@pytest.mark.usefixtures("flights")
def test_json(capsysbinary, tmp_path):
    assert cli.run(["sessions", "list", "--json", "-"]) == 0
    data = json.loads(capsysbinary.readouterr().out)
    assert data["schema"] == "fieldcal.sessions/1"
    assert [flight["verdict"] for flight in data["flights"]] == ["REFLY", "TRUST"]
    assert data["flights"][0]["counts"]["photos"] == 5
    assert cli.run(["sessions", "show", "2026-05", "--json", "-"]) == 0
    shown = json.loads(capsysbinary.readouterr().out)
    assert shown["schema"] == "fieldcal.session/1"
    assert shown["report"]["schema"] == "fieldcal.check/1"
    assert shown["plans"][0]["bytes"] == 2
    assert cli.run(["sessions", "show", "2026-05", "--json", str(tmp_path / "x.json")]) == 0
    assert json.loads((tmp_path / "x.json").read_text()) == shown


@pytest.mark.usefixtures("flights")
def test_export_to_a_folder(tmp_path, capsys):
    out = tmp_path / "out"
    assert cli.run(["sessions", "export", "2026-05", "--out", str(out)]) == 0
    assert capsys.readouterr().out.startswith("Wrote ")
    files = {p.relative_to(out).as_posix() for p in out.rglob("*") if not p.is_dir()}
    assert files == {
        "MANIFEST",
        "session.sqlite",
        "verdict.json",
        "report.html",
        "exports/colmap/images.txt",
        "plans/001-levee.plan",
        "plans/002-evil-plan",
    }
    check = ["sha256sum", "--check", "--strict", "MANIFEST"]
    done = subprocess.run(check, cwd=out, capture_output=True, text=True, check=True)
    assert done.stdout.count(": OK") == len(files) - 1
    with SessionReader.open(out) as copy, SessionReader.open(library.find("2026-05")) as session:
        copy.verify()
        assert copy.photos() == session.photos()
        assert copy.verdicts() == session.verdicts()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["flights", "out"]


@pytest.mark.usefixtures("flights")
def test_export_to_a_zip_file(tmp_path):
    first, second = tmp_path / "a.zip", tmp_path / "b.zip"
    for target in (first, second):
        assert cli.run(["sessions", "export", "2026-05", "--out", str(target)]) == 0
    assert first.read_bytes() == second.read_bytes()
    with zipfile.ZipFile(first) as archive:
        assert archive.testzip() is None
        assert {name.partition("/")[0] for name in archive.namelist()} == {"2026-05-31-1204-levee-north"}
        archive.extractall(tmp_path / "unpacked")
    place = tmp_path / "unpacked" / "2026-05-31-1204-levee-north"
    subprocess.run(["sha256sum", "--check", "--quiet", "MANIFEST"], cwd=place, check=True)


@pytest.mark.parametrize("name", ["out", "out.zip"])
@pytest.mark.usefixtures("flights")
def test_export_never_overwrites_without_a_word(tmp_path, capsys, name):
    out = tmp_path / name
    words = ["sessions", "export", "2026-05", "--out", str(out)]
    assert cli.run(words) == 0
    capsys.readouterr()
    assert cli.run(words) == 2
    assert "add --replace" in capsys.readouterr().err
    assert cli.run(["sessions", "export", "2026-06", "--replace", "--out", str(out)]) == 0
    assert capsys.readouterr().out.startswith("Replaced ")
    text = (
        zipfile.ZipFile(out).read("2026-06-01-1204-levee-north/MANIFEST").decode()
        if name.endswith("zip")
        else (out / "MANIFEST").read_text()
    )
    assert text.startswith("# fieldcal.session/1 2026-06-01-1204-levee-north\n")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["flights", name]


@pytest.mark.usefixtures("flights")
def test_export_leaves_what_is_not_its_own(tmp_path, capsys):
    mine = tmp_path / "mine"
    mine.mkdir()
    (tmp_path / "mine.zip").write_text("my own")
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("MANIFEST", "of something else")
    export_module.export_session(SessionReader.open(library.find("2026-05")), tmp_path / "out")
    (tmp_path / "out" / "notes.txt").write_text("my own")
    (tmp_path / "link").symlink_to(tmp_path / "out")
    for name in ("mine", "mine.zip", "other.zip", "out", "link"):
        words = ["sessions", "export", "2026-05", "--replace", "--out", str(tmp_path / name)]
        assert cli.run(words) == 2, name
        assert "no export of a flight" in capsys.readouterr().err
    assert (tmp_path / "out" / "notes.txt").read_text() == "my own"
    inside = library.find("2026-05") / "out"
    assert cli.run(["sessions", "export", "2026-05", "--out", str(inside)]) == 2
    assert not inside.exists()


@pytest.mark.parametrize("name", ["out", "out.zip"])
@pytest.mark.usefixtures("flights")
def test_an_export_that_fails_leaves_the_old_one(tmp_path, monkeypatch, name):
    out = tmp_path / name
    with SessionReader.open(library.find("2026-05")) as session:
        export_module.export_session(session, out)
        before = {p: p.read_bytes() for p in [out, *out.rglob("*")] if p.is_file()}

        def full(_: Path) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(export_module, "_settle", full)
        with pytest.raises(OutputError, match="disk is full"):
            export_module.export_session(session, out, replace=True)
        with pytest.raises(OutputError, match="no such folder"):
            export_module.export_session(session, tmp_path / "none" / "out")
    assert {p: p.read_bytes() for p in [out, *out.rglob("*")] if p.is_file()} == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["flights", name]


@pytest.mark.usefixtures("flights")
def test_a_flight_under_way_is_exported_whole(tmp_path):
    with library.resume() as session:
        session.add_event(Event("x", Stamp(1, ClockName.UTC)))
        assert cli.run(["sessions", "export", "2026-06", "--out", str(tmp_path / "out")]) == 0
        session.add_event(Event("y", Stamp(2, ClockName.UTC)))
    with sqlite3.connect(tmp_path / "out" / DATABASE) as copy:
        assert [row[0] for row in copy.execute("SELECT kind FROM events")] == ["x"]

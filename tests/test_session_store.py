"""The record of a flight: what goes in comes out, nothing changes, and what fails says so."""

from __future__ import annotations

import json
import math
import os
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import result_factory
from disks import mounted
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from calib.errors import InputError, OutputError
from calib.report_json import report_dict
from daemon.session import schema
from daemon.session.database import DATABASE, LOCK, is_held
from daemon.session.reader import SessionReader
from daemon.session.rows import (
    ClockName,
    Event,
    Pair,
    Pairing,
    PhotoFile,
    Plan,
    SolutionRecord,
    Stamp,
    Trigger,
    VerdictRecord,
)
from daemon.session.store import Session, program_versions

START = datetime(2026, 5, 31, 12, 4, tzinfo=UTC)
AT = Stamp(12.5, ClockName.BOOT, 0.01)
SHA = "ab" * 32


class Ticking:
    """A clock that goes on by a second each time it is read."""

    def __init__(self) -> None:
        self.now = START

    def __call__(self) -> datetime:
        self.now += timedelta(seconds=1)
        return self.now


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    with Session.create(tmp_path / "flight", Ticking()) as made:
        yield made


def fill(session: Session) -> None:
    """One of everything, and two of what is paired."""
    session.add_plan(Plan("levee.plan", b"\x00\xffplan"))
    session.add_event(Event("link.up", AT, {"port": "udp", "ü": [1, None, 2.5]}))
    for n in (1, 2):
        session.add_trigger(Trigger(f"boot 1, {n}", Stamp(n, ClockName.GPS), n, 50.8, -0.14, 104.5, {"q": n}))
        session.add_photo(PhotoFile(Path(f"photos/{n}.jpg"), f"{n:064x}", n))
    session.add_pairing(Pairing((Pair(1, 2, 0.6, False),), 1, 2, {"offset_s": 1.5}))
    session.add_pairing(Pairing((Pair(1, 1, 0.999, True), Pair(2, 2, 0.99, True, {"x": 1})), 2, 2))
    session.add_solution(SolutionRecord(2, {"f_px": 2320.1}))
    report = report_dict(result_factory.build(points=50))
    session.add_verdict(VerdictRecord(report, 2, True, 1))


def everything(session: SessionReader) -> list[object]:
    return [
        session.flight(),
        session.plans(),
        session.events(),
        session.triggers(),
        session.photos(),
        session.pairing(1),
        session.pairing(),
        session.solutions(),
        session.verdicts(),
        session.provenance(),
        session.counts(),
    ]


def test_what_goes_in_comes_out(session: Session) -> None:
    fill(session)
    before = everything(session)
    session.close()
    with SessionReader.open(session.folder) as again:
        assert everything(again) == before
        again.verify()
        assert again.flight().created == START + timedelta(seconds=1)
        (plan,) = again.plans()
        assert plan.value == Plan("levee.plan", b"\x00\xffplan")
        assert plan.recorded == START + timedelta(seconds=3)
        (event,) = again.events("link.up")
        assert event.value.at == AT
        assert event.value.data == {"port": "udp", "ü": [1, None, 2.5]}
        newest, older = again.pairing(), again.pairing(1)
        assert newest is not None
        assert older is not None
        assert (newest.seq, newest.value.pairs[1]) == (2, Pair(2, 2, 0.99, True, {"x": 1}))
        assert older.value.pairs == (Pair(1, 2, 0.6, False),)
        assert again.pairing(3) is None
        verdict = again.latest_verdict()
        assert verdict is not None
        assert (verdict.value.verdict, verdict.value.final, verdict.value.solution) == ("REFLY", True, 1)
        assert again.triggers(after=1)[0].value.image_index == 2


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(kind=st.text(st.characters(exclude_categories=["Cs"])), data=st.dictionaries(st.text(), json_values))
def test_any_event_survives(session: Session, kind: str, data: dict[str, object]) -> None:
    made = session.add_event(Event(kind, AT, data))
    assert session.events(after=made.seq - 1) == (made,)


def test_undecodable_photo_names_survive(session: Session) -> None:
    path = Path(os.fsdecode(b"photos/\xff\xfe.jpg"))
    session.add_photo(PhotoFile(path, SHA, 5))
    assert session.photos()[0].value.path == path
    session.add_photo(PhotoFile(session.folder.absolute() / "a.jpg", SHA.upper(), 5))
    assert session.photos(after=1)[0].value == PhotoFile(Path("a.jpg"), SHA, 5)


def test_what_comes_again_is_recorded_once(session: Session) -> None:
    first = session.add_trigger(Trigger("boot 1, 7", AT, 7))
    assert session.add_trigger(Trigger("boot 1, 7", Stamp(99, ClockName.UTC))) == first
    photo = session.add_photo(PhotoFile(Path("a.jpg"), SHA, 5))
    assert session.add_photo(PhotoFile(Path("a.jpg"), SHA, 5)) == photo
    assert session.add_photo(PhotoFile(Path("a.jpg"), "cd" * 32, 6)).seq == 2
    assert (session.counts().triggers, session.counts().photos) == (1, 2)


@pytest.mark.parametrize("table", schema.APPEND_ONLY)
def test_nothing_is_changed_or_deleted_by_any_program(session: Session, table: str) -> None:
    fill(session)
    with sqlite3.connect(session.folder / DATABASE) as other:
        rows = other.execute(f"SELECT * FROM {table}").fetchall()
        assert rows
        column = other.execute(f"SELECT name FROM pragma_table_info('{table}') LIMIT 1").fetchone()[0]
        places = ", ".join("?" * len(rows[0]))
        for statement, values in (
            (f"UPDATE {table} SET {column} = {column}", ()),
            (f"DELETE FROM {table}", ()),
            (f"INSERT OR REPLACE INTO {table} VALUES ({places})", rows[0]),
        ):
            with pytest.raises(sqlite3.IntegrityError, match="append-only"):
                other.execute(statement, values)
        assert other.execute(f"SELECT * FROM {table}").fetchall() == rows


def test_other_keys_are_no_way_round(session: Session) -> None:
    fill(session)
    with sqlite3.connect(session.folder / DATABASE) as other:
        for statement in (
            "INSERT OR REPLACE INTO triggers SELECT 9, recorded_us, key, 0, clock, sigma_s, image_index, "
            "latitude_deg, longitude_deg, altitude_amsl_m, data FROM triggers WHERE seq = 1",
            "INSERT OR REPLACE INTO photos SELECT 9, 0, path, sha256, 1 FROM photos WHERE seq = 1",
            "INSERT OR REPLACE INTO pairs VALUES (2, 9, 1, 0.1, 0, '{}')",
        ):
            with pytest.raises(sqlite3.IntegrityError, match="append-only"):
                other.execute(statement)


def test_a_batch_is_all_or_nothing(session: Session) -> None:
    def interrupted() -> None:
        with session.batch():
            session.add_event(Event("a", AT))
            raise KeyError

    with pytest.raises(KeyError):
        interrupted()
    assert session.events() == ()
    with session.batch():
        session.add_event(Event("a", AT))
        with session.batch():
            session.add_event(Event("b", AT))
    assert [event.value.kind for event in session.events()] == ["a", "b"]


def test_a_failure_inside_a_batch_cannot_be_swallowed(session: Session) -> None:
    def careless() -> None:
        with session.batch():
            session.add_event(Event("a", AT))
            with pytest.raises(InputError):
                session.add_pairing(Pairing((Pair(5, 5, 0.5, False),), 0, 0))
            with pytest.raises(OutputError):
                session.add_event(Event("b", AT))

    with pytest.raises(OutputError):
        careless()
    assert session.counts().events == session.counts().pairings == 0
    session.add_event(Event("c", AT))
    assert session.counts().events == 1


def test_unfit_entries_are_refused_whole(session: Session) -> None:
    for refused in (
        lambda: session.add_pairing(Pairing((Pair(1, 1, 0.5, False),), 0, 0)),
        lambda: session.add_verdict(VerdictRecord({"schema": "fieldcal.check/1"}, 0)),
        lambda: session.add_photo(PhotoFile(Path("a.jpg"), "short", 1)),
    ):
        with pytest.raises(InputError):
            refused()
    with pytest.raises(ValueError, match="JSON"):
        session.add_event(Event("a", AT, {"x": math.nan}))
    counts = session.counts()
    assert counts.pairings == counts.verdicts == counts.photos == counts.events == 0


def test_threads_share_one_writer(session: Session) -> None:
    def write(number: int) -> None:
        for n in range(20):
            with session.batch():
                session.add_event(Event(f"{number}", AT, {"n": n}))
                session.add_event(Event(f"{number}", AT, {"n": n}))

    threads = [threading.Thread(target=write, args=(n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    kinds = [event.value.kind for event in session.events()]
    assert len(kinds) == 160
    assert kinds[::2] == kinds[1::2]


def test_one_writer_and_any_readers(session: Session) -> None:
    with pytest.raises(InputError, match=rf"held by process {os.getpid()}"):
        Session.resume(session.folder)
    script = "import sys, pathlib; from daemon.session.store import Session; "
    script += "Session.resume(pathlib.Path(sys.argv[1]))"
    done = subprocess.run(
        [sys.executable, "-c", script, str(session.folder)], capture_output=True, text=True, check=False
    )
    assert "InputError" in done.stderr
    assert f"held by process {os.getpid()}" in done.stderr
    assert is_held(session.folder)
    with SessionReader.open(session.folder) as reader:
        session.add_event(Event("a", AT))
        assert len(reader.events()) == 1
    session.close()
    session.close()
    assert not is_held(session.folder)
    Session.resume(session.folder).close()


def test_another_program_in_the_database_is_named(session: Session) -> None:
    session._connection.execute("PRAGMA busy_timeout = 50")
    other = sqlite3.connect(session.folder / DATABASE, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    with pytest.raises(InputError, match="Another process is writing"):
        session.add_event(Event("a", AT))
    other.execute("ROLLBACK")
    other.close()
    session.add_event(Event("a", AT))


def test_a_place_that_is_taken(session: Session, tmp_path: Path) -> None:
    before = sorted(tmp_path.iterdir())
    with pytest.raises(InputError, match="already"):
        Session.create(session.folder)
    assert sorted(tmp_path.iterdir()) == before


def test_provenance_names_no_machine(session: Session, tmp_path: Path) -> None:
    session.close()
    Session.resume(session.folder).close()
    with SessionReader.open(session.folder) as reader:
        found = [entry.value.versions for entry in reader.provenance()]
    assert found == [program_versions(), program_versions()]
    assert {"fieldcal", "python", "sqlite", "schema", "numpy"} <= set(found[0])
    text = json.dumps([dict(entry) for entry in found])
    assert os.uname().nodename not in text
    assert str(Path.home()) not in text
    assert str(tmp_path) not in text


# --- Schema versions -----------------------------------------------------------------------------


def test_a_newer_schema_is_one_sentence(session: Session) -> None:
    session._connection.execute("PRAGMA user_version = 7")
    session.close()
    for opened in (SessionReader.open, Session.resume):
        with pytest.raises(
            InputError, match=r"newer fieldcal \(schema 7, this one knows 1\); update"
        ) as found:
            opened(session.folder)
        assert "\n" not in str(found.value)


def test_an_older_schema_is_brought_up(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(session)
    before = everything(session)
    session.close()
    newer = (*schema.MIGRATIONS, ("ALTER TABLE plans ADD COLUMN note TEXT",))
    monkeypatch.setattr(schema, "MIGRATIONS", newer)
    content = (session.folder / DATABASE).read_bytes()
    with SessionReader.open(session.folder) as reader:
        assert everything(reader) == before
        assert schema.version_of(reader._connection) == 2
    assert (session.folder / DATABASE).read_bytes() == content
    with Session.resume(session.folder) as again:
        assert schema.version_of(again._connection) == 2
        assert everything(again)[:9] == before[:9]


def test_a_migration_that_fails_leaves_the_old_one(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(session)
    session.close()
    broken = ("ALTER TABLE plans ADD COLUMN note TEXT", "ALTER TABLE nothing ADD COLUMN note TEXT")
    with monkeypatch.context() as patch:
        patch.setattr(schema, "MIGRATIONS", (*schema.MIGRATIONS, broken))
        with pytest.raises(sqlite3.OperationalError):
            Session.resume(session.folder)
    with Session.resume(session.folder) as again:
        assert schema.version_of(again._connection) == 1
        assert again.counts().plans == 1


# --- Bad disks and bad files ---------------------------------------------------------------------


def test_what_is_no_record(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no flight's record"):
        SessionReader.open(tmp_path)
    (tmp_path / DATABASE).write_text("hello, this is certainly not a database " * 50)
    with pytest.raises(InputError, match="damaged"):
        Session.resume(tmp_path)
    (tmp_path / DATABASE).unlink()
    with sqlite3.connect(tmp_path / DATABASE) as other:
        other.execute("CREATE TABLE mine(x)")
    before = (tmp_path / DATABASE).read_bytes()
    with pytest.raises(InputError, match="not the record of a flight"):
        Session.resume(tmp_path)
    assert (tmp_path / DATABASE).read_bytes() == before
    assert not (tmp_path / LOCK).exists()


def _said_when_read(folder: Path) -> str | None:
    try:
        with SessionReader.open(folder) as reader:
            reader.verify()
    except InputError as error:
        return str(error)
    return None


def test_damage_is_said_in_one_sentence(session: Session) -> None:
    fill(session)
    session.close()
    path = session.folder / DATABASE
    whole = path.read_bytes()
    page = int.from_bytes(whole[16:18], "big")
    found = 0
    for start in range(page, len(whole), page):
        path.write_bytes(whole[:start] + b"\xa5" * page + whole[start + page :])
        said = _said_when_read(session.folder)
        if said is not None:
            assert "damaged" in said
            assert "\n" not in said
            found += 1
    assert found >= 0.9 * (len(whole) / page - 1)
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="damaged"):
        Session.resume(session.folder)
    assert not is_held(session.folder)


def _until_full(write: Callable[[int], object]) -> tuple[int, str]:
    """How many writes were acknowledged, and what was said then."""
    for kept in range(1000):
        try:
            write(kept)
        except OutputError as error:
            return kept, str(error)
    raise AssertionError("the disk never filled up")


def test_a_full_disk_takes_nothing_and_loses_nothing(session: Session) -> None:
    fill(session)
    session._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    pages = session._connection.execute("PRAGMA page_count").fetchone()[0]
    session._connection.execute(f"PRAGMA max_page_count = {pages + 3}")
    kept, said = _until_full(lambda n: session.add_event(Event("n", AT, {"x": "y" * 1000 + str(n)})))
    assert "disk is full" in said
    assert "\n" not in said
    assert 0 < kept < 100
    assert len(session.events("n")) == kept
    session.verify()
    session._connection.execute("PRAGMA max_page_count = 100000")
    session.add_event(Event("n", AT))
    assert len(session.events("n")) == kept + 1


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A real file system of one megabyte."""
    with mounted(tmp_path, 1) as disk:
        yield disk


def test_a_really_full_disk_and_then_a_read_only_one(small_disk: Path) -> None:
    folder = small_disk / "flight"
    session = Session.create(folder)
    kept, said = _until_full(lambda n: session.add_plan(Plan(f"{n}", os.urandom(30_000))))
    assert "disk is full" in said
    assert kept > 3
    names = [plan.value.name for plan in session.plans()]
    assert names == [str(n) for n in range(kept)]
    session.close()
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    with SessionReader.open(folder) as reader:
        assert [plan.value.name for plan in reader.plans()] == names
        reader.verify()
    with pytest.raises(OutputError, match="read-only"):
        Session.resume(folder)
    with pytest.raises(OutputError, match="read-only"):
        Session.create(small_disk / "other")

"""kill -9 and cut power: nothing acknowledged is lost, and what remains is sound."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import random
import shutil
import signal
import time
from pathlib import Path
from typing import Any

from session_child import write_until_killed

from daemon.session.database import DATABASE, is_held
from daemon.session.reader import SessionReader
from daemon.session.rows import ClockName, Event, Stamp
from daemon.session.store import Session

KILLS = 60
#: Kills of one flight before the next is begun.
_PER_FLIGHT = 15


def _killed_child(folder: Path, seed: int, context: Any) -> list[tuple[str, int, Any]]:
    """What a child acknowledged before it was killed at a random instant."""
    rng = random.Random(seed)
    ours, its = context.Pipe(duplex=False)
    child = context.Process(target=write_until_killed, args=(folder, seed, its))
    child.start()
    its.close()
    acknowledged: list[tuple[str, int, Any]] = []
    try:
        # Most are killed while writing, some while they still open the record.
        if rng.random() < 0.15:
            until = time.monotonic() + rng.random() * 0.1
        else:
            assert ours.poll(20), "the child wrote nothing"
            until = time.monotonic() + rng.random() * 0.1
        while (left := until - time.monotonic()) > 0:
            if ours.poll(left):
                acknowledged += json.loads(ours.recv_bytes())
    finally:
        os.kill(child.pid, signal.SIGKILL)
        child.join(60)
    assert child.exitcode == -signal.SIGKILL
    # What it still had sent is acknowledged, too; a message that the kill cut in two (OSError) is not.
    with contextlib.suppress(EOFError, OSError):
        while ours.poll(0):
            acknowledged += json.loads(ours.recv_bytes())
    ours.close()
    return acknowledged


def _content(session: SessionReader) -> dict[str, dict[int, Any]]:
    versions = [session.pairing(n + 1) for n in range(session.counts().pairings)]
    return {
        "events": {e.seq: e.value.data["token"] for e in session.events("test")},
        "triggers": {t.seq: t.value.key for t in session.triggers()},
        "photos": {p.seq: p.value.size_bytes for p in session.photos()},
        "plans": {p.seq: [p.value.name, p.value.content.hex()] for p in session.plans()},
        "solutions": {s.seq: s.value.data["token"] for s in session.solutions()},
        "pairings": {p.seq: [p.value.data["token"], len(p.value.pairs)] for p in versions if p is not None},
    }


def test_nothing_acknowledged_is_lost_by_kill_9(tmp_path: Path) -> None:
    # A server that has loaded everything and forks: a kill costs milliseconds, not a Python's start.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["daemon.session.store"])
    total = struck = 0
    expected: dict[tuple[str, int], Any] = {}
    for seed in range(KILLS):
        folder = tmp_path / f"flight-{seed // _PER_FLIGHT}"
        if not folder.exists():
            Session.create(folder).close()
            expected = {}
        acknowledged = _killed_child(folder, seed, context)
        struck += bool(acknowledged)
        for table, seq, token in acknowledged:
            assert (table, seq) not in expected, "a seq was given twice"
            expected[table, seq] = token
        total += len(acknowledged)
        assert not is_held(folder)
        with SessionReader.open(folder) as session:  # Reading comes first: it must do without a writer.
            session.verify()
            found = _content(session)
        lost = [key for key, token in expected.items() if found[key[0]].get(key[1]) != token]
        assert not lost, f"kill {seed} lost {lost}"
        # Besides, at most the one write that was under way, and without gaps.
        for table, rows in found.items():
            assert sorted(rows) == list(range(1, len(rows) + 1)), table
        unsaid = {(table, seq): token for table, rows in found.items() for seq, token in rows.items()}
        extra = {key: token for key, token in unsaid.items() if key not in expected}
        assert len(extra) <= 6
        expected |= extra
    print(f"{KILLS} kills, {struck} while writing, {total} rows acknowledged, none lost")
    assert struck >= 0.7 * KILLS
    assert total > 5 * KILLS


def test_a_log_cut_anywhere_leaves_a_sound_beginning(tmp_path: Path) -> None:
    """What a power cut may leave of the unsynced end: the rows before it are whole, in order."""
    rng = random.Random(5)
    folder = tmp_path / "flight"
    with Session.create(folder) as session:
        sizes = []
        log = folder / f"{DATABASE}-wal"
        for number in range(30):
            data = {"n": number, "noise": "x" * rng.choice([5, 900, 9000])}
            session.add_event(Event("n", Stamp(number, ClockName.UTC), data))
            sizes.append(log.stat().st_size)
        whole = log.read_bytes()
        database = (folder / DATABASE).read_bytes()
    for trial in range(40):
        cut = rng.randrange(len(whole))
        place = tmp_path / f"cut-{trial}"
        place.mkdir()
        (place / DATABASE).write_bytes(database)
        torn = bytes(rng.randrange(256) for _ in range(100)) if trial % 2 else b""
        (place / f"{DATABASE}-wal").write_bytes(whole[:cut] + torn)
        least = sum(size <= cut for size in sizes)
        with SessionReader.open(place) as cut_off:
            cut_off.verify()
            kept = [event.value.data["n"] for event in cut_off.events()]
        assert kept == list(range(len(kept)))
        assert len(kept) >= least
        with Session.resume(place) as again:
            assert again.add_event(Event("n", Stamp(0, ClockName.UTC))).seq == len(kept) + 1
        shutil.rmtree(place)


def test_every_commit_is_synced(tmp_path: Path) -> None:
    with Session.create(tmp_path / "flight") as session:
        setting = {
            name: session._connection.execute(f"PRAGMA {name}").fetchone()[0]
            for name in ("journal_mode", "synchronous", "foreign_keys")
        }
    assert setting == {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1}

"""Reading a flight's record, also while another process writes it."""

from __future__ import annotations

import json
import os
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, TypeVar

from daemon.closing import Closing
from daemon.session.database import connect_reader, damaged, database_errors
from daemon.session.rows import (
    ClockName,
    Counts,
    Event,
    Flight,
    Pair,
    Pairing,
    PhotoFile,
    Plan,
    Provenance,
    Recorded,
    SolutionRecord,
    Stamp,
    Trigger,
    VerdictRecord,
    from_microseconds,
)

T = TypeVar("T")


class SessionReader(Closing):
    """The record of one flight, read-only. Each call sees one consistent state, the newest.

    Every method raises InputError for a damaged database and OutputError for a failing disk.
    May be used from several threads.
    """

    def __init__(self, folder: Path, connection: sqlite3.Connection) -> None:
        self.folder = folder
        self._connection = connection
        self._mutex = threading.RLock()

    @classmethod
    def open(cls, folder: Path) -> SessionReader:
        """Open the flight in ``folder``.

        Raises:
            InputError: no record there, not a record, damaged, of a newer fieldcal.
            OutputError: it cannot be opened on this disk.
        """
        return cls(folder, connect_reader(folder))

    def close(self) -> None:
        with self._mutex:
            self._connection.close()

    def flight(self) -> Flight:
        (row,) = self._rows("SELECT name, recorded_us FROM flight")
        return Flight(row[0], from_microseconds(row[1]))

    def plans(self) -> tuple[Recorded[Plan], ...]:
        """All plans, oldest first."""
        rows = self._rows("SELECT seq, recorded_us, name, content FROM plans ORDER BY seq")
        return tuple(_recorded(row, Plan(row[2], bytes(row[3]))) for row in rows)

    def events(self, kind: str | None = None, after: int = 0) -> tuple[Recorded[Event], ...]:
        """Events of one ``kind`` (None: all) with a seq above ``after``, oldest first."""
        rows = self._rows(
            "SELECT seq, recorded_us, kind, time_s, clock, sigma_s, data FROM events "
            "WHERE seq > ? AND (? IS NULL OR kind = ?) ORDER BY seq",
            (after, kind, kind),
        )
        return tuple(_recorded(row, Event(row[2], _stamp(row[3:6]), json.loads(row[6]))) for row in rows)

    def triggers(self, after: int = 0) -> tuple[Recorded[Trigger], ...]:
        """Triggers with a seq above ``after``, in the order in which they were recorded."""
        rows = self._rows(
            "SELECT seq, recorded_us, key, time_s, clock, sigma_s, image_index, latitude_deg, "
            "longitude_deg, altitude_amsl_m, data FROM triggers WHERE seq > ? ORDER BY seq",
            (after,),
        )
        return tuple(
            _recorded(
                row, Trigger(row[2], _stamp(row[3:6]), row[6], row[7], row[8], row[9], json.loads(row[10]))
            )
            for row in rows
        )

    def photos(self, after: int = 0) -> tuple[Recorded[PhotoFile], ...]:
        """Photos with a seq above ``after``, in the order of arrival (``recorded``)."""
        rows = self._rows(
            "SELECT seq, recorded_us, path, sha256, size_bytes FROM photos WHERE seq > ? ORDER BY seq",
            (after,),
        )
        return tuple(_recorded(row, PhotoFile(_path(row[2]), row[3], row[4])) for row in rows)

    def pairing(self, version: int | None = None) -> Recorded[Pairing] | None:
        """The pairing of that version (None: the newest); None where there is none."""
        # Pairs of a version are written in one transaction with it, so two queries see the same.
        heads = self._rows(
            "SELECT seq, recorded_us, photos, triggers, data FROM pairings "
            "WHERE ? IS NULL OR seq = ? ORDER BY seq DESC LIMIT 1",
            (version, version),
        )
        if not heads:
            return None
        (head,) = heads
        rows = self._rows(
            "SELECT photo, trigger_seq, probability, sure, data FROM pairs WHERE pairing = ? ORDER BY photo",
            (head[0],),
        )
        pairs = tuple(Pair(row[0], row[1], row[2], bool(row[3]), json.loads(row[4])) for row in rows)
        return _recorded(head, Pairing(pairs, head[2], head[3], json.loads(head[4])))

    def solutions(self, after: int = 0) -> tuple[Recorded[SolutionRecord], ...]:
        """Solutions with a seq above ``after``, oldest first."""
        rows = self._rows(
            "SELECT seq, recorded_us, photos, data FROM solutions WHERE seq > ? ORDER BY seq", (after,)
        )
        return tuple(_recorded(row, SolutionRecord(row[2], json.loads(row[3]))) for row in rows)

    def verdicts(self, after: int = 0) -> tuple[Recorded[VerdictRecord], ...]:
        """Verdicts with a seq above ``after``, oldest first."""
        rows = self._rows(f"{_VERDICTS} WHERE seq > ? ORDER BY seq", (after,))
        return tuple(_recorded(row, _verdict(row)) for row in rows)

    def latest_verdict(self) -> Recorded[VerdictRecord] | None:
        rows = self._rows(f"{_VERDICTS} ORDER BY seq DESC LIMIT 1")
        return _recorded(rows[0], _verdict(rows[0])) if rows else None

    def provenance(self) -> tuple[Recorded[Provenance], ...]:
        """One entry for the beginning and one for every resumption."""
        rows = self._rows("SELECT seq, recorded_us, data FROM provenance ORDER BY seq")
        return tuple(_recorded(row, Provenance(json.loads(row[2]))) for row in rows)

    def counts(self) -> Counts:
        """How much of everything there is, all at one instant."""
        tables = ("plans", "events", "triggers", "photos", "pairings", "solutions", "verdicts")
        (row,) = self._rows("SELECT " + ", ".join(f"(SELECT count(*) FROM {name})" for name in tables))
        return Counts(*row)

    def verify(self) -> None:
        """Read everything and check it.

        Raises:
            InputError: the database is damaged.
        """
        found = [row[0] for row in self._rows("PRAGMA integrity_check(1)")]
        if found != ["ok"]:
            raise damaged(self.folder, found[0])
        if self._rows("PRAGMA foreign_key_check"):
            raise damaged(self.folder, "entries refer to others that are missing")

    def backup(self, target: Path) -> None:
        """Copy one consistent state into the new file ``target``: a single file, checked, on the disk.

        Raises:
            OutputError: not writable, disk full. InputError: the record is damaged.
        """
        with self._using(), closing(sqlite3.connect(target, isolation_level=None)) as copy:
            self._connection.backup(copy)
            # A copy carries the mark of its write-ahead log; a file that travels must be whole alone.
            copy.execute("PRAGMA journal_mode = DELETE")
            (found,) = copy.execute("PRAGMA integrity_check(1)").fetchone()
        if found != "ok":
            raise damaged(self.folder, found)

    def _rows(self, statement: str, values: tuple[Any, ...] = ()) -> list[Any]:
        with self._using():
            return self._connection.execute(statement, values).fetchall()

    @contextmanager
    def _using(self) -> Iterator[None]:
        with self._mutex, database_errors(self.folder):
            yield


_VERDICTS = "SELECT seq, recorded_us, photos, final, solution, data FROM verdicts"


def _verdict(row: Any) -> VerdictRecord:
    return VerdictRecord(json.loads(row[5]), row[2], bool(row[3]), row[4])


def _recorded(row: Any, value: T) -> Recorded[T]:
    return Recorded(row[0], from_microseconds(row[1]), value)


def _stamp(row: Any) -> Stamp:
    return Stamp(row[0], ClockName(row[1]), row[2])


def _path(stored: bytes) -> Path:
    return Path(os.fsdecode(stored))

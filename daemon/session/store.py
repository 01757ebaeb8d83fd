"""Writing a flight's record. What a method has returned for is on the disk: kill -9 cannot take it."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from calib.errors import InputError, OutputError
from calib.files import output_errors
from calib.report_json import CheckReport
from daemon.session.database import FlightLock, connect_writer, database_errors
from daemon.session.reader import SessionReader
from daemon.session.rows import (
    Clock,
    Event,
    Json,
    Pairing,
    PhotoFile,
    Plan,
    Recorded,
    SolutionRecord,
    Stamp,
    T,
    Trigger,
    VerdictRecord,
    from_microseconds,
    microseconds,
    system_clock,
)
from daemon.session.schema import newest_version

#: Whose versions can change a result.
_PROGRAMS = ("fieldcal", "numpy", "scipy", "opencv-contrib-python-headless")
_STAGE = ".fieldcal-"


class Session(SessionReader):
    """The record of one flight, held for writing by this process.

    Every ``add_*`` has its row on the disk when it returns (a write-ahead log, synced each time), and
    has recorded nothing when it raises. Besides what :class:`SessionReader` raises:
    OutputError: disk full, read-only. InputError: a reference to something that is not recorded.
    ValueError: data that is no JSON, or a clock without a time zone.
    """

    def __init__(self, folder: Path, connection: sqlite3.Connection, lock: FlightLock, clock: Clock) -> None:
        super().__init__(folder, connection)
        self._lock = lock
        self._clock = clock
        self._depth = 0
        self._broken = False

    @classmethod
    def create(cls, folder: Path, clock: Clock = system_clock) -> Session:
        """Begin the record of a flight in ``folder``, which comes into being whole or not at all.

        Raises:
            InputError: there is something at ``folder`` already. OutputError: not writable, disk full.
        """
        with output_errors(folder):
            folder.parent.mkdir(parents=True, exist_ok=True)
            stage = Path(tempfile.mkdtemp(prefix=_STAGE, dir=folder.parent))
        try:
            with output_errors(folder):
                stage.chmod(0o755)
            with database_errors(folder):
                connection = connect_writer(stage)
                try:
                    with connection:
                        connection.execute("BEGIN IMMEDIATE")
                        row = (microseconds(clock()), folder.name)
                        connection.execute("INSERT INTO flight VALUES (1, ?, ?)", row)
                finally:
                    connection.close()
            with output_errors(folder):
                if folder.exists() or folder.is_symlink():
                    raise InputError(f"There is something at {folder} already; choose another name.")
                stage.rename(folder)
                for changed in (folder, folder.parent):
                    _sync_folder(changed)
        except BaseException:
            shutil.rmtree(stage, ignore_errors=True)
            raise
        return cls.resume(folder, clock)

    @classmethod
    def resume(cls, folder: Path, clock: Clock = system_clock) -> Session:
        """Go on with the flight in ``folder``; an older schema is brought up to date.

        Raises:
            InputError: no record there, damaged, of a newer fieldcal, or held by another process.
            OutputError: not writable.
        """
        with SessionReader.open(folder):
            pass  # What is not a record must not be given a lock file, let alone be written.
        lock = FlightLock(folder)
        try:
            session = cls(folder, connect_writer(folder), lock, clock)
        except BaseException:
            lock.release()
            raise
        try:
            session._insert("provenance", {"data": _json(program_versions())})
        except BaseException:
            session.close()
            raise
        return session

    def close(self) -> None:
        """Let the flight go. Nothing depends on it: all that was acknowledged is on the disk already."""
        try:
            super().close()
        finally:
            self._lock.release()

    @contextmanager
    def batch(self) -> Iterator[None]:
        """Make all writes of the block one: acknowledged at its end, or none of them recorded.

        Other threads wait meanwhile. Raises what the writes raise.
        """
        with self._using():
            if self._depth == 0:
                self._broken = False
                self._connection.execute("BEGIN IMMEDIATE")
            self._depth += 1
            try:
                yield
                if self._broken:
                    raise OutputError(f"Part of an entry could not be written into {self.folder}.")
                if self._depth == 1:
                    self._connection.execute("COMMIT")
            except BaseException:
                self._broken = True
                if self._depth == 1 and self._connection.in_transaction:
                    with suppress(sqlite3.Error):
                        self._connection.execute("ROLLBACK")
                raise
            finally:
                self._depth -= 1

    def add_plan(self, plan: Plan) -> Recorded[Plan]:
        """Keep a mission file as it was sent."""
        return self._add("plans", plan, {"name": plan.name, "content": plan.content})

    def add_event(self, event: Event) -> Recorded[Event]:
        return self._add("events", event, {"kind": event.kind, **_stamp(event.at), "data": _json(event.data)})

    def add_trigger(self, trigger: Trigger) -> Recorded[Trigger]:
        """Record an exposure once: a key that is known already gives the first record of it back."""
        with self.batch():
            known = self._rows("SELECT seq FROM triggers WHERE key = ?", (trigger.key,))
            if known:
                return self.triggers(after=known[0][0] - 1)[0]
            return self._add(
                "triggers",
                trigger,
                {
                    "key": trigger.key,
                    **_stamp(trigger.at),
                    "image_index": trigger.image_index,
                    "latitude_deg": trigger.latitude_deg,
                    "longitude_deg": trigger.longitude_deg,
                    "altitude_amsl_m": trigger.altitude_amsl_m,
                    "data": _json(trigger.data),
                },
            )

    def add_photo(self, photo: PhotoFile) -> Recorded[PhotoFile]:
        """Record that a photo arrived; the same file with the same content is recorded once."""
        path = photo.path
        if path.is_absolute() and path.is_relative_to(self.folder.absolute()):
            path = path.relative_to(self.folder.absolute())
        photo = PhotoFile(path, photo.sha256.lower(), photo.size_bytes)
        stored = os.fsencode(path)
        with self.batch():
            known = self._rows("SELECT seq FROM photos WHERE path = ? AND sha256 = ?", (stored, photo.sha256))
            if known:
                return self.photos(after=known[0][0] - 1)[0]
            values = {"path": stored, "sha256": photo.sha256, "size_bytes": photo.size_bytes}
            return self._add("photos", photo, values)

    def add_pairing(self, pairing: Pairing) -> Recorded[Pairing]:
        """Record all pairs anew as the next version, whole; older versions stay."""
        head = {"photos": pairing.photos, "triggers": pairing.triggers, "data": _json(pairing.data)}
        with self.batch():
            recorded = self._add("pairings", pairing, head)
            rows = [
                (recorded.seq, pair.photo, pair.trigger, pair.probability, pair.sure, _json(pair.data))
                for pair in pairing.pairs
            ]
            try:
                self._connection.executemany("INSERT INTO pairs VALUES (?, ?, ?, ?, ?, ?)", rows)
            except sqlite3.Error:
                self._broken = True
                raise
            return recorded

    def add_solution(self, solution: SolutionRecord) -> Recorded[SolutionRecord]:
        return self._add("solutions", solution, {"photos": solution.photos, "data": _json(solution.data)})

    def add_verdict(self, verdict: VerdictRecord) -> Recorded[VerdictRecord]:
        """Record a verdict.

        Raises:
            InputError: also when the report is not of schema ``fieldcal.check/1``.
        """
        try:
            CheckReport.model_validate(dict(verdict.report))
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(map(str, first["loc"]))
            raise InputError(f"This is no report of fieldcal.check/1: {place}: {first['msg']}.") from error
        values = {
            "photos": verdict.photos,
            "final": int(verdict.final),
            "solution": verdict.solution,
            "data": _json(verdict.report),
        }
        return self._add("verdicts", verdict, values)

    def _add(self, table: str, value: T, values: dict[str, Any]) -> Recorded[T]:
        seq, time_us = self._insert(table, values)
        return Recorded(seq, from_microseconds(time_us), value)

    def _insert(self, table: str, values: dict[str, Any]) -> tuple[int, int]:
        row = {"recorded_us": microseconds(self._clock()), **values}
        names, places = ", ".join(row), ", ".join("?" * len(row))
        with self.batch():
            if self._broken:
                raise OutputError(f"Part of an entry could not be written into {self.folder}.")
            try:
                cursor = self._connection.execute(
                    f"INSERT INTO {table}({names}) VALUES ({places})", tuple(row.values())
                )
            except sqlite3.Error:
                self._broken = True  # SQLite may have undone all of the batch by itself.
                raise
            seq = cursor.lastrowid
            assert seq is not None
            return seq, row["recorded_us"]


def program_versions() -> dict[str, str]:
    """Versions of what can change a result, and of the record itself; no machine, user or place."""
    versions = {"python": ".".join(map(str, sys.version_info[:3])), "sqlite": sqlite3.sqlite_version}
    for name in _PROGRAMS:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions | {"schema": str(newest_version())}


def _stamp(at: Stamp) -> dict[str, Any]:
    return {"time_s": at.time_s, "clock": at.clock.value, "sigma_s": at.sigma_s}


def _json(data: Json) -> str:
    # ASCII, so that undecodable bytes of file names (lone surrogates) survive.
    return json.dumps(dict(data), allow_nan=False, sort_keys=True)


def _sync_folder(folder: Path) -> None:
    """Have the names in ``folder`` on the disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)

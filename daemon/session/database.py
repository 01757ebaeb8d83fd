"""Opening a flight's database, holding it for one writer, and SQLite's errors in one sentence."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

from calib.errors import InputError, OutputError
from calib.files import output_errors
from daemon.session import schema

DATABASE, LOCK = "session.sqlite", "session.lock"
#: Somebody who only looks whether a flight is held does so for an instant; a writer waits that out.
_LOCK_PATIENCE_S = 1.0
_BUSY_S = 5.0
#: Older SQLite does not know strict tables.
_OLDEST_SQLITE = (3, 37, 0)


@contextmanager
def database_errors(folder: Path) -> Iterator[None]:
    """Turns SQLite's errors about the flight in ``folder`` into ours.

    Raises:
        OutputError: disk full, read-only or failing. InputError: damaged, not ours, held by another
        process, or a row that refers to nothing.
    """
    try:
        yield
    except sqlite3.Error as error:
        _explain(folder, error)


def _explain(folder: Path, error: sqlite3.Error) -> NoReturn:
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    where = f"the record of flight {folder.name} ({folder})"
    if code == sqlite3.SQLITE_FULL:
        raise OutputError(
            f"The disk is full: the last entry was not written into {where}; what was there is safe, "
            "free some space."
        ) from error
    if code in (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_PERM, sqlite3.SQLITE_CANTOPEN):
        raise OutputError(f"Cannot open {where} here: the disk is read-only or not yours.") from error
    if code == sqlite3.SQLITE_IOERR:
        raise OutputError(f"The disk fails at {where} ({error}): copy the folder elsewhere.") from error
    if code in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
        raise damaged(folder, str(error)) from error
    if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
        raise InputError(f"Another process is writing {where}; try again when it has ended.") from error
    if code == sqlite3.SQLITE_CONSTRAINT:
        raise InputError(f"An entry does not fit into {where}: {error}.") from error
    raise error


def damaged(folder: Path, detail: str) -> InputError:
    """The error for a database that cannot be trusted any more."""
    first = detail.splitlines()[0] if detail else "no detail"
    return InputError(
        f"The record of flight {folder.name} ({folder}) is damaged ({first}): copy the folder as it is "
        "before anything else; the photos themselves are not in it."
    )


class FlightLock:
    """Holds a flight for this process; the kernel lets go when the process ends, however it ends.

    Raises:
        InputError: another process, or another part of this one, holds it. OutputError: not writable.
    """

    def __init__(self, folder: Path) -> None:
        with output_errors(folder / LOCK):
            self._descriptor = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            try:
                self._take(folder)
                os.ftruncate(self._descriptor, 0)
                # Only for the sentence that the next one reads; a full disk must not keep us from resuming.
                with contextlib.suppress(OSError):
                    os.pwrite(self._descriptor, f"{os.getpid()}\n".encode(), 0)
            except BaseException:
                os.close(self._descriptor)
                raise

    def _take(self, folder: Path) -> None:
        until = time.monotonic() + _LOCK_PATIENCE_S
        while True:
            try:
                fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            except OSError as error:
                if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                    raise
            if time.monotonic() > until:
                holder = os.pread(self._descriptor, 20, 0).decode("ascii", "replace").strip()
                who = f"process {holder}" if holder.isdigit() else "another process"
                raise InputError(
                    f"Flight {folder.name} is held by {who}; end that first, or only read it meanwhile."
                )
            time.sleep(0.02)

    def release(self) -> None:
        """Let go; more than once does no harm."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def is_held(folder: Path) -> bool:
    """Whether a process is writing the flight in ``folder`` now."""
    try:
        descriptor = os.open(folder / LOCK, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False


def connect_writer(folder: Path, path: Path | None = None) -> sqlite3.Connection:
    """Open for writing, migrated, every commit on the disk when it returns; the flight must be held.

    Raises:
        OutputError, InputError: as :func:`database_errors`; a newer schema.
    """
    _require_sqlite()
    path = path or folder / DATABASE
    with database_errors(folder):
        connection = _connect(path, "rwc")
        try:
            if schema.version_of(connection):
                _check_ours(connection, folder)
            mode = connection.execute("PRAGMA journal_mode = WAL").fetchone()[0]
            if mode != "wal":
                raise OutputError(
                    f"{folder} is on a disk that cannot keep a flight's record (no write-ahead log); "
                    "choose another place."
                )
            for pragma in ("synchronous = FULL", "fullfsync = ON", "foreign_keys = ON"):
                connection.execute(f"PRAGMA {pragma}")
            if schema.version_of(connection) < schema.newest_version():
                schema.migrate(connection)
            _quick_check(connection, folder)
        except BaseException:
            connection.close()
            raise
    return connection


def connect_reader(folder: Path) -> sqlite3.Connection:
    """Open for reading, beside a writer if there is one; an older schema is brought up in memory only.

    Raises:
        OutputError, InputError: as :func:`database_errors`; no record there; a newer schema.
    """
    _require_sqlite()
    path = folder / DATABASE
    if not path.is_file():
        raise InputError(f"There is no flight's record in {folder}.")
    with database_errors(folder):
        connection = _open_reading(path)
        try:
            _check_ours(connection, folder)
            if schema.version_of(connection) < schema.newest_version():
                copy = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
                connection.backup(copy)
                connection.close()
                connection = copy
                schema.migrate(connection)
        except BaseException:
            connection.close()
            raise
    return connection


def _open_reading(path: Path) -> sqlite3.Connection:
    connection = _connect(path, "ro")
    try:
        schema.version_of(connection)
    except sqlite3.OperationalError:
        # A read-only disk has no place for the shared memory of a write-ahead log; without a log
        # none is needed.
        connection.close()
        log = path.with_name(path.name + "-wal")
        if log.exists() and log.stat().st_size:
            raise
        return _connect(path, "ro&immutable=1")
    return connection


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    # A URI that is percent-encoded: a folder may be named with ? or #.
    uri = f"{path.absolute().as_uri()}?mode={mode}"
    connection = sqlite3.connect(
        uri, uri=True, isolation_level=None, check_same_thread=False, timeout=_BUSY_S
    )
    connection.execute("PRAGMA cell_size_check = ON")
    return connection


def _check_ours(connection: sqlite3.Connection, folder: Path) -> None:
    version = schema.version_of(connection)
    owner = connection.execute("PRAGMA application_id").fetchone()[0]
    if version == 0 or owner != schema.APPLICATION_ID:
        raise InputError(f"{folder / DATABASE} is not the record of a flight.")
    if version > schema.newest_version():
        raise InputError(
            f"Flight {folder.name} was recorded by a newer fieldcal (schema {version}, this one knows "
            f"{schema.newest_version()}); update fieldcal to open it."
        )


def _quick_check(connection: sqlite3.Connection, folder: Path) -> None:
    (found,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    if found != "ok":
        raise damaged(folder, found)


def _require_sqlite() -> None:
    if sqlite3.sqlite_version_info < _OLDEST_SQLITE:
        raise InputError(
            f"SQLite {sqlite3.sqlite_version} is too old for flights' records; "
            f"{'.'.join(map(str, _OLDEST_SQLITE))} or newer is needed."
        )

"""Tables of a flight's database, their guards, and how older databases become newer ones.

Nothing is ever changed or deleted: SQL triggers refuse UPDATE, DELETE and INSERT OR REPLACE, also to
other programs that open the file.
"""

from __future__ import annotations

import sqlite3

#: "FCAL" in SQLite's header: says whose database it is.
APPLICATION_ID = 0x4643414C

_TABLES = """
CREATE TABLE flight(
  id INTEGER PRIMARY KEY CHECK (id = 1), recorded_us INTEGER NOT NULL, name TEXT NOT NULL) STRICT;
CREATE TABLE provenance(
  seq INTEGER PRIMARY KEY, recorded_us INTEGER NOT NULL, data TEXT NOT NULL CHECK (json_valid(data))) STRICT;
CREATE TABLE plans(
  seq INTEGER PRIMARY KEY, recorded_us INTEGER NOT NULL, name TEXT NOT NULL, content BLOB NOT NULL) STRICT;
CREATE TABLE events(
  seq INTEGER PRIMARY KEY, recorded_us INTEGER NOT NULL, time_s REAL NOT NULL, clock TEXT NOT NULL,
  sigma_s REAL, kind TEXT NOT NULL, data TEXT NOT NULL CHECK (json_valid(data))) STRICT;
CREATE TABLE triggers(
  seq INTEGER PRIMARY KEY, recorded_us INTEGER NOT NULL, key TEXT NOT NULL UNIQUE, time_s REAL NOT NULL,
  clock TEXT NOT NULL, sigma_s REAL, image_index INTEGER, latitude_deg REAL, longitude_deg REAL,
  altitude_amsl_m REAL, data TEXT NOT NULL CHECK (json_valid(data))) STRICT;
CREATE TABLE photos(
  seq INTEGER PRIMARY KEY, recorded_us INTEGER NOT NULL, path BLOB NOT NULL,
  sha256 TEXT NOT NULL CHECK (length(sha256) = 64), size_bytes INTEGER NOT NULL CHECK (size_bytes >= 0),
  UNIQUE (path, sha256)) STRICT;
CREATE TABLE pairings(
  seq INTEGER PRIMARY KEY, recorded_us INTEGER NOT NULL, photos INTEGER NOT NULL, triggers INTEGER NOT NULL,
  data TEXT NOT NULL CHECK (json_valid(data))) STRICT;
CREATE TABLE pairs(
  pairing INTEGER NOT NULL REFERENCES pairings(seq), photo INTEGER NOT NULL REFERENCES photos(seq),
  trigger_seq INTEGER NOT NULL REFERENCES triggers(seq),
  probability REAL NOT NULL CHECK (probability BETWEEN 0 AND 1), sure INTEGER NOT NULL CHECK (sure IN (0, 1)),
  data TEXT NOT NULL CHECK (json_valid(data)),
  PRIMARY KEY (pairing, photo), UNIQUE (pairing, trigger_seq)) STRICT, WITHOUT ROWID;
CREATE TABLE solutions(
  seq INTEGER PRIMARY KEY, recorded_us INTEGER NOT NULL, photos INTEGER NOT NULL,
  data TEXT NOT NULL CHECK (json_valid(data))) STRICT;
CREATE TABLE verdicts(
  seq INTEGER PRIMARY KEY, recorded_us INTEGER NOT NULL, photos INTEGER NOT NULL,
  final INTEGER NOT NULL CHECK (final IN (0, 1)), solution INTEGER REFERENCES solutions(seq),
  data TEXT NOT NULL CHECK (json_valid(data))) STRICT;
CREATE INDEX events_by_kind ON events(kind, seq);
"""

#: Table -> when a new row would take the place of an old one.
_SAME = {
    "flight": "id = NEW.id",
    "triggers": "seq = NEW.seq OR key = NEW.key",
    "photos": "seq = NEW.seq OR (path = NEW.path AND sha256 = NEW.sha256)",
    "pairs": "pairing = NEW.pairing AND (photo = NEW.photo OR trigger_seq = NEW.trigger_seq)",
    **dict.fromkeys(("provenance", "plans", "events", "pairings", "solutions", "verdicts"), "seq = NEW.seq"),
}
APPEND_ONLY = tuple(sorted(_SAME))


def _guards(table: str, same: str) -> tuple[str, ...]:
    refuse = f"BEGIN SELECT RAISE(ABORT, '{table} is append-only'); END"
    return (
        f"CREATE TRIGGER {table}_no_update BEFORE UPDATE ON {table} {refuse}",
        f"CREATE TRIGGER {table}_no_delete BEFORE DELETE ON {table} {refuse}",
        f"CREATE TRIGGER {table}_no_replace BEFORE INSERT ON {table} "
        f"WHEN EXISTS (SELECT 1 FROM {table} WHERE {same}) {refuse}",
    )


_VERSION_1 = (
    *(text.strip() for text in _TABLES.split(";") if text.strip()),
    *(guard for table, same in _SAME.items() for guard in _guards(table, same)),
)
#: Statements that lead from version n to n + 1, in order; never edited once released.
MIGRATIONS: tuple[tuple[str, ...], ...] = (_VERSION_1,)


def newest_version() -> int:
    """The schema version that this program writes."""
    return len(MIGRATIONS)


def version_of(connection: sqlite3.Connection) -> int:
    """The schema version of an open database; 0: nothing in it yet."""
    return int(connection.execute("PRAGMA user_version").fetchone()[0])


def migrate(connection: sqlite3.Connection) -> None:
    """Bring the database to :func:`newest_version`, all of it or nothing; no transaction may be open.

    Raises:
        sqlite3.Error: it cannot be written; the database is as it was.
    """
    connection.execute("BEGIN IMMEDIATE")
    try:
        for statements in MIGRATIONS[version_of(connection) :]:
            for statement in statements:
                connection.execute(statement)
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {newest_version()}")
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:
            connection.execute("ROLLBACK")
        raise

"""From flight to flight in one folder: ``fieldcal run --again``, as the service runs it.

A flight that is over leaves a list of the files that were in the folder then; the next one passes them over.
"""

from __future__ import annotations

from pathlib import Path

from daemon.capture.hot_folder import Marks, marks
from daemon.flight import STARTED, Source
from daemon.session.library import list_sessions, sessions_folder
from daemon.session.reader import SessionReader
from daemon.session.rows import ClockName, Event, Stamp, system_clock
from daemon.session.store import Session

FILES = "run.files"


def unended(folder: Path | None, source: Source = "folder") -> str | None:
    """The newest flight of this folder, or of another source, that was not ended and that nobody is writing,
    by name."""
    for summary in list_sessions()[0]:
        if summary.unfinished.ended or summary.held:
            continue
        with SessionReader.open(sessions_folder() / summary.name) as session:
            began = session.events(STARTED)
        if not began or began[-1].value.data.get("source", "folder") != source:
            continue
        if folder is None or began[-1].value.data.get("folder") == str(folder.absolute()):
            return summary.name
    return None


def earlier(folder: Path) -> Marks:
    """The files that were in the folder when its last flight ended, and stay as they were."""
    for summary in list_sessions()[0]:
        if not summary.unfinished.ended:
            continue
        with SessionReader.open(sessions_folder() / summary.name) as session:
            for event in reversed(session.events(FILES)):
                if event.value.data.get("folder") == str(folder.absolute()):
                    return {
                        folder.absolute() / name: (int(size), int(changed_ns))
                        for name, (size, changed_ns) in event.value.data["files"].items()
                    }
    return {}


def leave_files(session: Session, folder: Path) -> None:
    """Record what is in the folder, just before a flight is concluded.

    Raises:
        FieldcalError: the folder cannot be read, or the record not written.
    """
    there = folder.absolute()
    files = {str(path.relative_to(there)): list(mark) for path, mark in marks(folder).items()}
    session.add_event(
        Event(FILES, Stamp(system_clock().timestamp(), ClockName.UTC), {"folder": str(there), "files": files})
    )

"""Where flights live, how they are found by name, and what a flight still lacks."""

from __future__ import annotations

import difflib
import os
import re
import unicodedata
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import platformdirs

from calib.errors import FieldcalError, InputError, OutputError
from calib.files import output_errors
from calib.findings import Verdict
from daemon.session.database import DATABASE, is_held
from daemon.session.reader import SessionReader
from daemon.session.rows import Clock, ClockName, Counts, Event, Stamp, system_clock
from daemon.session.store import Session

SESSIONS_VARIABLE = "FIELDCAL_SESSIONS"
#: The event that ends a flight; a flight without it can be resumed.
FINISHED = "session.finished"
#: After it more photos are expected all the same.
REOPENED = "session.reopened"
_LONGEST_NAME = 80


@dataclass(frozen=True)
class Unfinished:
    """What is still to be done; counts of photos and triggers.

    ``unseen_photos`` came after the newest pairing, ``lonely_photos`` have no trigger in it and
    ``lonely_triggers`` no photo. ``behind`` photos came after the newest verdict.
    """

    ended: bool
    unseen_photos: int
    lonely_photos: int
    lonely_triggers: int
    behind: int
    final_verdict: bool

    @property
    def resumable(self) -> bool:
        """Whether going on makes sense: not ended, or photos that no final verdict has seen."""
        return not self.ended or not self.final_verdict or self.behind > 0

    def sentences(self) -> tuple[str, ...]:
        """What is unfinished, for people; empty: nothing."""
        found = []
        if not self.ended:
            found.append("The flight was not ended.")
        for count, text in (
            (self.unseen_photos, "came after the last pairing"),
            (self.lonely_photos, "without trigger"),
        ):
            if count:
                found.append(f"{count} photo{'' if count == 1 else 's'} {text}.")
        if self.lonely_triggers:
            found.append(
                f"{self.lonely_triggers} trigger{'' if self.lonely_triggers == 1 else 's'} without photo."
            )
        if not self.final_verdict:
            found.append("There is no final verdict.")
        elif self.behind:
            found.append(f"The verdict does not know the last {self.behind} of the photos.")
        return tuple(found)


@dataclass(frozen=True)
class Summary:
    """A flight in a line. ``held``: a process is writing it now. ``created`` in UTC."""

    name: str
    created: datetime
    counts: Counts
    verdict: Verdict | None
    final: bool
    held: bool
    unfinished: Unfinished


def sessions_folder() -> Path:
    """Where flights are kept: FIELDCAL_SESSIONS, or ``sessions`` in the user's data folder."""
    given = os.environ.get(SESSIONS_VARIABLE)
    return Path(given).expanduser() if given else platformdirs.user_data_path("fieldcal") / "sessions"


def begin(label: str = "flight", clock: Clock = system_clock) -> Session:
    """Begin a flight, named by the UTC time and ``label``; a name that is taken gets a number.

    Raises:
        OutputError: not writable, disk full.
    """
    base = f"{clock():%Y-%m-%d-%H%M}-{_slug(label)}"
    folder = sessions_folder()
    for number in range(1, 1000):
        place = folder / (base if number == 1 else f"{base}-{number}")
        if place.exists():
            continue
        return Session.create(place, clock)
    raise OutputError(f"There are too many flights named {base} in {folder}; choose another label.")


def finish(session: Session, clock: Clock = system_clock) -> None:
    """Record that the flight is over. Raises as :meth:`Session.add_event`."""
    session.add_event(Event(FINISHED, Stamp(clock().timestamp(), ClockName.UTC)))


def reopen(session: Session, clock: Clock = system_clock) -> None:
    """Record that the flight goes on though it was over. Raises as :meth:`Session.add_event`."""
    session.add_event(Event(REOPENED, Stamp(clock().timestamp(), ClockName.UTC)))


def names() -> tuple[str, ...]:
    """All flights, oldest first by their names.

    Raises:
        OutputError: the folder cannot be read.
    """
    folder = sessions_folder()
    if not folder.exists():
        return ()
    with output_errors(folder):
        found = [p.name for p in folder.iterdir() if not p.name.startswith(".") and (p / DATABASE).is_file()]
    return tuple(sorted(found))


def find(name: str) -> Path:
    """The folder of a flight, by its name or the beginning of it that no other has.

    Raises:
        InputError: none or several begin so.
    """
    known = names()
    found = [name] if name in known else [other for other in known if name and other.startswith(name)]
    if len(found) == 1:
        return sessions_folder() / found[0]
    if found:
        some = ", ".join(found[:5]) + (f" and {len(found) - 5} more" if len(found) > 5 else "")
        raise InputError(f"Several flights begin with {name}: {some}; write more of the name.")
    close = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    hint = f"Did you mean {' or '.join(close)}?" if close else "`fieldcal sessions list` shows all."
    raise InputError(f"There is no flight named {name} in {sessions_folder()}. {hint}")


def resume(name: str | None = None, clock: Clock = system_clock) -> Session:
    """Go on with a flight: that ``name``, or (None) the newest that is unfinished.

    Raises:
        InputError: no such flight, nothing to resume, or another process holds it.
    """
    if name is not None:
        return Session.resume(find(name), clock)
    summaries, _ = list_sessions()
    for summary in summaries:
        if summary.unfinished.resumable and not summary.held:
            return Session.resume(sessions_folder() / summary.name, clock)
    raise InputError(f"There is no unfinished flight in {sessions_folder()} to go on with.")


def list_sessions() -> tuple[tuple[Summary, ...], tuple[str, ...]]:
    """All flights, newest first, and one sentence for each that cannot be read.

    Raises:
        OutputError: the folder of flights cannot be read.
    """
    good, faults = [], []
    for name in names():
        try:
            with SessionReader.open(sessions_folder() / name) as session:
                good.append(summarise(session))
        except FieldcalError as error:
            faults.append(str(error))
    good.sort(key=lambda summary: (summary.created, summary.name), reverse=True)
    return tuple(good), tuple(faults)


def summarise(session: SessionReader) -> Summary:
    """A flight in a line. Raises as :class:`SessionReader`."""
    newest = session.latest_verdict()
    return Summary(
        name=session.folder.name,
        created=session.flight().created,
        counts=session.counts(),
        verdict=None if newest is None else newest.value.verdict,
        final=newest is not None and newest.value.final,
        held=is_held(session.folder),
        unfinished=unfinished(session),
    )


def unfinished(session: SessionReader) -> Unfinished:
    """What the flight still lacks. Raises as :class:`SessionReader`."""
    counts, pairing, verdict = session.counts(), session.pairing(), session.latest_verdict()
    pairs = pairing.value if pairing is not None else None
    seen = 0 if pairs is None else min(pairs.photos, counts.photos)
    if not counts.triggers:
        seen = counts.photos  # Photos without a vehicle have nothing to be paired with.
    paired = 0 if pairs is None else len(pairs.pairs)
    judged = 0 if verdict is None else min(verdict.value.photos, counts.photos)
    return Unfinished(
        ended=_ended(session),
        unseen_photos=counts.photos - seen,
        lonely_photos=max(seen - paired, 0) if counts.triggers else 0,
        lonely_triggers=max(counts.triggers - paired, 0),
        behind=counts.photos - judged,
        final_verdict=verdict is not None and verdict.value.final,
    )


def _ended(session: SessionReader) -> bool:
    finished, reopened = session.events(FINISHED), session.events(REOPENED)
    return bool(finished) and (not reopened or reopened[-1].seq < finished[-1].seq)


def _slug(text: str) -> str:
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode().lower()
    return re.sub(r"[^a-z0-9._-]+", "-", plain).strip("-._")[:_LONGEST_NAME] or "flight"

"""A flight as it goes on: photos in, provisional verdicts while they come, the final one at the end.

A loop of small steps that each return at once (:meth:`Flight.step`). What has happened is in the
session's record before anybody is told; the alignment child and this process may die at any instant.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from calib.align.stream import Finished, Progressed, Read, Restarted, Solve, Solver
from calib.check import choose_reference, conclude, read_set
from calib.errors import AlignmentError, FieldcalError, InputError
from calib.photos import LeftOut, Photo, Sorted, require_block, sort_photos
from calib.report_json import report_dict
from calib.result import CheckResult, Timing
from daemon.advice import what_to_fly
from daemon.aside import TURN_S
from daemon.capture.bringer import Bringer
from daemon.capture.hot_folder import Arrival, HotFolder, Marks, Poll
from daemon.capture.matching import Arrived, Matching, completed
from daemon.capture.trigger_book import TriggerBook
from daemon.flight_messages import capture_message, paired_words, verdict_message
from daemon.live.schemas import Link, Log, Message, Progress, Status
from daemon.pass_book import FLIGHT_FOLDER, PassFinder
from daemon.session.rows import ClockName, Event, PhotoFile, SolutionRecord, Stamp, VerdictRecord
from daemon.session.store import Session

if TYPE_CHECKING:
    from daemon.flight_link import FlightLink

#: The first provisional solution waits for so many photos, each further one for this share more.
FIRST, MORE = 6, 0.25
#: Photos that are read at once: small, so that a solution need not wait long.
_BATCH = 4
LOOK_EVERY_S = 0.5
#: Landed and disarmed, with a file for every trigger, so short a pause is enough.
LANDED_IDLE_S = 20.0
STARTED = "run.started"
_TRANSIENT_S = 0.1


#: Somebody else; from the vehicle's camera as it offers them; gphoto2.
Source = Literal["folder", "mavlink", "gphoto2"]


@dataclass(frozen=True)
class Options:
    """``idle_s``: the flight is over when nothing has come for so long (0: only when told);
    ``count``: or when so many photos are there. ``link``: the vehicle's address. ``anchors``: numbers of
    the vehicle's photos and the names of their files, where the operator knows. ``passed_over``: files in
    the folder that belong to earlier flights. ``source``: who brings the photos into the folder."""

    vehicle: str
    folder: Path
    source: Source = "folder"
    reference: str | None = None
    idle_s: float = 120.0
    count: int | None = None
    link: str | None = None
    anchors: tuple[tuple[int, str], ...] = ()
    passed_over: Marks = field(default_factory=dict)


Phase = Literal["waiting", "collecting", "concluding", "ended"]


class Flight:
    """One flight of a hot folder.

    Args:
        tell: takes messages for whoever watches; never waits.
        clock: seconds on a clock that never steps.
        link: the vehicle's, where there is one; closed by the caller.
        bringer: who brings the photos, where it is not somebody else; closed by the caller.
    """

    def __init__(
        self,
        session: Session,
        options: Options,
        solver: Solver,
        tell: Callable[[Message], None],
        clock: Callable[[], float] = time.monotonic,
        link: FlightLink | None = None,
        bringer: Bringer | None = None,
    ) -> None:
        self._session, self._options, self._solver, self._tell = session, options, solver, tell
        self._clock, self._link, self._bringer = clock, link, bringer
        # Without a link what was told in an earlier run still places the photos of a card read at home.
        book = link.book if link is not None else TriggerBook(session) if session.counts().triggers else None
        self._book = book
        self._matching = None if book is None else Matching(session, book, options.anchors, clock)
        self._hot = HotFolder(options.folder, clock=clock, passed_over=options.passed_over)
        self._photos: dict[Path, Arrived] = {}
        self._unread: list[Photo] = []
        self._poll = Poll((), 0, ())
        self._looked_s, self._moved_s = -1e9, clock()
        self._solved_for = self._failed_for = 0
        self._aligned = 0
        self._since = datetime.now(UTC)
        self._phase: Phase = "waiting"
        self._degraded: tuple[str, ...] = ()
        self._over = False
        # Photos that a final verdict has seen: only others are waited for.
        self._from = 0
        self._count = options.count
        self._seq = session.counts().photos
        self._trying_for = self._trying_seq = 0
        self._told: object = None
        self._idled_s = -1e9
        self._resume()

    # -- what is asked of it -----------------------------------------------------------------------

    def finish(self) -> None:
        """No more photos come: conclude."""
        self._over = True

    @property
    def over(self) -> bool:
        """Whether it is time for :meth:`conclude`."""
        if self._over:
            return True
        if self._count is not None and self._poll.whole >= self._count:
            return True
        idle_s, link = self._options.idle_s, self._link
        if idle_s == 0 or self._poll.whole <= self._from or not self._photos or self._poll.fault:
            return False
        if link is not None and link.flying:
            return False
        moved_s = self._moved_s if self._bringer is None else max(self._moved_s, self._bringer.moved_s)
        if link is not None:
            moved_s = max(moved_s, link.moved_s)
            if link.landed and self._poll.whole >= link.book.count:
                idle_s = min(idle_s, LANDED_IDLE_S)
        return self._clock() - moved_s >= idle_s

    def step(self) -> None:
        """Look at folder and link if it is time, and let the alignment go on.

        Raises:
            FieldcalError: the record cannot be written.
        """
        self._look()
        self._listen()
        if not self._solver.busy:
            self._begin_something()
        happening = self._solver.poll(_TRANSIENT_S)
        if not self._solver.busy and happening is None:
            time.sleep(_TRANSIENT_S)
        self._take(happening)
        self._tell_state()

    def idle(self) -> None:
        """Listen and tell, while something else goes on; returns at once.

        Raises:
            FieldcalError: the record cannot be written.
        """
        self._listen()
        self._tell_state()

    def at_work(self, stage: str) -> None:
        """Tell what goes on beside this flight's own steps."""
        self._progress(stage, 0, 0)

    def conclude(self) -> CheckResult:
        """The final verdict: the check's own of all photos in the folder now; recorded when it returns.

        Raises:
            FieldcalError: the photos cannot be used, or the record cannot be written.
        """
        self._enter("concluding")
        self._say("No more photos: the final verdict is being worked out.")
        self._solver.call_off()
        while self._solver.busy:
            self._take(self._solver.poll(_TRANSIENT_S))
            self.idle()
        while True:
            self._looked_s = -1e9
            self._look()
            if not self._poll.fault:
                break
            self.idle()
            time.sleep(LOOK_EVERY_S)
        self._listen(at_once=True)
        if self._bringer is not None and self._bringer.missing:
            self._say(f"{self._bringer.missing} photos that the camera offers were not fetched.", "warning")
        # Photos of an extra pass are told apart; nothing but this flight's own photos is solved.
        passes = PassFinder(None, self._session.folder / FLIGHT_FOLDER, alone=True)
        found = read_set(
            self._files(), self._reading, lambda photos: passes.complete(self._completed(photos))
        )
        require_block(found)
        self._missing(found.used, found.left_out)
        seq = self._session.counts().photos
        reference, note = choose_reference(found.used[0], self._options.reference)
        lens = None if reference is None else reference.lens
        covariance = None if reference is None else reference.lens_covariance
        started = time.monotonic()
        self._solver.submit(Solve(found.used, True, lens, covariance))
        finished: Finished | None = None
        while finished is None:
            happening = self._solver.poll(_TRANSIENT_S)
            if isinstance(happening, Finished):
                finished = happening
            else:
                self._take(happening)
            self.idle()
        if finished.error is not None:
            raise finished.error
        if finished.outcome is None:
            raise AlignmentError("The alignment ended without a result; run it again.")
        wall_s = time.monotonic() - started
        # Of the final solution alone; what was done before is not counted.
        timing = Timing(wall_s, finished.cpu_s, len(found.used) / max(wall_s, 1e-9))
        result = conclude(finished.outcome, found.left_out, reference, note, timing)
        result = replace(result, what_to_fly=what_to_fly(result), extra_pass=passes.extra_pass)
        self._record(result, seq, final=True)
        return result

    def go_on(self, photos: int) -> None:
        """Collect again after a final verdict: an extra pass of so many photos is to be flown."""
        self._over, self._from = False, self._poll.whole
        if self._count is not None:
            self._count = self._poll.whole + photos
        if self._link is not None:
            self._link.flies_again()
        self._enter("collecting")

    def ended(self) -> None:
        """Tell that it is over."""
        self._enter("ended")

    # -- photos ------------------------------------------------------------------------------------

    def _look(self) -> None:
        now = self._clock()
        if now - self._looked_s < LOOK_EVERY_S:
            return
        self._looked_s = now
        self._bring()
        before, self._poll = self._poll, self._hot.poll()
        if self._poll.fault != before.fault:
            self._say(
                self._poll.fault or "The folder is there again.", "warning" if self._poll.fault else "info"
            )
        if self._poll.arrived or self._poll.waiting != before.waiting or self._poll.fault != before.fault:
            self._moved_s = now
        for arrival in self._poll.arrived:
            self._arrive(arrival)

    def _bring(self) -> None:
        if self._bringer is None:
            return
        self._bringer.poll()
        for level, text in self._bringer.news():
            self._say(text, level)

    def _files(self) -> list[Path]:
        return self._hot.files() if self._options.passed_over else [self._options.folder]

    def _arrive(self, arrival: Arrival) -> None:
        photo = arrival.photo
        path = photo.path.absolute()
        row = self._session.add_photo(PhotoFile(path, arrival.sha256, arrival.size_bytes))
        self._seq = max(self._seq, row.seq)
        self._photos[photo.path] = Arrived(photo, row.seq)
        self._unread.append(photo)
        if self._phase == "waiting":
            self._enter("collecting")

    # -- the vehicle -------------------------------------------------------------------------------

    def _listen(self, at_once: bool = False) -> None:
        """Take in what the link tells, and pair if it is time or ``at_once``."""
        if self._link is not None:
            self._link.poll()
            for level, text in self._link.news():
                self._say(text, level)
        if self._matching is not None and self._book is not None:
            if self._bringer is not None:
                self._matching.belongs(self._bringer.anchors())
            self._matching.look(self._photos, at_once)
            if at_once:
                self._say(paired_words(self._matching.pairing, len(self._photos), self._book))

    def _completed(self, photos: Sequence[Photo]) -> Sequence[Photo]:
        """The photos with positions and angles of their triggers, where they have none themselves."""
        return photos if self._matching is None else completed(photos, self._matching.tags())

    def _sorted(self) -> Sorted:
        return sort_photos(self._completed([arrived.photo for arrived in self._photos.values()]))

    def _missing(self, used: Sequence[Photo], left_out: Sequence[LeftOut]) -> None:
        """Say which recorded photos are not in the folder any more."""
        there = {photo.path.absolute() for photo in used} | {item.path.absolute() for item in left_out}
        here = self._session.folder.absolute()
        gone = [row.value.path.name for row in self._session.photos() if here / row.value.path not in there]
        if gone:
            self._say(
                f"{len(gone)} of the photos recorded earlier are not in {self._options.folder} any more, "
                f"for example {gone[0]}: the verdict rests on those that are.",
                "warning",
            )

    # -- alignment ---------------------------------------------------------------------------------

    def _begin_something(self) -> None:
        due = len(self._photos) >= max(FIRST, (1 + MORE) * max(self._solved_for, self._failed_for))
        if self._unread and not (due and len(self._photos) >= 2 * max(self._solved_for, FIRST)):
            batch, self._unread = self._unread[:_BATCH], self._unread[_BATCH:]
            self._solver.submit(Read(tuple(batch)))
            return
        if not due:
            return
        found = self._sorted()
        try:
            require_block(found)
            reference, _ = choose_reference(found.used[0], self._options.reference)
        except InputError as error:
            self._failed_for = len(self._photos)
            self._say(f"Not yet: {error}")
            return
        lens = None if reference is None else reference.lens
        covariance = None if reference is None else reference.lens_covariance
        self._trying_for = len(self._photos)
        self._trying_seq = self._seq
        self._solver.submit(Solve(found.used, False, lens, covariance))

    def _take(self, happening: Finished | Progressed | Restarted | None) -> None:
        if isinstance(happening, Progressed):
            self._progress(happening.stage, happening.done, happening.total)
        elif isinstance(happening, Restarted):
            self._degraded = ("The alignment process died and was started again.",)
            self._say(self._degraded[0], "warning")
        elif isinstance(happening, Finished):
            if happening.error is None:
                self._degraded = ()
            if isinstance(happening.request, Solve):
                self._provisional(happening)

    def _provisional(self, finished: Finished) -> None:
        if finished.error is not None:
            if not isinstance(finished.error, FieldcalError):
                raise finished.error
            self._failed_for = self._trying_for
            self._say(f"Not yet: {finished.error}")
            return
        if finished.outcome is None:
            return
        self._solved_for = self._trying_for
        request = finished.request
        assert isinstance(request, Solve)
        left_out = self._sorted().left_out
        reference, note = choose_reference(request.photos[0], self._options.reference)
        result = conclude(finished.outcome, left_out, reference, note, Timing(0.0, 0.0, 0.0))
        self._record(replace(result, what_to_fly=what_to_fly(result)), self._trying_seq, final=False)

    def _record(self, result: CheckResult, seq: int, final: bool) -> None:
        report = report_dict(result)
        self._aligned = len(result.solution.photos)
        with self._session.batch():
            data = {key: report[key] for key in ("calibration", "alignment", "network", "dome")}
            solution = self._session.add_solution(SolutionRecord(seq, data))
            recorded = self._session.add_verdict(VerdictRecord(report, seq, final, solution.seq))
        self._tell(verdict_message(self._options.vehicle, report, final, recorded.recorded))

    # -- telling -----------------------------------------------------------------------------------

    def _resume(self) -> None:
        newest = self._session.latest_verdict()
        if newest is not None:
            value = newest.value
            self._from = value.photos if value.final else 0
            self._tell(
                verdict_message(self._options.vehicle, dict(value.report), value.final, newest.recorded)
            )
        if self._session.counts().photos:
            self._say(f"{self._session.counts().photos} photos are recorded already.")
        self._session.add_event(
            Event(
                STARTED,
                Stamp(datetime.now(UTC).timestamp(), ClockName.UTC),
                {
                    "folder": str(self._options.folder.absolute()),
                    "source": self._options.source,
                    "vehicle": self._options.vehicle,
                    "reference": self._options.reference,
                    "link": self._options.link,
                },
            )
        )
        self._tell_state()

    def _enter(self, phase: Phase) -> None:
        self._phase, self._since = phase, datetime.now(UTC)
        self._tell_state()

    def _say(self, text: str, level: Literal["info", "warning", "error"] = "info") -> None:
        self._tell(Log(vehicle=self._options.vehicle, at=datetime.now(UTC), level=level, text=text))

    def _reading(self, stage: str, done: int, total: int) -> None:
        self._progress(stage, done, total)
        now = self._clock()
        if now - self._idled_s >= TURN_S:
            self._idled_s = now
            self.idle()

    def _progress(self, stage: str, done: int, total: int) -> None:
        self._tell(
            Progress(
                vehicle=self._options.vehicle,
                photos=len(self._photos),
                aligned=self._aligned,
                stage=stage,
                done=done,
                of=total or None,
            )
        )

    def _tell_state(self) -> None:
        vehicle, link = self._options.vehicle, self._link
        degraded = [*self._degraded, *([self._poll.fault] if self._poll.fault else [])]
        degraded += [] if link is None else link.degraded
        degraded += [] if self._bringer is None else self._bringer.degraded
        state = (self._phase, degraded)
        if state != self._told:
            self._told = state
            self._tell(
                Status(
                    vehicle=vehicle,
                    phase=self._phase,
                    session=self._session.folder.name,
                    since=self._since,
                    degraded=degraded,
                )
            )
        self._tell(Link(vehicle=vehicle) if link is None else link.message(vehicle))
        self._tell(capture_message(vehicle, self._poll, self._book, self._matching))

"""The course of `fieldcal run`: collect, conclude, hand over; again where an extra pass is flown."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Literal, TypeVar

from calib.errors import FieldcalError
from calib.files import write_text_atomic
from calib.findings import Verdict
from calib.output import REPORT_HTML, write_outputs
from calib.report_json import report_json
from calib.result import CheckResult
from calib.wording import VERDICT_WORDS, printable
from daemon.again import leave_files
from daemon.aside import in_process, in_thread
from daemon.capture.tagging import Kind, Tagged, tag_photos
from daemon.cli_upload import backup_folder
from daemon.flight import Flight
from daemon.live.schemas import Log, Message
from daemon.output import console, write_stdout
from daemon.run_screen import Screen
from daemon.session.library import finish, reopen
from daemon.session.reader import SessionReader
from daemon.session.store import Session
from daemon.terminal import print_summary

if TYPE_CHECKING:
    from daemon.flight_link import FlightLink
    from daemon.refly_offer import Pass
    from mission.refly import Refly
    from mission.refly_site import FlownSite

T = TypeVar("T")
#: Extra passes are offered so often: what two have not cured a third will not.
MOST_PASSES = 2
#: Nothing at the end of a flight takes longer: the report, copies with geotags, the search, an upload.
WRITING_S, SEARCH_S, UPLOAD_S = 1200.0, 900.0, 600.0


@dataclass(frozen=True)
class Wishes:
    """What becomes of the result. ``yes``: the operator's word for an upload, given in advance.

    ``again``: folder whose next flight passes the photos of this one over (None: there is none).
    """

    out: Path | None = None
    json_to: str | None = None
    quiet: bool = False
    geotag: Kind | None = None
    site: Path | None = None
    offer_refly: bool = False
    yes: bool = False
    again: Path | None = None


class Rounds:
    """One flight from its first photo to its last verdict.

    Args:
        alive: gives signs of life while something goes on, for so many seconds at most.
    """

    def __init__(
        self,
        flight: Flight,
        session: Session,
        told: FlightLink | None,
        screen: Screen,
        wishes: Wishes,
        vehicle: str,
        tell: Callable[[Message], None],
        alive: Callable[[float], AbstractContextManager[None]],
    ) -> None:
        self._flight, self._session, self._told = flight, session, told
        self._screen, self._wishes = screen, wishes
        self._vehicle, self._tell, self._alive = vehicle, tell, alive

    def run(self) -> Verdict:
        """The last verdict.

        Raises:
            FieldcalError: the photos cannot be used, or something cannot be written.
        """
        for number in range(MOST_PASSES + 1):
            result = self._round()
            found = self._extra_pass(result)
            if found is None or number == MOST_PASSES or not self._uploaded(found):
                break
            reopen(self._session)
            self._flight.go_on(found.photos)
            self._say("Fly it when you are ready: its photos are waited for. Ctrl-C ends without them.")
        self._flight.ended()
        if self._wishes.json_to == "-":
            write_stdout(report_json(result))
        return result.verdict

    def _round(self) -> CheckResult:
        wishes, session = self._wishes, self._session
        with self._screen.busy("waiting for photos"):
            with _interrupts(self._flight.finish):
                while not self._flight.over:
                    self._flight.step()
            try:
                if wishes.again is not None:
                    leave_files(session, wishes.again)
                result = self._flight.conclude()
            except FieldcalError as error:
                if wishes.again is not None:
                    finish(session)  # Without a verdict; its photos are not tried again and again.
                self._tell(self._log(str(error), "error"))
                raise
        with self._alive(WRITING_S):
            return self._written(result)

    def _written(self, result: CheckResult) -> CheckResult:
        """With its report and what else was wished for."""
        wishes, session = self._wishes, self._session
        result = replace(result, exports=self._aside(lambda: write_outputs(result, session.folder)))
        if wishes.out is not None:
            out = wishes.out
            self._aside(lambda: write_outputs(result, out))
        if wishes.geotag is not None:
            kind, folder = wishes.geotag, session.folder / wishes.geotag.value
            self._say(self._aside(lambda: _tagged(session.folder, folder, kind)).sentence(folder))
        finish(session)
        if wishes.json_to not in (None, "-"):
            write_text_atomic(Path(str(wishes.json_to)), report_json(result))
        if wishes.quiet and wishes.json_to != "-":
            print(f"{VERDICT_WORDS[result.verdict]}: {printable(result.headline)}", flush=True)
        elif not wishes.quiet:
            report = (wishes.out or session.folder) / REPORT_HTML
            print_summary(result, console(wishes.json_to == "-"), report)
        return result

    def _extra_pass(self, result: CheckResult) -> Pass | None:
        """Found, told and in the flight's folder; None where nothing is to be flown."""
        if result.verdict is not Verdict.REFLY:
            return None
        # Loaded when it is wanted: a daemon that was killed is to be back soon.
        from daemon.refly_offer import find_pass

        told = self._told
        launch, flavour = (None, "ardupilot") if told is None else (told.launch, told.flavour)
        with self._screen.busy("planning the extra pass"), self._alive(SEARCH_S):
            self._flight.at_work("planning the extra pass")
            found = find_pass(self._session, self._wishes.site, launch, flavour, self._search)
        self._say(f"Extra pass: {found.text}")
        return found if found.photos else None

    def _search(self, site: FlownSite) -> Refly:
        from mission.refly import refly

        return in_process(refly, (site,), self._flight.idle, SEARCH_S)

    def _aside(self, work: Callable[[], T]) -> T:
        return in_thread(work, self._flight.idle)

    def _uploaded(self, found: Pass) -> bool:
        told = self._told
        if told is None or not self._wishes.offer_refly:
            return False
        from daemon.refly_offer import PATIENCE_S, offer

        with self._alive(PATIENCE_S + UPLOAD_S):
            return offer(
                *(told, self._session, found, self._word, backup_folder(), self._say, self._screen.busy),
                meanwhile=self._flight.idle,
            )

    def _word(self) -> bool:
        """The operator may take a while to answer."""
        question = "Upload the extra pass to the vehicle?"
        return self._wishes.yes or self._aside(lambda: self._screen.ask(question))

    def _say(self, text: str) -> None:
        self._tell(self._log(text))

    def _log(self, text: str, level: Literal["info", "error"] = "info") -> Log:
        return Log(vehicle=self._vehicle, at=datetime.now(UTC), level=level, text=text)


def _tagged(record: Path, folder: Path, kind: Kind) -> Tagged:
    with SessionReader.open(record) as session:
        return tag_photos(session, folder, kind)


@contextmanager
def _interrupts(first: Callable[[], None]) -> Iterator[None]:
    """The first Ctrl-C calls ``first``; further ones interrupt as always."""
    usual = signal.getsignal(signal.SIGINT)

    def once(number: int, frame: FrameType | None) -> None:
        del number, frame
        signal.signal(signal.SIGINT, usual)
        first()

    signal.signal(signal.SIGINT, once)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)

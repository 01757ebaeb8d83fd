"""What the link tells of a flight: triggers with positions, into the record; the vehicle's state, in words.

The photo flight never waits for it and never fails with it: a link that is silent or cut is said, and
opened again by the link itself.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from daemon.capture.fetch import Fetcher
from daemon.capture.recent import Recent
from daemon.capture.trigger_book import TriggerBook
from daemon.closing import Closing
from daemon.link import events as ev
from daemon.link.address import Address, Kind, log_path, parse
from daemon.link.airborne import Airborne
from daemon.link.decode import MOUNT_PARAMETERS
from daemon.link.forward import Forward
from daemon.link.live import Link
from daemon.link.replay import Replay
from daemon.link.tlog import LogWriter
from daemon.link.transfer import ReadParameters
from daemon.live import schemas
from daemon.session.rows import ClockName, Event, Stamp
from daemon.session.store import Session
from mission.encode import Flavour

if TYPE_CHECKING:
    from mission.feasibility import Place

LOG_FILE = "link.tlog"
AIRBORNE, LANDED = "vehicle.airborne", "vehicle.landed"
#: A vehicle that was last heard in the air counts as flying for so long: no multirotor stays up longer.
LONGEST_FLIGHT_S = 3600.0
#: Not heard for so long since the start is worth a word.
_FIRST_S = 15.0
#: A replay is read in pieces of so long, so that photos are looked at meanwhile.
_PIECE_S = 0.5
#: MAV_SEVERITY: error and worse.
_ERROR = 3
Level = Literal["info", "warning", "error"]
News = tuple[Level, str]


def open_source(text: str, forward: Forward | None = None) -> Link | Replay:
    """A vehicle, or a recorded flight.

    Raises:
        InputError: no such address, or it cannot be used.
    """
    address = parse(text)
    if address.kind is Kind.LOG:
        return replay_of(address)
    return Link(address, forward=forward)


def replay_of(address: Address) -> Replay:
    """
    Raises:
        InputError: the log cannot be read. FormatError: it is none.
    """
    path = log_path(address)
    with Replay(path) as trial:
        next(trial.events(), None)
    return Replay(path)


class FlightLink(Closing):
    """One flight's link; closed with it, the source too.

    Args:
        clock: seconds on a clock that never steps.
    """

    def __init__(
        self, source: Link | Replay, session: Session, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """
        Raises:
            OutputError: the log cannot be written.
        """
        self.source = source
        self.book = TriggerBook(session)
        self._session, self._clock = session, clock
        self._recent = Recent()
        self._airborne = Airborne(flown=bool(session.events(AIRBORNE)))
        self._news: list[News] = []
        self._degraded: tuple[str, ...] = ()
        self._heard, self._silent, self._asked = False, True, False
        self._started_s = self._heard_s = clock()
        self.moved_s = clock()
        self._log: LogWriter | None = None
        if isinstance(source, Link):
            self._log = LogWriter(session.folder / LOG_FILE)
            source.record_into(self._log)

    def close(self) -> None:
        self.source.close()
        if self._log is not None:
            self._log.close()

    # -- what it knows -----------------------------------------------------------------------------

    @property
    def flying(self) -> bool:
        """Armed as far as was heard, so in the air or about to be; who fell silent long ago is down."""
        over = self._replayed or self._clock() - self._heard_s > LONGEST_FLIGHT_S
        return self._airborne.armed and not over

    @property
    def landed(self) -> bool:
        """Down and disarmed after a flight, or the recorded flight is at its end."""
        return self._airborne.landed or self._replayed

    @property
    def degraded(self) -> tuple[str, ...]:
        return self._degraded

    @property
    def flavour(self) -> Flavour:
        """Whose missions the vehicle takes; ArduPilot's while it is not known."""
        return "px4" if self.source.state.autopilot is ev.Autopilot.PX4 else "ardupilot"

    @property
    def place(self) -> Place | None:
        """Where the vehicle is, as far as it knows."""
        from mission.feasibility import Place

        at = self.source.state.last(ev.Position)
        return None if at is None else Place(at.latitude_deg, at.longitude_deg)

    @property
    def launch(self) -> tuple[float, float] | None:
        """Where it was switched on or armed, degrees: mission heights count from there."""
        home = self.source.state.last(ev.HomePosition)
        return None if home is None else (home.latitude_deg, home.longitude_deg)

    def fetcher(self, folder: Path) -> Fetcher | None:
        """Fetches what the vehicle's camera offers into ``folder``; None for a recorded flight."""
        if not isinstance(self.source, Link):
            return None
        return Fetcher(self.book, folder, self.source, self._clock)

    def flies_again(self) -> None:
        """A further flight is expected: the landing before it is no end."""
        self._airborne = replace(self._airborne, flown=False)
        self.moved_s = self._clock()

    def news(self) -> list[News]:
        """What happened since the last time, for people."""
        found, self._news = self._news, []
        return found

    def message(self, vehicle: str) -> schemas.Link:
        """The state of vehicle and link as it goes over the bus."""
        state = self.source.state
        beat, place, battery = state.last(ev.Heartbeat), state.last(ev.Position), state.last(ev.Battery)
        loss = state.quality.loss_share
        return schemas.Link(
            vehicle=vehicle,
            connected=self._connected,
            autopilot=None if beat is None else beat.autopilot.value,
            mode=None if beat is None else beat.mode,
            armed=None if beat is None else beat.armed,
            quality=None if loss is None else 1 - loss,
            battery=None if battery is None else battery.remaining_share,
            latitude_deg=None if place is None else place.latitude_deg,
            longitude_deg=None if place is None else place.longitude_deg,
            height_m=None if place is None else place.height_m,
        )

    # -- what happens ------------------------------------------------------------------------------

    def poll(self) -> None:
        """Take in what was heard since the last time; returns soon.

        Raises:
            FieldcalError: the record cannot be written, or the recorded flight cannot be read.
        """
        end = time.monotonic() + _PIECE_S
        with self._session.batch():
            for heard in self.source.events(0):
                self._take(heard.event, heard.at_s)
                if time.monotonic() > end:
                    break
            self.book.place(self._recent, self.source.state.time_base, self.source.now_s())
        self._look_at_link()

    def _take(self, event: ev.Event, at_s: float) -> None:
        self._heard_s = self._clock()
        base = self.source.state.time_base
        self._recent.add(event)
        for jump in self._recent.news():
            size_m = max(jump.horizontal_m, jump.vertical_m)
            text = (
                f"The vehicle's position jumped by {size_m:.0f} m, and photos are placed no better for now."
            )
            self._news.append(("warning", text))
        if isinstance(event, ev.PhotoReport):
            if self.book.hear(event, at_s, base):
                self.moved_s = self._clock()
        elif isinstance(event, ev.VehicleRestarted):
            self.book.restarted(at_s)
            self._news.append(("warning", "The vehicle has started anew; its photos are counted on."))
        elif isinstance(event, ev.Position):
            self.book.place(self._recent, base, at_s)
        elif isinstance(event, ev.StatusText) and event.severity <= _ERROR and event.text.strip():
            self._news.append(("warning", f"The vehicle says: {event.text.strip()}"))
        before, self._airborne = self._airborne, self._airborne.add(event)
        if self._airborne.in_air and not before.in_air:
            self._flies(AIRBORNE, "The vehicle is in the air.", at_s)
        elif self._airborne.landed and not before.landed:
            self._flies(LANDED, "The vehicle has landed and is disarmed.", at_s)

    def _flies(self, kind: str, text: str, at_s: float) -> None:
        self._session.add_event(Event(kind, Stamp(at_s, ClockName.UTC)))
        self._news.append(("info", text))
        self.moved_s = self._clock()

    # -- how the link does -------------------------------------------------------------------------

    @property
    def _replayed(self) -> bool:
        return isinstance(self.source, Replay) and self.source.ended

    @property
    def _connected(self) -> bool:
        return not self._replayed and self.source.state.connected(self.source.now_s())

    def _look_at_link(self) -> None:
        if isinstance(self.source, Replay):
            if self.source.ended and not self._heard:
                self._heard = True
                text = f"The recorded flight is read to its end: {self.book.count} triggers."
                self._news.append(("info", text))
            return
        link, faults = self.source, []
        state, health = link.state, link.health
        if self._connected:
            if self._silent:
                self._news.append(("info", self._greeting(link)))
            self._heard, self._silent = True, False
            names = MOUNT_PARAMETERS[state.autopilot]
            if names and not self._asked and state.system_id is not None:
                # Without it nobody knows whether its mount's angles are the body's.
                self._asked = True
                link.ask(ReadParameters(state.system_id, names))
        elif self._heard or self._clock() - self._started_s > _FIRST_S:
            self._silent = True
            why = f" ({health.fault.rstrip('.')})" if health.fault else ""
            faults.append(f"The vehicle is not heard on {link.address}{why}; photos are taken all the same.")
        if health.log_fault is not None:
            faults.append(health.log_fault)
        for fault in faults:
            if fault not in self._degraded:
                self._news.append(("warning", fault))
        self._degraded = tuple(faults)

    def _greeting(self, link: Link) -> str:
        from mission.feasibility import NAMES

        beat = link.state.last(ev.Heartbeat)
        name = next((n for key, n in NAMES.items() if key == link.state.autopilot), "another autopilot")
        mode = "" if beat is None else f", {'armed' if beat.armed else 'disarmed'}, mode {beat.mode}"
        return f"The vehicle is heard{' again' if self._heard else ''}: {name}{mode}."

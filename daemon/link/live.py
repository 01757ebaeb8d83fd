"""The link to a vehicle: one thread that owns the line, and everything that is said on it.

Every frame, heard or said, goes into the log, through :class:`daemon.link.state.LinkState` (and so
through the one decode table) and to the ground station, in this order. Nothing is sent that is not on
the list of :mod:`daemon.link.allowed`.
"""

from __future__ import annotations

import logging
import os
import queue
import select
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

from calib.errors import InputError
from daemon.closing import Closing
from daemon.link import allowed, wire
from daemon.link.address import Address, Kind
from daemon.link.forward import Forward
from daemon.link.state import Heard, LinkState
from daemon.link.streams import Streams
from daemon.link.tlog import LogWriter
from daemon.link.transfer import Exchange
from daemon.link.transport import Origin, Transport, open_transport

_log = logging.getLogger(__name__)
LOOK_S = 0.05
HEARTBEAT_S = 1.0
#: Often at first, so that the clocks are known when the first photo comes.
TIMESYNC_S, TIMESYNC_LATER_S, TIMESYNC_OFTEN = 0.5, 2.0, 20
REOPEN_S, REOPEN_MOST_S = 0.5, 5.0
#: Events that nobody fetches: the oldest go (an hour at 30 a second).
MOST_EVENTS = 100_000
#: Whoever sends from elsewhere than the vehicle gets a splitter of its own, so many at most.
_MOST_ORIGINS = 16


class NoVehicleError(InputError):
    """No vehicle was heard, or it is gone."""


@dataclass(frozen=True)
class LinkHealth:
    """How the link itself does. ``open``: there is a line (not: a vehicle). ``fault``: what is wrong, one
    sentence. ``reopened``: times the line was opened again. ``worst_late_s``: by which the thread was late
    with anything. ``unread``: events that nobody fetched in time."""

    open: bool = False
    fault: str | None = None
    reopened: int = 0
    worst_late_s: float = 0.0
    unread: int = 0
    log_fault: str | None = None


@dataclass(frozen=True)
class _Job:
    exchange: Exchange
    done: threading.Event = field(default_factory=threading.Event)


def steady_clock() -> Callable[[], float]:
    """Seconds since 1970 as the computer believes now, and from then on without ever stepping."""
    start_s, start = time.time(), time.monotonic()
    return lambda: start_s + (time.monotonic() - start)


class Link(Closing):
    """Context manager. Attributes may be read from any thread.

    Args:
        log: everything is recorded there; closed by the caller.
        forward: closed with the link.
        sent: called (in the link's thread) with each message of ours as it is sent.
        open_line: how a line is opened, for tests.
    """

    def __init__(
        self,
        address: Address,
        *,
        log: LogWriter | None = None,
        forward: Forward | None = None,
        clock: Callable[[], float] | None = None,
        sent: Callable[[wire.Outgoing], None] | None = None,
        open_line: Callable[[Address], Transport] = open_transport,
    ) -> None:
        """
        Raises:
            InputError: the address cannot be used as it is (no rights, port taken, a log).
        """
        if address.kind is Kind.LOG:
            raise InputError(f"{address} is a recorded flight, not a vehicle.")
        self.address = address
        self._clock = clock or steady_clock()
        self._log_writer, self._forward, self._sent = log, forward, sent
        self._open_line = open_line
        self._packer = wire.Packer()
        self._splitters: dict[Origin, wire.Splitter] = {}
        self._state = LinkState()
        self._health = LinkHealth()
        self._streams = Streams()
        self._events: queue.Queue[Heard | None] = queue.Queue(MOST_EVENTS)
        self._job: _Job | None = None
        self._one_at_a_time = threading.Lock()
        self._asked: queue.SimpleQueue[_Job] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._wake_read, self._wake_write = os.pipe()
        self._line: Transport | None = None
        self._heartbeat_due = self._timesync_due = self._reopen_due = 0.0
        self._reopen_wait_s = REOPEN_S
        self._questions = 0
        try:
            self._line = self._open_line(address)
        except OSError as error:
            self._cut(error)
        except BaseException:
            os.close(self._wake_read)
            os.close(self._wake_write)
            raise
        self._health = replace(self._health, open=self._line is not None)
        self._thread = threading.Thread(target=self._run, name="link", daemon=True)
        self._thread.start()

    # --- For other threads -------------------------------------------------------------------------

    @property
    def state(self) -> LinkState:
        return self._state

    @property
    def health(self) -> LinkHealth:
        return self._health

    @property
    def streams(self) -> Streams:
        return self._streams

    def now_s(self) -> float:
        return self._clock()

    @property
    def connected(self) -> bool:
        """A vehicle is there: its heartbeat is fresh."""
        return self._state.connected(self._clock())

    def events(self, wait_s: float | None = None) -> Iterator[Heard]:
        """See :class:`daemon.link.source.Source`. One reader only."""
        while True:
            try:
                heard = self._events.get(timeout=wait_s)
            except queue.Empty:
                return
            if heard is None:
                return
            yield heard

    def wait_for_vehicle(self, seconds: float) -> int:
        """The vehicle's system id, as soon as a heartbeat is fresh.

        Raises:
            NoVehicleError: none within ``seconds``.
        """
        if not self.wait(lambda: self.connected, seconds):
            why = self._health.fault or "is it switched on, and does it send to this address?"
            raise NoVehicleError(f"No vehicle was heard on {self.address} for {seconds:g} s: {why}")
        system_id = self._state.system_id
        assert system_id is not None  # connected says so
        return system_id

    def wait(self, true: Callable[[], bool], seconds: float) -> bool:
        """Whether ``true()`` came true within ``seconds``."""
        end = time.monotonic() + seconds
        while not true():
            if time.monotonic() > end or self._stop.is_set():
                return False
            time.sleep(0.02)
        return True

    def record_into(self, log: LogWriter) -> None:
        """Record everything from now on; closed by the caller, after the link."""
        self._log_writer = log

    def ask(self, exchange: Exchange) -> None:
        """Have an exchange carried out when its turn comes; nobody waits for it."""
        self._asked.put(_Job(exchange))
        self._wake()

    def run(self, exchange: Exchange, look: Callable[[], None] | None = None) -> None:
        """Carry out an exchange with the vehicle; returns when it is over. One at a time: others wait.

        ``look`` is called now and then meanwhile. Interrupted, the exchange ends where it is.

        Raises:
            NoVehicleError: the link is closed.
        """
        with self._one_at_a_time:
            if self._stop.is_set():
                raise NoVehicleError("The link is closed.")
            job = _Job(exchange)
            self._asked.put(job)
            self._wake()
            try:
                while not job.done.wait(LOOK_S) and self._thread.is_alive():
                    if look is not None:
                        look()
            except BaseException:
                exchange.over = True
                raise

    def close(self) -> None:
        """End the thread and close the line. Again does no harm."""
        if self._stop.is_set():
            return
        self._stop.set()
        self._wake()
        self._thread.join(5)
        os.close(self._wake_read)
        os.close(self._wake_write)

    def _wake(self) -> None:
        os.write(self._wake_write, b"x")

    # --- The link's thread -------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._step()
            except (OSError, InputError) as error:
                self._cut(error)
            except Exception as error:  # noqa: BLE001 top of a supervised loop: said, and the line opened anew
                _log.exception("The link stumbled.")
                self._cut(error)
        self._end()

    def _end(self) -> None:
        for one in (self._line, self._forward):
            if one is not None:
                one.close()
        if self._job is not None:
            self._job.done.set()
        self._put(None)

    def _step(self) -> None:
        if self._line is None:
            self._reopen()
        before = self._clock()
        readable = self._wait_for_bytes()
        late_s = self._clock() - before - LOOK_S
        if self._wake_read in readable:
            os.read(self._wake_read, 4096)
        line = self._line
        if line is not None and line.fileno() in readable:
            for data, origin in line.read():
                self._hear(line, data, origin)
        if self._forward is not None and self._forward.fileno() in readable:
            for frame in self._forward.read():
                self._pass_on(frame)
        self._keep_going()
        late_s = max(late_s, self._clock() - before - LOOK_S)
        if late_s > self._health.worst_late_s:
            self._health = replace(self._health, worst_late_s=late_s)

    def _wait_for_bytes(self) -> Sequence[int]:
        files = [self._wake_read]
        files += [one.fileno() for one in (self._line, self._forward) if one is not None]
        readable, _, _ = select.select(files, [], [], LOOK_S)
        return [int(file) for file in readable]

    def _hear(self, line: Transport, data: bytes, origin: Origin) -> None:
        for frame in self._splitter(origin).feed(data):
            at_us = round(self._clock() * 1e6)
            vehicle, beats = self._state.system_id, self._state.quality.heartbeat_s
            self._note(frame, at_us)
            if self._state.quality.heartbeat_s != beats or vehicle is None:
                line.answer(origin)
            if self._forward is not None and not _for_us_alone(frame):
                self._forward.send(frame.raw)
            job, message = self._job, frame.message
            if job is not None and message is not None and frame.system_id == self._state.system_id:
                self._say(*job.exchange.receive(message, self._clock()))
                self._look_if_over(job)

    def _splitter(self, origin: Origin) -> wire.Splitter:
        if origin not in self._splitters and len(self._splitters) >= _MOST_ORIGINS:
            self._splitters.clear()
        return self._splitters.setdefault(origin, wire.Splitter())

    def _note(self, frame: wire.Frame, at_us: int, ours: bool = False) -> None:
        """Into the log and the state; events to whoever reads them."""
        if self._log_writer is not None:
            self._log_writer.write(at_us, wire.without_content(frame))
            if self._log_writer.fault != self._health.log_fault:
                self._health = replace(self._health, log_fault=self._log_writer.fault)
        self._state, events = self._state.hear(frame, at_us / 1e6, ours)
        for event in events:
            self._put(Heard(at_us / 1e6, event))

    def _put(self, heard: Heard | None) -> None:
        while True:
            try:
                self._events.put_nowait(heard)
                return
            except queue.Full:
                self._health = replace(self._health, unread=self._health.unread + 1)
                self._events.get_nowait()

    def _pass_on(self, frame: wire.Frame) -> None:
        if self._line is not None:
            self._line.write(frame.raw)
            self._note(frame, round(self._clock() * 1e6))

    def _say(self, *messages: wire.Outgoing) -> None:
        for message in messages:
            raw = self._packer.pack(allowed.check(message))
            if self._line is None or not self._line.write(raw):
                continue
            for frame in wire.Splitter().feed(raw):
                self._note(frame, round(self._clock() * 1e6), ours=True)
            if self._sent is not None:
                self._sent(message)

    def _keep_going(self) -> None:
        now = self._clock()
        if now >= self._heartbeat_due:
            self._heartbeat_due = now + HEARTBEAT_S
            self._say(wire.heartbeat())
        vehicle = self._state.system_id
        if vehicle is not None and self._state.connected(now):
            if now >= self._timesync_due:
                self._questions += 1
                often = self._questions <= TIMESYNC_OFTEN
                self._timesync_due = now + (TIMESYNC_S if often else TIMESYNC_LATER_S)
                self._say(wire.time_question(round(now * 1e6) / 1e6))
            state = self._state
            self._streams, stream = self._streams.next(state.autopilot, state.counts, state.boots, now)
            if stream is not None:
                self._say(wire.ask_stream(vehicle, *stream))
        if self._job is None and not self._asked.empty():
            self._job = self._asked.get()
            if not self._job.exchange.over:
                self._say(*self._job.exchange.start(now))
        if self._job is not None:
            self._say(*self._job.exchange.tick(now))
            self._look_if_over(self._job)

    def _look_if_over(self, job: _Job) -> None:
        if job.exchange.over:
            self._job = None
            job.done.set()

    def _cut(self, error: Exception) -> None:
        """The line is lost: said once, opened again after a while."""
        if self._line is not None:
            self._line.close()
            self._line = None
        reason = (getattr(error, "strerror", None) or str(error)).rstrip(".").lower()
        self._health = replace(
            self._health, open=False, fault=f"the line to {self.address} is cut ({reason})."
        )
        self._reopen_due = self._clock() + self._reopen_wait_s

    def _reopen(self) -> None:
        now = self._clock()
        if now < self._reopen_due:
            return
        self._reopen_wait_s = min(2 * self._reopen_wait_s, REOPEN_MOST_S)
        self._line = self._open_line(self.address)
        self._splitters.clear()
        self._reopen_wait_s = REOPEN_S
        count = self._health.reopened + 1
        self._health = replace(self._health, open=True, fault=None, reopened=count)


def _for_us_alone(frame: wire.Frame) -> bool:
    """A file's content that we asked for: a ground station behind us has no use for it."""
    message = frame.message
    if message is None or message.name != wire.FILE_TRANSFER:
        return False
    return message.integer("target_system") == wire.SYSTEM_ID

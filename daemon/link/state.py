"""What is known of a vehicle and its link, made of the frames heard and said, in their order. Pure.

The live link and the replay of its log feed the same frames to it and come to the same state.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TypeVar

from daemon.link import decode
from daemon.link import events as ev
from daemon.link.clock import TimeBase
from daemon.link.quality import Quality
from daemon.link.wire import GROUND_STATION, SYSTEM_ID, Frame

E = TypeVar("E", bound=ev.Event)
#: Without a heartbeat for this long the vehicle counts as gone.
SILENT_S = 3.5
#: A boot time that falls back by more than this, or is shorter than the silence before it, is another boot,
#: once so many messages in a row, over so long, say so and go on from there. Messages that were held up
#: somewhere come in no order, or among newer.
RESTART_S, RESTART_MESSAGES, RESTART_STAYS_S = 5.0, 8, 0.5
#: By so much messages of one clock may come out of order.
_SHUFFLED_S = 1.0
_AUTOPILOT_COMPONENT = 1
#: Questions of ours that may still be answered.
_MOST_QUESTIONS = 32
_EMPTY: Mapping[type, ev.Event] = MappingProxyType({})
_TIMED = (ev.Position, ev.Attitude, ev.SystemTime)


@dataclass(frozen=True)
class Heard:
    """``at_s``: receiver's clock, seconds since 1970, never stepping (see :class:`daemon.link.live.Link`)."""

    at_s: float
    event: ev.Event


@dataclass(frozen=True)
class _Behind:
    """Messages of a clock that is behind the vehicle's: since when, its newest time, how many in a row."""

    since_s: float
    boot_s: float
    count: int = 1


@dataclass(frozen=True)
class LinkState:
    """``system_id``: the vehicle's, the first autopilot that was heard. ``boots``: how often it was seen to
    start anew. ``stations``: other ground stations and when they were last heard. ``parameters``: those
    that were asked for. ``unknown``: names of messages that the decode table does not have."""

    system_id: int | None = None
    latest: Mapping[type, ev.Event] = field(default_factory=lambda: _EMPTY)
    parameters: Mapping[str, float] = field(default_factory=dict)
    time_base: TimeBase = field(default_factory=TimeBase)
    quality: Quality = field(default_factory=Quality)
    stations: Mapping[int, float] = field(default_factory=dict)
    others: frozenset[int] = frozenset()
    unknown: frozenset[str] = frozenset()
    boots: int = 1
    counts: Mapping[str, int] = field(default_factory=dict)
    _boot_s: float | None = None
    _boot_heard_s: float = 0.0
    _behind: _Behind | None = None
    _asked_ns: tuple[int, ...] = ()

    def last(self, kind: type[E]) -> E | None:
        """The newest event of a kind."""
        found = self.latest.get(kind)
        return found if isinstance(found, kind) else None

    @property
    def autopilot(self) -> ev.Autopilot:
        beat = self.last(ev.Heartbeat)
        return ev.Autopilot.OTHER if beat is None else beat.autopilot

    def connected(self, now_s: float) -> bool:
        """Whether a heartbeat came within :data:`SILENT_S`."""
        age = self.quality.age_s(now_s)
        return age is not None and age <= SILENT_S

    def hear(self, frame: Frame, at_s: float, ours: bool = False) -> tuple[LinkState, tuple[ev.Event, ...]]:
        """The state after one frame, and the events in it.

        Args:
            ours: the frame was sent by us.
        """
        message = frame.message
        if ours or frame.system_id == SYSTEM_ID:
            if message is not None and message.name == "TIMESYNC" and message.integer("tc1") == 0:
                asked = (*self._asked_ns, message.integer("ts1"))[-_MOST_QUESTIONS:]
                return replace(self, _asked_ns=asked), ()
            return self, ()
        event = None if message is None else decode.decode(message, self._context())
        if isinstance(event, ev.Heartbeat) and frame.component_id == _AUTOPILOT_COMPONENT:
            return self._beat(event, frame, at_s)
        if message is not None and message.name == "HEARTBEAT" and message.integer("type") == GROUND_STATION:
            return replace(self, stations={**self.stations, frame.system_id: at_s}), ()
        if frame.system_id != self.system_id:
            return self, ()
        state = replace(self, quality=self.quality.hear(frame.component_id, frame.sequence, at_s))
        if message is None:
            return state, ()
        counts = {**state.counts, message.name: state.counts.get(message.name, 0) + 1}
        state = replace(state, counts=counts)
        if not decode.is_known(message.name):
            state = replace(state, unknown=state.unknown | {message.name})
        if event is None:
            return state, ()
        return state._with(event, frame, at_s)

    def _beat(self, event: ev.Heartbeat, frame: Frame, at_s: float) -> tuple[LinkState, tuple[ev.Event, ...]]:
        if self.system_id not in (None, frame.system_id):
            return replace(self, others=self.others | {frame.system_id}), ()
        quality = self.quality.hear(frame.component_id, frame.sequence, at_s).beat(at_s)
        counts = {**self.counts, "HEARTBEAT": self.counts.get("HEARTBEAT", 0) + 1}
        latest = {**self.latest, ev.Heartbeat: event}
        return replace(self, system_id=frame.system_id, quality=quality, latest=latest, counts=counts), (
            event,
        )

    def _with(self, event: ev.Event, frame: Frame, at_s: float) -> tuple[LinkState, tuple[ev.Event, ...]]:
        state, before = self, tuple[ev.Event, ...]()
        if isinstance(event, _TIMED) and frame.component_id == _AUTOPILOT_COMPONENT:
            utc_s = event.utc_s if isinstance(event, ev.SystemTime) else None
            state = state._at_boot(event.vehicle_boot_s, at_s, utc_s)
            if state.boots > self.boots:
                before = (ev.VehicleRestarted(state.boots),)
        if isinstance(event, ev.TimeSync):
            state = state._timesync(event, frame, at_s)
        elif isinstance(event, ev.SystemTime):
            base = state.time_base.with_system_time(event.vehicle_boot_s, event.utc_s)
            state = replace(state, time_base=base)
        elif isinstance(event, ev.Parameter):
            state = replace(state, parameters={**state.parameters, event.name: event.value})
        return replace(state, latest={**state.latest, type(event): event}), (*before, event)

    def _at_boot(self, boot_s: float, at_s: float, utc_s: float | None) -> LinkState:
        """The vehicle's clock was read, and perhaps its UTC; one boot more where it started anew."""
        if self._boot_s is None:
            return replace(self, _boot_s=boot_s, _boot_heard_s=at_s)
        if boot_s >= self._boot_s - RESTART_S:
            newer = max(boot_s, self._boot_s)
            if boot_s >= at_s - self._boot_heard_s - _SHUFFLED_S:
                heard_s = at_s if boot_s == newer else self._boot_heard_s
                return replace(self, _boot_s=newer, _boot_heard_s=heard_s, _behind=None)
            # It seems to have been switched on while nobody heard it; or it is a simulation that runs slowly.
            known = self.time_base.utc_from_boot.samples
            if known and utc_s is None:
                return self
            if known and utc_s is not None and abs(utc_s - boot_s - known[-1].offset_s) < _SHUFFLED_S:
                return replace(self, _boot_s=newer, _boot_heard_s=at_s, _behind=None)
            if known:
                return self._anew(boot_s, at_s)
        behind = self._behind
        if behind is None or boot_s < behind.boot_s - _SHUFFLED_S:
            return replace(self, _behind=_Behind(at_s, boot_s))
        behind = _Behind(behind.since_s, max(boot_s, behind.boot_s), behind.count + 1)
        if behind.count < RESTART_MESSAGES or at_s - behind.since_s < RESTART_STAYS_S:
            return replace(self, _behind=behind)
        return self._anew(behind.boot_s, at_s)

    def _anew(self, boot_s: float, at_s: float) -> LinkState:
        fresh = replace(self, boots=self.boots + 1, time_base=TimeBase(), _behind=None)
        return replace(fresh, _boot_s=boot_s, _boot_heard_s=at_s)

    def _timesync(self, event: ev.TimeSync, frame: Frame, at_s: float) -> LinkState:
        """Answers to another station's questions are heard as well: only ours count."""
        asked_ns = 0 if frame.message is None else frame.message.integer("ts1")
        if asked_ns not in self._asked_ns:
            return self
        left = tuple(ns for ns in self._asked_ns if ns != asked_ns)
        base = self.time_base.with_timesync(event.asked_s, event.vehicle_boot_s, at_s)
        return replace(self, time_base=base, _asked_ns=left)

    def _context(self) -> decode.Context:
        mount = decode.servo_mount(self.autopilot, self.parameters)
        return decode.Context(self.autopilot, mount, self.last(ev.GimbalAttitude) is not None)

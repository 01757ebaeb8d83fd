"""Which messages a vehicle is asked to send, how often, and when to ask again. Pure.

Autopilots stay silent until asked, forget it when they start anew, and the question itself can be lost:
what does not come is asked for again, more and more seldom.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from daemon.link.events import Autopilot

_BOTH = {
    **{"ATTITUDE": 10.0, "GLOBAL_POSITION_INT": 5.0, "GIMBAL_DEVICE_ATTITUDE_STATUS": 5.0},
    **{"MISSION_CURRENT": 2.0, "SYSTEM_TIME": 1.0, "GPS_RAW_INT": 1.0, "SYS_STATUS": 1.0},
    **{"EXTENDED_SYS_STATE": 1.0, "BATTERY_STATUS": 0.5, "HOME_POSITION": 0.2},
}
#: Hertz. ArduPilot repeats the last photo's CAMERA_FEEDBACK at its rate, which makes lost ones harmless.
#: PX4 tells every photo once by itself.
WANTED: Mapping[Autopilot, Mapping[str, float]] = {
    Autopilot.ARDUPILOT: {**_BOTH, "EKF_STATUS_REPORT": 1.0, "CAMERA_FEEDBACK": 2.0},
    Autopilot.PX4: {**_BOTH, "ESTIMATOR_STATUS": 1.0},
    Autopilot.OTHER: _BOTH,
}
#: A stream counts as running while it comes at this share of its rate.
_RUNNING_SHARE = 0.3
FIRST_S, LONGEST_S = 4.0, 60.0
#: Questions are spread out: a slow radio has room for little.
GAP_S = 0.05


@dataclass(frozen=True)
class Stream:
    """``count`` messages had come when it was looked at last, at ``looked_s``; asked ``times`` in a row."""

    count: int
    looked_s: float
    wait_s: float
    times: int = 1


@dataclass(frozen=True)
class Streams:
    """``streams.next(...)`` names one message to ask for now, or none."""

    asked: Mapping[str, Stream] | None = None
    boots: int = 1
    _last_s: float = -1e9

    def next(
        self, autopilot: Autopilot, counts: Mapping[str, int], boots: int, now_s: float
    ) -> tuple[Streams, tuple[str, float] | None]:
        """The state after, and (message, hertz) to ask for. ``counts``: messages come so far, by name."""
        asked = {} if self.asked is None or boots != self.boots else self.asked
        if now_s - self._last_s < GAP_S:
            return self, None
        for name, rate_hz in WANTED[autopilot].items():
            count, before = counts.get(name, 0), asked.get(name)
            if before is None:
                stream = Stream(count, now_s, FIRST_S + 1 / rate_hz)
                return Streams({**asked, name: stream}, boots, now_s), (name, rate_hz)
            if now_s < before.looked_s + before.wait_s:
                continue
            due = _RUNNING_SHARE * rate_hz * (now_s - before.looked_s)
            if count - before.count >= max(1.0, due):
                fresh = Stream(count, now_s, FIRST_S + 1 / rate_hz)
                asked = {**asked, name: fresh}
                continue
            wait_s = min(2 * before.wait_s, LONGEST_S)
            again = Stream(count, now_s, wait_s, before.times + 1)
            return Streams({**asked, name: again}, boots, now_s), (name, rate_hz)
        return replace(self, asked=asked, boots=boots), None

    def missing(self, counts: Mapping[str, int]) -> tuple[str, ...]:
        """Asked for more than once and never come."""
        return tuple(n for n, s in (self.asked or {}).items() if s.times > 1 and not counts.get(n, 0))

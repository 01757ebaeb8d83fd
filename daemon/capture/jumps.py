"""Where a vehicle's position jumped: then nobody knows which side is right, and the photos' sigmas say so.

A receiver that loses or changes satellites moves by metres at once and back some seconds later, its stated
accuracy unmoved. What it is told from: the place moves, and neither the velocity nor the way so far
explains it. Pure.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from calib.camera import FloatArray
from daemon.capture.position import ACCELERATION_M_S2, MAX_HOLE_S, TrackSample

#: A place that has not jumped for so long is what the receiver says it is.
SETTLED_S = 60.0
#: Doubts that are over for so long are forgotten: photos are placed long before.
KEEP_S = 120.0
#: Added where a jump would not have been seen: in and between holes of the track.
UNWATCHED_M = 2.5
#: Steps smaller than this are none, nor those within the stated sigma.
_LEAST_M = 0.3
#: Steps are held against the usual unrest between neighbours: medians of so many (2-D, 1-D).
_UNREST, _TIMES_2D, _TIMES_1D = 25, 4.0, 7.0
_M_PER_DEG = 111_200.0


@dataclass(frozen=True)
class Doubt:
    """Positions from ``since_s`` to ``until_s`` (the vehicle's boot clock) may be off by so much, m."""

    since_s: float
    until_s: float
    horizontal_m: float
    vertical_m: float

    def holds(self, boot_s: float) -> bool:
        return self.since_s <= boot_s <= self.until_s


class Jumps:
    """Feed every position to :meth:`add`; messages that come late are passed over.

    ``doubts``: of the last minutes; the last one may be open (``until_s`` infinite). Of doubts about the
    past, those not yet fetched are in :meth:`looking_back`.
    """

    def __init__(self) -> None:
        self.doubts: list[Doubt] = []
        self._open = False
        self._back: list[Doubt] = []
        self._last: tuple[TrackSample, FloatArray] | None = None
        self._rate: FloatArray | None = None
        self._level: FloatArray = np.zeros(3)
        self._since_s = self._stepped_s = 0.0
        self._settled = False
        self._unrest: deque[tuple[float, float]] = deque(maxlen=_UNREST)

    def at(self, boot_s: float) -> tuple[float, float]:
        """By how much a position of that moment may be off, horizontally and vertically, m."""
        found = [doubt for doubt in self.doubts if doubt.holds(boot_s)]
        return (
            max((doubt.horizontal_m for doubt in found), default=0.0),
            max((doubt.vertical_m for doubt in found), default=0.0),
        )

    def looking_back(self) -> list[Doubt]:
        """Doubts about moments before they were had, since the last call."""
        found, self._back = self._back, []
        return found

    def add(self, sample: TrackSample, velocity_m_s: tuple[float, float, float]) -> Doubt | None:
        """Take in a position and the velocity told with it (east, north, up); a jump that it is, if so."""
        velocity = np.array(velocity_m_s, dtype=float)
        before, self._last = self._last, (sample, velocity)
        if before is None:
            self._since_s = sample.time_s
            return None
        last, last_velocity = before
        passed_s = sample.time_s - last.time_s
        if passed_s <= 0:
            self._last = before
            return None
        if passed_s > MAX_HOLE_S:
            self._hole(last.time_s, sample.time_s)
            return None
        moved = _moved_m(last, sample)
        if self._rate is None and not (velocity.any() or last_velocity.any()):
            self._rate = moved / passed_s  # Perhaps it never tells its velocity.
            return None
        guesses = [moved - passed_s * (velocity + last_velocity) / 2]
        if self._rate is not None:
            # A vehicle that does not tell its velocity goes on as it went.
            guesses.append(moved - passed_s * self._rate)
        step = min(guesses, key=lambda one: float(np.linalg.norm(one)))
        across, up = float(np.hypot(step[0], step[1])), abs(float(step[2]))
        bend_m = ACCELERATION_M_S2 * passed_s**2 / 4
        jumped = across > self._least_m(last, sample, bend_m, 0) or up > self._least_m(
            last, sample, bend_m, 1
        )
        if not jumped:
            self._unrest.append((across, up))
            self._rate = moved / passed_s
            self._settle(sample.time_s)
            return None
        self._rate = (moved - step) / passed_s
        return self._step(last.time_s, sample, step, bend_m)

    def _least_m(self, last: TrackSample, sample: TrackSample, bend_m: float, axis: int) -> float:
        names = ("sigma_horizontal_m", "sigma_vertical_m")
        stated_m: float = max(getattr(last, names[axis]), getattr(sample, names[axis]))
        usual_m = float(np.median([one[axis] for one in self._unrest])) if self._unrest else 0.0
        return bend_m + max(_LEAST_M, stated_m, (_TIMES_2D, _TIMES_1D)[axis] * usual_m)

    def _step(self, before_s: float, sample: TrackSample, step: FloatArray, bend_m: float) -> Doubt | None:
        at_s = sample.time_s
        self._close(at_s)
        if not self._settled:
            # Whether it came here or went from here cannot be told.
            self._look_back(Doubt(self._since_s, at_s, *_sizes(step)))
            self._since_s = at_s
        self._level = self._level + step
        self._stepped_s = at_s
        across, up = _sizes(self._level)
        if across <= self._least_m(sample, sample, bend_m, 0) and up <= self._least_m(
            sample, sample, bend_m, 1
        ):
            self._level, self._settled = np.zeros(3), True
            return None
        found = Doubt(before_s, np.inf, across, up)
        self.doubts = [one for one in self.doubts if one.until_s > at_s - KEEP_S]
        self.doubts.append(found)
        self._open = True
        return found

    def _hole(self, before_s: float, at_s: float) -> None:
        """What happened meanwhile nobody knows. A jump that was open stays in doubt."""
        if not self._settled:
            self._look_back(Doubt(self._since_s, before_s, UNWATCHED_M, UNWATCHED_M))
        self._since_s, self._settled, self._rate = at_s, False, None
        self._settle(at_s)

    def _settle(self, at_s: float) -> None:
        if at_s - self._stepped_s > SETTLED_S:
            self._close(at_s)
            self._level = np.zeros(3)
            self._settled = self._settled or at_s - self._since_s > SETTLED_S

    def _close(self, at_s: float) -> None:
        if self._open:
            self.doubts[-1] = replace(self.doubts[-1], until_s=at_s)
            self._open = False

    def _look_back(self, doubt: Doubt) -> None:
        self.doubts.insert(0, doubt)
        self._back.append(doubt)


def _moved_m(one: TrackSample, other: TrackSample) -> FloatArray:
    """East, north, up, m; over some metres the ground is flat."""
    north = (other.latitude_deg - one.latitude_deg) * _M_PER_DEG
    east = (other.longitude_deg - one.longitude_deg + 180) % 360 - 180
    east *= _M_PER_DEG * np.cos(np.radians(one.latitude_deg))
    return np.array([east, north, other.altitude_m - one.altitude_m])


def _sizes(step: FloatArray) -> tuple[float, float]:
    return float(np.hypot(step[0], step[1])), abs(float(step[2]))

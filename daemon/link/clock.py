"""Time base: how one clock stands against another, with an uncertainty that can be relied on.

Each sample says "the offset lies within these bounds" (half the round trip of a TIMESYNC, the
resolution of a SYSTEM_TIME). The estimate is the place where most of the recent bounds overlap
(Marzullo's algorithm): one outlier moves nothing, and a step of the clock is followed after
:data:`STEP_SAMPLES` samples that agree with each other but not with the estimate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

#: Clocks of autopilots and laptops are good to this (crystal, temperature); older samples widen by it.
DRIFT_PPM = 100.0
WINDOW = 40
STEP_SAMPLES = 5
#: Bounds are never believed narrower (scheduling on both sides).
LEAST_HALF_S = 0.0005
#: At least this share of the window has to overlap, else the clocks do not run alike.
LEAST_SHARE = 0.5
#: GNSS receivers hand over the time within this of its truth.
GNSS_LATENCY_S = 0.2


@dataclass(frozen=True)
class OffsetSample:
    """``at_s``: when, on the clock that the offset is added to. ``half_s``: bound of its error."""

    at_s: float
    offset_s: float
    half_s: float


@dataclass(frozen=True)
class Offset:
    """``other = own + offset_s``, surely within ``half_s`` if most samples are honest."""

    offset_s: float
    half_s: float
    samples: int


@dataclass(frozen=True)
class ClockOffset:
    """Pure state: ``clock = clock.add(sample)``. Samples in order of their arrival."""

    samples: tuple[OffsetSample, ...] = ()
    strays: tuple[OffsetSample, ...] = ()
    steps: int = 0

    def add(self, sample: OffsetSample) -> ClockOffset:
        """The state with one more sample; ``steps`` counts the steps of the clock seen so far."""
        now = self._estimate(sample.at_s)
        if now is None or abs(sample.offset_s - now.offset_s) <= now.half_s + _half_s(sample, sample.at_s):
            strays = self.strays if now is None else ()
            return replace(self, samples=(*self.samples, sample)[-WINDOW:], strays=strays)
        strays = (*self.strays, sample)[-STEP_SAMPLES:]
        if len(strays) == STEP_SAMPLES and _overlap(strays, sample.at_s)[2] == STEP_SAMPLES:
            return ClockOffset(strays, (), self.steps + 1)
        return replace(self, strays=strays)

    def at(self, own_s: float) -> Offset | None:
        """The offset at a time of the own clock; None without samples, or where they contradict."""
        return None if len(self.strays) >= STEP_SAMPLES else self._estimate(own_s)

    def _estimate(self, own_s: float) -> Offset | None:
        if not self.samples:
            return None
        low, high, count = _overlap(self.samples, own_s)
        if count < LEAST_SHARE * len(self.samples):
            return None
        return Offset((low + high) / 2, (high - low) / 2, count)


@dataclass(frozen=True)
class TimeBase:
    """The vehicle's boot clock against the receiver's (TIMESYNC) and against UTC (SYSTEM_TIME)."""

    boot_from_local: ClockOffset = field(default_factory=ClockOffset)
    utc_from_boot: ClockOffset = field(default_factory=ClockOffset)

    def with_timesync(self, asked_s: float, vehicle_boot_s: float, answered_s: float) -> TimeBase:
        """An answer to a question sent at ``asked_s``, received ``answered_s`` (receiver's clock)."""
        if not 0 <= answered_s - asked_s < 10:  # somebody else's question
            return self
        middle = (asked_s + answered_s) / 2
        sample = OffsetSample(middle, vehicle_boot_s - middle, (answered_s - asked_s) / 2)
        return replace(self, boot_from_local=self.boot_from_local.add(sample))

    def with_system_time(self, vehicle_boot_s: float, utc_s: float | None) -> TimeBase:
        """Both clocks of the vehicle read at once; nothing before it knows the date."""
        if utc_s is None:
            return self
        sample = OffsetSample(vehicle_boot_s, utc_s - vehicle_boot_s, 0.0015)
        return replace(self, utc_from_boot=self.utc_from_boot.add(sample))

    def boot_of_local(self, local_s: float) -> tuple[float, float] | None:
        """Receiver's time -> (vehicle's boot time, bound of its error); None while not known."""
        found = self.boot_from_local.at(local_s)
        return None if found is None else (local_s + found.offset_s, found.half_s)

    def utc_of_boot(self, vehicle_boot_s: float) -> tuple[float, float] | None:
        """Vehicle's boot time -> (UTC, bound of its error, the receiver's latency included)."""
        found = self.utc_from_boot.at(vehicle_boot_s)
        return None if found is None else (vehicle_boot_s + found.offset_s, found.half_s + GNSS_LATENCY_S)

    def boot_of_utc(self, utc_s: float) -> float | None:
        """The vehicle's own UTC back to its boot time (no GNSS latency: the same clock wrote both)."""
        if not self.utc_from_boot.samples:
            return None
        latest = self.utc_from_boot.samples[-1]
        found = self.utc_from_boot.at(utc_s - latest.offset_s)
        return None if found is None else utc_s - found.offset_s


def _half_s(sample: OffsetSample, at_s: float) -> float:
    return max(sample.half_s, LEAST_HALF_S) + DRIFT_PPM * 1e-6 * abs(at_s - sample.at_s)


def _overlap(samples: Sequence[OffsetSample], at_s: float) -> tuple[float, float, int]:
    """Where most of the bounds overlap: low, high, how many."""
    edges = []
    for sample in samples:
        half = _half_s(sample, at_s)
        edges += [(sample.offset_s - half, -1), (sample.offset_s + half, 1)]
    edges.sort()
    best, count, low, high = 0, 0, 0.0, 0.0
    for place, (value, kind) in enumerate(edges):
        count -= kind
        if count > best:
            best, low, high = count, value, edges[place + 1][0]
    return low, high, best

"""What a flight's record holds, as frozen values. No I/O."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from pathlib import Path
from typing import Any, Generic, TypeVar

from calib.findings import Verdict

#: Gives the time now, with a time zone; injected, so that tests and replays decide what time it is.
Clock = Callable[[], datetime]
Json = Mapping[str, Any]
T = TypeVar("T")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def system_clock() -> datetime:
    """The computer's own clock, in UTC."""
    return datetime.now(UTC)


def microseconds(time: datetime) -> int:
    """Microseconds since 1970 UTC.

    Raises:
        ValueError: ``time`` has no time zone.
    """
    if time.tzinfo is None:
        raise ValueError("a time without a time zone cannot be recorded")
    return (time - _EPOCH) // timedelta(microseconds=1)


def from_microseconds(count: int) -> datetime:
    return _EPOCH + timedelta(microseconds=count)


class ClockName(StrEnum):
    """Whose clock a time was read from; times on two clocks are not comparable without an offset."""

    UTC = "utc"  # seconds since 1970, as this computer believes
    GPS = "gps"  # seconds since 1970 UTC, from the vehicle's receiver
    BOOT = "boot"  # seconds since the autopilot started
    CAMERA = "camera"  # seconds since 1970 by the camera's clock, in no known zone
    MONOTONIC = "monotonic"  # seconds since this computer started


@dataclass(frozen=True)
class Stamp:
    """``time_s`` in seconds on ``clock``; ``sigma_s`` in seconds, None where it is not known."""

    time_s: float
    clock: ClockName
    sigma_s: float | None = None


@dataclass(frozen=True)
class Recorded(Generic[T]):
    """A value as the record holds it: ``seq`` counts from 1 within its kind, ``recorded`` is in UTC."""

    seq: int
    recorded: datetime
    value: T


@dataclass(frozen=True)
class Flight:
    """``name`` as the flight was begun, which its folder may no longer have."""

    name: str
    created: datetime


@dataclass(frozen=True)
class Plan:
    """A mission file as it was, byte for byte."""

    name: str
    content: bytes


@dataclass(frozen=True)
class Event:
    kind: str
    at: Stamp
    data: Json = field(default_factory=dict)


@dataclass(frozen=True)
class Trigger:
    """One exposure as the vehicle reports it; not measured: whether the camera really took it.

    ``key`` names this exposure for good ("boot 2, camera 1, 17"): a report of it that comes again
    after a cut or a restart is recognised by it. Position in WGS84 degrees and metres above mean sea
    level, None where the vehicle gave none.
    """

    key: str
    at: Stamp
    image_index: int | None = None
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_amsl_m: float | None = None
    data: Json = field(default_factory=dict)


@dataclass(frozen=True)
class PhotoFile:
    """A photo that arrived whole; ``path`` is relative to the flight's folder where it lies inside it."""

    path: Path
    sha256: str
    size_bytes: int


@dataclass(frozen=True)
class Pair:
    """``photo`` and ``trigger`` are seqs; ``probability`` (0-1) that they belong together.

    ``sure`` pairs may be geotagged; ``data`` holds position and its sigma at the exposure.
    """

    photo: int
    trigger: int
    probability: float
    sure: bool
    data: Json = field(default_factory=dict)


@dataclass(frozen=True)
class Pairing:
    """One version of all pairs (its seq is the version); ``data``: clock offset, drift, how found.

    ``photos`` and ``triggers`` say up to which seq it saw them: what came later is not yet paired,
    what is older and in no pair was looked at and left alone.
    """

    pairs: tuple[Pair, ...]
    photos: int
    triggers: int
    data: Json = field(default_factory=dict)


@dataclass(frozen=True)
class SolutionRecord:
    """A self-calibration; ``photos`` is the seq of the last photo that had arrived for it."""

    photos: int
    data: Json


@dataclass(frozen=True)
class VerdictRecord:
    """A verdict, ``report`` in schema ``fieldcal.check/1``; ``photos`` as in :class:`SolutionRecord`.

    ``solution`` is the seq of the solution behind it. ``final``: the flight was over.
    """

    report: Json
    photos: int
    final: bool = False
    solution: int | None = None

    @property
    def verdict(self) -> Verdict:
        return Verdict(self.report["verdict"])


@dataclass(frozen=True)
class Provenance:
    """Which programs wrote from here on; it names no machine, user or place."""

    versions: Mapping[str, str]


@dataclass(frozen=True)
class Counts:
    plans: int
    events: int
    triggers: int
    photos: int
    pairings: int
    solutions: int
    verdicts: int

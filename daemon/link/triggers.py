"""One photo, counted once, out of everything that vehicles and cameras say about it.

* ArduPilot repeats CAMERA_FEEDBACK as often as it is asked to: a photo is its ``img_idx``.
* A camera component adds CAMERA_IMAGE_CAPTURED, PX4 sends it beside CAMERA_TRIGGER: reports of two
  sources belong together by their times, and once their numbers are known to run in step, by those.
* Any message may be lost, late or doubled; numbers start again when the vehicle does.

Asking ArduPilot for CAMERA_FEEDBACK at a few hertz makes lost messages harmless: each photo is told
until the next one is taken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace

from daemon.link.events import PhotoFacts, PhotoReport, PhotoSource

#: Two sources' times of one photo differ by less (shutter lag), in one clock. Until the numbers are
#: known to run in step, photos closer together than twice this can be mistaken where messages are lost.
SAME_CLOCK_S = 0.45
#: The same where only the times of arrival can be compared.
ARRIVAL_S = 1.0
#: Where the numbers say something else, times must agree this well to be believed.
SURE_S = 0.1
#: Numbers tell of a new start first, the clock within so long.
NOTICED_S = 30.0
#: The same number with a time so near is the same message.
SAME_REPORT_S = 1e-3
#: The other source may tell of a photo so long after, while the vehicle's new start is noticed.
LATE_S = 5.0
#: A number told again with a time this much later is another photo: the vehicle started anew.
RESTART_S = 2.0
#: A report is compared with so many photos back.
LOOK_BACK = 64
#: After so many agreeing pairs the numbers of two sources are taken to run in step.
IN_STEP = 2


@dataclass(frozen=True)
class Trigger(PhotoFacts):
    """One photo as known so far. ``number`` counts from 1 in the order of first hearing; ``revision``
    grows when a later report adds something. ``heard_s``: receiver's clock, of the first report.
    ``indices``: the number that each source gave. ``confirmed``: None until a camera says so.
    """

    number: int
    revision: int
    heard_s: float
    indices: tuple[tuple[PhotoSource, int], ...]
    camera: int
    vehicle_boot_s: float | None
    utc_s: float | None

    def index(self, source: PhotoSource) -> int | None:
        return dict(self.indices).get(source)


_SHARED = ("vehicle_boot_s", "utc_s", *(f.name for f in fields(PhotoFacts)))
_Key = tuple[int, PhotoSource, int, int, int]
_Stream = tuple[PhotoSource, int, int]


@dataclass
class TriggerFilter:
    """Feed every :class:`PhotoReport` to :meth:`add`; :attr:`photos` is the count of photos."""

    photos: list[Trigger] = field(default_factory=list)
    _by_key: dict[_Key, int] = field(default_factory=dict)
    _times: dict[_Key, tuple[float | None, float | None]] = field(default_factory=dict)
    _highest: dict[_Stream, tuple[int, float]] = field(default_factory=dict)
    _steps: dict[tuple[PhotoSource, PhotoSource], tuple[int, int]] = field(default_factory=dict)
    _lost: tuple[int, ...] = ()
    _noticed_s: float = -math.inf
    _epoch: int = 0
    _epoch_start: int = 0

    def add(self, report: PhotoReport, heard_s: float) -> Trigger | None:
        """The photo if the report is the first of it or adds to it; None if it says nothing new.

        ``heard_s``: arrival on any clock that never steps, in vehicle time or faster.
        """
        if self._restarted(report):
            self._begin_anew()
            self._noticed_s = heard_s
        key = self._key(report)
        known = self._by_key.get(key, self._told_before(key, report))
        if known is not None:
            self._by_key[key] = known
            return self._merge(known, report)
        self._times[key] = (report.vehicle_boot_s, report.utc_s)
        if report.utc_s is not None:
            before = self._highest.get(_stream(report), (report.index, report.utc_s))
            self._highest[_stream(report)] = max(before, (report.index, report.utc_s))
        found = self._partner(report, heard_s)
        if found is not None:
            self._learn(self.photos[found], report)
            self._by_key[key] = found
            return self._merge(found, report)
        self._by_key[key] = len(self.photos)
        shared = {name: getattr(report, name) for name in _SHARED}
        number, own = len(self.photos) + 1, ((report.source, report.index),)
        self.photos.append(Trigger(number, 0, heard_s, own, report.camera, **shared))
        return self.photos[-1]

    def _told_before(self, key: _Key, report: PhotoReport) -> int | None:
        """The same photo, told before it was known that the vehicle had started anew."""
        earlier = (key[0] - 1, *key[1:])
        before = self._times.get(earlier)
        apart = None if before is None else _apart_s(before, (report.vehicle_boot_s, report.utc_s))
        if apart is None or abs(apart) > SAME_REPORT_S:
            return None
        self._times[key] = (report.vehicle_boot_s, report.utc_s)
        return self._by_key.get(earlier)

    def restarted(self, heard_s: float = math.inf) -> None:
        """The vehicle started anew (its boot time went back): numbers seen from here on are new photos.

        Where numbers told it shortly before, they are so already.
        """
        if heard_s - self._noticed_s > NOTICED_S:
            self._begin_anew()

    def _begin_anew(self) -> None:
        self._lost += self._lost_now()
        self._epoch += 1
        self._epoch_start = len(self.photos)
        self._steps.clear()
        self._highest.clear()

    def lost(self) -> tuple[int, ...]:
        """Numbers that no message told of, between the first and the last told since each of the vehicle's
        starts (so a number may be there twice).

        In the numbering of the first source that is there of feedback, trigger, captured. One camera.
        """
        return (*self._lost, *self._lost_now())

    def _lost_now(self) -> tuple[int, ...]:
        current = self.photos[self._epoch_start :]
        for source in PhotoSource:
            if not any(photo.index(source) is not None for photo in current):
                continue
            told = {n for photo in current if (n := self._number_in(photo, source)) is not None}
            return tuple(n for n in range(min(told), max(told)) if n not in told)
        return ()

    def _number_in(self, photo: Trigger, source: PhotoSource) -> int | None:
        own = photo.index(source)
        if own is not None:
            return own
        for other, index in photo.indices:
            step = self._steps.get((other, source))
            if step is not None:
                return index + step[0]
        return None

    def _key(self, report: PhotoReport) -> _Key:
        index = report.index
        if index < 0:  # not numbered by the camera: the tenth of a second tells photos apart
            index = -1 - round(10 * (report.vehicle_boot_s or report.utc_s or 0.0))
        return (self._epoch, report.source, report.component_id, report.camera, index)

    def _restarted(self, report: PhotoReport) -> bool:
        """The same number with another time, or a lower one with a later UTC than a higher one had.

        A late message has both its number and its time from before, so it is no restart.
        """
        before = self._times.get(self._key(report))
        if before is not None:
            apart = _apart_s(before, (report.vehicle_boot_s, report.utc_s))
            return apart is not None and abs(apart) > RESTART_S
        highest = self._highest.get(_stream(report))
        if report.utc_s is None or highest is None or report.index < 0:
            return False
        return report.index < highest[0] and report.utc_s > highest[1] + RESTART_S

    def _partner(self, report: PhotoReport, heard_s: float) -> int | None:
        """The photo that another source told of, and this one not yet."""
        best: tuple[float, int] | None = None
        for place in range(max(0, len(self.photos) - LOOK_BACK), len(self.photos)):
            photo = self.photos[place]
            earlier = place < self._epoch_start
            if photo.index(report.source) is not None or (earlier and heard_s - photo.heard_s > LATE_S):
                continue
            gap = _apart_s((photo.vehicle_boot_s, photo.utc_s), (report.vehicle_boot_s, report.utc_s))
            limit = SURE_S if earlier else SAME_CLOCK_S
            if gap is None and earlier:
                continue
            if gap is None:
                gap, limit = heard_s - photo.heard_s, ARRIVAL_S
            in_step = None if earlier else self._in_step(photo, report)
            if in_step is not None and not in_step:
                limit = SURE_S
            elif in_step:
                limit *= 5  # numbers agree: a message may well have come late
            if abs(gap) <= limit and (best is None or abs(gap) < best[0]):
                best = (abs(gap), place)
        return None if best is None else best[1]

    def _in_step(self, photo: Trigger, report: PhotoReport) -> bool | None:
        for source, index in photo.indices:
            step = self._steps.get((source, report.source))
            if step is not None and step[1] >= IN_STEP:
                return report.index - index == step[0]
        return None

    def _learn(self, photo: Trigger, report: PhotoReport) -> None:
        for source, index in photo.indices:
            for pair, step in (
                ((source, report.source), report.index - index),
                ((report.source, source), index - report.index),
            ):
                before = self._steps.get(pair)
                agreed = before[1] + 1 if before is not None and before[0] == step else 1
                self._steps[pair] = (step, agreed)

    def _merge(self, place: int, report: PhotoReport) -> Trigger | None:
        photo = self.photos[place]
        news: dict[str, object] = {
            name: value
            for name in _SHARED
            if getattr(photo, name) in (None, "") and (value := getattr(report, name)) not in (None, "")
        }
        if photo.index(report.source) is None:
            news["indices"] = (*photo.indices, (report.source, report.index))
        if not news:
            return None
        self.photos[place] = replace(photo, revision=photo.revision + 1, **news)  # type: ignore[arg-type]
        return self.photos[place]


def _stream(report: PhotoReport) -> _Stream:
    return (report.source, report.component_id, report.camera)


def _apart_s(
    one: tuple[float | None, float | None], other: tuple[float | None, float | None]
) -> float | None:
    """Second minus first in a clock that both have."""
    for a, b in zip(one, other, strict=True):
        if a is not None and b is not None:
            return b - a
    return None

"""The photos that a vehicle told of, in the flight's record before anybody is told, and restored from it.

Every report that says something new is an event; fed to a :class:`TriggerFilter` again in their order
they bring it back to where it was, so that a photo told again after a crash is the same photo.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from pydantic import TypeAdapter

from daemon.capture.adapters import image_index
from daemon.capture.geotag import Geotag
from daemon.capture.recent import Recent, doubted
from daemon.link.clock import TimeBase
from daemon.link.events import PhotoReport
from daemon.link.triggers import Trigger as LinkTrigger
from daemon.link.triggers import TriggerFilter
from daemon.session.reader import SessionReader
from daemon.session.rows import ClockName, Event, Stamp, Trigger
from daemon.session.store import Session

HEARD, PLACED, RESTARTED = "photo.heard", "photo.placed", "vehicle.restarted"
#: From the order to the exposure, s: cameras take up to 0.2 s, unless a pin tells the exposure itself.
ORDERED_SIGMA_S, EXPOSED_SIGMA_S = 0.1, 0.02
#: A photo whose moment stays unknown so long is placed as its message says.
_PATIENCE_S = 10.0
_REPORT, _TAG = TypeAdapter(PhotoReport), TypeAdapter(Geotag)


@dataclass(frozen=True)
class Offer:
    """Where a photo's file can be fetched, told by a component of the vehicle. ``number``: of the photo."""

    number: int
    url: str
    component_id: int


class TriggerBook:
    """All of one flight. ``seqs``: number of the photo -> its seq in the record; ``offers``: -> its file."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._filter = TriggerFilter()
        self._times: dict[int, _Times] = {}
        self._started = 0
        self._open: dict[int, float] = {}
        self.places: dict[int, Geotag] = {}
        self.seqs: dict[int, int] = {}
        self.offers: dict[int, Offer] = {}
        self._restore()

    @property
    def count(self) -> int:
        """Photos told of."""
        return len(self._filter.photos)

    @property
    def confirmed(self) -> int | None:
        """Of them those that the camera itself confirmed; None where no camera ever does."""
        told = [photo for photo in self._filter.photos if photo.confirmed is not None or photo.completed]
        return sum(photo.confirmed is not False for photo in told) if told else None

    @property
    def lost(self) -> tuple[int, ...]:
        """Numbers that no message told of."""
        return self._filter.lost()

    def photos(self) -> list[LinkTrigger]:
        """In the order of first hearing, with their times on both clocks as far as they are known.

        Times since boot of before a restart are left out: they are no times of the clock that runs now.
        """
        found = []
        for photo in self._filter.photos:
            utc_s, boot_s = self._times.get(photo.number, (None, None))
            current = photo.number > self._started
            found.append(replace(photo, utc_s=utc_s, vehicle_boot_s=boot_s if current else None))
        return found

    def hear(self, report: PhotoReport, heard_s: float, base: TimeBase) -> bool:
        """Record a report if it says something new; whether it is a new photo.

        Raises:
            FieldcalError: the record cannot be written.
        """
        photo = self._filter.add(report, heard_s)
        if photo is None:
            return False
        new = photo.number not in self.seqs
        self._times[photo.number] = _known(self._times.get(photo.number), _times(photo, base))
        with self._session.batch():
            if new:
                self.seqs[photo.number] = self._session.add_trigger(_row(photo, heard_s)).seq
                self._open[photo.number] = heard_s
            self._session.add_event(Event(HEARD, Stamp(heard_s, ClockName.UTC), self._heard(photo, report)))
        self._note_offer(photo.number, report)
        return new

    def restarted(self, heard_s: float) -> None:
        """The vehicle began anew: its numbers and boot times are others now. Raises as :meth:`hear`."""
        self._filter.restarted(heard_s)
        self._started = self.count
        self._session.add_event(Event(RESTARTED, Stamp(heard_s, ClockName.UTC), {"photos": self.count}))

    def place(self, recent: Recent, base: TimeBase, now_s: float) -> None:
        """Give a position to every photo whose surroundings are known by now. Raises as :meth:`hear`.

        ``now_s``: the receiver's clock, as in ``heard_s``.
        """
        self._doubt(recent, now_s)
        for number, heard_s in list(self._open.items()):
            photo = self._filter.photos[number - 1]
            given_up = now_s - heard_s > _PATIENCE_S or number <= self._started
            _, boot_s = self._times[number] = _known(self._times.get(number), _times(photo, base))
            if not given_up and (boot_s is None or not recent.covers(boot_s)):
                continue
            del self._open[number]
            sigma_s = EXPOSED_SIGMA_S if photo.completed else ORDERED_SIGMA_S
            if number <= self._started:
                boot_s = None  # Of another clock than what is known of the track now.
            interpolated = None if boot_s is None else recent.at(boot_s, sigma_s)
            told = recent.told(photo, boot_s, sigma_s)
            tags = [tag for tag in (interpolated, told) if tag is not None]
            if not tags:
                continue
            # At the edge of a hole in the track the photo's own message knows better.
            tag = min(tags, key=lambda one: one.position.sigma_horizontal_m or 0.0)
            self._put(number, tag, now_s)

    def _doubt(self, recent: Recent, now_s: float) -> None:
        """Photos that were placed before it showed that their places may have jumped are known worse."""
        for doubt in recent.jumps.looking_back():
            for number in range(self.count, self._started, -1):
                tag, boot_s = self.places.get(number), self._times[number][1]
                if boot_s is not None and boot_s < doubt.since_s - _PATIENCE_S:
                    break
                if tag is None or boot_s is None or not doubt.holds(boot_s):
                    continue
                place = doubted(tag.position, doubt.horizontal_m, doubt.vertical_m)
                self._put(number, replace(tag, position=place), now_s)

    def _put(self, number: int, tag: Geotag, now_s: float) -> None:
        """Recorded; what was recorded of this photo before is over."""
        utc_s, boot_s = self._times[number]
        data = {
            "photo": number,
            "utc_s": utc_s,
            "boot_s": boot_s,
            "tag": _TAG.dump_python(tag, mode="json"),
        }
        self._session.add_event(Event(PLACED, Stamp(now_s, ClockName.UTC), data))
        self.places[number] = tag

    def _note_offer(self, number: int, report: PhotoReport) -> None:
        if report.url and report.confirmed is not False:
            self.offers.setdefault(number, Offer(number, report.url, report.component_id))

    def _heard(self, photo: LinkTrigger, report: PhotoReport) -> dict[str, Any]:
        utc_s, boot_s = self._times[photo.number]
        said = _REPORT.dump_python(report, mode="json", exclude_defaults=True)
        return {"photo": photo.number, "utc_s": utc_s, "boot_s": boot_s, "report": said}

    def _restore(self) -> None:
        rows = {row.value.key: row.seq for row in self._session.triggers()}
        for event in self._session.events():
            kind, data = event.value.kind, event.value.data
            if kind == RESTARTED:
                self._filter.restarted(event.value.at.time_s)
                self._started = self.count
            elif kind == HEARD:
                heard_s = event.value.at.time_s
                report = _REPORT.validate_python(data["report"])
                self._filter.add(report, heard_s)
                self._note_offer(data["photo"], report)
                self.seqs[data["photo"]] = rows[_key(data["photo"])]
                self._open.setdefault(data["photo"], heard_s)
                self._times[data["photo"]] = (data["utc_s"], data["boot_s"])
            elif kind == PLACED:
                self._open.pop(data["photo"], None)
                self._times[data["photo"]] = (data["utc_s"], data["boot_s"])
        self.places = places_of(self._session)


def places_of(session: SessionReader) -> dict[int, Geotag]:
    """Number of the photo -> position and angles, as recorded. Raises as :class:`SessionReader`."""
    return {
        row.value.data["photo"]: _TAG.validate_python(row.value.data["tag"]) for row in session.events(PLACED)
    }


#: UTC and time since boot, s.
_Times = tuple[float | None, float | None]


def _times(photo: LinkTrigger, base: TimeBase) -> _Times:
    """Each from the other where only one was told: the vehicle wrote both from one clock."""
    utc_s, boot_s = photo.utc_s, photo.vehicle_boot_s
    if utc_s is None and boot_s is not None:
        offset = base.utc_from_boot.at(boot_s)
        utc_s = None if offset is None else boot_s + offset.offset_s
    elif boot_s is None and utc_s is not None:
        boot_s = base.boot_of_utc(utc_s)
    return utc_s, boot_s


def _known(before: _Times | None, now: _Times) -> _Times:
    old = before or (None, None)
    return (old[0] if old[0] is not None else now[0], old[1] if old[1] is not None else now[1])


def _key(number: int) -> str:
    return f"photo {number}"


def _row(photo: LinkTrigger, heard_s: float) -> Trigger:
    clocks: Mapping[ClockName, float | None] = {
        ClockName.GPS: photo.utc_s,
        ClockName.BOOT: photo.vehicle_boot_s,
        ClockName.UTC: heard_s,
    }
    name, at_s = next((name, value) for name, value in clocks.items() if value is not None)
    return Trigger(
        _key(photo.number),
        Stamp(at_s, name),
        image_index(photo),
        photo.latitude_deg,
        photo.longitude_deg,
        photo.altitude_msl_m,
    )

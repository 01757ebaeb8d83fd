"""Photos and triggers of one flight, paired again as they come, and what the pairs tell of the photos.

Every pairing is in the record when it is used. Versions are stored whole, so they are made more seldom
the more photos there are.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from calib.photos.photo import Photo
from daemon.capture import adapters
from daemon.capture.geotag import Geotag
from daemon.capture.pairing import renew
from daemon.capture.records import ClockFit, Pair, Pairing, Shot
from daemon.capture.trigger_book import TriggerBook
from daemon.session import rows
from daemon.session.reader import SessionReader
from daemon.session.store import Session

#: Paired again for this share of new photos and triggers, or after a pause of so long, or anyway (s).
_MORE, _PAUSE_S, _ANYWAY_S = 0.05, 4.0, 60.0
#: Of the time at most this share goes into pairing.
_SHARE = 0.05
_NOTHING = Pairing((), (), (), None)


@dataclass(frozen=True)
class Arrived:
    """A photo in the folder; ``seq`` in the record."""

    photo: Photo
    seq: int


class Matching:
    """Args:
    anchors: (number of the vehicle's photo, file name) that the operator says belong together.
    """

    def __init__(
        self,
        session: Session,
        book: TriggerBook,
        anchors: Sequence[tuple[int, str]] = (),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._session, self._book, self._anchors, self._clock = session, book, list(anchors), clock
        self._seq_of, self.pairing = _restored(session, book)
        self._sizes = self._seen = (0, 0)
        self._changed_s, self._last_s, self._cost_s = -1e9, -1e9, 0.0

    def look(self, photos: Mapping[Path, Arrived], at_once: bool = False) -> bool:
        """Pair again if it is time, or ``at_once``; whether the pairing is another now.

        Raises:
            FieldcalError: the record cannot be written.
        """
        now_s, sizes = self._clock(), (self._book.count, len(photos))
        if sizes != self._sizes:
            self._sizes, self._changed_s = sizes, now_s
        if not at_once and not self._due(now_s):
            return False
        self._seen = sizes
        triggers = adapters.triggers(self._book.photos())
        shots = self._shots(photos)
        before, started_s = self.pairing, self._clock()
        names = {Path(shot.name).name: shot.name for shot in shots}
        anchors = [(number, names[name]) for number, name in self._anchors if name in names]
        # What is wanted at once is the last word: it rests on no earlier clock.
        self.pairing = renew(_NOTHING if at_once else before, triggers, shots, anchors=anchors)
        self._last_s = self._clock()
        self._cost_s = self._last_s - started_s
        if _content(before) == _content(self.pairing):
            return False
        self._record()
        return True

    def belongs(self, names: Mapping[str, int]) -> None:
        """File name -> number of the vehicle's photo, where the camera itself says which is which."""
        self._anchors += [(number, name) for name, number in names.items()]

    def tags(self) -> dict[str, Geotag]:
        """Absolute path of a photo -> position and angles of its trigger, for sure pairs."""
        return {
            pair.shot.name: self._book.places[pair.trigger.key]
            for pair in self.pairing.sure_pairs
            if pair.trigger.key in self._book.places
        }

    def _due(self, now_s: float) -> bool:
        new = sum(self._sizes) - sum(self._seen)
        if not new or now_s - self._last_s < self._cost_s / _SHARE:
            return False
        many = new >= max(1.0, _MORE * sum(self._seen))
        return many or now_s - self._changed_s > _PAUSE_S or now_s - self._last_s > _ANYWAY_S

    def _shots(self, photos: Mapping[Path, Arrived]) -> list[Shot]:
        """Those in the folder, and those paired in an earlier run that are not read again yet."""
        found = {pair.shot.name: pair.shot for pair in self.pairing.pairs}
        for path, arrived in photos.items():
            name = str(path.absolute())
            self._seq_of[name] = arrived.seq
            found.pop(name, None)
            for shot in adapters.shots([replace(arrived.photo, path=Path(name))]):
                found[name] = shot
        return list(found.values())

    def _record(self) -> None:
        pairs = [
            rows.Pair(
                self._seq_of[pair.shot.name],
                self._book.seqs[pair.trigger.key],
                pair.probability,
                pair.sure,
                {
                    "photo": pair.trigger.key,
                    "time_s": pair.shot.time_s,
                    "resolution_s": pair.shot.resolution_s,
                    "order": pair.shot.order,
                },
            )
            for pair in self.pairing.pairs
        ]
        clock = self.pairing.clock
        data: dict[str, Any] = {"advice": self.pairing.advice}
        if clock is not None and not self.pairing.ambiguous:
            data["clock"] = dict(vars(clock))
        counts = self._session.counts()
        self._session.add_pairing(rows.Pairing(tuple(pairs), counts.photos, counts.triggers, data))


def completed(photos: Sequence[Photo], tags: Mapping[str, Geotag]) -> list[Photo]:
    """The photos with what they do not say themselves filled in; what they say stays.

    Where most photos have a position of their own, the others get none: two receivers with heights of
    two kinds in one block do more harm than a few photos without.
    """
    own = sum(photo.position is not None for photo in photos)
    places = 2 * own <= len(photos)
    found = []
    for photo in photos:
        tag = tags.get(str(photo.path.absolute()))
        if tag is not None:
            photo = replace(
                photo,
                position=photo.position or (tag.position if places else None),
                gimbal=photo.gimbal or tag.gimbal,
                aircraft=photo.aircraft or tag.aircraft,
            )
        found.append(photo)
    return found


def parted(pairing: Pairing, count: int, lost: int) -> str | None:
    """Where triggers and photos part, in a sentence; None where they do not, or nothing can be said yet.

    ``count``: triggers told of. Photos that may still come, after the last paired one, are not missed.
    """
    if not pairing.pairs:
        return None
    last = max(pair.trigger.time_s for pair in pairing.pairs)
    first = min(pair.trigger.time_s for pair in pairing.pairs)
    parts = []
    missing = sum(first < trigger.time_s < last for trigger in pairing.triggers_without_photo)
    if missing:
        parts.append(f"triggers without photo: {missing} of {count}")
    if lost:
        parts.append(f"triggers not heard: {lost}")
    camera_s = (
        max(pair.shot.time_s for pair in pairing.pairs),
        min(pair.shot.time_s for pair in pairing.pairs),
    )
    lonely = sum(camera_s[1] < shot.time_s < camera_s[0] for shot in pairing.photos_without_trigger)
    if lonely:
        parts.append(f"photos without trigger: {lonely}")
    text = "; ".join(parts)
    return f"{text[0].upper()}{text[1:]}." if parts else None


def _content(pairing: Pairing) -> object:
    return {(pair.trigger.key, pair.shot.name, pair.sure) for pair in pairing.pairs}, pairing.advice


def _restored(session: SessionReader, book: TriggerBook) -> tuple[dict[str, int], Pairing]:
    """Seqs of the recorded photos by absolute path, and the newest pairing of them."""
    paths = {row.seq: str(session.folder.absolute() / row.value.path) for row in session.photos()}
    seq_of = {path: seq for seq, path in paths.items()}
    recorded = session.pairing()
    if recorded is None:
        return seq_of, _NOTHING
    triggers = {trigger.key: trigger for trigger in adapters.triggers(book.photos())}
    pairs = []
    for pair in recorded.value.pairs:
        data = pair.data
        shot = Shot(paths[pair.photo], data["time_s"], data["resolution_s"], data["order"])
        if data["photo"] in triggers:
            pairs.append(Pair(triggers[data["photo"]], shot, pair.probability))
    clock = recorded.value.data.get("clock")
    return seq_of, Pairing(tuple(pairs), (), (), None if clock is None else ClockFit(**clock))

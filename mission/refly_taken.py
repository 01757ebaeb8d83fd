"""Which photos of a card are those of a recommended pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from calib.camera import FloatArray
from calib.flown_file import SurveyPhoto
from calib.frames import rotation_cam_from_world
from calib.photos.photo import Photo
from calib.wording import printable
from mission.planned_network import poses
from mission.refly_record import Pass, PassRecord

#: How far a photo may be from its station: two receivers' errors and a pilot's by hand, the larger of metres
#: and a share of the flying height; the same for heights above launch; and between their optical axes.
NEAR_M, NEAR_SHARE, HEIGHT_M, HEIGHT_SHARE, AXIS_DEG = 20.0, 0.3, 10.0, 0.25, 20.0
#: What such errors usually are; the nearest pairs in these units are taken.
_USUAL_M, _USUAL_HEIGHT_M, _USUAL_DEG = 5.0, 3.0, 5.0
#: Where the survey itself is not there to prove it: this share of the stations has a photo, and two at least.
ALONE_SHARE, ALONE_LEAST = 0.5, 2
#: Of the photos taken while the pass was flown so many are of it, or it was another flight that came by.
OWN_SHARE = 0.4
_NEVER = 1e6


@dataclass(frozen=True)
class Taken:
    """A pass that was flown, ``flown`` of those in the record.

    ``photos``: for each of its stations (None: none); ``survey``: of the survey before.
    """

    record: PassRecord
    flown: Pass
    photos: tuple[Photo | None, ...]
    survey: tuple[Photo, ...]

    @property
    def count(self) -> int:
        """Stations with a photo."""
        return sum(photo is not None for photo in self.photos)


def taken(record: PassRecord, photos: Sequence[Photo], named: bool = False) -> Taken | None:
    """The photos of the pass among ``photos``; None where it is not there.

    By the camera, by the time (after the survey), by place, height and direction against the stations. The
    survey's own photos are known by their image data. ``named``: the user says that this is the pass.
    """
    known = {_key(p) for p in record.survey}
    mine = [p for p in photos if _same_camera(record, p)]
    survey = tuple(p for p in mine if _key(p) in known)
    times = [p.time for p in record.survey if p.time is not None]
    last = max(times, default=None)
    later = [
        p
        for p in mine
        if _key(p) not in known and (p.time is None or last is None or p.time > last)
    ]  # fmt: skip
    proven = bool(survey) or named
    tried = [Taken(record, one, _photos_of(record, one, later, proven), survey) for one in record.passes]
    best = max(tried, key=lambda t: t.count / len(t.photos))
    return best if best.count or named else None


def _photos_of(
    record: PassRecord, one: Pass, later: Sequence[Photo], proven: bool
) -> tuple[Photo | None, ...]:
    """The photo of each station; none at all where they are too few to be that pass."""
    pairs = _pairs(record, one, later)
    least = 1 if proven else max(ALONE_LEAST, ALONE_SHARE * len(one.stations))
    if len(pairs) < least or not _mostly_of_it([later[i] for i in pairs.values()], later):
        pairs = {}
    return tuple(later[pairs[s]] if s in pairs else None for s in range(len(one.stations)))


def _key(photo: SurveyPhoto | Photo) -> object:
    """The same for the same photo, now and when the survey was checked."""
    name = str(photo.path).replace("\\", "/").rsplit("/", 1)[-1]
    return photo.fingerprint or (name.lower(), photo.time)


def _same_camera(record: PassRecord, photo: Photo) -> bool:
    camera = photo.camera
    same_size = (camera.width, camera.height) == (record.width, record.height)
    return same_size and printable(camera.name) == record.camera


def _mostly_of_it(own: Sequence[Photo], later: Sequence[Photo]) -> bool:
    """Whether little else was photographed while the pass was flown."""
    times = [p.time for p in own if p.time is not None]
    if len(times) < len(own) or not times:
        return len(own) >= OWN_SHARE * len(later)
    between = sum(p.time is None or min(times) <= p.time <= max(times) for p in later)
    return len(own) >= OWN_SHARE * between


def _pairs(record: PassRecord, one: Pass, photos: Sequence[Photo]) -> dict[int, int]:
    """Station -> photo, each at most once, together as near as can be."""
    cost = _cost(record, one, photos)
    if not cost.size:
        return {}
    rows, columns = linear_sum_assignment(cost)
    return {int(s): int(p) for s, p in zip(rows, columns, strict=True) if cost[s, p] < _NEVER}


def _cost(record: PassRecord, one: Pass, photos: Sequence[Photo]) -> FloatArray:
    """(stations, photos): squared distance in usual errors; _NEVER where a photo is not the station's."""
    stations = one.planned
    rotations, centres = poses(stations)
    cost = np.zeros((len(stations), len(photos)))
    for j, photo in enumerate(photos):
        at = photo.position
        if at is None:
            cost[:, j] = _NEVER
            continue
        place = record.frame.enu(
            np.array([at.latitude_deg]), np.array([at.longitude_deg]), np.array([0.0])
        )[0]  # fmt: skip
        away = np.linalg.norm(centres[:, :2] - place[:2], axis=1)
        far = ~(away <= max(NEAR_M, NEAR_SHARE * record.height_agl_m))
        cost[:, j] += (away / _USUAL_M) ** 2
        if at.height_above_launch_m is not None:
            up = np.abs(centres[:, 2] - at.height_above_launch_m)
            far |= ~(up <= max(HEIGHT_M, HEIGHT_SHARE * record.height_agl_m))
            cost[:, j] += (up / _USUAL_HEIGHT_M) ** 2
        if photo.gimbal is not None:
            axis = rotation_cam_from_world(photo.gimbal)[2]
            turn = np.degrees(np.arccos(np.clip(rotations[:, 2] @ axis, -1, 1)))
            far |= ~(turn <= AXIS_DEG)
            cost[:, j] += (turn / _USUAL_DEG) ** 2
        cost[far, j] = _NEVER
    return cost

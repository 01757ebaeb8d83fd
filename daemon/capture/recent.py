"""Where the vehicle has been in the last half minute, and so where its camera was at an exposure. No I/O."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Iterable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from calib.photos.photo import AltitudeDatum, GimbalAngles, Position
from daemon.capture.geotag import Geotag
from daemon.capture.jumps import UNWATCHED_M, Doubt, Jumps
from daemon.capture.position import MAX_HOLE_S, ExposurePosition, Track, TrackSample
from daemon.link import events as ev
from daemon.link.attitude import between, earth_angles
from daemon.link.events import Angles, PhotoFacts

T = TypeVar("T")
KEEP_S = 30.0
#: Of each kind, for senders of positions that never come.
_MOST = 5000
#: Samples this far to both sides of an exposure enter its position.
_AROUND_S = 5.0
#: An attitude this far from the exposure is none.
_ATTITUDE_S = 0.6
#: An exposure is not waited for longer than this for the sample behind it.
_WAIT_S = 1.5
#: GPS_FIX_TYPE of an RTK receiver (float, fixed); others are not believed to be better than a metre, which
#: they state but do not keep over a flight.
_RTK = 5
_LEAST_PLAIN_M = 1.0
#: Single-frequency ranges in the open, one sigma: what times the dilution gives a sigma where none is stated.
_RANGE_M, _RANGE_UP_M = 1.9, 2.1
#: GPS_FIX_TYPE of a place in three dimensions; without one the autopilot reckons on, and drifts.
_FIXED, _UNFIXED_M = 3, 30.0
#: At most what a survey is flown at; for a position whose speed is not known.
_SPEED_M_S = 10.0


class Recent:
    """Feed every event to :meth:`add`. Times are the vehicle's boot clock, s."""

    def __init__(self) -> None:
        self._samples: deque[TrackSample] = deque(maxlen=_MOST)
        self._launch_m: float | None = None
        self._attitudes: deque[tuple[float, Angles]] = deque(maxlen=_MOST)
        self._gimbals: deque[tuple[float, ev.GimbalAttitude]] = deque(maxlen=_MOST)
        self._plain = TrackSample(0.0, 0.0, 0.0, 0.0)
        self._rtk = False
        self.jumps = Jumps()
        self._news: list[Doubt] = []
        self._said_s = -np.inf

    def news(self) -> list[Doubt]:
        """Jumps of the position since the last call; of many in a row the first."""
        found, self._news = self._news, []
        return found

    def add(self, event: ev.Event) -> None:
        if isinstance(event, ev.VehicleRestarted):
            for series in (self._samples, self._attitudes, self._gimbals):
                series.clear()
            self.jumps, self._said_s = Jumps(), -np.inf
        elif isinstance(event, ev.GnssFix):
            self._plain, self._rtk = _accuracy(event), event.fix >= _RTK
        elif isinstance(event, ev.Position):
            self._launch_m = event.altitude_msl_m - event.height_m
            sample = replace(
                self._plain,
                time_s=event.vehicle_boot_s,
                latitude_deg=event.latitude_deg,
                longitude_deg=event.longitude_deg,
                altitude_m=event.altitude_msl_m,
            )
            self._samples.append(sample)
            jump = self.jumps.add(sample, event.velocity_enu_m_s)
            if jump is not None and jump.since_s > self._said_s + KEEP_S:
                self._said_s = jump.since_s
                self._news.append(jump)
            self._forget(event.vehicle_boot_s - KEEP_S)
        elif isinstance(event, ev.Attitude):
            self._attitudes.append((event.vehicle_boot_s, event.angles))
        elif isinstance(event, ev.GimbalAttitude):
            at_s = event.vehicle_boot_s
            if at_s is None and self._attitudes:
                at_s = self._attitudes[-1][0]
            if at_s is not None:
                self._gimbals.append((at_s, event))

    def covers(self, boot_s: float) -> bool:
        """Whether waiting longer would tell nothing more about this moment."""
        if not self._samples or self._samples[-1].time_s < boot_s:
            return False
        if self._samples[-1].time_s > boot_s + _WAIT_S:
            return True
        others = [series[-1][0] for series in (self._attitudes, self._gimbals) if series]
        return all(newest_s >= boot_s for newest_s in others)

    def at(self, boot_s: float, sigma_s: float) -> Geotag | None:
        """Position and angles at a moment known to ``sigma_s``; None in a hole of the track."""
        near = [s for s in self._samples if abs(s.time_s - boot_s) <= _AROUND_S]
        place = Track(near).at(boot_s, sigma_s)
        if place is None:
            return None
        height_m = None if self._launch_m is None else place.altitude_m - self._launch_m
        return self._tag(boot_s, doubted(_position(place, height_m), *self.jumps.at(boot_s)))

    def told(self, photo: PhotoFacts, boot_s: float | None, sigma_s: float) -> Geotag | None:
        """The same from the position that came with the photo's own message; None where none came."""
        if photo.latitude_deg is None or photo.longitude_deg is None or photo.altitude_msl_m is None:
            return None
        moved_m = _SPEED_M_S * sigma_s
        place = Position(
            photo.latitude_deg,
            photo.longitude_deg,
            photo.altitude_msl_m,
            photo.height_m,
            float(np.hypot(self._plain.sigma_horizontal_m, moved_m)),
            float(np.hypot(self._plain.sigma_vertical_m, moved_m)),
            AltitudeDatum.SEA_LEVEL,
        )
        if boot_s is not None and self._watched(boot_s):
            place = doubted(place, *self.jumps.at(boot_s))
        elif not self._rtk:
            # Nothing shows whether the place had jumped then.
            place = doubted(place, UNWATCHED_M, UNWATCHED_M)
        tag = self._tag(boot_s, place)
        if tag.aircraft is None and photo.vehicle_angles is not None:
            return replace(tag, aircraft=_camera_angles(photo.vehicle_angles))
        return tag

    def _watched(self, boot_s: float) -> bool:
        """Whether the track has no hole there."""
        before = max((s.time_s for s in self._samples if s.time_s <= boot_s), default=-np.inf)
        after = min((s.time_s for s in self._samples if s.time_s >= boot_s), default=np.inf)
        return after - before <= MAX_HOLE_S

    def _tag(self, boot_s: float | None, place: Position) -> Geotag:
        aircraft = None if boot_s is None else _mean(_around(self._attitudes, boot_s), boot_s)
        gimbal = None if boot_s is None else _mean(self._gimbal_around(boot_s), boot_s)
        return Geotag(
            place,
            None if gimbal is None else _camera_angles(gimbal),
            None if aircraft is None else _camera_angles(aircraft),
        )

    def _gimbal_around(self, boot_s: float) -> list[tuple[float, Angles]]:
        found = []
        for at_s, gimbal in _around(self._gimbals, boot_s):
            vehicle = _mean(_around(self._attitudes, at_s), at_s)
            angles = None if vehicle is None else earth_angles(gimbal, vehicle)
            if angles is not None:
                found.append((at_s, angles))
        return found

    def _forget(self, before_s: float) -> None:
        while self._samples[0].time_s < before_s:
            self._samples.popleft()
        for series in (self._attitudes, self._gimbals):
            while series and series[0][0] < before_s:
                series.popleft()


def _accuracy(fix: ev.GnssFix) -> TrackSample:
    """The receiver's claim, as far as it is believed; without one what its dilutions make likely."""
    least_m = 0.0 if fix.fix >= _RTK else _LEAST_PLAIN_M
    usual = TrackSample(0.0, 0.0, 0.0, 0.0)
    across_m, up_m = usual.sigma_horizontal_m, usual.sigma_vertical_m
    if fix.hdop is not None:
        across_m = max(across_m, _RANGE_M * fix.hdop)
    if fix.vdop is not None:
        up_m = max(up_m, _RANGE_UP_M * fix.vdop)
    if fix.fix < _FIXED:
        across_m = up_m = least_m = _UNFIXED_M
    return replace(
        usual,
        sigma_horizontal_m=max(fix.horizontal_accuracy_m or across_m, least_m),
        sigma_vertical_m=max(fix.vertical_accuracy_m or up_m, least_m),
    )


def doubted(place: Position, horizontal_m: float, vertical_m: float) -> Position:
    """The same place, known by so much worse."""
    return replace(
        place,
        sigma_horizontal_m=float(np.hypot(place.sigma_horizontal_m or 0.0, horizontal_m)),
        sigma_vertical_m=float(np.hypot(place.sigma_vertical_m or 0.0, vertical_m)),
    )


def _position(place: ExposurePosition, height_m: float | None) -> Position:
    return Position(
        place.latitude_deg,
        place.longitude_deg,
        place.altitude_m,
        height_m,
        place.sigma_horizontal_m,
        place.sigma_vertical_m,
        AltitudeDatum.SEA_LEVEL,
    )


def _around(series: Iterable[tuple[float, T]], at_s: float) -> list[tuple[float, T]]:
    """The last sample before and the first after a moment, where they are near; messages may come late."""
    ordered = sorted(series, key=lambda sample: sample[0])
    right = bisect_left([sample[0] for sample in ordered], at_s)
    pair = ordered[max(right - 1, 0) : right + 1]
    return [sample for sample in pair if abs(sample[0] - at_s) <= _ATTITUDE_S]


def _mean(samples: list[tuple[float, Angles]], at_s: float) -> Angles | None:
    if len(samples) < 2 or samples[0][0] == samples[-1][0]:
        return samples[0][1] if samples else None
    (before_s, before), (after_s, after) = samples
    return between(before, after, (at_s - before_s) / (after_s - before_s))


def _camera_angles(angles: Angles) -> GimbalAngles:
    """MAVLink's order of turns is DJI's: yaw, pitch, roll from north-east-down."""
    return GimbalAngles(angles.yaw_deg, angles.pitch_deg, angles.roll_deg)

"""The camera's position at the exposure, from the vehicle's track."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.camera import FloatArray
from calib.frames import LocalFrame

#: Further than this from a sample nothing is made up.
MAX_EXTRAPOLATION_S = 1.0
#: Longer holes in the track than this are not bridged, except within MAX_EXTRAPOLATION_S of a sample.
MAX_HOLE_S = 2.0
#: What a multirotor accelerates at most in a survey; bounds the error between samples.
ACCELERATION_M_S2 = 3.0


@dataclass(frozen=True)
class TrackSample:
    """Vehicle clock in s; WGS84 degrees; altitude in m on the caller's datum, kept as it is; roll,
    pitch, yaw of the vehicle in degrees (aerospace order, yaw clockwise from true north); standard
    deviations of the position in m."""

    time_s: float
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0
    sigma_horizontal_m: float = 1.5
    sigma_vertical_m: float = 3.0


@dataclass(frozen=True)
class LeverArm:
    """Camera as seen from the point the track describes, in the vehicle's axes, m; ``sigma_m`` each."""

    forward_m: float = 0.0
    right_m: float = 0.0
    down_m: float = 0.0
    sigma_m: float = 0.02


@dataclass(frozen=True)
class ExposurePosition:
    """Where the camera was (WGS84 degrees, m on the track's datum), how the vehicle lay (degrees, yaw
    0-360), its speed over ground, and sigmas in m that hold the track's own, the moment's and the
    interpolation's."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    roll_deg: float
    pitch_deg: float
    yaw_deg: float
    speed_m_s: float
    sigma_horizontal_m: float
    sigma_vertical_m: float


class Track:
    """Samples sorted by time, the later of two at one time kept; immutable.

    Linear between neighbours in a local metric frame, angles along the shorter way round.
    """

    def __init__(self, samples: Sequence[TrackSample]) -> None:
        by_time = {s.time_s: s for s in samples}
        self._samples = [by_time[t] for t in sorted(by_time)]
        self._time_s = np.array([s.time_s for s in self._samples])
        self._frame: LocalFrame | None = None
        self._enu_m: FloatArray = np.zeros((0, 3))
        if self._samples:
            first = self._samples[0]
            self._frame = LocalFrame(
                float(first.latitude_deg), float(first.longitude_deg), float(first.altitude_m)
            )
            self._enu_m = self._frame.enu(
                np.array([s.latitude_deg for s in self._samples]),
                np.array([s.longitude_deg for s in self._samples]),
                np.array([s.altitude_m for s in self._samples]),
            )

    def at(
        self, time_s: float, sigma_s: float = 0.0, lever: LeverArm | None = None
    ) -> ExposurePosition | None:
        """The camera at a moment of the vehicle's clock with its sigma in s.

        None more than 1 s before the first or after the last sample, or that far into a hole.
        """
        if self._frame is None or not np.isfinite(time_s):
            return None
        nearest_s = float(np.abs(self._time_s - time_s).min())
        right = int(np.searchsorted(self._time_s, time_s))
        inside = 0 < right < len(self._time_s) or nearest_s == 0
        right = min(max(right, 1), len(self._time_s) - 1) if len(self._time_s) > 1 else 0
        left = max(right - 1, 0)
        before, after = self._samples[left], self._samples[right]
        span_s = after.time_s - before.time_s
        if nearest_s > MAX_EXTRAPOLATION_S and not (inside and span_s <= MAX_HOLE_S):
            return None
        share = (time_s - before.time_s) / span_s if span_s > 0 else 0.0
        velocity = (self._enu_m[right] - self._enu_m[left]) / span_s if span_s > 0 else np.zeros(3)
        place = self._enu_m[left] + share * (self._enu_m[right] - self._enu_m[left])
        # Angles are interpolated only: a turn continued beyond the last sample would be invented.
        held = min(max(share, 0.0), 1.0)
        roll, pitch, yaw = (
            _between(a, b, held)
            for a, b in (
                (before.roll_deg, after.roll_deg),
                (before.pitch_deg, after.pitch_deg),
                (before.yaw_deg, after.yaw_deg),
            )
        )
        lever = lever or LeverArm()
        place = place + _enu_from_vehicle(roll, pitch, yaw) @ np.array(
            [lever.forward_m, lever.right_m, lever.down_m]
        )
        latitude, longitude, altitude = self._frame.geodetic(place[None])[0].tolist()
        speed, climb = float(np.hypot(velocity[0], velocity[1])), abs(float(velocity[2]))
        # Chord against arc: at most a t (T - t) / 2 between samples, and beyond the ends the same form.
        bend = ACCELERATION_M_S2 / 2 * abs((time_s - before.time_s) * (after.time_s - time_s))
        if span_s == 0:  # a single sample: unknown speed
            bend = 10.0 * nearest_s
        own = [before, after]
        horizontal = np.sqrt(
            max(s.sigma_horizontal_m for s in own) ** 2 + (speed * sigma_s) ** 2 + bend**2 + lever.sigma_m**2
        )
        vertical = np.sqrt(
            max(s.sigma_vertical_m for s in own) ** 2 + (climb * sigma_s) ** 2 + bend**2 + lever.sigma_m**2
        )
        return ExposurePosition(
            latitude,
            longitude,
            altitude,
            (roll + 180) % 360 - 180,
            (pitch + 180) % 360 - 180,
            yaw % 360,
            speed,
            float(horizontal),
            float(vertical),
        )


def _between(from_deg: float, to_deg: float, share: float) -> float:
    return from_deg + share * ((to_deg - from_deg + 180) % 360 - 180)


def _enu_from_vehicle(roll_deg: float, pitch_deg: float, yaw_deg: float) -> FloatArray:
    """Rotation (3, 3) from forward-right-down to east-north-up."""
    (cr, cp, cy), (sr, sp, sy) = (f(np.radians([roll_deg, pitch_deg, yaw_deg])) for f in (np.cos, np.sin))
    north_east_down = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    enu: FloatArray = north_east_down[[1, 0, 2]] * np.array([[1.0], [1.0], [-1.0]])
    return enu

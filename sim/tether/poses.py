"""Where the camera was at a moment, from what the vehicle told of itself. Pure but for its memory.

What is told of the photo itself comes first: CAMERA_FOV_STATUS of that moment (the simulated vehicle's
own truth), then place and camera angles in the photo's message, then telemetry interpolated to the moment.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from calib.camera import FloatArray
from calib.frames import rotation_cam_from_world
from calib.photos.photo import GimbalAngles
from daemon.capture.position import Track, TrackSample
from daemon.link import events as ev
from daemon.link.attitude import angles_of, earth_angles, quaternion_of
from daemon.link.triggers import Trigger

#: A pose told with a time this near to a photo's is that photo's.
SAME_S = 0.03
#: Telemetry this far from a moment still counts for it.
NEAR_S = 3.0
_KEPT = 512
#: A camera without a gimbal looks straight down from the vehicle.
FIXED = ev.GimbalAttitude(None, ev.Angles(0.0, -90.0, 0.0), ev.AngleFrame.BODY)


@dataclass(frozen=True)
class Pose:
    """Degrees, m above the vehicle's sea level; rotation (3, 3); velocity (3,) east, north, up in m/s.

    ``told``: the vehicle told it of this very photo; else it is interpolated.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    rotation_cam_from_world: FloatArray
    velocity_m_s: FloatArray
    told: bool


class Poses:
    """Feed every event to :meth:`add`; times are the vehicle's, since its start."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """The vehicle started anew, and so did its clock."""
        self._positions: deque[ev.Position] = deque(maxlen=_KEPT)
        self._attitudes: deque[ev.Attitude] = deque(maxlen=_KEPT)
        self._gimbals: deque[ev.GimbalAttitude] = deque(maxlen=_KEPT)
        self._told: deque[ev.CameraPose] = deque(maxlen=_KEPT)

    def add(self, event: ev.Event) -> None:
        if isinstance(event, ev.Position):
            self._positions.append(event)
        elif isinstance(event, ev.Attitude):
            self._attitudes.append(event)
        elif isinstance(event, ev.GimbalAttitude):
            self._gimbals.append(event)
        elif isinstance(event, ev.CameraPose):
            self._told.append(event)

    def complete(self, boot_s: float) -> bool:
        """Whether nothing that is still to come would change the pose at a moment."""
        if self._of_the_photo(boot_s) is not None:
            return True
        timed = [s for s in self._gimbals if s.vehicle_boot_s is not None]
        streams: list[Sequence[ev.Position | ev.Attitude | ev.GimbalAttitude]]
        streams = [self._positions, self._attitudes, *([timed] if timed else [])]
        return all(stream and (stream[-1].vehicle_boot_s or 0.0) >= boot_s for stream in streams)

    def at(self, boot_s: float, photo: Trigger) -> Pose | None:
        """The camera's pose at a moment; None where too little is known of it."""
        velocity = self._velocity(boot_s)
        told = self._of_the_photo(boot_s)
        if told is not None:
            place = (told.latitude_deg, told.longitude_deg, told.altitude_msl_m)
            return Pose(*place, _rotation(told.angles), velocity, True)
        found = self._place(boot_s, photo)
        angles = photo.camera_angles or self._camera_angles(boot_s)
        if found is None or angles is None:
            return None
        return Pose(*found, _rotation(angles), velocity, False)

    def _of_the_photo(self, boot_s: float) -> ev.CameraPose | None:
        near = [pose for pose in self._told if abs(pose.vehicle_boot_s - boot_s) <= SAME_S]
        return min(near, key=lambda pose: abs(pose.vehicle_boot_s - boot_s), default=None)

    def _place(self, boot_s: float, photo: Trigger) -> tuple[float, float, float] | None:
        if (
            photo.latitude_deg is not None
            and photo.longitude_deg is not None
            and photo.altitude_msl_m is not None
        ):
            return photo.latitude_deg, photo.longitude_deg, photo.altitude_msl_m
        near = [p for p in self._positions if abs(p.vehicle_boot_s - boot_s) <= NEAR_S]
        samples = [
            TrackSample(p.vehicle_boot_s, p.latitude_deg, p.longitude_deg, p.altitude_msl_m) for p in near
        ]
        place = Track(samples).at(boot_s)
        return None if place is None else (place.latitude_deg, place.longitude_deg, place.altitude_m)

    def _velocity(self, boot_s: float) -> FloatArray:
        nearest = min(self._positions, key=lambda p: abs(p.vehicle_boot_s - boot_s), default=None)
        return np.zeros(3) if nearest is None else np.array(nearest.velocity_enu_m_s)

    def _camera_angles(self, boot_s: float) -> ev.Angles | None:
        near = [a for a in self._attitudes if abs(a.vehicle_boot_s - boot_s) <= NEAR_S]
        vehicle = _turned([(a.vehicle_boot_s, a.angles) for a in near], boot_s)
        if vehicle is None:
            return None
        gimbal = self._gimbal(boot_s)
        return None if gimbal is None else earth_angles(gimbal, vehicle)

    def _gimbal(self, boot_s: float) -> ev.GimbalAttitude | None:
        if not self._gimbals:
            return FIXED
        last = self._gimbals[-1]
        # Of ArduPilot's mounts the servo mount, which tells body angles, is the one that simulators have.
        frame = ev.AngleFrame.BODY if last.frame is ev.AngleFrame.UNSURE else last.frame
        if last.vehicle_boot_s is None:  # no time in the message: the last word counts
            return ev.GimbalAttitude(None, last.angles, frame)
        timed = [(s.vehicle_boot_s, s.angles) for s in self._gimbals if s.vehicle_boot_s is not None]
        angles = _turned([(t, a) for t, a in timed if abs(t - boot_s) <= NEAR_S], boot_s)
        return None if angles is None else ev.GimbalAttitude(boot_s, angles, frame)


def _turned(samples: Sequence[tuple[float, ev.Angles]], at_s: float) -> ev.Angles | None:
    """The angles between samples, by the shortest turn; before the first and after the last they stay."""
    if not samples:
        return None
    by_time = dict(sorted(samples, key=lambda sample: sample[0]))
    times = list(by_time)
    if len(times) == 1:
        return by_time[times[0]]
    turns = Rotation.from_quat([quaternion_of(a) for a in by_time.values()], scalar_first=True)
    between = Slerp(times, turns)(min(max(at_s, times[0]), times[-1]))
    return angles_of(between.as_quat(scalar_first=True).tolist())


def _rotation(angles: ev.Angles) -> FloatArray:
    """MAVLink's angles and DJI's gimbal angles are the same: yaw, pitch, roll of the optical axis."""
    return rotation_cam_from_world(GimbalAngles(angles.yaw_deg, angles.pitch_deg, angles.roll_deg))

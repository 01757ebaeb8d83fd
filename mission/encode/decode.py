"""From mission items back to the photos they take: for files, and for what a vehicle holds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from calib.camera import FloatArray
from calib.errors import FormatError
from calib.frames import LocalFrame
from mission.encode import constants as mav
from mission.encode.items import Flavour, Item
from mission.encode.roi import angles
from mission.plan import Station

MOST_PHOTOS_ON_LEG = 100_000
#: A photo by distance this close to the line's end (in distances) may or may not come: not counted.
UNSURE_END = 0.5


def guess_flavour(items: Sequence[Item]) -> Flavour:
    """ArduPilot's missions start with home: a waypoint at an absolute height."""
    home = bool(items) and items[0].command == mav.NAV_WAYPOINT and _plain(items[0].frame) == mav.GLOBAL
    return "ardupilot" if home else "px4"


def stations_of_items(
    items: Sequence[Item], launch: LocalFrame, flavour: Flavour | None = None
) -> tuple[Station, ...]:
    """Every photo that the mission takes, in order, in the launch point's frame.

    The heading is the last one commanded (CONDITION_YAW; on PX4 the waypoint's), or that of the
    flight where none is; a point of interest counts before both. Photos by distance are those
    before the line's end. ``pattern`` is empty: items do not carry it.

    Raises:
        FormatError: photos so close together that no flight meant them.
    """
    return _Replay(launch, flavour or guess_flavour(items)).run(items)


@dataclass
class _Replay:
    """The mission flown in the mind: where the vehicle is and where the camera looks."""

    launch: LocalFrame
    flavour: Flavour
    at_m: FloatArray = field(default_factory=lambda: np.zeros(3))
    yaw_deg: float = math.nan
    course_deg: float = 0.0
    gimbal_yaw_deg: float = 0.0
    gimbal_absolute: bool = False
    pitch_deg: float = -90.0
    roi_m: FloatArray | None = None
    spacing_m: float = 0.0
    first_now: bool = False
    found: list[Station] = field(default_factory=list)

    def run(self, items: Sequence[Item]) -> tuple[Station, ...]:
        where = self._places(items)
        start = 1 if self.flavour == "ardupilot" and guess_flavour(items) == "ardupilot" else 0
        for index in range(start, len(items)):
            item = items[index]
            if item.command in mav.FLOWN_TO:
                self._fly(item, where[index])
            elif item.command == mav.NAV_RETURN_TO_LAUNCH:
                self.spacing_m = 0.0
            else:
                self._do(item, where[index])
        return tuple(self.found)

    def _places(self, items: Sequence[Item]) -> FloatArray:
        """East, north, up of every item (n, 3); NaN where it has none."""
        out = np.full((len(items), 3), np.nan)
        chosen = [i for i, item in enumerate(items) if item.has_place]
        if chosen:
            altitude = [
                items[i].z + (0.0 if _plain(items[i].frame) == mav.GLOBAL else self.launch.altitude_m)
                for i in chosen
            ]
            out[chosen] = self.launch.enu(
                np.array([items[i].latitude_deg for i in chosen]),
                np.array([items[i].longitude_deg for i in chosen]),
                np.array(altitude, dtype=float),
            )
        return out

    def _fly(self, item: Item, to_m: FloatArray) -> None:
        if item.command == mav.NAV_TAKEOFF:
            self.at_m = np.array([*self.at_m[:2], to_m[2]]) if np.isfinite(to_m).all() else self.at_m
            return
        if not np.isfinite(to_m).all():
            return
        way = to_m - self.at_m
        if math.hypot(way[0], way[1]) > 0.1:
            self.course_deg = float(np.degrees(np.arctan2(way[0], way[1])) % 360)
        if self.spacing_m > 0:
            self._line(to_m)
        self.at_m = to_m
        # Copter ignores a waypoint's yaw.
        if self.flavour == "px4" and item.command == mav.NAV_WAYPOINT:
            self.yaw_deg = item.param4 % 360 if math.isfinite(item.param4) else math.nan

    def _line(self, to_m: FloatArray) -> None:
        length = float(np.linalg.norm(to_m - self.at_m))
        if length > MOST_PHOTOS_ON_LEG * self.spacing_m:
            raise FormatError(
                f"The mission asks for more than {MOST_PHOTOS_ON_LEG} photos on one leg: it is damaged."
            )
        step = 0 if self.first_now else 1
        while step == 0 or step * self.spacing_m < length - UNSURE_END * self.spacing_m:
            share = step * self.spacing_m / length if length > 0 else 0.0
            self._photo(self.at_m + share * (to_m - self.at_m))
            step += 1
        self.first_now = False

    def _do(self, item: Item, place_m: FloatArray) -> None:
        command = item.command
        if command == mav.CONDITION_YAW:
            relative = item.param4 != 0
            base = self._heading() if relative else 0.0
            turn = -item.param1 if relative and item.param3 < 0 else item.param1
            self.yaw_deg = (base + turn) % 360
        elif command in (mav.DO_GIMBAL_MANAGER_PITCHYAW, mav.DO_MOUNT_CONTROL):
            manager = command == mav.DO_GIMBAL_MANAGER_PITCHYAW
            yaw = item.param2 if manager else item.param3
            self.pitch_deg = item.param1 if math.isfinite(item.param1) else self.pitch_deg
            self.gimbal_yaw_deg = yaw if math.isfinite(yaw) else 0.0
            self.gimbal_absolute = manager and bool(item.x & mav.YAW_LOCK)
            self.roi_m = None
        elif command in (mav.DO_SET_ROI_LOCATION, mav.DO_SET_ROI):
            self.roi_m = place_m if np.isfinite(place_m).all() else None
        elif command == mav.DO_SET_ROI_NONE:
            self.roi_m = None
        elif command == mav.DO_SET_CAM_TRIGG_DIST:
            self.spacing_m = max(item.param1, 0.0)
            self.first_now = item.param3 == 1
        elif _takes_one(item):
            self._photo(self.at_m)

    def _heading(self) -> float:
        return self.yaw_deg if math.isfinite(self.yaw_deg) else self.course_deg

    def _photo(self, at_m: FloatArray) -> None:
        if self.roi_m is not None:
            yaw, pitch = angles(at_m, self.roi_m)
        else:
            nose = 0.0 if self.gimbal_absolute else self._heading()
            yaw, pitch = (nose + self.gimbal_yaw_deg) % 360, self.pitch_deg
        self.found.append(Station(float(at_m[0]), float(at_m[1]), float(at_m[2]), yaw, pitch))


def _takes_one(item: Item) -> bool:
    digicam = item.command == mav.DO_DIGICAM_CONTROL and item.x == 1
    return digicam or (item.command == mav.IMAGE_START_CAPTURE and item.param3 == 1)


def _plain(frame: int) -> int:
    return mav.SAME_FRAME.get(frame, frame)

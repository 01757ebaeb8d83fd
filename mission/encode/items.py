"""Mission items as MAVLink's MISSION_ITEM_INT carries them, and what both autopilots share.

A photo at a STOP is taken when vehicle and gimbal have settled: fly there, aim, wait
(NAV_DELAY, at which the vehicle stays), photo, and a short wait so that the shutter is closed
before the gimbal or the vehicle turns again. Every stop and every line brings its own aim and
camera commands *after* the waypoint that leads to it, so that a mission taken up again at any
waypoint (new battery, pause) loses none of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calib.camera import FloatArray
from calib.errors import InputError
from calib.frames import LocalFrame
from mission.encode import constants as mav
from mission.plan import Plan, Shot, Waypoint

Flavour = Literal["ardupilot", "px4"]
FLAVOURS: tuple[Flavour, ...] = ("ardupilot", "px4")

#: How cameras are pointed: gimbal pitch and vehicle yaw of each station, or a point of interest
#: where the stations of a pattern share one.
Aim = Literal["angles", "roi"]

#: From the command to the closed shutter, with the slow cameras in mind (s).
SHUTTER_S = 0.5
#: Lowest climb after take-off that autopilots do (m).
LOWEST_TAKEOFF_M = 2.5
#: Photos of a line are never asked for closer together (a line of no length has no other spacing).
SHORTEST_GAP_M = 0.1
#: A photo due by distance is not taken where it lies this far beyond the line's end. Measured: a Copter
#: that comes at 8 m/s flies on for 0.5 m, and begins its line 0.1 m late.
OVERSHOOT_M = 1.0
NAN = math.nan


@dataclass(frozen=True)
class Item:
    """One item. ``x``, ``y``: latitude, longitude in 1e-7 degrees where the command has a place
    (otherwise the bare params 5 and 6); ``z``: metres in ``frame``, or param 7."""

    command: int
    frame: int
    param1: float = 0.0
    param2: float = 0.0
    param3: float = 0.0
    param4: float = 0.0
    x: int = 0
    y: int = 0
    z: float = 0.0
    autocontinue: bool = True

    @property
    def has_place(self) -> bool:
        return self.command in mav.WITH_PLACE and self.frame != mav.MISSION

    @property
    def latitude_deg(self) -> float:
        return self.x * 1e-7

    @property
    def longitude_deg(self) -> float:
        return self.y * 1e-7


def item(
    command: int,
    frame: int,
    params: Sequence[float],
    x: int = 0,
    y: int = 0,
    z: float = 0.0,
    autocontinue: bool = True,
) -> Item:
    """An item from its first four params in a row (more are left out)."""
    one, two, three, four = (float(p) for p in params[:4])
    return Item(command, frame, one, two, three, four, x, y, z, autocontinue)


def do(command: int, *params: float, x: int = 0, z: float = 0.0) -> Item:
    """An item without a place, in frame MISSION (PX4 takes no other)."""
    return item(command, mav.MISSION, [*params, 0.0, 0.0, 0.0, 0.0], x, 0, z)


def photo() -> Item:
    """One photo by every camera (id 0), not counted (sequence 0)."""
    return do(mav.IMAGE_START_CAPTURE, 0.0, 0.0, 1.0, 0.0)


def wait(seconds: float) -> Item:
    """Stay here, to a tenth of a second upwards."""
    return do(mav.NAV_DELAY, math.ceil(seconds * 10 - 1e-6) / 10, -1.0, -1.0, -1.0)


def every(distance_m: float) -> Item:
    """A photo now and each ``distance_m`` from here on."""
    return do(mav.DO_SET_CAM_TRIGG_DIST, distance_m, 0.0, 1.0)


def no_more_photos() -> Item:
    return do(mav.DO_SET_CAM_TRIGG_DIST)


def speed(metres_per_s: float) -> Item:
    return do(mav.DO_CHANGE_SPEED, 1.0, metres_per_s, -1.0)


def centimetres(height_m: float) -> float:
    """What autopilots store; never -0."""
    return round(height_m, 2) + 0.0


def degrees_e7(degrees: float) -> int:
    return round(degrees * 1e7)


def places(frame: LocalFrame, enu_m: FloatArray) -> list[tuple[int, int, float]]:
    """East, north, up (n, 3) in m -> latitude, longitude (1e-7 degrees), metres above the launch."""
    if not len(enu_m):
        return []
    found = []
    for latitude, longitude, altitude in frame.geodetic(np.asarray(enu_m, dtype=float)).tolist():
        east = (longitude + 180) % 360 - 180
        found.append((degrees_e7(latitude), degrees_e7(east), altitude - frame.altitude_m))
    return found


def line_gap_m(start: Waypoint, end: Waypoint) -> float:
    """Distance between the photos of a LINE (see :func:`mission.plan.line_photos_m`)."""
    length = float(np.linalg.norm(end.enu_m - start.enu_m))
    return max(length / max(math.ceil(length / start.spacing_m - 1e-9), 1), SHORTEST_GAP_M)


def trigger_gap_m(start: Waypoint, end: Waypoint) -> float:
    """Distance at which photos are triggered on a LINE, its last one at ``end`` by command.

    A vehicle flies past the end before it stands, and a photo due by distance at the very end would often
    be taken there as well, half a metre from the one by command. So the distance is a little longer than
    :func:`line_gap_m`, by :data:`OVERSHOOT_M` over the whole line.
    """
    gap = line_gap_m(start, end)
    length = float(np.linalg.norm(end.enu_m - start.enu_m))
    return gap + min(OVERSHOOT_M, gap / 4) / max(round(length / gap), 1)


def line_goes_on(before: Waypoint | None, here: Waypoint) -> bool:
    """A line that ends here is followed by another with the same aim: no need to stop."""
    return (
        before is not None
        and before.shot is Shot.LINE
        and here.shot is Shot.LINE
        and before.yaw_deg == here.yaw_deg
        and before.pitch_deg == here.pitch_deg
    )


def turn_deg(from_yaw_deg: float, to_yaw_deg: float) -> float:
    """Smaller angle between two headings, 0-180."""
    return abs((to_yaw_deg - from_yaw_deg + 180) % 360 - 180)


def takeoff_height_m(plan: Plan, first_m: float) -> float:
    return max(first_m if plan.waypoints else plan.return_height_m, LOWEST_TAKEOFF_M)


def check(plan: Plan, items: tuple[Item, ...]) -> tuple[Item, ...]:
    """``items``, if the autopilot has room for them.

    Raises:
        InputError: more than ``plan.vehicle.most_items``.
    """
    if len(items) > plan.vehicle.most_items:
        raise InputError(
            f"The mission has {len(items)} items, but the autopilot holds only {plan.vehicle.most_items}: "
            "split the area, use fewer stops or fewer lines, or raise the vehicle's item limit if it has one."
        )
    return items


def check_plan(plan: Plan) -> None:
    """Refuse what no format can hold.

    Raises:
        InputError: a number that is none, a line without spacing, or one that leads nowhere.
    """
    for w in plan.waypoints:
        if not all(map(math.isfinite, (w.east_m, w.north_m, w.height_m, w.yaw_deg, w.pitch_deg))):
            raise InputError("The plan has a waypoint with a number that is none, so it cannot be written.")
        if w.shot is Shot.LINE and not (w.spacing_m > 0 and math.isfinite(w.spacing_m)):
            raise InputError("A line of photos has no spacing, so it cannot be written.")
    if plan.waypoints and plan.waypoints[-1].shot is Shot.LINE:
        raise InputError("The plan ends with a line of photos that leads nowhere, so it cannot be written.")

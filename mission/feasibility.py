"""What forbids a mission file to be flown by the vehicle at hand, or should make the operator think.

:mod:`mission.limits` holds a plan against its site while it is made; here only the file and the vehicle
are known, whoever made the file.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from pyproj import Geod

from calib.camera import FloatArray
from mission.encode import Flavour, ReadPlan
from mission.encode import constants as mav
from mission.encode.items import Item
from mission.limits import FIRST_WAYPOINT_M
from mission.rule import Finding
from mission.space import make_space

#: Heights count from where the vehicle is switched on: farther from the launch point they may not fit.
LAUNCH_M = 50.0
LOWEST_M = 5.0
#: Measured; PX4's room depends on the board, and it refuses what is too much.
MOST_ITEMS: dict[Flavour, int | None] = {"ardupilot": 650, "px4": None}
NAMES: dict[Flavour, str] = {"ardupilot": "ArduPilot", "px4": "PX4"}
_WGS84 = Geod(ellps="WGS84")
_TERRAIN = (mav.GLOBAL_TERRAIN_ALT, mav.GLOBAL_TERRAIN_ALT_INT)
#: NaN is taken here by ArduPilot, in param 4 only.
_FREE_YAW = frozenset({mav.NAV_WAYPOINT, mav.NAV_TAKEOFF, mav.NAV_LAND, mav.NAV_LOITER_UNLIM})
#: Commands that belong to a photo mission; others are named.
_USUAL = mav.FLOWN_TO | {
    *(mav.NAV_RETURN_TO_LAUNCH, mav.NAV_DELAY, mav.CONDITION_DELAY, mav.CONDITION_YAW, mav.DO_CHANGE_SPEED),
    *(mav.DO_SET_ROI_LOCATION, mav.DO_SET_ROI_NONE, mav.DO_SET_ROI, mav.DO_DIGICAM_CONTROL),
    *(mav.DO_MOUNT_CONTROL, mav.DO_SET_CAM_TRIGG_DIST, mav.DO_GIMBAL_MANAGER_PITCHYAW),
    mav.DO_GIMBAL_MANAGER_CONFIGURE,
    *(mav.IMAGE_START_CAPTURE, mav.IMAGE_STOP_CAPTURE),
    # Trigger and gimbal set-up, camera mode, landing marker, jump: ground stations write them.
    *(177, 189, 204, 214, 530, 2003),
}


@dataclass(frozen=True)
class Place:
    """Where the vehicle is, WGS84 degrees."""

    latitude_deg: float
    longitude_deg: float


def check_file(plan: ReadPlan, flavour: Flavour, vehicle: Place | None = None) -> tuple[Finding, ...]:
    """All rules held against a mission file with items, kept or not.

    Args:
        flavour: of the vehicle. vehicle: where it stands; None where it does not know itself.
    """
    return (
        _autopilot(plan, flavour),
        _items(plan, flavour),
        _numbers(plan, flavour),
        _places(plan, flavour),
        _take_off(plan),
        _end(plan),
        _launch(plan, vehicle),
        _first_waypoint(plan, vehicle),
        _heights(plan),
        _fence(plan),
        _photos(plan),
        _commands(plan, flavour),
    )


def _autopilot(plan: ReadPlan, flavour: Flavour) -> Finding:
    ok = plan.flavour in (None, flavour)
    message = f"The mission is written for {NAMES[flavour]}, which the vehicle flies."
    if not ok and plan.flavour is not None:
        message = (
            f"The mission is written for {NAMES[plan.flavour]}, and the vehicle flies {NAMES[flavour]}: "
            f"plan it again with --autopilot {flavour}."
        )
    return Finding("autopilot", True, ok, None, None, "", message)


def _items(plan: ReadPlan, flavour: Flavour) -> Finding:
    count, most = len(plan.items), MOST_ITEMS[flavour]
    ok = count > 0 and (most is None or count <= most)
    message = f"The mission has {count} items"
    if count == 0:
        message += ": there is nothing to fly."
    elif not ok:
        message += f", and {NAMES[flavour]} holds {most}: split the area."
    else:
        message += "." if most is None else f", and {NAMES[flavour]} holds {most}."
    return Finding("item-limit", True, ok, float(count), most, "items", message)


def _numbers(plan: ReadPlan, flavour: Flavour) -> Finding:
    bad = [
        index
        for index, item in enumerate(plan.items, 1)
        if not math.isfinite(item.z) or (flavour == "ardupilot" and _refused_nan(item))
    ]
    message = "Every item has the numbers that it needs."
    if bad:
        message = f"{NAMES[flavour]} refuses item{_list(bad)}: a number in it is left open (NaN)."
    return Finding("numbers", True, not bad, float(len(bad)), 0.0, "items", message)


def _refused_nan(item: Item) -> bool:
    open_yaw = math.isnan(item.param4) and item.command not in _FREE_YAW
    return open_yaw or any(map(math.isnan, (item.param1, item.param2, item.param3)))


def _places(plan: ReadPlan, flavour: Flavour) -> Finding:
    """ArduPilot reads zeros as "here" and "as high as now", without a word."""
    bad = [
        index
        for index, item in enumerate(plan.items, 1)
        if item.command in mav.FLOWN_TO - {mav.NAV_TAKEOFF, mav.NAV_LAND}
        and (item.x == item.y == 0 or (flavour == "ardupilot" and item.z == 0 and not _absolute(item)))
    ]
    message = "Every waypoint has a place and a height."
    if bad:
        message = (
            f"Item{_list(bad)} is a waypoint without a place or height; the vehicle would stay where it is."
        )
    return Finding("places", True, not bad, float(len(bad)), 0.0, "items", message)


def _take_off(plan: ReadPlan) -> Finding:
    flown = [item.command for item in plan.items if item.command in mav.FLOWN_TO]
    ok = bool(flown) and flown[0] == mav.NAV_TAKEOFF
    message = "The mission begins with a take-off."
    if not ok:
        message = "The mission does not begin with a take-off: it can only be begun in the air."
    return Finding("take-off", False, ok, None, None, "", message)


def _end(plan: ReadPlan) -> Finding:
    flown = [i.command for i in plan.items if i.command in mav.FLOWN_TO | {mav.NAV_RETURN_TO_LAUNCH}]
    ok = bool(flown) and flown[-1] in (mav.NAV_RETURN_TO_LAUNCH, mav.NAV_LAND)
    message = "The mission ends with the way home or a landing."
    if not ok:
        message = "The mission ends in the air: you will have to bring the vehicle home."
    return Finding("way-home", False, ok, None, None, "", message)


def _launch(plan: ReadPlan, vehicle: Place | None) -> Finding:
    if vehicle is None:
        message = "The vehicle does not know where it is yet, so the launch point was not compared."
        return Finding("launch-place", False, False, None, LAUNCH_M, "m", message)
    away = _distance_m(vehicle, Place(plan.launch.latitude_deg, plan.launch.longitude_deg))
    ok = away <= LAUNCH_M
    message = f"The vehicle stands {_metres(away)} from the planned launch point"
    message += "." if ok else ": heights count from where it stands, so they may not fit the ground there."
    return Finding("launch-place", False, ok, away, LAUNCH_M, "m", message)


def _first_waypoint(plan: ReadPlan, vehicle: Place | None) -> Finding:
    first = next((i for i in _waypoints(plan) if i.x or i.y), None)
    start = vehicle or Place(plan.launch.latitude_deg, plan.launch.longitude_deg)
    if first is None:
        return Finding("first-waypoint", True, False, None, None, "m", "The mission has no waypoint.")
    away = _distance_m(start, Place(first.latitude_deg, first.longitude_deg))
    ok = away <= FIRST_WAYPOINT_M
    whose = "vehicle" if vehicle else "launch point"
    message = f"The first waypoint is {_metres(away)} from the {whose}"
    message += "." if ok else f", more than {FIRST_WAYPOINT_M:g} m: is this the right mission?"
    return Finding("first-waypoint", False, ok, away, FIRST_WAYPOINT_M, "m", message)


def _heights(plan: ReadPlan) -> Finding:
    flown = [i for i in _waypoints(plan) if math.isfinite(i.z)]
    if any(i.frame in _TERRAIN for i in flown):
        message = "Heights count from the ground below: the vehicle needs terrain data, or it will not arm."
        return Finding("heights", False, False, None, LOWEST_M, "m", message)
    heights = [i.z - (plan.launch.altitude_m if _absolute(i) else 0.0) for i in flown]
    if not heights:
        return Finding("heights", False, False, None, LOWEST_M, "m", "The mission has no waypoint.")
    low, high = min(heights), max(heights)
    ok = low >= LOWEST_M
    message = f"The waypoints are {low:.0f} to {high:.0f} m above the launch point"
    message += "." if ok else f"; below {LOWEST_M:g} m there is little room for error."
    return Finding("heights", False, ok, low, LOWEST_M, "m", message)


def _fence(plan: ReadPlan) -> Finding:
    """Every leg, as a line, stays inside the file's fence."""
    if plan.fence is None:
        message = "The file has no fence; the vehicle keeps the one that it has."
        return Finding("fence", True, True, None, None, "m", message)
    area = make_space(plan.fence, (), plan.launch, 0.0, 0.0).fence_area
    corners = np.vstack([np.zeros((1, 2)), _path_m(plan)[:, :2], np.zeros((1, 2))])
    legs: Any = shapely.linestrings(np.stack([corners[:-1], corners[1:]], axis=1))
    outside = np.atleast_1d(~shapely.covers(area, legs))
    if not outside.any():
        margin = float(shapely.distance(shapely.boundary(area), legs).min())
        message = f"The whole path stays inside the file's fence, at least {_metres(margin)} from it."
        return Finding("fence", True, True, margin, 0.0, "m", message)
    worst = float(shapely.distance(area, shapely.points(corners)).max())
    message = (
        f"{int(outside.sum())} of {len(outside)} legs leave the file's fence, by up to {_metres(worst)}."
    )
    return Finding("fence", True, False, -worst, 0.0, "m", message)


def _photos(plan: ReadPlan) -> Finding:
    count = len(plan.stations)
    message = f"The mission takes {count} photos." if count else "The mission takes no photos."
    return Finding("photos", False, count > 0, float(count), None, "photos", message)


def _commands(plan: ReadPlan, flavour: Flavour) -> Finding:
    commands = [item.command for item in plan.items]
    strange = sorted(set(commands) - _USUAL)
    message = "All commands are those of a photo mission."
    if strange:
        message = (
            f"The mission holds commands that a photo mission does not need: {', '.join(map(str, strange))}."
        )
    elif flavour == "px4" and _gimbal_not_taken(commands):
        message = (
            "The mission does not take the gimbal (DO_GIMBAL_MANAGER_CONFIGURE), so PX4 denies what it asks "
            "of it, and the camera looks ahead: plan it again."
        )
    elif flavour == "px4" and mav.NAV_DELAY in commands:
        message = (
            "The mission waits with NAV_DELAY, during which PX4 of June 2025 to March 2026 can fly down: "
            "plan it again."
        )
    else:
        return Finding("commands", False, True, 0.0, 0.0, "commands", message)
    return Finding("commands", False, False, float(max(len(strange), 1)), 0.0, "commands", message)


def _gimbal_not_taken(commands: Sequence[int]) -> bool:
    """A gimbal command comes before the one that gives it to the mission."""
    asked, taken = mav.DO_GIMBAL_MANAGER_PITCHYAW, mav.DO_GIMBAL_MANAGER_CONFIGURE
    return asked in commands and taken not in commands[: commands.index(asked)]


def _waypoints(plan: ReadPlan) -> list[Item]:
    return [i for i in plan.items if i.command in mav.FLOWN_TO - {mav.NAV_TAKEOFF, mav.NAV_LAND}]


def _path_m(plan: ReadPlan) -> FloatArray:
    """East, north, up of the places that are flown to, (n, 3)."""
    flown = [i for i in plan.items if i.command in mav.FLOWN_TO and (i.x or i.y)]
    if not flown:
        return np.zeros((0, 3))
    return plan.launch.enu(
        np.array([i.latitude_deg for i in flown]),
        np.array([i.longitude_deg for i in flown]),
        np.full(len(flown), plan.launch.altitude_m),
    )


def _absolute(item: Item) -> bool:
    return mav.SAME_FRAME.get(item.frame, item.frame) == mav.GLOBAL


def _distance_m(one: Place, other: Place) -> float:
    return float(_WGS84.inv(one.longitude_deg, one.latitude_deg, other.longitude_deg, other.latitude_deg)[2])


def _metres(value: float) -> str:
    return f"{value:.1f} m" if value < 10 else f"{value:.0f} m" if value < 5000 else f"{value / 1000:.0f} km"


def _list(numbers: Sequence[int]) -> str:
    shown = ", ".join(map(str, numbers[:5]))
    more = f" and {len(numbers) - 5} more" if len(numbers) > 5 else ""
    return f" {shown}{more}" if len(numbers) == 1 else f"s {shown}{more}"

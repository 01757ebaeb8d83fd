"""ArduPilot Copter: a plan as mission items. Behaviour as measured on ArduCopter 4.6.

* Item 0 is home (the vehicle puts its own there); without it the take-off is swallowed.
* Waypoints carry no yaw: CONDITION_YAW turns the vehicle. Starting a waypoint turns it back towards
  the flight direction (WP_YAW_BEHAVIOR), and of the commands between two waypoints the first runs
  before the next waypoint starts, the others after; so on a line the heading is given again as the
  second command.
* Gimbal angles are whole degrees, and the rates must be numbers.
* Latitude and longitude both 0 would mean "here", height 0 "keep the height": both are evaded by the
  smallest step there is (1e-7 degrees, 1 cm).
* Hold times of waypoints are whole seconds, so NAV_DELAY waits.
"""

from __future__ import annotations

import math

import numpy as np

from mission.encode import constants as mav
from mission.encode.items import (
    SHUTTER_S,
    Aim,
    Item,
    centimetres,
    check,
    check_plan,
    degrees_e7,
    do,
    every,
    line_goes_on,
    no_more_photos,
    photo,
    places,
    speed,
    takeoff_height_m,
    trigger_gap_m,
    turn_deg,
    wait,
)
from mission.encode.roi import roi_items
from mission.plan import Plan, Shot, Waypoint

#: Turning speed on the spot that is surely reached (ATC_SLEW_YAW is 60 by default).
TURN_DEG_S = 45.0


def items(plan: Plan, aim: Aim = "angles") -> tuple[Item, ...]:
    """The mission, home item first, return to launch last.

    Raises:
        InputError: too many items, or a line without an end or a spacing.
    """
    check_plan(plan)
    at = [_place(*p) for p in places(plan.launch, np.array([w.enu_m for w in plan.waypoints]))]
    rois = roi_items(plan) if aim == "roi" else [None] * len(at)
    launch = plan.launch
    here = (degrees_e7(launch.latitude_deg), degrees_e7((launch.longitude_deg + 180) % 360 - 180))
    climb = takeoff_height_m(plan, at[0].z if at else 0.0)
    out = [
        Item(mav.NAV_WAYPOINT, mav.GLOBAL, x=here[0], y=here[1], z=launch.altitude_m),
        Item(mav.NAV_TAKEOFF, mav.GLOBAL_RELATIVE_ALT, x=here[0], y=here[1], z=centimetres(climb)),
        speed(plan.vehicle.speed_m_s),
    ]
    before: Waypoint | None = None
    for index, waypoint in enumerate(plan.waypoints):
        out.append(at[index])
        goes_on = line_goes_on(before, waypoint)
        if before is not None and before.shot is Shot.LINE:
            out.append(photo())
            if not goes_on:
                out += [no_more_photos(), wait(SHUTTER_S)]
        if waypoint.shot is not Shot.NONE and not goes_on:
            roi = rois[index]
            out += [_gimbal(waypoint), _yaw(waypoint)] if roi is None else [roi]
            out.append(wait(plan.vehicle.settle_s + _turn_s(before, waypoint)))
        if waypoint.shot is Shot.STOP:
            out += [photo(), wait(SHUTTER_S)]
            if rois[index] is not None and (index + 1 == len(rois) or rois[index + 1] is None):
                out.append(do(mav.DO_SET_ROI_NONE))
        if waypoint.shot is Shot.LINE:
            gap = trigger_gap_m(waypoint, plan.waypoints[index + 1])
            if goes_on:
                out.append(_gimbal(waypoint))
            out += [every(gap), _yaw(waypoint)]
        before = waypoint
    if at and plan.return_height_m > at[-1].z + 0.5:
        last = at[-1]
        out.append(_place(last.x, last.y, plan.return_height_m))
    out.append(do(mav.NAV_RETURN_TO_LAUNCH))
    return check(plan, tuple(out))


def _place(x: int, y: int, height_m: float) -> Item:
    """Fly there; ``x``, ``y`` in 1e-7 degrees, the height above the launch to the centimetre."""
    if x == 0 and y == 0:
        y = 1
    z = centimetres(height_m)
    return Item(mav.NAV_WAYPOINT, mav.GLOBAL_RELATIVE_ALT, x=x, y=y, z=z if z else 0.01)


def _gimbal(waypoint: Waypoint) -> Item:
    """Pitch to the whole degree, yaw in the nose's direction (roll and pitch locked to the horizon)."""
    pitch = math.floor(waypoint.pitch_deg + 0.5)
    return do(mav.DO_GIMBAL_MANAGER_PITCHYAW, pitch, x=mav.ROLL_LOCK | mav.PITCH_LOCK)


def _yaw(waypoint: Waypoint) -> Item:
    return do(mav.CONDITION_YAW, waypoint.yaw_deg % 360)


def _turn_s(before: Waypoint | None, here: Waypoint) -> float:
    """Time to turn from the flight direction, in which the vehicle arrives, to the heading."""
    if before is None:
        return turn_deg(0.0, 180.0) / TURN_DEG_S
    east, north = here.east_m - before.east_m, here.north_m - before.north_m
    if math.hypot(east, north) < 1:
        return turn_deg(before.yaw_deg, here.yaw_deg) / TURN_DEG_S
    return turn_deg(math.degrees(math.atan2(east, north)), here.yaw_deg) / TURN_DEG_S

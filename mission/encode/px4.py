"""PX4 multicopter: a plan as mission items. Behaviour as measured on PX4 v1.16.

* No home item: item 0 is the take-off.
* Commands without a place need frame MISSION, places GLOBAL_RELATIVE_ALT; CONDITION_YAW is not
  known, waypoints carry the yaw, and the vehicle holds it on the way there. So the end of a line
  carries the line's yaw, and a second waypoint at the same place turns to another one.
* Only straight legs: orbits are waypoints.
* A gimbal turns only for whom it has been given to: without DO_GIMBAL_MANAGER_CONFIGURE the mission's
  own gimbal commands are denied without a word, and the camera looks ahead on all photos. Once is
  enough: PX4 runs it again itself where a mission is taken up in its middle.
* No NAV_DELAY: a PX4 that corrects its home's height in the air (main from June 2025 to March 2026) flies
  down towards sea level while an item without a place lasts, and on the leg after it (flown: 11 m on a
  line of 60 m). So a wait is a waypoint that is held, and one stands between the last command and a line.
* Rates of a gimbal command are NaN ("as fast as it goes"), as the MAVLink definition has it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from mission.encode import constants as mav
from mission.encode.items import (
    NAN,
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
)
from mission.encode.roi import roi_items
from mission.plan import Plan, Shot, Waypoint


def items(plan: Plan, aim: Aim = "angles") -> tuple[Item, ...]:
    """The mission, take-off first, return to launch last.

    Raises:
        InputError: too many items, or a line without an end or a spacing.
    """
    check_plan(plan)
    at = [_place(*p) for p in places(plan.launch, np.array([w.enu_m for w in plan.waypoints]))]
    rois = roi_items(plan) if aim == "roi" else [None] * len(at)
    launch = plan.launch
    takeoff = Item(
        mav.NAV_TAKEOFF,
        mav.GLOBAL_RELATIVE_ALT,
        param4=NAN,
        x=degrees_e7(launch.latitude_deg),
        y=degrees_e7((launch.longitude_deg + 180) % 360 - 180),
        z=centimetres(takeoff_height_m(plan, at[0].z if at else 0.0)),
    )
    out = [takeoff, speed(plan.vehicle.speed_m_s)]
    before: Waypoint | None = None
    for index, (waypoint, place) in enumerate(zip(plan.waypoints, at, strict=True)):
        roi = rois[index]
        yaw = NAN if roi is not None or waypoint.shot is Shot.NONE else _yaw_deg(waypoint)
        here, goes_on = replace(place, param4=yaw), line_goes_on(before, waypoint)
        if before is not None and before.shot is Shot.LINE:
            end = replace(place, param4=_yaw_deg(before))
            out += [end, photo()]
            if not goes_on:
                out += [no_more_photos(), _stay(end, SHUTTER_S)]
                if waypoint.shot is not Shot.NONE and yaw != end.param4:
                    out.append(here)
        else:
            out.append(here)
        if waypoint.shot is not Shot.NONE and not goes_on:
            if roi is None and not any(one.command == mav.DO_GIMBAL_MANAGER_CONFIGURE for one in out):
                out.append(_take_gimbal())
            out += [_gimbal(waypoint) if roi is None else roi, _stay(here, plan.vehicle.settle_s)]
        if waypoint.shot is Shot.STOP:
            out += [photo(), _stay(here, SHUTTER_S)]
            if roi is not None and (index + 1 == len(rois) or rois[index + 1] is None):
                out.append(do(mav.DO_SET_ROI_NONE))
        if waypoint.shot is Shot.LINE:
            if goes_on:
                out.append(_gimbal(waypoint))
            out.append(every(trigger_gap_m(waypoint, plan.waypoints[index + 1])))
            if not goes_on:
                out.append(_stay(here, 0.0))
        before = waypoint
    if at and plan.return_height_m > at[-1].z + 0.5:
        out.append(replace(at[-1], param4=NAN, z=centimetres(plan.return_height_m)))
    out.append(do(mav.NAV_RETURN_TO_LAUNCH))
    return check(plan, tuple(out))


def _place(x: int, y: int, height_m: float) -> Item:
    return Item(mav.NAV_WAYPOINT, mav.GLOBAL_RELATIVE_ALT, x=x, y=y, z=height_m)


def _stay(here: Item, seconds: float) -> Item:
    """A waypoint where the vehicle is already, held to a tenth of a second upwards."""
    return replace(here, param1=math.ceil(seconds * 10 - 1e-6) / 10)


def _yaw_deg(waypoint: Waypoint) -> float:
    return waypoint.yaw_deg % 360


def _take_gimbal() -> Item:
    """The gimbal is the mission's (-2) from here on; whoever had it as second keeps it (-1)."""
    return do(mav.DO_GIMBAL_MANAGER_CONFIGURE, -2.0, -2.0, -1.0, -1.0)


def _gimbal(waypoint: Waypoint) -> Item:
    """Pitch as given, yaw in the nose's direction (only roll and pitch are locked to the horizon)."""
    return do(
        mav.DO_GIMBAL_MANAGER_PITCHYAW,
        waypoint.pitch_deg,
        0.0,
        NAN,
        NAN,
        x=mav.ROLL_LOCK | mav.PITCH_LOCK,
    )

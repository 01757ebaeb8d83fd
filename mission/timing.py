"""How long a plan takes, how far it goes, what it asks of the battery.

An estimate: speeds are trapezoids (constant acceleration) that come to rest where the path bends or a
photo is taken from standing; a multicopter holds its ground speed until its airspeed limit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from calib.camera import FloatArray
from mission.plan import Plan, Shot, Vehicle, stations
from mission.site import Wind

#: Airspeed at which a camera quadcopter gives up, at least: against more wind it falls behind.
MOST_AIRSPEED_M_S = 15.0
#: Slowest it can get over ground in an estimate; slower, and the wind forbids the flight.
LEAST_GROUND_SPEED_M_S = 0.5
#: Bends below this are flown through.
_STRAIGHT_DEG = 10.0
#: Induced velocity of a hovering camera quadcopter; drag takes the hover power once over at this airspeed.
_INDUCED_M_S = 4.5
_DRAG_M_S = 16.0


@dataclass(frozen=True)
class Timing:
    """What a plan costs. ``length_m``: of the path with take-off, way home and landing.

    ``battery_share``: of the vehicle's endurance, which is taken to be the time it can hover.
    """

    length_m: float
    duration_s: float
    photos: int
    battery_share: float
    legs_s: FloatArray


@dataclass(frozen=True)
class Leg:
    """One straight part of the flight and the time spent standing at its end."""

    start_m: FloatArray
    end_m: FloatArray
    stand_s: float
    flown_through: bool


def flight_legs(plan: Plan) -> tuple[Leg, ...]:
    """The flight from the ground at the launch point back to it: climb, path, way home, landing."""
    path = plan.path_m
    last = path[-2] if len(path) > 1 else path[-1]
    home_height = max(float(last[2]), plan.return_height_m)
    ground = np.zeros(3)
    corners = [
        ground,
        *path[:-1],
        np.array([*last[:2], home_height]),
        np.array([0.0, 0.0, home_height]),
        ground,
    ]
    stands = [
        0.0,
        *(plan.vehicle.settle_s if w.shot is Shot.STOP else 0.0 for w in plan.waypoints),
        0.0,
        0.0,
        0.0,
    ]
    legs = []
    for index, (start, end) in enumerate(pairwise(corners)):
        through = (
            index + 2 < len(corners) and stands[index] == 0 and _straight(start, end, corners[index + 2])
        )
        legs.append(Leg(start, end, stands[index], through))
    return tuple(leg for leg in legs if leg.stand_s > 0 or np.any(leg.start_m != leg.end_m))


def timing(plan: Plan, wind: Wind | None = None) -> Timing:
    """Duration, length, photos and battery of ``plan`` in a steady wind."""
    vehicle = plan.vehicle
    air = _wind_vector(wind or Wind())
    legs = flight_legs(plan)
    seconds = np.zeros(len(legs))
    energy_s = 0.0
    arriving = 0.0
    for index, leg in enumerate(legs):
        way = leg.end_m - leg.start_m
        length = float(np.linalg.norm(way))
        speed = leg_speed_m_s(plan, way, air)
        leaving = 0.0
        if leg.flown_through and index + 1 < len(legs):
            after = legs[index + 1]
            leaving = min(speed, leg_speed_m_s(plan, after.end_m - after.start_m, air))
        moving, arriving = _trapezoid_s(length, speed, arriving, leaving, vehicle.acceleration_m_s2)
        seconds[index] = moving + leg.stand_s
        along = way / max(moving, 1e-9)
        energy_s += moving * power_share(along - air) + leg.stand_s * power_share(-air)
    length_m = float(sum(np.linalg.norm(leg.end_m - leg.start_m) for leg in legs))
    return Timing(
        length_m,
        float(seconds.sum()),
        len(stations(plan)),
        energy_s / vehicle.endurance_s if vehicle.endurance_s > 0 else math.inf,
        seconds,
    )


def leg_speed_m_s(plan: Plan, way_m: FloatArray, air_m_s: FloatArray) -> float:
    """Speed along a leg (3,) in m/s: limited by the vehicle's speeds, climb, descent and the wind (3,)."""
    length = float(np.linalg.norm(way_m))
    if length == 0:
        return plan.vehicle.speed_m_s
    unit = way_m / length
    vehicle = plan.vehicle
    limits = [vehicle.speed_m_s / max(float(np.hypot(*unit[:2])), 1e-9)]
    if abs(unit[2]) > 1e-9:
        limits.append((vehicle.climb_m_s if unit[2] > 0 else vehicle.descent_m_s) / abs(float(unit[2])))
    # |speed unit - air| <= most: the larger root.
    most = most_airspeed_m_s(vehicle)
    along = float(unit @ air_m_s)
    room = along**2 - float(air_m_s @ air_m_s) + most**2
    limits.append(along + math.sqrt(room) if room > 0 else 0.0)
    return max(min(limits), LEAST_GROUND_SPEED_M_S)


def most_airspeed_m_s(vehicle: Vehicle) -> float:
    """Fastest through the air, in an estimate."""
    return max(MOST_AIRSPEED_M_S, 1.25 * vehicle.speed_m_s)


def power_share(airspeed_m_s: FloatArray) -> float:
    """Power against hovering at a velocity through the air (3,): momentum theory and drag."""
    level, climb = float(np.hypot(*airspeed_m_s[:2])), float(airspeed_m_s[2])
    # Glauert: induced velocity falls with forward speed.
    ratio = 0.5 * (level / _INDUCED_M_S) ** 2
    induced = math.sqrt(math.sqrt(ratio**2 + 1) - ratio)
    lifted = climb / _INDUCED_M_S if climb > 0 else 0.4 * climb / _INDUCED_M_S
    return max(0.75 * induced + 0.25 + lifted + (level / _DRAG_M_S) ** 3, 0.3)


def _wind_vector(wind: Wind) -> FloatArray:
    towards = math.radians(wind.from_deg + 180)
    return wind.speed_m_s * np.array([math.sin(towards), math.cos(towards), 0.0])


def _trapezoid_s(
    length_m: float, speed: float, entering: float, leaving: float, acceleration: float
) -> tuple[float, float]:
    """Time over a stretch, entered and left at given speeds, and the speed it is really left at."""
    entering, leaving = min(entering, speed), min(leaving, speed)
    if length_m <= 0:
        return 0.0, entering
    # What cannot be reached within the stretch is not.
    leaving = min(leaving, math.sqrt(entering**2 + 2 * acceleration * length_m))
    top = min(speed, math.sqrt(acceleration * length_m + 0.5 * (entering**2 + leaving**2)))
    top = max(top, entering, leaving)
    up, down = (top - entering) / acceleration, (top - leaving) / acceleration
    used = 0.5 * (entering + top) * up + 0.5 * (leaving + top) * down
    return up + down + max(length_m - used, 0.0) / top, leaving


def _straight(start: FloatArray, end: FloatArray, after: FloatArray) -> bool:
    one, two = end - start, after - end
    size = float(np.linalg.norm(one) * np.linalg.norm(two))
    return size > 0 and float(one @ two) / size > math.cos(math.radians(_STRAIGHT_DEG))


def minutes(seconds: float) -> str:
    """A time in the air as people say it: "5 min 03 s"."""
    whole, rest = divmod(round(seconds), 60)
    return f"{whole} min {rest:02d} s"

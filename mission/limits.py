"""What forbids a plan, or should make the operator think: every rule is listed, kept or not."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from calib.errors import InputError
from mission.limits_path import (
    ceiling_finding,
    clearance_finding,
    fence_finding,
    launch_finding,
    return_finding,
    standoff_finding,
)
from mission.plan import Plan, Shot, line_photos_m, stations
from mission.rule import Finding
from mission.site import Site
from mission.timing import minutes, most_airspeed_m_s, timing

#: A first waypoint farther away is more often a slip than meant.
FIRST_WAYPOINT_M = 900.0
#: Overlaps below these seldom align.
LEAST_FORWARD, LEAST_SIDE = 0.6, 0.4


def check_limits(plan: Plan, site: Site, items: int | None = None) -> tuple[Finding, ...]:
    """All rules held against ``plan``, in words.

    Args:
        items: mission items of the largest encoding, where that is known; otherwise they are counted
            as the encoders need them: waypoint, camera and gimbal command.
    """
    checks: list[Callable[[Plan, Site], Finding]] = [
        launch_finding,
        fence_finding,
        ceiling_finding,
        clearance_finding,
        standoff_finding,
        return_finding,
        _first_waypoint,
        _gimbal,
        _trigger,
        _endurance,
        _overlap,
    ]
    return (*(check(plan, site) for check in checks), _items(plan, items))


def item_count(plan: Plan) -> int:
    """Mission items, about: home, take-off, way home; a waypoint each; the camera's and gimbal's."""
    return 3 + len(plan.waypoints) + 2 * sum(w.shot is not Shot.NONE for w in plan.waypoints)


def hard_violations(findings: tuple[Finding, ...]) -> tuple[Finding, ...]:
    """Those for which a plan is not to be flown."""
    return tuple(f for f in findings if f.hard and not f.ok)


def _first_waypoint(plan: Plan, site: Site) -> Finding:
    del site
    if not plan.waypoints:
        raise InputError("The plan has no waypoint.")
    first = plan.waypoints[0]
    distance = math.hypot(first.east_m, first.north_m)
    ok = distance <= FIRST_WAYPOINT_M
    message = f"The first waypoint is {distance:.0f} m from the launch point"
    message += "." if ok else f", more than {FIRST_WAYPOINT_M:g} m: is the launch point right?"
    return Finding("first-waypoint", False, ok, distance, FIRST_WAYPOINT_M, "m", message)


def _gimbal(plan: Plan, site: Site) -> Finding:
    del site
    low, high = plan.vehicle.gimbal_lowest_deg, plan.vehicle.gimbal_highest_deg
    pitch = np.array([s.pitch_deg for s in stations(plan)] or [low])
    over = np.maximum(low - pitch, pitch - high)
    worst = float(pitch[int(np.argmax(over))])
    bad = int((over > 0.01).sum())
    limit = low if worst < (low + high) / 2 else high
    message = (
        f"The camera is pitched {pitch.min():.0f} to {pitch.max():.0f} degrees, and the gimbal reaches "
        f"{low:g} to {high:g}."
    )
    if bad:
        message = (
            f"{bad} photos need the camera at up to {worst:.0f} degrees, beyond the gimbal's "
            f"{low:g} to {high:g}; "
            "the autopilot would clamp it without a word."
        )
    return Finding("gimbal-range", True, not bad, worst, limit, "degrees", message)


def _trigger(plan: Plan, site: Site) -> Finding:
    del site
    least = plan.vehicle.camera_interval_s
    steps = [
        float(np.linalg.norm(np.diff(line_photos_m(here, after)[:2], axis=0)))
        for here, after in zip(plan.waypoints[:-1], plan.waypoints[1:], strict=True)
        if here.shot is Shot.LINE
    ]
    if not steps:
        return Finding(
            "trigger-interval", True, True, None, least, "s", "Every photo is taken from standing."
        )
    interval = min(steps) / plan.vehicle.speed_m_s
    ok = interval >= least
    message = (
        f"On the lines a photo is due every {interval:.1f} s at {plan.vehicle.speed_m_s:.1f} m/s, "
        "and the camera "
        f"takes one every {least:g} s"
    )
    message += "." if ok else f": fly at {min(steps) / least:.1f} m/s at most."
    return Finding("trigger-interval", True, ok, interval, least, "s", message)


def _endurance(plan: Plan, site: Site) -> Finding:
    cost = timing(plan, site.wind)
    limit = 100 * (1 - plan.vehicle.reserve_share)
    share = 100 * cost.battery_share
    ok = share <= limit
    message = (
        f"The flight takes {minutes(cost.duration_s)} and {share:.0f} % of a battery "
        f"({minutes(plan.vehicle.endurance_s)}); {100 - limit:.0f} % are kept for extra passes and landing"
    )
    most = most_airspeed_m_s(plan.vehicle)
    if ok:
        message += "."
    elif site.wind.speed_m_s >= most:
        message += (
            f"; a wind of {site.wind.speed_m_s:g} m/s is more than the aircraft flies ({most:.0f} m/s): wait."
        )
    else:
        batteries = math.ceil(share / max(limit, 1e-9))
        message += (
            f", so {limit:.0f} % are available: let it be split into {batteries} missions or more (--split), "
            "fly higher, or ask for less overlap."
        )
    return Finding("endurance", True, ok, share, limit, "%", message)


def _overlap(plan: Plan, site: Site) -> Finding:
    del plan
    forward, side = 100 * site.forward_overlap, 100 * site.side_overlap
    ok = site.forward_overlap >= LEAST_FORWARD - 1e-9 and site.side_overlap >= LEAST_SIDE - 1e-9
    message = f"Photos overlap by {forward:.0f} % along the lines and {side:.0f} % across"
    if not ok:
        message += f"; below {100 * LEAST_FORWARD:g} and {100 * LEAST_SIDE:g} % photos seldom align"
    short_forward = forward / LEAST_FORWARD < side / LEAST_SIDE
    value, limit = (forward, 100 * LEAST_FORWARD) if short_forward else (side, 100 * LEAST_SIDE)
    return Finding("overlap", False, ok, value, limit, "%", message + ".")


def _items(plan: Plan, items: int | None) -> Finding:
    if items is None:
        items = item_count(plan)
    most = plan.vehicle.most_items
    ok = items <= most
    message = f"The mission has about {items} items, and the autopilot holds {most}"
    message += "." if ok else ": let it be split (--split), or follow the terrain less closely (fly higher)."
    return Finding("item-limit", True, ok, float(items), float(most), "items", message)

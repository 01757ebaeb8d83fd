"""Points of interest: where the views of a pattern's stations meet."""

from __future__ import annotations

from itertools import groupby

import numpy as np

from calib.camera import FloatArray
from mission.encode import constants as mav
from mission.encode.items import Item, centimetres, places
from mission.plan import Plan, Shot, Waypoint

#: The views must pass this close to the point, in proportion to their distance to it (0.3 degrees).
TOLERANCE = 0.005
#: Steeper views (pitch below this) say nothing on the heading.
STEEPEST_DEG = -85.0


def view(waypoint: Waypoint) -> FloatArray:
    """Direction in which the camera looks, east, north, up, unit length (3,)."""
    yaw, pitch = np.radians([waypoint.yaw_deg, waypoint.pitch_deg])
    return np.array([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)])


def angles(from_m: FloatArray, to_m: FloatArray) -> tuple[float, float]:
    """Yaw (0-360) and pitch in degrees of the view from one place (3,) to another."""
    east, north, up = to_m - from_m
    return float(np.degrees(np.arctan2(east, north)) % 360), float(
        np.degrees(np.arctan2(up, np.hypot(east, north)))
    )


def common_point(waypoints: list[Waypoint]) -> FloatArray | None:
    """East, north, up (3,) of the one point at which all look; None where there is none."""
    if len(waypoints) < 3 or any(w.pitch_deg < STEEPEST_DEG for w in waypoints):
        return None
    at = np.array([w.enu_m for w in waypoints])
    along = np.array([view(w) for w in waypoints])
    across = np.eye(3) - along[:, :, None] * along[:, None, :]
    normal = across.sum(axis=0)
    if np.linalg.cond(normal) > 1e6:
        return None
    point: FloatArray = np.linalg.solve(normal, (across @ at[:, :, None]).sum(axis=0)[:, 0])
    offset = point - at
    distance = np.linalg.norm(offset, axis=1)
    miss = np.linalg.norm((across @ offset[:, :, None])[:, :, 0], axis=1)
    ahead = (offset * along).sum(axis=1) > 0
    return point if bool(ahead.all() and (miss <= TOLERANCE * distance).all()) else None


def points_of_interest(plan: Plan) -> dict[int, FloatArray]:
    """Index of waypoint -> its pattern's point of interest, for the patterns of stops that have one."""
    found: dict[int, FloatArray] = {}
    for _, run in groupby(enumerate(plan.waypoints), key=lambda pair: (pair[1].pattern, pair[1].shot)):
        members = list(run)
        if members[0][1].shot is not Shot.STOP:
            continue
        point = common_point([waypoint for _, waypoint in members])
        if point is not None:
            found.update({index: point for index, _ in members})
    return found


def roi_items(plan: Plan) -> list[Item | None]:
    """For each waypoint the command that points at its pattern's point of interest, None without one.

    ArduPilot and PX4 both take the place in frame GLOBAL_RELATIVE_ALT (PX4 not in MISSION).
    """
    points = points_of_interest(plan)
    found: list[Item | None] = [None] * len(plan.waypoints)
    at = places(plan.launch, np.array([*points.values()]).reshape(-1, 3))
    for index, (x, y, z) in zip(points, at, strict=True):
        found[index] = Item(mav.DO_SET_ROI_LOCATION, mav.GLOBAL_RELATIVE_ALT, x=x, y=y, z=centimetres(z))
    return found

"""A fence as mission items of type 1 (https://mavlink.io/en/services/mission.html#fence_mission_commands).

The ceiling is a parameter of the autopilot (ArduPilot FENCE_ALT_MAX, PX4 GF_MAX_VER_DIST) and no item.
"""

from __future__ import annotations

from collections.abc import Sequence

from mission.encode import constants as mav
from mission.encode.items import Item, degrees_e7, item
from mission.fence import Fence

KEEP_IN, KEEP_OUT, CIRCLE_IN, CIRCLE_OUT = 5001, 5002, 5003, 5004


def fence_items(fence: Fence) -> tuple[Item, ...]:
    """Polygon by polygon a corner each (param 1: how many it has), then circles (param 1: radius in m)."""
    found = []
    for command, polygons in ((KEEP_IN, fence.keep_in), (KEEP_OUT, fence.keep_out)):
        for polygon in polygons:
            found += [_at(command, float(len(polygon)), *corner) for corner in polygon]
    for circle in fence.circles:
        command = CIRCLE_IN if circle.inside else CIRCLE_OUT
        found.append(_at(command, circle.radius_m, circle.latitude_deg, circle.longitude_deg))
    return tuple(found)


def compare_fence(sent: Sequence[Item], read_back: Sequence[Item]) -> list[str]:
    """Differences that matter, one sentence each: zones, corners to 1e-7 degree, radii to a decimetre."""
    if len(sent) != len(read_back):
        return [f"The vehicle's fence has {len(read_back)} corners and circles, but {len(sent)} were sent."]
    found = []
    for index, (ours, theirs) in enumerate(zip(sent, read_back, strict=True)):
        same = (
            ours.command == theirs.command
            and abs(ours.x - theirs.x) <= 1
            and abs(ours.y - theirs.y) <= 1
            and abs(ours.param1 - theirs.param1) <= 0.1
        )
        if not same:
            found.append(f"Corner or circle {index} of the fence differs on the vehicle.")
    return found


def _at(command: int, param1: float, latitude_deg: float, longitude_deg: float) -> Item:
    x, y = degrees_e7(latitude_deg), degrees_e7(longitude_deg)
    return item(command, mav.GLOBAL, [param1, 0.0, 0.0, 0.0], x, y)

"""QGroundControl's ``.plan``: JSON, file version 1, mission 2, geofence 2, rally points 2.

Definition: QGroundControl developer guide, "Plan File Format"; only ``SimpleItem`` is written,
which MAVSDK reads too. The home of ArduPilot missions is ``plannedHomePosition``, not an item.
"""

from __future__ import annotations

import json
import math
from typing import Any

from calib.errors import FormatError
from calib.frames import LocalFrame
from mission.encode import constants as mav
from mission.encode.decode import stations_of_items
from mission.encode.items import Flavour, Item, item
from mission.encode.readplan import ReadPlan, int32, integer, latitude_longitude, number
from mission.fence import Circle, Fence, Polygon
from mission.plan import Plan

_FIRMWARE: dict[Flavour, int] = {"ardupilot": mav.ARDUPILOTMEGA, "px4": mav.PX4}
WHAT = "The plan file"
#: Above the launch point (QGroundControlQmlGlobal.AltitudeModeRelative).
_RELATIVE = 1
_MULTICOPTER = 2


def text(plan: Plan, items: tuple[Item, ...], fence: Fence | None, flavour: Flavour) -> str:
    """The file's text, UTF-8 JSON. ``items`` are those of :mod:`ardupilot` or :mod:`px4`."""
    launch, speed = plan.launch, plan.vehicle.speed_m_s
    own = items[1:] if flavour == "ardupilot" else items
    mission = {
        "cruiseSpeed": speed,
        "firmwareType": _FIRMWARE[flavour],
        "globalPlanAltitudeMode": _RELATIVE,
        "hoverSpeed": speed,
        "items": [_entry(one, index + 1) for index, one in enumerate(own)],
        "plannedHomePosition": [launch.latitude_deg, launch.longitude_deg, launch.altitude_m],
        "vehicleType": _MULTICOPTER,
        "version": 2,
    }
    whole = {
        "fileType": "Plan",
        "geoFence": _fence(fence or Fence()),
        "groundStation": "QGroundControl",
        "mission": mission,
        "rallyPoints": {"points": [], "version": 2},
        "version": 1,
    }
    return json.dumps(whole, indent=2, allow_nan=False) + "\n"


def read(raw: str) -> ReadPlan:
    """Stations, launch point and fence of a ``.plan``.

    Raises:
        FormatError: not a plan, or one with items (surveys, structure scans) that are not written out.
    """
    try:
        whole = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{WHAT} is not JSON: save it again in QGroundControl.") from error
    if not isinstance(whole, dict) or whole.get("fileType") != "Plan":
        raise FormatError(f"{WHAT} is JSON, but not a QGroundControl plan (its fileType is not Plan).")
    mission = whole.get("mission")
    if not isinstance(mission, dict) or mission.get("version") != 2:
        raise FormatError(f"{WHAT} has no mission of version 2: save it again in a newer QGroundControl.")
    flavour: Flavour = "px4" if mission.get("firmwareType") == mav.PX4 else "ardupilot"
    launch, entries = _launch(mission), mission.get("items")
    if not isinstance(entries, list):
        raise FormatError(f"{WHAT} has no list of mission items.")
    items = tuple(one for entry in entries for one in _items(entry))
    notes: list[str] = []
    fence = _read_fence(whole.get("geoFence"), notes)
    return ReadPlan(stations_of_items(items, launch, flavour), launch, fence, tuple(notes), items, flavour)


def _entry(item: Item, number_: int) -> dict[str, object]:
    placed = item.has_place
    place: list[float] = (
        [round(item.latitude_deg, 7), round(item.longitude_deg, 7)] if placed else [item.x, item.y]
    )
    params = [item.param1, item.param2, item.param3, item.param4, *place, item.z]
    entry: dict[str, object] = {
        "autoContinue": item.autocontinue,
        "command": item.command,
        "doJumpId": number_,
        "frame": item.frame,
        "params": [None if math.isnan(p) else p for p in params],
        "type": "SimpleItem",
    }
    if placed:
        entry |= {"AMSLAltAboveTerrain": None, "Altitude": item.z, "AltitudeMode": _RELATIVE}
    return entry


def _items(entry: object) -> list[Item]:
    if not isinstance(entry, dict):
        raise FormatError(f"{WHAT} has a mission item that is not an object.")
    if entry.get("type") == "ComplexItem":
        inner = entry.get("TransectStyleComplexItem")
        listed = inner.get("Items") if isinstance(inner, dict) else None
        if not isinstance(listed, list):
            raise FormatError(
                f"{WHAT} has a {str(entry.get('complexItemType', 'complex item'))[:40]} that only "
                "QGroundControl can unfold: it is not read."
            )
        return [found for one in listed for found in _items(one)]
    params = entry.get("params")
    if not isinstance(params, list) or len(params) != 7:
        raise FormatError(f"{WHAT} has a mission item without its seven params.")
    values = [math.nan if p is None else number(p, "A param of a mission item") for p in params]
    command, frame = integer(entry.get("command"), "A command"), integer(entry.get("frame"), "A frame")
    placed = Item(command, frame).has_place
    x, y, z = (0.0 if math.isnan(value) else value for value in values[4:])
    if placed:
        if x or y:
            latitude_longitude(x, y, WHAT)
        x, y = x * 1e7, y * 1e7
    goes_on = entry.get("autoContinue") is not False
    return [item(command, frame, values, int32(x, WHAT), int32(y, WHAT), z, goes_on)]


def _launch(mission: dict[str, Any]) -> LocalFrame:
    home = mission.get("plannedHomePosition")
    if not isinstance(home, list) or len(home) != 3:
        raise FormatError(f"{WHAT} has no planned home position, so heights and places have no origin.")
    latitude, longitude = (number(value, "The planned home position") for value in home[:2])
    latitude_longitude(latitude, longitude, WHAT)
    altitude = 0.0 if home[2] is None else number(home[2], "The planned home altitude")
    return LocalFrame(latitude, longitude, altitude)


# --- Fence ---------------------------------------------------------------------------------------


def _fence(fence: Fence) -> dict[str, object]:
    polygons = [(True, p) for p in fence.keep_in] + [(False, p) for p in fence.keep_out]
    return {
        "circles": [
            {
                "circle": {"center": [c.latitude_deg, c.longitude_deg], "radius": c.radius_m},
                "inclusion": c.inside,
                "version": 1,
            }
            for c in fence.circles
        ],
        "polygons": [
            {"inclusion": inside, "polygon": [list(corner) for corner in polygon], "version": 1}
            for inside, polygon in polygons
        ],
        "version": 2,
    }


def _read_fence(found: object, notes: list[str]) -> Fence | None:
    if not isinstance(found, dict) or found.get("version") != 2:
        if found is not None:
            notes.append("The file's fence is of an old version and was not read.")
        return None
    keep: dict[bool, list[Polygon]] = {True: [], False: []}
    circles: list[Circle] = []
    try:
        for one in found.get("polygons", []):
            corners = tuple(_corner(corner) for corner in one["polygon"])
            keep[one.get("inclusion", True) is not False].append(corners)
        for one in found.get("circles", []):
            centre = _corner(one["circle"]["center"])
            radius = number(one["circle"]["radius"], "A fence circle's radius")
            circles.append(Circle(*centre, radius, one.get("inclusion", True) is not False))
        fence = Fence(tuple(keep[True]), tuple(keep[False]), tuple(circles))
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise FormatError(f"{WHAT} has a damaged fence: save it again in QGroundControl.") from error
    return None if fence.is_empty else fence


def _corner(pair: Any) -> tuple[float, float]:
    latitude, longitude = (number(value, "A fence corner") for value in pair)
    return latitude, longitude

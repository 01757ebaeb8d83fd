"""Which mission items each autopilot takes, and what it keeps of them. Measured; see the module
:mod:`mission.encode.compare`, from which this is kept apart on purpose."""

from __future__ import annotations

import math
from dataclasses import replace

from mission.encode import Flavour, Item
from sim.vehicle.dialect import mavlink

PLACED = frozenset({16, 17, 18, 19, 21, 22, 82, 195, 201})
NAVIGATION = frozenset({16, 17, 18, 19, 20, 21, 22, 82, 93})
_FRAMES = {"ardupilot": {0, 2, 3, 5, 6, 10, 11}, "px4": {0, 3, 5, 6}}
_COPTER_COMMANDS = (
    PLACED | NAVIGATION | {92, 94, 112, 114, 115, 177, 178, 179, 181, 182, 183, 184, 197, 203, 205, 206}
) | {206, 207, 208, 211, 212, 215, 218, 222, 530, 1000, 2000, 2001, 2500, 2501, 42600}
_PX4_COMMANDS = (PLACED | NAVIGATION) - {18, 82} | {
    *(31, 112, 177, 178, 179, 183, 189, 197, 203, 205, 206, 211, 214, 530, 532, 1000, 1001, 2000, 2001),
    *(2003, 2500, 2501, 3000),
}
MOST_ITEMS = {"ardupilot": 650, "px4": 500}


def refusal(flavour: Flavour, item: Item) -> int:
    """MAV_MISSION_RESULT for one item; 0 (accepted) where the autopilot takes it."""
    commands = _COPTER_COMMANDS if flavour == "ardupilot" else _PX4_COMMANDS
    if item.command not in commands:
        return int(mavlink.MAV_MISSION_UNSUPPORTED)
    placed = item.command in PLACED
    if placed and item.frame not in _FRAMES[flavour]:
        return int(mavlink.MAV_MISSION_UNSUPPORTED_FRAME)
    if flavour == "px4":
        return 0 if placed or item.frame == 2 else int(mavlink.MAV_MISSION_UNSUPPORTED)
    for number in range(1, 5):
        free = number == 4 and item.command in (16, 17, 21, 22)
        if math.isnan(getattr(item, f"param{number}")) and not free:
            return int(mavlink.MAV_MISSION_INVALID_PARAM1) + number - 1
    return 0


def kept(flavour: Flavour, index: int, item: Item, home: Item) -> Item:
    """The item as it is read back. ``home`` takes the place of ArduPilot's item 0."""
    if flavour == "px4":
        if item.command not in PLACED:
            return item
        # In radians and single precision, 0 to 2 pi; integer clients get integer frames back.
        turned = math.degrees(math.radians(item.param4) % (2 * math.pi))
        return replace(item, param4=turned, frame={0: 5, 3: 6}.get(item.frame, item.frame))
    if index == 0:
        return home
    item = replace(item, frame={5: 0, 6: 3, 11: 10}.get(item.frame, item.frame))
    if item.command in PLACED:
        item = replace(item, z=math.trunc(item.z * 100) / 100)
        if item.command == 16:
            item = replace(item, param1=float(int(item.param1)), param2=0.0, param3=0.0, param4=0.0)
        else:
            item = replace(item, param2=0.0, param3=0.0, param4=0.0)
        return item
    item = replace(item, frame=0)
    if item.command == 1000:
        return replace(item, param1=float(int(item.param1)), param2=float(int(item.param2)))
    return replace(item, param2=0.0) if item.command == 206 else item

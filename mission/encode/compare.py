"""What a vehicle holds against what was sent to it, beyond what its storage is known to lose.

Losses as measured: ArduCopter 4.6 replaces home, keeps heights to a centimetre, holds to whole
seconds, drops params 2-4 of waypoints, rounds gimbal angles to degrees, drops param 2 of
DO_SET_CAM_TRIGG_DIST and reads commands without a place back in frame 0; frames 5, 6, 11 come back
as 0, 3, 10. PX4 1.16 keeps all but the difference between float and integer frames and the turns
of an angle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from mission.encode import constants as mav
from mission.encode.items import Flavour, Item

_PARAMS = ("param1", "param2", "param3", "param4")


def stored(item: Item, flavour: Flavour) -> Item:
    """``item`` without what the autopilot does not keep."""
    item = replace(item, frame=mav.SAME_FRAME.get(item.frame, item.frame), autocontinue=True)
    if flavour == "px4":
        return replace(item, param4=item.param4 % 360) if item.command in mav.FLOWN_TO else item
    if not item.has_place:
        item = replace(item, frame=mav.GLOBAL)
    if item.command == mav.NAV_WAYPOINT:
        return replace(item, param1=math.floor(item.param1), param2=0.0, param3=0.0, param4=0.0)
    if item.command == mav.NAV_TAKEOFF:
        # Copter climbs where it stands: the place is not its business.
        return replace(item, param1=0.0, param2=0.0, param3=0.0, param4=0.0, x=0, y=0)
    if item.command == mav.DO_SET_CAM_TRIGG_DIST:
        return replace(item, param2=0.0)
    if item.command == mav.DO_GIMBAL_MANAGER_PITCHYAW:
        return replace(item, param1=float(round(item.param1)), param2=float(round(item.param2)))
    return item


def compare(sent: Sequence[Item], read_back: Sequence[Item], flavour: Flavour) -> list[str]:
    """Differences that matter, one sentence each; none: the vehicle holds the mission that was sent.

    Places must agree to the last 1e-7 degree, heights to 1.1 cm (ArduPilot) or to single
    precision, other numbers to single precision.
    """
    if len(sent) != len(read_back):
        return [f"The vehicle holds {len(read_back)} items, but {len(sent)} were sent."]
    found: list[str] = []
    for index, (ours, theirs) in enumerate(zip(sent, read_back, strict=True)):
        if flavour == "ardupilot" and index == 0:
            continue  # home is the vehicle's own
        want, have = stored(ours, flavour), stored(theirs, flavour)
        found += [f"Item {index} has {what}." for what in _differences(want, have, flavour)]
    return found


def _differences(want: Item, have: Item, flavour: Flavour) -> list[str]:
    if want.command != have.command:
        return [f"command {have.command} on the vehicle instead of {want.command}"]
    found = [
        f"{name} {getattr(have, name)} on the vehicle instead of {getattr(want, name)}"
        for name in ("frame", "x", "y")
        if getattr(want, name) != getattr(have, name)
    ]
    for name in (*_PARAMS, "z"):
        ours, theirs = getattr(want, name), getattr(have, name)
        if not _same(ours, theirs, 0.011 if name == "z" and flavour == "ardupilot" else 0.0, want, name):
            found.append(f"{name} {theirs:g} on the vehicle instead of {ours:g}")
    return found


def _same(ours: float, theirs: float, tolerance: float, item: Item, name: str) -> bool:
    if math.isnan(ours) or math.isnan(theirs):
        return math.isnan(ours) and math.isnan(theirs)
    difference = abs(ours - theirs)
    if name == "param4" and item.command in mav.FLOWN_TO:
        difference = min(difference, 360 - difference)
        tolerance = 1e-3
    return difference <= max(tolerance, 2e-6 * max(abs(ours), abs(theirs)), 1e-6)

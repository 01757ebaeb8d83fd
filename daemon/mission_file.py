"""A mission file on its way to a vehicle."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from calib.errors import InputError
from calib.frames import LocalFrame
from daemon.link.upload import Mission
from daemon.link.vehicle_mission import read_held
from mission import encode
from mission.encode import Flavour, Item, ReadPlan
from mission.encode import constants as mav
from mission.encode.fence_items import fence_items
from mission.encode.items import degrees_e7

UPLOADABLE = (".plan", ".waypoints", ".json")


@dataclass(frozen=True)
class Loaded:
    """``plan`` for looking at it, ``mission`` for the vehicle."""

    plan: ReadPlan
    mission: Mission


def load(path: Path, flavour: Flavour, with_fence: bool = True) -> Loaded:
    """A mission of ``fieldcal plan`` or a ground station (.plan, .waypoints), or one that was kept from a
    vehicle (.json), for a vehicle of ``flavour``.

    Raises:
        InputError: another kind of file, not readable. FormatError: damaged.
    """
    suffix = path.suffix.lower()
    if suffix not in UPLOADABLE:
        raise InputError(
            f"{path.name} is no mission that a vehicle takes over MAVLink: use {', '.join(UPLOADABLE)}."
        )
    if suffix == ".json":
        return _kept(path, with_fence)
    plan = encode.read(path)
    items = plan.items if flavour == "px4" else (_home(plan.launch), *plan.items)
    fence = fence_items(plan.fence) if with_fence and plan.fence is not None else None
    return Loaded(plan, Mission(path.name, flavour, items, fence))


def _kept(path: Path, with_fence: bool) -> Loaded:
    held = read_held(path)
    placed = [i for i in held.mission if i.has_place and (i.x or i.y)]
    launch = LocalFrame(placed[0].latitude_deg, placed[0].longitude_deg) if placed else LocalFrame(0.0, 0.0)
    if placed and held.flavour == "ardupilot":
        launch = replace(launch, altitude_m=held.mission[0].z)
    own = held.mission[1:] if held.flavour == "ardupilot" else held.mission
    stations = encode.stations_of_items(held.mission, launch, held.flavour)
    plan = ReadPlan(stations, launch, None, (), own, held.flavour)
    fence = held.fence if with_fence else None
    return Loaded(plan, Mission(path.name, held.flavour, held.mission, fence))


def _home(launch: LocalFrame) -> Item:
    """ArduPilot's item 0; the vehicle puts its own place there."""
    x, y = degrees_e7(launch.latitude_deg), degrees_e7((launch.longitude_deg + 180) % 360 - 180)
    return Item(mav.NAV_WAYPOINT, mav.GLOBAL, x=x, y=y, z=launch.altitude_m)

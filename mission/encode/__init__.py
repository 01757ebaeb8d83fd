"""One plan in every dialect: :func:`write` by file suffix, :func:`read` back what can be read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from calib.errors import InputError
from calib.files import write_bytes_atomic
from calib.frames import LocalFrame
from mission.encode import ardupilot, kml, litchi, px4, qgc_plan, waypoints, wpml, wpml_read
from mission.encode.compare import compare
from mission.encode.decode import stations_of_items
from mission.encode.files import read_bytes, text_of
from mission.encode.items import FLAVOURS, Aim, Flavour, Item
from mission.encode.readplan import ReadPlan
from mission.fence import Fence
from mission.plan import Plan

__all__ = [
    "FLAVOURS",
    "READABLE",
    "SUFFIXES",
    "Aim",
    "Flavour",
    "Item",
    "ReadPlan",
    "compare",
    "items",
    "read",
    "stations_of_items",
    "write",
]


@dataclass(frozen=True)
class _Options:
    fence: Fence | None
    flavour: Flavour
    aim: Aim


def items(plan: Plan, flavour: Flavour, aim: Aim = "angles") -> tuple[Item, ...]:
    """The mission as the autopilot wants it uploaded (ArduPilot's with home as item 0).

    Raises:
        InputError: more items than the vehicle holds, or a line without an end.
    """
    return ardupilot.items(plan, aim) if flavour == "ardupilot" else px4.items(plan, aim)


def _plan(plan: Plan, options: _Options) -> tuple[bytes, list[str]]:
    found = items(plan, options.flavour, options.aim)
    notes = _item_notes(plan, options)
    if options.fence is not None and options.fence.ceiling_m is not None:
        notes.append("The plan file holds the fence but not its ceiling: set it in the autopilot.")
    return qgc_plan.text(plan, found, options.fence, options.flavour).encode(), notes


def _waypoints(plan: Plan, options: _Options) -> tuple[bytes, list[str]]:
    text = waypoints.text(items(plan, options.flavour, options.aim))
    return text.encode(), [*_item_notes(plan, options), *_no_fence(options, "Waypoint files")]


def _kml(plan: Plan, _: _Options) -> tuple[bytes, list[str]]:
    return kml.text(plan).encode(), ["KML is for looking at: it holds no camera commands."]


def _kmz(plan: Plan, options: _Options) -> tuple[bytes, list[str]]:
    data, notes = wpml.kmz(plan)
    return data, [*notes, *_no_fence(options, "DJI waylines")]


def _litchi(plan: Plan, options: _Options) -> tuple[bytes, list[str]]:
    text, notes = litchi.text(plan)
    return text.encode(), [*notes, *_no_fence(options, "Litchi missions")]


def _item_notes(plan: Plan, options: _Options) -> list[str]:
    notes = []
    whole = all(w.pitch_deg == round(w.pitch_deg) for w in plan.waypoints)
    if options.flavour == "ardupilot" and options.aim == "angles" and not whole:
        notes.append("ArduPilot's gimbal angles are whole degrees: camera pitches were rounded.")
    return notes


def _no_fence(options: _Options, what: str) -> list[str]:
    if options.fence is None or options.fence.is_empty:
        return []
    return [f"{what} hold no fence: load it into the autopilot another way."]


_WRITERS: dict[str, Callable[[Plan, _Options], tuple[bytes, list[str]]]] = {
    ".plan": _plan,
    ".waypoints": _waypoints,
    ".kml": _kml,
    ".kmz": _kmz,
    ".csv": _litchi,
}

#: What :func:`write` writes, and what it is for.
SUFFIXES: dict[str, str] = {
    ".plan": "QGroundControl and MAVSDK",
    ".waypoints": "Mission Planner, MAVProxy, QGroundControl",
    ".kml": "eyes: Google Earth, QGIS",
    ".kmz": "DJI Pilot 2, FlightHub 2 (WPML)",
    ".csv": "Litchi",
}
#: What :func:`read` reads.
READABLE = (".plan", ".waypoints", ".kmz", ".csv")


def write(
    plan: Plan,
    path: Path,
    *,
    fence: Fence | None = None,
    flavour: Flavour = "ardupilot",
    aim: Aim = "angles",
) -> list[str]:
    """Write a plan in the format that the suffix of ``path`` names, whole or not at all.

    Args:
        fence: goes into the formats that hold one.
        flavour: whose mission items a ``.plan`` or ``.waypoints`` gets.
        aim: "roi" points at the centre of orbits instead of giving each photo's angles, where the
            stops of a pattern share one point of interest.

    Returns:
        what the format cannot hold of this plan, in sentences.

    Raises:
        InputError: unknown suffix, more items than the vehicle holds, a line without an end.
        OutputError: not writable.
    """
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise InputError(
            f"{path.name}: no mission format has the ending {path.suffix or '(none)'!r}; "
            f"there are {', '.join(SUFFIXES)}."
        )
    data, notes = writer(plan, _Options(fence, flavour, aim))
    write_bytes_atomic(path, data)
    return notes


def read(path: Path, *, launch: LocalFrame | None = None) -> ReadPlan:
    """Read a mission file back as the photos it takes.

    Args:
        launch: where the vehicle starts, for the formats that may not say so.

    Raises:
        FormatError: not such a file, or a damaged one.
        InputError: unknown suffix, or not readable.
    """
    suffix = path.suffix.lower()
    if suffix == ".plan":
        return qgc_plan.read(text_of(read_bytes(path), qgc_plan.WHAT))
    if suffix == ".waypoints":
        return waypoints.read(text_of(read_bytes(path), waypoints.WHAT), launch)
    if suffix == ".kmz":
        return wpml_read.read(read_bytes(path), launch)
    if suffix == ".csv":
        return litchi.read(text_of(read_bytes(path), litchi.WHAT), launch)
    raise InputError(f"{path.name} cannot be read as a mission: only {', '.join(READABLE)} can.")

"""What reading a mission file gives, and the checks that all readers share."""

from __future__ import annotations

import math
from dataclasses import dataclass

from calib.errors import FormatError
from calib.frames import LocalFrame
from mission.encode.decode import MOST_PHOTOS_ON_LEG
from mission.encode.items import Flavour, Item
from mission.fence import Fence
from mission.plan import Station


@dataclass(frozen=True)
class ReadPlan:
    """A mission file as photos.

    ``stations``: in the order of the flight, in the frame of ``launch``, ``pattern`` empty.
    ``launch``: the origin of the stations (in a file without one: the take-off, else the first
    place). ``fence``: None where the file has none. ``notes``: what was guessed or left out, in
    sentences. ``items``: the MAVLink items, without home; empty for formats that have none.
    """

    stations: tuple[Station, ...]
    launch: LocalFrame
    fence: Fence | None = None
    notes: tuple[str, ...] = ()
    items: tuple[Item, ...] = ()
    flavour: Flavour | None = None


def number(value: object, what: str) -> float:
    """A finite number from JSON or from text, or FormatError."""
    found = math.nan
    if isinstance(value, str | int | float) and not isinstance(value, bool):
        try:
            found = float(value)
        except (ValueError, OverflowError):
            found = math.nan
    if not math.isfinite(found):
        raise FormatError(f"{what} is {str(value)[:40]!r}, not a number: the mission file is damaged.")
    return found


def integer(value: object, what: str) -> int:
    found = number(value, what)
    if found % 1 or not 0 <= found < 2**16:
        raise FormatError(f"{what} is {str(value)[:40]!r}, which MAVLink does not have.")
    return int(found)


def int32(value: float, what: str) -> int:
    """The whole number that an item's x or y has room for."""
    if not abs(value) < 2**31:
        raise FormatError(f"{what} has the number {value:g} where a mission item has room for 32 bits only.")
    return round(value)


def photos_on_leg(length_m: float, gap_m: float, what: str) -> None:
    """Refuse a distance between photos that fills memory with them."""
    if length_m > gap_m * MOST_PHOTOS_ON_LEG:
        raise FormatError(f"{what} asks for more than {MOST_PHOTOS_ON_LEG} photos on one leg: it is damaged.")


def latitude_longitude(latitude_deg: float, longitude_deg: float, what: str) -> None:
    """Refuse what is no place on Earth."""
    if not (-90 <= latitude_deg <= 90 and -180 <= longitude_deg <= 180):
        raise FormatError(
            f"{what} has a place at {latitude_deg:g}, {longitude_deg:g}, which is no latitude and longitude "
            "in degrees."
        )

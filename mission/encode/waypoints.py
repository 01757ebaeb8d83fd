"""Mission Planner's and QGroundControl's ``.waypoints``: text that starts with ``QGC WPL 110``.

Definition: mavlink.io, "File Formats", Mission Plain-Text File Format: index, current, frame,
command, params 1-4, latitude, longitude, height, autocontinue, by tabs. ArduPilot's files have home
as line 0, PX4's have none.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from pyproj import Geod

from calib.errors import FormatError
from calib.frames import LocalFrame
from mission.encode import constants as mav
from mission.encode.decode import guess_flavour, stations_of_items
from mission.encode.items import Item, item
from mission.encode.readplan import ReadPlan, int32, integer, latitude_longitude, number

HEADER = "QGC WPL 110"
WHAT = "The waypoint file"
#: Nobody flies a photo mission this far from home: there latitude and longitude were exchanged.
FAR_M = 50_000.0
_GEOD = Geod(ellps="WGS84")


def text(items: tuple[Item, ...]) -> str:
    """The file's text; places to 1e-7 degrees, NaN as ``NaN``."""
    return "\n".join([HEADER, *(_line(index, one) for index, one in enumerate(items)), ""])


def read(raw: str, launch: LocalFrame | None = None) -> ReadPlan:
    """Stations of a ``.waypoints`` file. Exchanged latitude and longitude are put right, with a note.

    Args:
        launch: where the vehicle starts, if known: counts before the file's home, and finds files in
            which home is exchanged as well.

    Raises:
        FormatError: not such a file, a damaged line, or no place at all.
    """
    lines = raw.lstrip("\ufeff").splitlines()
    if not lines or lines[0].strip() != HEADER:
        raise FormatError(
            f"{WHAT} does not start with {HEADER!r}: it is not a mission, or an old kind of one."
        )
    items = [_item(line) for line in lines[1:] if line.strip() and not line.startswith("#")]
    if not items:
        raise FormatError(f"{WHAT} holds no items.")
    notes: list[str] = []
    flavour = guess_flavour(items)
    items = _right_way_round(items, launch, notes)
    for one in items:
        if one.has_place:
            latitude_longitude(one.latitude_deg, one.longitude_deg, WHAT)
    if launch is None:
        launch = _launch(items, notes)
    own = tuple(items[1:] if flavour == "ardupilot" else items)
    return ReadPlan(stations_of_items(items, launch, flavour), launch, None, tuple(notes), own, flavour)


def _line(index: int, item: Item) -> str:
    place = [_degrees(item.x), _degrees(item.y)] if item.has_place else [str(item.x), str(item.y)]
    params = [_number(p) for p in (item.param1, item.param2, item.param3, item.param4)]
    fields = [index, int(index == 0), item.frame, item.command, *params, *place, _number(item.z)]
    return "\t".join([*map(str, fields), str(int(item.autocontinue))])


def _degrees(e7: int) -> str:
    whole, part = divmod(abs(e7), 10**7)
    return f"{'-' if e7 < 0 else ''}{whole}.{part:07d}"


def _number(value: float) -> str:
    return "NaN" if math.isnan(value) else f"{value:.9g}"


def _item(line: str) -> Item:
    fields = line.split()
    if len(fields) != 12:
        raise FormatError(f"{WHAT} has a line of {len(fields)} fields instead of 12: {line.strip()[:40]!r}.")
    frame, command = integer(fields[2], "A frame"), integer(fields[3], "A command")
    params = [
        math.nan if field.lower() == "nan" else number(field, "A param of a waypoint")
        for field in fields[4:8]
    ]
    scale = 1e7 if Item(command, frame).has_place else 1.0
    x, y = (int32(number(field, "A place") * scale, WHAT) for field in fields[8:10])
    return item(command, frame, params, x, y, number(fields[10], "A height"), fields[11] != "0")


def _flown(items: list[Item]) -> list[Item]:
    return [item for item in items if item.has_place and (item.x or item.y)]


def _launch(items: list[Item], notes: list[str]) -> LocalFrame:
    placed = _flown(items)
    if not placed:
        raise FormatError(f"{WHAT} holds no place, so there is nothing to photograph.")
    home = placed[0]
    absolute = mav.SAME_FRAME.get(home.frame, home.frame) == mav.GLOBAL
    if not absolute:
        notes.append("The file names no home: the first place counts as the launch point.")
    return LocalFrame(home.latitude_deg, home.longitude_deg, home.z if absolute else 0.0)


def _right_way_round(items: list[Item], launch: LocalFrame | None, notes: list[str]) -> list[Item]:
    """Exchange x and y of the places where only that brings them near the start of the flight."""
    placed = _flown(items)
    if not placed:
        return items
    start = placed[0]
    home = (
        (launch.latitude_deg, launch.longitude_deg) if launch else (start.latitude_deg, start.longitude_deg)
    )
    if launch is None and abs(home[0]) > 90:
        home = (home[1], home[0])

    def far(item: Item, swapped: bool) -> bool:
        latitude, longitude = item.latitude_deg, item.longitude_deg
        if swapped:
            latitude, longitude = longitude, latitude
        if not (abs(latitude) <= 90 and abs(longitude) <= 180):
            return True
        return bool(np.asarray(_GEOD.inv(home[1], home[0], longitude, latitude)[2]) > FAR_M)

    wrong = [item for item in placed if far(item, False) and not far(item, True)]
    if not wrong:
        return items
    notes.append(
        f"Latitude and longitude of {len(wrong)} places were exchanged in the file (they lay more than "
        f"{FAR_M / 1000:.0f} km from home); they were put right."
    )
    chosen = {id(item) for item in wrong}
    return [replace(item, x=item.y, y=item.x) if id(item) in chosen else item for item in items]

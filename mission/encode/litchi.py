"""Litchi's mission CSV (Mission Hub import): one row per waypoint, 46 columns, metres.

Definition: litchiutilities.com, "Litchi CSV Format Description", and files exported by the Mission
Hub. Heights are above the take-off point (altitudemode 0). The file holds no settings of the whole
mission: Heading Mode must be set to Custom (otherwise headings are ignored), Path Mode to Straight
Lines, Finish Action to RTH.
"""

from __future__ import annotations

import csv
import io
import math

import numpy as np

from calib.errors import FormatError
from calib.frames import LocalFrame
from mission.encode.items import SHUTTER_S, check_plan, line_gap_m, places
from mission.encode.markup import decimal
from mission.encode.readplan import ReadPlan, latitude_longitude, number, photos_on_leg
from mission.plan import Plan, Shot, Station, Waypoint

ACTIONS = 15
MOST_WAYPOINTS = 99
HEADER = (
    *("latitude", "longitude", "altitude(m)", "heading(deg)", "curvesize(m)"),
    *("rotationdir", "gimbalmode", "gimbalpitchangle"),
    *(f"action{kind}{n}" for n in range(1, ACTIONS + 1) for kind in ("type", "param")),
    *("altitudemode", "speed(m/s)", "poi_latitude", "poi_longitude", "poi_altitude(m)"),
    *("poi_altitudemode", "photo_timeinterval", "photo_distinterval"),
)
WHAT = "The Litchi file"
_STAY, _PHOTO, _TURN, _TILT, _NONE = 0, 1, 4, 5, -1
_INTERPOLATE = 2


def text(plan: Plan) -> tuple[str, list[str]]:
    """The file's text, and what Litchi needs to know besides.

    Raises:
        InputError: a line without an end or a spacing.
    """
    check_plan(plan)
    at = places(plan.launch, np.array([w.enu_m for w in plan.waypoints]))
    out = io.StringIO()
    table = csv.writer(out, lineterminator="\n")
    table.writerow(HEADER)
    before: Waypoint | None = None
    for index, (waypoint, (x, y, height)) in enumerate(zip(plan.waypoints, at, strict=True)):
        line = waypoint.shot is Shot.LINE
        gap = line_gap_m(waypoint, plan.waypoints[index + 1]) if line else -1.0
        ending = before is not None and before.shot is Shot.LINE
        carried = before if ending and before is not None else waypoint
        actions = _actions(plan, waypoint, ending)
        flat = [field for action in actions + [(_NONE, 0)] * (ACTIONS - len(actions)) for field in action]
        place = [decimal(x * 1e-7, 7), decimal(y * 1e-7, 7), decimal(height, 3)]
        aim = [round(carried.yaw_deg) % 360, "0", 0, _INTERPOLATE, round(carried.pitch_deg)]
        speed = decimal(min(max(plan.vehicle.speed_m_s, 0.1), 15.0), 2)
        table.writerow([*place, *aim, *flat, 0, speed, 0, 0, 0, 0, -1, decimal(gap, 6)])
        before = waypoint
    return out.getvalue(), _notes(plan)


def _actions(plan: Plan, waypoint: Waypoint, ending: bool) -> list[tuple[int, int]]:
    """Photo of the line that ends here, then turn, tilt, wait and photo of what begins here."""
    found = [(_PHOTO, 0)] if ending else []
    if waypoint.shot is Shot.NONE:
        return found
    aim = [(_TURN, round(waypoint.yaw_deg) % 360), (_TILT, round(waypoint.pitch_deg))]
    found += [*aim, (_STAY, math.ceil(plan.vehicle.settle_s * 1000)), (_PHOTO, 0)]
    if waypoint.shot is Shot.STOP:
        found.append((_STAY, int(SHUTTER_S * 1000)))
    return found


def _notes(plan: Plan) -> list[str]:
    notes = [
        "Litchi: set Heading Mode to Custom, Path Mode to Straight Lines and Finish Action to RTH after "
        "importing; the file cannot hold these.",
        "Litchi's turn and tilt actions are whole degrees.",
    ]
    if len(plan.waypoints) > MOST_WAYPOINTS:
        notes.append(
            f"The mission has {len(plan.waypoints)} waypoints, but Litchi flies at most {MOST_WAYPOINTS}: "
            "split it."
        )
    if any(w.shot is Shot.LINE for w in plan.waypoints):
        notes.append("Not every drone takes photos by distance in Litchi: try it before the survey.")
    return notes


def read(raw: str, launch: LocalFrame | None = None) -> ReadPlan:
    """Stations of a Litchi CSV in metres; without ``launch`` the first waypoint is the origin.

    Raises:
        FormatError: not such a file, or a damaged one.
    """
    try:
        rows = list(csv.DictReader(io.StringIO(raw)))
    except csv.Error as error:
        raise FormatError(f"{WHAT} is not a table ({error}).") from error
    if not rows or not {*HEADER[:4], "gimbalpitchangle"} <= set(rows[0]):
        raise FormatError(f"{WHAT} has no rows or lacks Litchi's columns (in metres): export it again.")
    values = np.array([[number(row[name], name) for name in HEADER[:4]] for row in rows])
    for latitude, longitude in values[:, :2].tolist():
        latitude_longitude(latitude, longitude, WHAT)
    notes = []
    if launch is None:
        launch = LocalFrame(float(values[0, 0]), float(values[0, 1]))
        notes.append("The file does not say where the flight starts: the first waypoint is the origin.")
    at = launch.enu(values[:, 0], values[:, 1], values[:, 2] + launch.altitude_m)
    found: list[Station] = []
    for index, row in enumerate(rows):
        yaw, pitch = values[index, 3] % 360, number(row["gimbalpitchangle"], "gimbalpitchangle")
        for n in range(1, ACTIONS + 1):
            kind = number(row.get(f"actiontype{n}") or _NONE, "actiontype")
            amount = number(row.get(f"actionparam{n}") or 0, "actionparam")
            if kind == _TURN:
                yaw = amount % 360
            elif kind == _TILT:
                pitch = amount
            elif kind == _PHOTO:
                found.append(_station(at[index], yaw, pitch))
        gap = number(row.get("photo_distinterval") or -1, "photo_distinterval")
        if gap > 0 and index + 1 < len(rows):
            way = at[index + 1] - at[index]
            length = float(np.linalg.norm(way))
            photos_on_leg(length, gap, WHAT)
            steps = range(1, math.ceil(length / gap - 0.5))
            found += [_station(at[index] + step * gap / length * way, yaw, pitch) for step in steps]
    return ReadPlan(tuple(found), launch, None, tuple(notes))


def _station(at: np.ndarray[tuple[int, ...], np.dtype[np.float64]], yaw: float, pitch: float) -> Station:
    return Station(float(at[0]), float(at[1]), float(at[2]), float(yaw), pitch)

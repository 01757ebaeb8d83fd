"""DJI's wayline files: a KMZ with ``wpmz/template.kml`` (for editing) and ``wpmz/waylines.wpml`` (flown).

Definition: DJI Cloud API, "DJI WPML" (github.com/dji-sdk/Cloud-API-Doc: overview, template.kml,
waylines.wpml, common elements), for M300/M350, M30, M3E, M3D and newer. Heights are above the
take-off point (relativeToStartPoint). At each waypoint the aircraft stops and does its actions in
sequence: turn, tilt, wait, photo; the heading is kept ("fixed") until the next turn. Photos of a
line: one at either end by command, those between by distance (multipleDistance).
"""

from __future__ import annotations

import io
import re
import zipfile
from dataclasses import dataclass

import numpy as np

from mission.encode.items import SHUTTER_S, check_plan, line_gap_m, places, turn_deg
from mission.encode.markup import Node, decimal, document
from mission.plan import Plan, Shot, Waypoint

TEMPLATE, WAYLINES = "wpmz/template.kml", "wpmz/waylines.wpml"
_KML = 'kml xmlns="http://www.opengis.net/kml/2.2" xmlns:wpml="http://www.dji.com/wpmz/1.0.2"'
#: The format's largest speed (m/s) and range of the safe take-off height (m).
FASTEST, TAKEOFF_M = 15.0, (1.2, 1500.0)
MOST_WAYPOINTS = 65536
#: The same time stamp in every file, so that one plan gives one file.
_STAMP = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True)
class Drone:
    """Numbers of aircraft and camera (Cloud API, common elements)."""

    name: str
    kind: int
    sub: int
    payload: int


_MAVIC_3E = Drone("Mavic 3 Enterprise", 77, 0, 66)
#: By what a camera's name contains, letters and digits only.
_DRONES = (
    ("m3td", Drone("Matrice 3TD", 91, 1, 81)),
    ("m3d", Drone("Matrice 3D", 91, 0, 80)),
    ("m3t", Drone("Mavic 3 Thermal", 77, 1, 67)),
    ("m3m", Drone("Mavic 3 Multispectral", 77, 2, 68)),
    ("m3e", _MAVIC_3E),
    ("m30t", Drone("Matrice 30T", 67, 1, 53)),
    ("m30", Drone("Matrice 30", 67, 0, 52)),
    ("h20t", Drone("Matrice 300 with H20T", 60, 0, 43)),
    ("h20", Drone("Matrice 300 with H20", 60, 0, 42)),
)


def drone_of(camera_name: str) -> Drone | None:
    """The aircraft that carries a camera of this name; None where the name does not say."""
    plain = re.sub(r"[^a-z0-9]", "", camera_name.lower())
    return next((drone for part, drone in _DRONES if part in plain), None)


def kmz(plan: Plan) -> tuple[bytes, list[str]]:
    """The archive's bytes, and what it cannot hold.

    Raises:
        InputError: a line without an end or a spacing.
    """
    check_plan(plan)
    drone = drone_of(plan.camera_name)
    found = drone or _MAVIC_3E
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in ((TEMPLATE, _template(plan, found)), (WAYLINES, _waylines(plan, found))):
            archive.writestr(zipfile.ZipInfo(name, _STAMP), text, zipfile.ZIP_DEFLATED)
    return out.getvalue(), _notes(plan, drone)


def _notes(plan: Plan, drone: Drone | None) -> list[str]:
    notes = []
    if drone is None:
        notes.append(
            f"The camera's name does not say which DJI drone carries it: the file names a {_MAVIC_3E.name}, "
            "and DJI's programs may refuse it for another one."
        )
    if plan.vehicle.speed_m_s > FASTEST:
        notes.append(f"DJI waylines fly at most {FASTEST:g} m/s: the speed was reduced.")
    if any(w.shot is Shot.LINE for w in plan.waypoints):
        notes.append(
            "DJI Fly does not take the photos between the ends of a line, although the format has them; use "
            "stops there."
        )
    if len(plan.waypoints) > MOST_WAYPOINTS:
        notes.append(f"The mission has more than {MOST_WAYPOINTS} waypoints, which the format cannot number.")
    return notes


def _template(plan: Plan, drone: Drone) -> str:
    launch = plan.launch
    reference = f"{launch.latitude_deg:.8f},{launch.longitude_deg:.8f},{launch.altitude_m:.3f}"
    folder: list[Node] = [
        ("wpml:templateType", "waypoint"),
        ("wpml:templateId", 0),
        (
            "wpml:waylineCoordinateSysParam",
            [("wpml:coordinateMode", "WGS84"), ("wpml:heightMode", "relativeToStartPoint")],
        ),
        ("wpml:autoFlightSpeed", _speed(plan)),
        ("wpml:globalHeight", max((w.height_m for w in plan.waypoints), default=0.0)),
        ("wpml:gimbalPitchMode", "manual"),
        ("wpml:globalWaypointHeadingParam", _heading()),
        ("wpml:globalWaypointTurnMode", "toPointAndStopWithDiscontinuityCurvature"),
        ("wpml:globalUseStraightLine", 1),
        *_placemarks(plan, template=True),
        (
            "wpml:payloadParam",
            # The misspelling is the format's own.
            [("wpml:payloadPositionIndex", 0), ("wpml:imageFormat", "visable")],
        ),
    ]
    config = _mission(plan, drone, [("wpml:takeOffRefPoint", reference)])
    return document((_KML, [("Document", [("wpml:author", "fieldcal"), config, ("Folder", folder)])]))


def _waylines(plan: Plan, drone: Drone) -> str:
    folder: list[Node] = [
        ("wpml:templateId", 0),
        ("wpml:executeHeightMode", "relativeToStartPoint"),
        ("wpml:waylineId", 0),
        ("wpml:autoFlightSpeed", _speed(plan)),
        *_placemarks(plan, template=False),
    ]
    return document((_KML, [("Document", [_mission(plan, drone, []), ("Folder", folder)])]))


def _mission(plan: Plan, drone: Drone, more: list[Node]) -> Node:
    first = plan.waypoints[0].height_m if plan.waypoints else plan.return_height_m
    lowest, highest = TAKEOFF_M
    return (
        "wpml:missionConfig",
        [
            ("wpml:flyToWaylineMode", "safely"),
            ("wpml:finishAction", "goHome"),
            ("wpml:exitOnRCLost", "executeLostAction"),
            ("wpml:executeRCLostAction", "goBack"),
            ("wpml:takeOffSecurityHeight", min(max(first, lowest), highest)),
            *more,
            ("wpml:globalTransitionalSpeed", _speed(plan)),
            ("wpml:globalRTHHeight", plan.return_height_m),
            ("wpml:droneInfo", [("wpml:droneEnumValue", drone.kind), ("wpml:droneSubEnumValue", drone.sub)]),
            (
                "wpml:payloadInfo",
                [("wpml:payloadEnumValue", drone.payload), ("wpml:payloadPositionIndex", 0)],
            ),
        ],
    )


def _speed(plan: Plan) -> float:
    return min(max(plan.vehicle.speed_m_s, 0.1), FASTEST)


def _heading() -> list[Node]:
    return [("wpml:waypointHeadingMode", "fixed"), ("wpml:waypointHeadingPathMode", "followBadArc")]


def _placemarks(plan: Plan, *, template: bool) -> list[Node]:
    at = places(plan.launch, np.array([w.enu_m for w in plan.waypoints]))
    group = 0
    found: list[Node] = []
    before: Waypoint | None = None
    yaw = 0.0
    for index, (waypoint, (x, y, height)) in enumerate(zip(plan.waypoints, at, strict=True)):
        ending = before is not None and before.shot is Shot.LINE
        actions = _actions(plan, waypoint, ending, yaw)
        groups: list[Node] = []
        if actions:
            groups.append(_group(group, index, index, [("wpml:actionTriggerType", "reachPoint")], actions))
        if waypoint.shot is Shot.LINE:
            gap = decimal(line_gap_m(waypoint, plan.waypoints[index + 1]), 6)
            by_distance: list[Node] = [
                ("wpml:actionTriggerType", "multipleDistance"),
                ("wpml:actionTriggerParam", gap),
            ]
            groups.append(_group(group + len(groups), index, index + 1, by_distance, [_photo()]))
        group += len(groups)
        place = f"{decimal(y * 1e-7, 7)},{decimal(x * 1e-7, 7)}"
        found.append(
            (
                "Placemark",
                [
                    ("Point", [("coordinates", place)]),
                    ("wpml:index", index),
                    *(_for_template(plan, height) if template else _for_flight(plan, height)),
                    ("wpml:waypointHeadingParam", _heading()),
                    (
                        "wpml:waypointTurnParam",
                        [
                            ("wpml:waypointTurnMode", "toPointAndStopWithDiscontinuityCurvature"),
                            ("wpml:waypointTurnDampingDist", 0),
                        ],
                    ),
                    ("wpml:useStraightLine", 1),
                    *groups,
                ],
            )
        )
        yaw = yaw if waypoint.shot is Shot.NONE else waypoint.yaw_deg
        before = waypoint
    return found


def _for_template(plan: Plan, height_m: float) -> list[Node]:
    return [
        ("wpml:useGlobalHeight", 0),
        ("wpml:ellipsoidHeight", decimal(plan.launch.altitude_m + height_m, 3)),
        ("wpml:height", decimal(height_m, 3)),
        ("wpml:useGlobalSpeed", 1),
        ("wpml:useGlobalHeadingParam", 0),
        ("wpml:useGlobalTurnParam", 0),
    ]


def _for_flight(plan: Plan, height_m: float) -> list[Node]:
    return [("wpml:executeHeight", decimal(height_m, 3)), ("wpml:waypointSpeed", _speed(plan))]


def _group(number: int, start: int, end: int, trigger: list[Node], actions: list[Node]) -> Node:
    numbered: list[Node] = [
        ("wpml:action", [("wpml:actionId", i), *content])
        for i, (_, content) in enumerate(actions)
        if not isinstance(content, str | int | float)
    ]
    return (
        "wpml:actionGroup",
        [
            ("wpml:actionGroupId", number),
            ("wpml:actionGroupStartIndex", start),
            ("wpml:actionGroupEndIndex", end),
            ("wpml:actionGroupMode", "sequence"),
            ("wpml:actionTrigger", trigger),
            *numbered,
        ],
    )


def _actions(plan: Plan, waypoint: Waypoint, ending: bool, yaw_before: float) -> list[Node]:
    found = [_photo(), _hover(SHUTTER_S)] if ending else []
    if waypoint.shot is Shot.NONE:
        return found
    found += [_turn(yaw_before, waypoint.yaw_deg), _tilt(waypoint.pitch_deg)]
    found += [_hover(max(plan.vehicle.settle_s, 0.1)), _photo()]
    return [*found, _hover(SHUTTER_S)] if waypoint.shot is Shot.STOP else found


def _action(function: str, params: list[Node]) -> Node:
    return (
        "wpml:action",
        [("wpml:actionActuatorFunc", function), ("wpml:actionActuatorFuncParam", params)],
    )


def _photo() -> Node:
    return _action(
        "takePhoto",
        [
            ("wpml:payloadPositionIndex", 0),
            ("wpml:fileSuffix", "fieldcal"),
            ("wpml:useGlobalPayloadLensIndex", 1),
        ],
    )


def _hover(seconds: float) -> Node:
    return _action("hover", [("wpml:hoverTime", seconds)])


def _turn(from_deg: float, to_deg: float) -> Node:
    heading = (to_deg + 180) % 360 - 180
    clockwise = abs(turn_deg(from_deg, to_deg) - (to_deg - from_deg) % 360) < 1e-6
    return _action(
        "rotateYaw",
        [
            ("wpml:aircraftHeading", heading),
            ("wpml:aircraftPathMode", "clockwise" if clockwise else "counterClockwise"),
        ],
    )


def _tilt(pitch_deg: float) -> Node:
    return _action(
        "gimbalRotate",
        [
            ("wpml:payloadPositionIndex", 0),
            ("wpml:gimbalHeadingYawBase", "north"),
            ("wpml:gimbalRotateMode", "absoluteAngle"),
            ("wpml:gimbalPitchRotateEnable", 1),
            ("wpml:gimbalPitchRotateAngle", pitch_deg),
            ("wpml:gimbalRollRotateEnable", 0),
            ("wpml:gimbalRollRotateAngle", 0),
            ("wpml:gimbalYawRotateEnable", 0),
            ("wpml:gimbalYawRotateAngle", 0),
            ("wpml:gimbalRotateTimeEnable", 0),
            ("wpml:gimbalRotateTime", 0),
        ],
    )

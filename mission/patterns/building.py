"""Rings around a building ([SEN]) and passes along a wall ([C&D])."""

from __future__ import annotations

import math

import numpy as np
import shapely
from shapely import LineString, Point, Polygon

from calib.camera import FloatArray
from calib.errors import InputError
from mission.patterns.around import allowed
from mission.patterns.piece import Part, Piece
from mission.plan import Station, stop
from mission.site import Site, Wall

#: Distance between the stations of a ring, as a share of the distance to the building.
_STEP_SHARE = 0.35
_LEAST_STATIONS, _MOST_STATIONS = 8, 48
#: How far the object is moved off the image centre, as a share of half the field of view.
_OFF_CENTRE = 0.45
#: From the lowest ring's to the highest ring's angle below the horizon.
_LOWEST_DEG, _HIGHEST_DEG = 20.0, 60.0
#: [C&D]: 24 photos as 12 pairs whose axes meet on the wall at 45 degrees from either side.
WALL_PAIRS = 12
WALL_ANGLE_DEG = 45.0


def rings_part(site: Site) -> Part:
    """Rings around a structure at several heights, on all sides, as far away as the survey is high.

    Without a structure the area itself is the object. From ring to ring the object stands left,
    right, above and below the image centre, so that the sensor's edges get observations.

    Raises:
        InputError: nothing of the rings is allowed.
    """
    outline, foot, height, name = _object(site)
    rings = site.options.rings
    if not 1 <= rings <= 12:
        raise InputError(f"Building rings are flown at 1 to 12 heights, not {rings}.")
    distance = site.height_m
    middle = np.array([outline.centroid.x, outline.centroid.y])
    half_x = math.atan(site.camera.width / 2 / site.camera.f_px)
    half_y = math.atan(site.camera.height / 2 / site.camera.fy_px)
    pieces: list[Piece] = []
    notes: list[str] = []
    for ring in range(rings):
        share = ring / (rings - 1) if rings > 1 else 0.5
        down = math.radians(_LOWEST_DEG + share * (_HIGHEST_DEG - _LOWEST_DEG))
        away = max(distance * math.cos(down), site.space.standoff_m + 1.0)
        level = max(foot + 0.5 * height + distance * math.sin(down), foot + site.clearance_m)
        # Right, left; and every second ring above or below instead.
        side, upward = [(1, 0), (-1, 0), (0, 1), (0, -1)][ring % 4]
        places = _around(outline, away, ring % 2)
        stations = []
        for east, north in places:
            to = middle - [east, north]
            pitch = -math.degrees(math.atan2(level - (foot + 0.5 * height), float(np.hypot(*to))))
            yaw = math.degrees(math.atan2(to[0], to[1])) + side * math.degrees(_OFF_CENTRE * half_x)
            pitch = float(
                np.clip(
                    pitch + upward * math.degrees(_OFF_CENTRE * half_y),
                    site.vehicle.gimbal_lowest_deg,
                    site.vehicle.gimbal_highest_deg,
                )
            )
            lowest = site.ground_m(east, north) + site.clearance_m
            stations.append(Station(east, north, max(level, lowest), yaw % 360, pitch, "rings"))
        kept = allowed(site, stations)
        if len(kept) < len(stations):
            notes.append(
                f"{len(stations) - len(kept)} of the {len(stations)} photos of ring {ring + 1} "
                f"around {name} are "
                "left out for fence or structures."
            )
        if kept:
            pieces.append(Piece(tuple(stop(s) for s in kept), loop=len(kept) == len(stations)))
    if not pieces:
        raise InputError(f"No station of the rings around {name} is allowed by fence and structures.")
    return Part("rings", tuple(pieces), tuple(notes))


def wall_part(site: Site) -> Part:
    """Passes along a wall about 10 m away: pairs of photos whose axes meet on it at +-45 degrees.

    Raises:
        InputError: there is no wall, or no place before it.
    """
    wall = site.options.wall or _longest_side(site)
    start, end = np.array(wall.start_m), np.array(wall.end_m)
    length = float(np.hypot(*(end - start)))
    if length < 1:
        raise InputError("The wall is shorter than a metre.")
    along = (end - start) / length
    normal = _outward(site, start, end, along)
    away = site.options.wall_distance_m
    rows = 2 if wall.height_m >= 6 else 1
    per_row = WALL_PAIRS // rows
    # The targets lie along the wall; each is looked at from one distance to its left and to its right.
    targets = start + along * length * ((np.arange(per_row) + 0.5) / per_row)[:, None]
    facing = math.degrees(math.atan2(-normal[0], -normal[1]))
    foot = site.ground_m(*((start + end) / 2))
    shift = away * math.tan(math.radians(WALL_ANGLE_DEG))
    pieces: list[Piece] = []
    lost = 0
    for row in range(rows):
        level = foot + max(wall.height_m * (row + 1) / (rows + 1), 2.0)
        for sign in (-1, 1):
            # Standing to the left (as seen from the wall's start) the camera looks to the right.
            turn = _turn(along, normal) * sign * WALL_ANGLE_DEG
            stations = [
                Station(float(p[0]), float(p[1]), level, (facing + turn) % 360, 0.0, "wall")
                for p in targets + sign * shift * along + away * normal
            ]
            kept = allowed(site.wall_site(), stations)
            lost += len(stations) - len(kept)
            if kept:
                pieces.append(Piece(tuple(stop(s) for s in kept)))
    if not pieces:
        raise InputError(f"No place {away:g} m before the wall is allowed by fence and structures.")
    notes = (f"{lost} of the {2 * rows * per_row} photos of the wall are left out for fence or structures.",)
    return Part("wall", tuple(pieces), notes if lost else ())


def _object(site: Site) -> tuple[Polygon, float, float, str]:
    """Outline, height of its foot above launch, own height and name of what the rings go around."""
    poi = site.options.poi_m
    structures = sorted(site.space.structures, key=lambda s: s.outline.distance(Point(poi or site.middle_m)))
    if structures:
        chosen = structures[0]
        return chosen.outline, chosen.top_m - chosen.height_m, chosen.height_m, chosen.name
    middle = site.area.centroid
    return site.area, site.ground_m(middle.x, middle.y), 0.0, "the area"


def _around(outline: Polygon, away_m: float, phase: int) -> FloatArray:
    """Places (n, 2) at equal steps around the outline, ``away_m`` from it, clockwise."""
    ring = LineString(outline.convex_hull.buffer(away_m, quad_segs=32).exterior.coords)
    count = int(np.clip(round(ring.length / (_STEP_SHARE * away_m)), _LEAST_STATIONS, _MOST_STATIONS))
    at = (np.arange(count) + 0.5 * phase) / count
    points = shapely.line_interpolate_point(ring, at, normalized=True)
    return np.asarray(shapely.get_coordinates(points))


def _longest_side(site: Site) -> Wall:
    if not site.space.structures:
        raise InputError("There is no wall to fly along: give one (--wall), or a structure in the site file.")
    structure = site.space.structures[0]
    corners = np.asarray(structure.outline.exterior.coords)[:, :2]
    longest = int(np.argmax(np.hypot(*np.diff(corners, axis=0).T)))
    (a, b), (c, d) = corners[longest], corners[longest + 1]
    return Wall((float(a), float(b)), (float(c), float(d)), structure.height_m)


def _outward(site: Site, start: FloatArray, end: FloatArray, along: FloatArray) -> FloatArray:
    """The side of the wall to fly on: outside its structure, else the launch point's."""
    normal = np.array([along[1], -along[0]])
    middle = (start + end) / 2
    for structure in site.space.structures:
        for sign in (1, -1):
            if structure.outline.contains(Point(middle + sign * 0.1 * normal)):
                return -sign * normal
    return normal if float(-middle @ normal) >= 0 else -normal


def _turn(along: FloatArray, normal: FloatArray) -> float:
    """+1 where a camera that faces the wall and moves along it moves to its right, else -1.

    Facing the wall the right hand is at (-normal) turned clockwise; from there the target is left.
    """
    right = np.array([-normal[1], normal[0]])
    return -1.0 if float(right @ along) > 0 else 1.0

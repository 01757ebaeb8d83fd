"""From pattern names and a site to one plan: pieces in a short order, joined by ways that are allowed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import shapely
from shapely import MultiPoint, Point

from calib.camera import FloatArray
from calib.errors import InputError
from mission.connect import connection
from mission.order import ordered
from mission.patterns import pattern_parts
from mission.patterns.piece import Piece
from mission.plan import Plan, Shot, Waypoint, line_photos_m
from mission.site import Site

#: Photos of a line come no faster than this share of what the camera can do.
_CAMERA_SHARE = 0.95
#: Grid of points on which the ground below the way home is looked at.
_HOME_SAMPLES = 60
#: Above everything on the way home.
_HOME_SPARE_M = 5.0


@dataclass(frozen=True)
class Composition:
    """A plan, and what the operator should know about how it came about."""

    plan: Plan
    notes: tuple[str, ...]


def compose(names: Sequence[str], site: Site) -> Plan:
    """One mission of the patterns ``names`` (see ``mission.patterns``); see :func:`compose_with_notes`."""
    return compose_with_notes(names, site).plan


def compose_with_notes(names: Sequence[str], site: Site) -> Composition:
    """One mission of the patterns ``names`` over ``site``, in the order given, each by a short path.

    The speed is lowered where the camera could not keep up, and the height of the way home chosen so
    that it clears ground and structures.

    Raises:
        InputError: a pattern cannot be flown there, or the fence cuts it off from the launch point.
    """
    parts = [part for name in names for part in pattern_parts(name, site)]
    notes = [note for part in parts for note in part.notes]
    waypoints: list[Waypoint] = []
    home = np.zeros(3)
    _check_launch(site)
    for part in parts:
        around = site.wall_site() if part.pattern == "wall" else site
        if not part.pieces:
            raise InputError(f"The fence leaves no photo of the {part.pattern} pattern.")
        here = waypoints[-1].enu_m if waypoints else np.array([0.0, 0.0, part.pieces[0].ends_m[0, 2]])
        home[2] = here[2]
        loops = [piece for piece in part.pieces if piece.loop]
        # Rings are flown one by one, from the lowest, each begun where the last one ended.
        groups = [[piece] for piece in part.pieces] if loops else [list(part.pieces)]
        for group in groups:
            for piece in ordered(group, here, home):
                waypoints += joined(around, here, piece, part.pattern)
                here = waypoints[-1].enu_m
    waypoints += way_home(site.wall_site() if parts[-1].pattern == "wall" else site, waypoints[-1])
    vehicle = site.vehicle
    speed = _camera_speed_m_s(waypoints, vehicle.camera_interval_s)
    if speed < vehicle.speed_m_s:
        notes.append(
            f"The speed is lowered from {vehicle.speed_m_s:g} to {speed:.1f} m/s, so that the "
            "camera keeps up "
            f"(one photo every {vehicle.camera_interval_s:g} s)."
        )
        vehicle = replace(vehicle, speed_m_s=speed)
    plan = Plan(
        site.name,
        site.frame,
        site.camera,
        site.camera_name,
        vehicle,
        tuple(waypoints),
        return_height_m(site, waypoints),
    )
    return Composition(plan, tuple(notes))


def _check_launch(site: Site) -> None:
    for structure in site.space.structures:
        if structure.outline.intersects(Point(0, 0)):
            raise InputError(f"The launch point lies inside {structure.name}; choose another (--launch).")


def joined(site: Site, here_m: FloatArray, piece: Piece, pattern: str) -> list[Waypoint]:
    """A piece with the way to it from ``here_m`` (3,), round and over what is in the way.

    Raises:
        InputError: fence and structures leave no way.
    """
    first = piece.waypoints[0]
    start = np.array([*here_m[:2], first.height_m]) if not np.any(here_m[:2]) else here_m
    way = connection(site, start, first.enu_m, first)
    if way is None and not np.any(here_m[:2]) and not site.space.fence_area.covers(Point(0, 0)):
        way = []  # Nothing can be done about a launch point outside the fence; the limits will say so.
    if way is None:
        raise InputError(
            f"Fence and structures leave no way to the {pattern} pattern at {_place(site, first.enu_m)}; "
            "move the launch point, or plan the two sides of the fence as two missions."
        )
    joined = [*way]
    for before, after in zip(piece.waypoints, [*piece.waypoints[1:], None], strict=True):
        joined.append(before)
        if after is not None and before.shot is not Shot.LINE:
            # Stations of a ring: the straight leg between two of them may cut a corner.
            between = connection(site, before.enu_m, after.enu_m, after)
            if between is None:
                raise InputError(
                    f"Fence and structures leave no way along the {pattern} pattern at "
                    f"{_place(site, after.enu_m)}; choose another radius, height or point of interest."
                )
            joined += between
    return joined


def way_home(site: Site, last: Waypoint) -> list[Waypoint]:
    """Corners to fly before turning home, where the straight way is not allowed."""
    start, home = last.enu_m, np.array([0.0, 0.0, last.height_m])
    corners = site.space.route(start, home)
    if corners is None or len(corners) == 0:
        return []
    nothing = replace(last, shot=Shot.NONE, spacing_m=0.0)
    return [replace(nothing, east_m=float(e), north_m=float(n)) for e, n in corners]


def _camera_speed_m_s(waypoints: Sequence[Waypoint], interval_s: float) -> float:
    """The fastest speed at which the camera keeps up on every line."""
    steps = [
        np.linalg.norm(np.diff(line_photos_m(here, after)[:2], axis=0))
        for here, after in pairwise(waypoints)
        if here.shot is Shot.LINE
    ]
    if not steps or interval_s <= 0:
        return math.inf
    return float(min(steps)) * _CAMERA_SHARE / interval_s


def return_height_m(site: Site, waypoints: Sequence[Waypoint]) -> float:
    """A height above the launch point that clears ground and structures from everywhere on the path."""
    places = np.array([[0.0, 0.0], *([w.east_m, w.north_m] for w in waypoints)])
    hull = MultiPoint(places).convex_hull.buffer(1.0)
    west, south, east, north = hull.bounds
    x, y = np.meshgrid(np.linspace(west, east, _HOME_SAMPLES), np.linspace(south, north, _HOME_SAMPLES))
    inside = shapely.contains_xy(hull, x, y)
    points = np.concatenate([np.stack([x[inside], y[inside]], axis=-1), places])
    height = float(site.terrain.height_m(points[:, 0], points[:, 1]).max()) + site.clearance_m + _HOME_SPARE_M
    for structure in site.space.structures:
        if structure.outline.distance(hull) < site.space.standoff_m:
            height = max(height, structure.top_m + site.space.standoff_m + 1.0)
    return math.ceil(max(height, 20.0))


def _place(site: Site, at_m: FloatArray) -> str:
    latitude, longitude, _ = site.frame.geodetic(at_m)
    return f"{latitude:.6f}, {longitude:.6f}"

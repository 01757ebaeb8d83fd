"""Where in a survey extra photos do good: well inside the block, near the path, apart from each other."""

from __future__ import annotations

import numpy as np
import shapely
import shapely.ops
from shapely import Polygon
from shapely.geometry.base import BaseGeometry

from calib.camera import FloatArray
from mission.plan import Plan
from mission.planned_network import PlannedNetwork

#: Places of a large area at most, and how far apart they are at least, in flying heights.
MOST_PLACES = 4
APART_HEIGHTS = 4.0


def places_of_pass(plan: Plan, planned: PlannedNetwork, area: Polygon | None) -> FloatArray:
    """Middles (k, 2) of the ground that extra photos look at: the first near the way home.

    The others each as far as possible from those before (Gonzalez 1985, farthest-first traversal), at
    waypoints: the path passes there anyway.
    """
    inner = _inner(planned, area)
    path = plan.path_m
    last = path[-2] if len(path) > 2 else path[0]
    found = [_inside(inner, last)]
    nodes = np.array([_inside(inner, at) for at in path[1:-1]]).reshape(-1, 2)
    while len(found) < MOST_PLACES and len(nodes):
        away = np.linalg.norm(nodes[:, None] - np.array(found), axis=2).min(axis=1)
        farthest = int(np.argmax(away))
        if away[farthest] < APART_HEIGHTS * planned.height_agl_m:
            break
        found.append(nodes[farthest])
    return np.array(found)


def _inner(planned: PlannedNetwork, area: Polygon | None) -> BaseGeometry:
    """The area without its edge, where photos have few neighbours; its middle where nothing is left."""
    hull: BaseGeometry = (
        area if area is not None else shapely.MultiPoint(planned.network.centres_m[:, :2]).convex_hull
    )
    for share in (1.0, 0.7, 0.4):
        shrunk = hull.buffer(-share * planned.height_agl_m)
        if not shrunk.is_empty:
            return shrunk
    return hull.centroid


def _inside(inner: BaseGeometry, at_m: FloatArray) -> FloatArray:
    nearest = shapely.ops.nearest_points(inner, shapely.Point(at_m[:2]))[0]
    return np.array([nearest.x, nearest.y])

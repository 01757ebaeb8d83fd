"""Ways between pieces: round what is forbidden, over what is high."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np

from calib.camera import FloatArray
from mission.plan import Shot, Waypoint
from mission.site import Site
from mission.terrain import profile_m

#: Steps along a leg at which the ground is looked at.
STEP_M = 5.0
#: A way over high ground is planned this much above the least clearance.
_SPARE_M = 2.0


def connection(site: Site, start_m: FloatArray, end_m: FloatArray, like: Waypoint) -> list[Waypoint] | None:
    """Waypoints between two places (3,), without photos, the camera already held as at ``like``.

    None where fence and structures leave no way.
    """
    corners = site.space.route(start_m, end_m)
    if corners is None:
        return None
    path = np.vstack([start_m[:2], corners, end_m[:2]])
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    share = along / along[-1] if along[-1] > 0 else along
    heights = start_m[2] + share * (end_m[2] - start_m[2])
    way = np.column_stack([path, heights])
    if len(corners) and end_m[2] != start_m[2]:
        # The way round was found for the lower end: change height only where it is not lower.
        way[1:-1, 2] = max(start_m[2], end_m[2])
    if lack_of_clearance_m(site, way) > 0:
        level = float(highest_ground_m(site, way)) + site.clearance_m + _SPARE_M
        level = max(level, float(start_m[2]), float(end_m[2]))
        over = np.column_stack([path, np.full(len(path), level)])
        way = np.vstack([start_m, over, end_m])
    return [_passing(like, at) for at in _without_repeats(way)[1:-1]]


def lack_of_clearance_m(site: Site, way_m: FloatArray) -> float:
    """By how much the path (n, 3) comes closer to the ground than it may, at its worst; negative: clear."""
    if math.isinf(site.terrain.resolution_m):
        return site.clearance_m - float(way_m[:, 2].min()) if len(way_m) else 0.0
    worst = -math.inf
    for start, end in pairwise(way_m):
        distance, ground = profile_m(site.terrain, start, end, STEP_M)
        share = distance / distance[-1] if distance[-1] > 0 else distance
        height = start[2] + share * (end[2] - start[2])
        worst = max(worst, float((site.clearance_m - (height - ground)).max()))
    return worst


def highest_ground_m(site: Site, way_m: FloatArray) -> float:
    """Highest ground under the path (n, 2 or 3)."""
    return max(float(profile_m(site.terrain, start, end, STEP_M)[1].max()) for start, end in pairwise(way_m))


def _without_repeats(way_m: FloatArray) -> FloatArray:
    moved = np.linalg.norm(np.diff(way_m, axis=0), axis=1) > 1e-6
    keep = np.concatenate([[True], moved])
    keep[-1] = True
    kept: FloatArray = way_m[keep]
    return kept


def _passing(like: Waypoint, at_m: FloatArray) -> Waypoint:
    return replace(
        like,
        east_m=float(at_m[0]),
        north_m=float(at_m[1]),
        height_m=float(at_m[2]),
        shot=Shot.NONE,
        spacing_m=0.0,
    )

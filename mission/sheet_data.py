"""What the plan sheet draws, as numbers: for the figures of the HTML sheet and for the picture alike."""

from __future__ import annotations

import numpy as np
import shapely

from calib.camera import FloatArray
from mission.footprint import outline_m
from mission.limits_path import path_samples_m, way_home_m
from mission.plan import stations
from mission.planned import Planned

#: Footprints and places drawn at most; more only slow a phone down.
MOST_FOOTPRINTS = 40
_MOST_SAMPLES = 3000
_VIEW_CELLS = 60


def extent(planned: Planned) -> tuple[float, float, float, float]:
    """West, south, east, north of what matters, with a little room."""
    path = planned.plan.path_m[:, :2]
    corners = np.concatenate([path, shapely.get_coordinates(planned.site.area)])
    (west, south), (east, north) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
    room = 0.06 * max(east - west, north - south, 1.0)
    return west - room, south - room, east + room, north + room


def profile(planned: Planned) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Along the path (n,), the ground (n,) and the path's height (n,), in m above the launch point."""
    path = np.vstack([path_samples_m(planned.plan), way_home_m(planned.plan)])
    path = path[:: max(1, -(-len(path) // _MOST_SAMPLES))]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    return along, planned.site.terrain.height_m(path[:, 0], path[:, 1]), path[:, 2]


def views(planned: Planned) -> tuple[FloatArray, FloatArray, FloatArray, list[FloatArray]]:
    """Photos that see each cell of the area on level ground, and outlines of photos on the ground.

    East (a,), north (b,), photos (b, a) with NaN outside the area; outlines (n, 2) of every photo.
    """
    west, south, east, north = planned.site.area.bounds
    step = max(east - west, north - south) / _VIEW_CELLS
    x, y = np.arange(west + step / 2, east, step), np.arange(south + step / 2, north, step)
    gx, gy = np.meshgrid(x, y)
    inside = shapely.contains_xy(planned.site.area, gx, gy)
    places = np.stack([gx[inside], gy[inside]], axis=-1)
    outlines = _outlines(planned)
    count = np.zeros(len(places))
    for outline in outlines:
        polygon = shapely.polygons(outline)
        shapely.prepare(polygon)
        count += shapely.contains_xy(polygon, places)
    grid = np.full(gx.shape, np.nan)
    grid[inside] = count
    return x, y, grid, outlines


def _outlines(planned: Planned) -> list[FloatArray]:
    photos = stations(planned.plan)
    at = np.array([[s.east_m, s.north_m] for s in photos]).reshape(-1, 2)
    ground = planned.site.terrain.height_m(at[:, 0], at[:, 1])
    most = 3 * planned.site.height_m + 50
    return [outline_m(planned.plan.camera, s, float(g), most) for s, g in zip(photos, ground, strict=True)]

"""Sites for the tests of mission planning: areas, terrains, fences, and a count of views by ray casting."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from shapely import Polygon

from calib.camera import BrownCamera, FloatArray
from calib.frames import LocalFrame, rotation_cam_from_world
from calib.photos.photo import GimbalAngles
from mission.fence import Fence
from mission.plan import Plan, Station, stations
from mission.site import Site
from mission.space import Structure, make_space
from mission.terrain import FlatTerrain, Terrain
from sim.flights import phantom3

FRAME = LocalFrame(54.77, -1.58, 100.0)


@dataclass(frozen=True)
class Hills:
    """Waves of ``amplitude_m`` and ``length_m`` on a slope (m per m)."""

    amplitude_m: float
    length_m: float
    slope: float = 0.0
    name: str = "hills"
    resolution_m: float = 1.0

    def height_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        k = 2 * math.pi / self.length_m
        waves = np.sin(k * np.asarray(east_m)) + np.sin(0.7 * k * np.asarray(north_m))
        return np.asarray(self.amplitude_m / 2 * waves + self.slope * np.asarray(east_m))


def make_site(area: Polygon, **given: Any) -> Site:
    """A site with an ordinary camera; structures and margins of the space by keyword, too."""
    fence = given.pop("fence", Fence())
    frame = given.pop("frame", FRAME)
    structures: tuple[Structure, ...] = given.pop("structures", ())
    space = make_space(fence, structures, frame, given.pop("margin_m", 5.0), given.pop("standoff_m", 10.0))
    values: dict[str, Any] = {
        "name": "test",
        "camera": phantom3(),
        "camera_name": "phantom3",
        "height_m": 60.0,
        "terrain": FlatTerrain(),
    }
    return Site(frame=frame, area=area, space=space, fence=fence, **(values | given))


def views(plan: Plan, terrain: Terrain, places_m: FloatArray, pattern: str = "") -> FloatArray:
    """How many photos see each place on the ground (n, 2): projected through the true lens."""
    ground = np.column_stack([places_m, terrain.height_m(places_m[:, 0], places_m[:, 1])])
    count = np.zeros(len(places_m))
    for station in stations(plan):
        if not pattern or station.pattern == pattern:
            count += sees(plan.camera, station, ground)
    return count


def sees(camera: BrownCamera, station: Station, ground_m: FloatArray) -> FloatArray:
    rotation = rotation_cam_from_world(GimbalAngles(station.yaw_deg, station.pitch_deg, 0.0))
    at = (ground_m - [station.east_m, station.north_m, station.height_m]) @ rotation.T
    front = at[:, 2] > 0.1
    rays = at[:, :2] / np.where(front, at[:, 2], 1.0)[:, None]
    # Beyond the turning point of the radial polynomial the projection comes back into the image.
    near = np.hypot(*rays.T) < 1.2
    pixels = camera.project(np.where((front & near)[:, None], rays, 9.0))
    inside = (pixels > 0).all(axis=1) & (pixels < [camera.width, camera.height]).all(axis=1)
    return np.asarray(front & near & inside, dtype=float)


def places_in(area: Polygon, count: int = 400) -> FloatArray:
    """Places in an area, its corners and edges included, (n, 2)."""
    west, south, east, north = area.bounds
    side = math.isqrt(count)
    x, y = np.meshgrid(np.linspace(west, east, side), np.linspace(south, north, side))
    grid = np.stack([x.ravel(), y.ravel()], axis=-1)
    inside = grid[shapely.contains_xy(area, grid)]
    edge = shapely.get_coordinates(shapely.segmentize(area, max(east - west, north - south) / 12))
    return np.concatenate([inside, edge])

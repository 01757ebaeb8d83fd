"""From the keys of a site file and the command line to a :class:`Site`."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from shapely import Polygon

from calib.camera import BrownCamera
from calib.errors import InputError
from calib.frames import LocalFrame
from calib.references import load_reference
from mission.area import GeoArea, area_from_corners, load_area, local_points_m
from mission.fence import Circle, Fence
from mission.plan import Vehicle
from mission.site import CLEARANCE_M, FORWARD_OVERLAP, SIDE_OVERLAP, PatternOptions, Site, Wall, Wind
from mission.site_file import Outline, SiteFile
from mission.space import Structure, make_space
from mission.terrain import FlatTerrain, Terrain, load_terrain

#: Margins of the terrain around the area, in flying heights: turns, orbits, what photos see.
_TERRAIN_MARGIN_HEIGHTS = 4.0
_TERRAIN_MARGIN_M = 300.0
#: Flying heights above ground that make sense.
LEAST_HEIGHT_M, MOST_HEIGHT_M = 2.0, 2000.0


def build_site(keys: SiteFile, source: str = "the site") -> Site:
    """Everything read, projected and checked.

    Raises:
        InputError: something needed is missing or unusable, in one sentence.
    """
    if keys.area is None:
        raise InputError("There is no area to survey: give one with --area, or as area in the site file.")
    area = outline(keys.area, "area")
    camera, camera_name = _camera(keys.camera)
    height = _height_m(keys, camera)
    latitude, longitude = keys.launch or area.middle
    frame = LocalFrame(latitude, longitude)
    local = area.local(frame)
    terrain = terrain_of(keys.dem, frame, local, height)
    name = keys.name or _name(keys, source)
    return site_of(keys, name, frame, local, camera, camera_name, height, terrain)


def site_of(
    keys: SiteFile,
    name: str,
    frame: LocalFrame,
    area: Polygon,
    camera: BrownCamera,
    camera_name: str,
    height_m: float,
    terrain: Terrain,
) -> Site:
    """What is given, with fence, structures, vehicle, wind and limits of ``keys``.

    Raises:
        InputError: one of them is unusable, in one sentence.
    """
    fence = _fence(keys)
    structures = tuple(_structure(s.outline, s.height_m, s.name, frame, terrain) for s in keys.structure)
    standoff = 10.0 if keys.standoff_m is None else keys.standoff_m
    margin = 5.0 if keys.fence_margin_m is None else keys.fence_margin_m
    return Site(
        name=name,
        frame=frame,
        area=area,
        camera=camera,
        camera_name=camera_name,
        height_m=height_m,
        terrain=terrain,
        space=make_space(fence, structures, frame, margin, standoff),
        vehicle=_vehicle(keys),
        wind=Wind() if keys.wind is None else Wind(keys.wind.speed_m_s, keys.wind.from_deg),
        fence=fence,
        forward_overlap=keys.forward_overlap or FORWARD_OVERLAP,
        side_overlap=keys.side_overlap or SIDE_OVERLAP,
        clearance_m=CLEARANCE_M if keys.clearance_m is None else keys.clearance_m,
        options=_options(keys, frame),
    )


def outline(given: Outline, what: str) -> GeoArea:
    """An outline as a file, text or corners."""
    return load_area(given, what) if isinstance(given, str) else area_from_corners(given, f"the {what}")


def _camera(given: str | None) -> tuple[BrownCamera, str]:
    if given is None:
        raise InputError("There is no camera: give one with --camera, or as camera in the site file.")
    reference = load_reference(given)
    if reference.comparable_brown is not None and reference.width > 0:
        return reference.comparable_brown, reference.name
    if reference.f_px is None or reference.width == 0:
        lack = "image size" if reference.width == 0 else "focal length"
        raise InputError(
            f"The {lack} of {reference.name} is not known, so no mission can be planned with it; "
            "name a camera or calibration file that has it."
        )
    return BrownCamera.ideal(reference.width, reference.height, reference.f_px), reference.name


def _height_m(keys: SiteFile, camera: BrownCamera) -> float:
    if keys.height_m is not None:
        height = keys.height_m
        asked = f"A height of {height:g} m"
    elif keys.gsd_cm is not None:
        height = keys.gsd_cm / 100 * camera.f_px
        asked = f"A ground resolution of {keys.gsd_cm:g} cm, which means flying {height:.0f} m high,"
    else:
        raise InputError("There is neither a height nor a ground resolution: give --height or --gsd.")
    if not LEAST_HEIGHT_M <= height <= MOST_HEIGHT_M:
        raise InputError(
            f"{asked} cannot be planned: heights above ground go from {LEAST_HEIGHT_M:g} to "
            f"{MOST_HEIGHT_M:g} m."
        )
    if keys.ceiling_m is not None and height > keys.ceiling_m:
        raise InputError(
            f"{asked} is {height - keys.ceiling_m:.0f} m above the ceiling of {keys.ceiling_m:g} m; "
            "fly lower."
        )
    return height


def terrain_of(dem: str | None, frame: LocalFrame, area: Polygon, height_m: float) -> Terrain:
    """The terrain model ``dem`` around ``area``; flat ground where there is none."""
    if dem is None:
        return FlatTerrain()
    west, south, east, north = area.bounds
    margin = _TERRAIN_MARGIN_HEIGHTS * height_m + _TERRAIN_MARGIN_M
    bounds = (min(west, 0) - margin, min(south, 0) - margin, max(east, 0) + margin, max(north, 0) + margin)
    return load_terrain(Path(dem), frame, bounds)


def _fence(keys: SiteFile) -> Fence:
    polygons: dict[str, list[tuple[tuple[float, float], ...]]] = {"in": [], "out": []}
    circles = []
    for zone in keys.fence:
        area = outline(zone.outline, f"keep-{zone.keep} zone")
        if area.circle is not None:
            latitude, longitude, radius = area.circle
            circles.append(Circle(latitude, (longitude + 180) % 360 - 180, radius, inside=zone.keep == "in"))
            continue
        polygons[zone.keep].append(_corners(area.polygon.exterior))
        # A hole in a keep-in zone is a keep-out zone; one in a keep-out zone is not worth the risk.
        if zone.keep == "in":
            polygons["out"] += [_corners(hole) for hole in area.polygon.interiors]
    return Fence(tuple(polygons["in"]), tuple(polygons["out"]), tuple(circles), keys.ceiling_m)


def _corners(ring: Any) -> tuple[tuple[float, float], ...]:
    return tuple((float(y), float((x + 180) % 360 - 180)) for x, y in list(ring.coords)[:-1])


def _structure(given: Outline, height_m: float, name: str, frame: LocalFrame, terrain: Terrain) -> Structure:
    polygon = outline(given, name).local(frame)
    corners = np.asarray(polygon.exterior.coords)[:, :2]
    # Its height is above its lowest ground at the middle, its top above the highest: on the safe side.
    ground = float(terrain.height_m(corners[:, 0], corners[:, 1]).max())
    return Structure(polygon, ground + height_m, height_m, name)


def _vehicle(keys: SiteFile) -> Vehicle:
    given = {k: v for k, v in keys.vehicle.model_dump().items() if v is not None}
    vehicle = replace(Vehicle(), **given)
    if vehicle.gimbal_lowest_deg >= vehicle.gimbal_highest_deg:
        raise InputError(
            f"The gimbal's lowest angle ({vehicle.gimbal_lowest_deg:g}) must be below its highest "
            f"({vehicle.gimbal_highest_deg:g})."
        )
    return vehicle


def _options(keys: SiteFile, frame: LocalFrame) -> PatternOptions:
    given = {k: v for k, v in keys.pattern.model_dump().items() if v is not None and k != "poi"}
    if keys.pattern.poi is not None:
        given["poi_m"] = _place(frame, keys.pattern.poi)
    if keys.wall is not None:
        wall = keys.wall
        given["wall"] = Wall(_place(frame, wall.start), _place(frame, wall.end), wall.height_m)
        if wall.distance_m is not None:
            given["wall_distance_m"] = wall.distance_m
    return PatternOptions(**given)


def _place(frame: LocalFrame, at: tuple[float, float]) -> tuple[float, float]:
    east, north = local_points_m(frame, np.array([at[0]]), np.array([at[1]]))[0]
    if not math.hypot(east, north) < 100_000:
        raise InputError(f"The place {at[0]:g}, {at[1]:g} is far away from the launch point.")
    return float(east), float(north)


def _name(keys: SiteFile, source: str) -> str:
    if (
        isinstance(keys.area, str)
        and Path(keys.area).suffix
        and "," not in keys.area
        and "(" not in keys.area
    ):
        return Path(keys.area).stem
    return Path(source).stem if source.endswith(".toml") else "survey"

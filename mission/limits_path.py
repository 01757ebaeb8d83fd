"""Limits on where the path goes: fence, ceiling, ground, structures, way home, sampled to a metre."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import shapely
from shapely import Point

from calib.camera import FloatArray
from mission.plan import Plan
from mission.rule import Finding
from mission.site import Site
from mission.terrain import below_plane_m

STEP_M = 1.0
#: Samples of one path at most; longer ones are sampled more coarsely, at legs' ends always.
_MOST_SAMPLES = 400_000


def path_samples_m(plan: Plan, step_m: float = STEP_M) -> FloatArray:
    """Places along the whole path (n, 3), at most ``step_m`` apart, from above launch to above home."""
    path = plan.path_m[:-1]  # The way home is looked at on its own: it is flown at its own height.
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    step = max(step_m, float(lengths.sum()) / _MOST_SAMPLES)
    pieces = [
        start + np.linspace(0, 1, max(math.ceil(length / step), 1), endpoint=False)[:, None] * (end - start)
        for start, end, length in zip(path[:-1], path[1:], lengths, strict=True)
    ]
    return np.concatenate([*pieces, path[-1:]])


def way_home_m(plan: Plan, step_m: float = STEP_M) -> FloatArray:
    """Places (n, 3) along the way home: up to the return height, then straight to above the launch point."""
    last = plan.path_m[-2]
    level = max(float(last[2]), plan.return_height_m)
    count = max(math.ceil(float(np.hypot(*last[:2])) / step_m), 1) + 1
    flat = np.linspace(1, 0, count)[:, None] * last[:2]
    return np.vstack([last, np.column_stack([flat, np.full(count, level)])])


def launch_finding(plan: Plan, site: Site) -> Finding:
    """The launch point lies inside the fence."""
    del plan
    away = float(site.space.fence_area.distance(Point(0, 0)))
    ok = away == 0
    message = "The launch point lies inside the fence." if site.space.has_zones else "There is no fence."
    if not ok:
        message = f"The launch point lies outside the fence, {_metres(away)} from the nearest allowed place."
    return Finding("launch-inside-fence", True, ok, away, 0.0, "m", message)


def fence_finding(plan: Plan, site: Site) -> Finding:
    """Every leg stays inside the fence: exactly, as lines, not only at waypoints."""
    if not site.space.has_zones:
        return Finding("fence", True, True, None, None, "m", "There is no fence.")
    area = site.space.fence_area
    path = plan.path_m
    legs: Any = shapely.linestrings(np.stack([path[:-1, :2], path[1:, :2]], axis=1))
    bad = ~shapely.covers(area, legs)
    if not bad.any():
        margin = float(shapely.distance(shapely.boundary(area), legs).min())
        message = f"The whole path stays inside the fence, at least {_metres(margin)} from it."
        return Finding("fence", True, True, margin, 0.0, "m", message)
    samples = np.vstack([path_samples_m(plan), way_home_m(plan)])
    outside = float(shapely.distance(area, shapely.points(samples[:, :2])).max())
    where = int(np.flatnonzero(bad)[0])
    message = (
        f"{int(bad.sum())} of the {len(legs)} legs leave the fence, by up to {_metres(outside)}; "
        "the first is "
        f"{_leg_name(where, len(legs))}."
    )
    return Finding("fence", True, False, -outside, 0.0, "m", message)


def ceiling_finding(plan: Plan, site: Site) -> Finding:
    """The path stays below the ceiling above the launch point."""
    # Autopilots measure the ceiling as they fly: in altitude, not from the frame's plane.
    path = np.vstack([plan.path_m, way_home_m(plan, step_m=100.0)])
    highest = float((path[:, 2] + below_plane_m(path[:, :2])).max())
    ceiling = site.space.ceiling_m
    if ceiling is None:
        message = f"There is no ceiling; the path goes up to {highest:.0f} m above the launch point."
        return Finding("ceiling", True, True, highest, None, "m", message)
    ok = highest <= ceiling + 1e-6
    message = f"The path goes up to {highest:.0f} m above the launch point, and the ceiling is {ceiling:g} m"
    message += "." if ok else f": {highest - ceiling:.0f} m too high."
    return Finding("ceiling", True, ok, highest, ceiling, "m", message)


def clearance_finding(plan: Plan, site: Site) -> Finding:
    """Every leg clears the ground."""
    samples = path_samples_m(plan)
    above = samples[:, 2] - site.terrain.height_m(samples[:, 0], samples[:, 1])
    worst = int(np.argmin(above))
    least = float(above[worst])
    ok = least >= site.clearance_m - 1e-6
    message = f"The path stays at least {least:.0f} m above the ground ({site.terrain.name})"
    if not ok:
        lack = site.clearance_m - least
        message = (
            f"The path comes to {least:.0f} m above the ground at {_place(site, samples[worst])}, "
            f"{lack:.0f} m less "
            f"than the clearance of {site.clearance_m:g} m"
        )
    return Finding("terrain-clearance", True, ok, least, site.clearance_m, "m", message + ".")


def standoff_finding(plan: Plan, site: Site) -> Finding:
    """Every leg keeps away from structures, sideways or above."""
    limit = site.space.standoff_m
    if not site.space.structures:
        return Finding("stand-off", True, True, None, limit, "m", "There are no structures.")
    samples = path_samples_m(plan)
    least, name = _distance_to_structures(site, samples)
    allowed = _wall_limit(plan, limit, site)
    ok = least >= allowed - 0.05
    message = f"The path keeps {_metres(least)} from {name}"
    message += "." if ok else f", {_metres(allowed - least)} less than the stand-off of {allowed:g} m."
    return Finding("stand-off", True, ok, least, allowed, "m", message)


def return_finding(plan: Plan, site: Site) -> Finding:
    """The way home clears ground, structures and fence, from the last waypoint; and from everywhere else."""
    home = way_home_m(plan)
    above = home[:, 2] - site.terrain.height_m(home[:, 0], home[:, 1])
    least = float(above[1:].min())
    structures = _distance_to_structures(site, home[1:])[0] if site.space.structures else math.inf
    short = least < site.clearance_m - 1e-6
    close = structures < site.space.standoff_m - 0.05
    height = float(home[-1, 2])
    message = f"The way home at {height:.0f} m clears the ground by {least:.0f} m"
    if short or close:
        what = (
            f"comes to {least:.0f} m above the ground"
            if short
            else f"passes {_metres(structures)} from a structure"
        )
        message = f"The way home at {height:.0f} m {what}"
        return Finding(
            "return-path", True, False, least, site.clearance_m, "m", f"{message}; raise the return height."
        )
    crossing = _straight_home_crossings(plan, site)
    if crossing:
        message += (
            f"; but from {crossing} waypoints the straight way home, which a failsafe takes, leaves the fence"
        )
        return Finding("return-path", False, False, least, site.clearance_m, "m", message + ".")
    return Finding("return-path", True, True, least, site.clearance_m, "m", message + ".")


def _straight_home_crossings(plan: Plan, site: Site) -> int:
    if not site.space.has_zones:
        return 0
    places = np.array([[w.east_m, w.north_m] for w in plan.waypoints])
    ways = shapely.linestrings(np.stack([places, np.zeros_like(places)], axis=1))
    return int((~shapely.covers(site.space.fence_area, ways)).sum())


def _distance_to_structures(site: Site, samples_m: FloatArray) -> tuple[float, str]:
    """Smallest distance in space from the samples (n, 3) to a structure, and its name."""
    least, name = math.inf, ""
    points = shapely.points(samples_m[:, :2])
    for structure in site.space.structures:
        sideways = shapely.distance(structure.outline, points)
        above = np.maximum(samples_m[:, 2] - structure.top_m, 0.0)
        # Beside it or above it; over its roof the height alone counts.
        distance = float(np.where(sideways > 0, np.hypot(sideways, above), above).min())
        if distance < least:
            least, name = distance, structure.name
    return least, name


def _wall_limit(plan: Plan, limit: float, site: Site) -> float:
    """Wall passes are flown at the wall's own distance, which the operator chose."""
    if any(w.pattern == "wall" for w in plan.waypoints):
        return site.wall_site().space.standoff_m
    return limit


def _leg_name(index: int, count: int) -> str:
    if index == 0:
        return "the one from the launch point"
    return "the way home" if index == count - 1 else f"from waypoint {index} to {index + 1}"


def _metres(value: float) -> str:
    return f"{value:.1f} m" if value < 10 else f"{value:.0f} m"


def _place(site: Site, at_m: FloatArray) -> str:
    latitude, longitude, _ = site.frame.geodetic(at_m)
    return f"{latitude:.6f}, {longitude:.6f}"

"""Parallel lines over the area: every place in as many photos as the overlaps promise, at the worst.

Coordinates of a grid: u to the right of its heading, v along it, from the area's middle. A line at
u answers for the places of the area that lie within half a window (:class:`Spacing`) to either
side, and goes on beyond the last of them. Over terrain the ground rises inside the photos, and
spacings shrink by the share of the height that is left above the highest ground in sight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import shapely
from shapely import Polygon, affinity

from calib.camera import FloatArray
from calib.errors import InputError
from mission.footprint import Spacing, spacing
from mission.patterns.piece import Part, Piece
from mission.patterns.profile import line_waypoints
from mission.patterns.relief import Relief, level, relief
from mission.site import Site

#: What a turn costs, as seconds of flight, when headings are compared.
_TURN_S = 4.0
#: Lines of one grid at most; more would be a slip of units.
_MOST_LINES = 2000


@dataclass(frozen=True)
class Grid:
    """How a grid is to be flown. ``height_m`` above ground."""

    pattern: str
    height_m: float
    heading_deg: float
    off_nadir_deg: float = 0.0


@dataclass(frozen=True)
class _Run:
    """One line: at u, photos from v0 to v1 at ``gaps`` equal steps."""

    u: float
    v0: float
    v1: float
    gaps: int


def grid_part(site: Site, grid: Grid) -> Part:
    """The lines of ``grid`` over the area of ``site``, inside its fence.

    Raises:
        InputError: overlaps or heights that cannot be flown.
    """
    seen = site.footprint(grid.off_nadir_deg)
    across = spacing(2 * seen.half_across * grid.height_m, site.side_overlap)
    along = spacing(seen.along * grid.height_m, site.forward_overlap)
    # The photos lie behind what they see, in front of it on the way back: both ends get the room.
    ahead = 0.5 * (seen.ahead + seen.behind) * grid.height_m
    turned, to_map = _turned(site.area, grid.heading_deg)
    if site.terrain.resolution_m == math.inf:
        rise = level()
    else:
        reach = seen.reach * grid.height_m
        rise = relief(site.terrain, turned.bounds, to_map, grid.height_m, reach, across.window)
    runs = _runs(turned, across, along, ahead, rise)
    pieces: list[Piece] = []
    left_out = 0
    for run in runs:
        v = np.linspace(run.v0, run.v1, run.gaps + 1)
        photos = to_map(np.stack([np.full_like(v, run.u), v], axis=-1))
        for points in _allowed(site, photos, grid.height_m):
            left_out -= len(points)
            waypoints = line_waypoints(
                site, points, grid.height_m, grid.heading_deg, grid.off_nadir_deg, grid.pattern
            )
            pieces.append(Piece(waypoints, turning=True))
        left_out += len(photos)
    notes: tuple[str, ...] = ()
    if left_out:
        notes = (
            f"The fence cuts {left_out} photos off the {grid.pattern} grid: the overlap is lower along it.",
        )
    return Part(grid.pattern, tuple(pieces), notes)


def best_heading_deg(site: Site) -> float:
    """The heading with the least time for lines and turns: along the sides of the area's hull, as a rule."""
    if site.options.heading_deg is not None:
        return site.options.heading_deg
    hull = shapely.get_coordinates(site.area.convex_hull)
    steps = np.diff(hull[:, :2], axis=0)
    length = np.hypot(*steps.T)
    steps = steps[np.argsort(-length)][:24]
    edges = np.degrees(np.arctan2(steps[:, 0], steps[:, 1])) % 180
    seen = site.footprint()
    across = spacing(2 * seen.half_across * site.height_m, site.side_overlap)
    along = spacing(seen.along * site.height_m, site.forward_overlap)
    best, heading = math.inf, 0.0
    for candidate in [*dict.fromkeys(np.round(edges, 1)), 0.0, 90.0]:
        turned, _ = _turned(site.area, float(candidate))
        runs = _runs(turned, across, along, 0.0, level())
        cost = sum(run.v1 - run.v0 for run in runs) + len(runs) * (
            _TURN_S * site.vehicle.speed_m_s + across.step
        )
        if cost < best - 1e-6:
            best, heading = cost, float(candidate)
    return heading


class _ToMap:
    """(u, v) (n, 2) -> east, north (n, 2)."""

    def __init__(self, middle: tuple[float, float], heading_deg: float) -> None:
        a = math.radians(heading_deg)
        self._matrix = np.array([[math.cos(a), math.sin(a)], [-math.sin(a), math.cos(a)]])
        self._middle = np.array(middle)

    def __call__(self, uv: FloatArray) -> FloatArray:
        moved: FloatArray = uv @ self._matrix.T + self._middle
        return moved


def _turned(area: Polygon, heading_deg: float) -> tuple[Polygon, _ToMap]:
    """The area in (u, v), and the way back."""
    x, y = float(area.centroid.x), float(area.centroid.y)
    turned = affinity.translate(affinity.rotate(area, heading_deg, origin=(x, y)), -x, -y)
    return turned, _ToMap((x, y), heading_deg)


def _runs(turned: Polygon, across: Spacing, along: Spacing, ahead: float, rise: Relief) -> list[_Run]:
    west, _, east, _ = turned.bounds
    lines = _line_places(west, east, across, rise)
    scales = np.array([rise.at(u, 0.5 * across.window) for u in lines])
    half = 0.5 * across.window * scales
    _, south, _, north = turned.bounds
    bottom, top = np.full_like(lines, south - 1), np.full_like(lines, north + 1)
    strips = shapely.box(lines - half, bottom, lines + half, top)
    runs: list[_Run] = []
    for u, scale, inside in zip(lines, scales, shapely.intersection(turned, strips), strict=True):
        step = along.step * scale
        reach = along.margin * scale + abs(ahead)
        merged: list[list[float]] = []
        for _, low, _, high in sorted((p.bounds for p in shapely.get_parts(inside)), key=lambda b: b[1]):
            # Closer than a window the photos of both sides are needed anyway.
            if merged and low - merged[-1][1] < 2 * reach + along.window * scale:
                merged[-1][1] = max(merged[-1][1], high)
            else:
                merged.append([low, high])
        for low, high in merged:
            span = high - low + 2 * reach
            gaps = max(math.ceil(span / step - 1e-9), along.views - 1, 1)
            runs.append(_Run(float(u), low - reach, high + reach, gaps))
    return runs


def _line_places(west: float, east: float, across: Spacing, rise: Relief) -> FloatArray:
    """Where the lines lie, (n,): no gap wider than the spacing there allows."""
    start = west - across.margin * rise.at(west, 0.0)
    end = east + across.margin * rise.at(east, 0.0)
    places = [start]
    while places[-1] < end - 1e-6 or len(places) < across.views:
        places.append(places[-1] + across.step * rise.at(places[-1], across.window))
        if len(places) > _MOST_LINES:
            raise InputError(
                f"The grid would need more than {_MOST_LINES} lines, {across.step:.2g} m apart; fly "
                "higher or "
                "ask for less overlap."
            )
    found: FloatArray = np.array(places)
    if len(places) == across.views and found[-1] > end:
        found -= (found[-1] - end) / 2  # A narrow area: the lines on both sides of its middle.
        return found
    if found[-1] - start > end - start > 0:
        found = start + (found - start) * (end - start) / (found[-1] - start)
    return found


def _allowed(site: Site, photos_m: FloatArray, height_m: float) -> list[FloatArray]:
    """The stretches of a line (k, 2) each that the fence and the structures leave."""
    lowest = float(site.terrain.height_m(photos_m[:, 0], photos_m[:, 1]).min()) + height_m
    free = site.space.free(lowest)
    good = np.asarray(shapely.contains_xy(free, photos_m))
    linked = np.zeros(0, dtype=bool)
    if len(photos_m) > 1:
        legs = shapely.linestrings(np.stack([photos_m[:-1], photos_m[1:]], axis=1))
        linked = np.asarray(shapely.covers(site.space.free(lowest, site.space.margin_m - 0.01), legs))
    stretches: list[FloatArray] = []
    start: int | None = None
    for index, fine in enumerate(good):
        if fine and start is None:
            start = index
        if start is not None and (index + 1 == len(good) or not good[index + 1] or not linked[index]):
            stretches.append(photos_m[start : index + 1])
            start = None
    return stretches

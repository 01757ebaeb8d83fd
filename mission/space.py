"""Where the aircraft may be, in metres around the launch point: fence, structures, and ways round them."""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, field

import numpy as np
import shapely
from shapely import LineString, MultiPolygon, Point, Polygon
from shapely.geometry.base import BaseGeometry

from calib.camera import FloatArray
from calib.errors import InputError
from calib.frames import LocalFrame
from mission.area import local_points_m
from mission.fence import Circle, Fence

#: Half the width of the square that stands for "everywhere" where there is no keep-in zone.
_EVERYWHERE_M = 100_000.0
#: A circle's segments per quarter. Keep-in circles are drawn inside, keep-out circles outside the true one.
_QUARTER = 16
#: Corners a way round may touch; more are thinned out.
_MOST_CORNERS = 400


@dataclass(frozen=True)
class Structure:
    """Something that stands up: its outline in m, its top above the launch point's ground in m."""

    outline: Polygon
    top_m: float
    height_m: float
    name: str = "structure"


@dataclass(frozen=True, eq=False)
class Space:
    """All places that are allowed. Heights are above the launch point.

    ``fence_area``: inside every keep-in zone and outside every keep-out zone, exactly. ``margin_m``:
    how far from the fence a mission is planned; ``standoff_m``: from a structure, sideways and above.
    """

    fence_area: Polygon | MultiPolygon
    structures: tuple[Structure, ...] = ()
    ceiling_m: float | None = None
    margin_m: float = 5.0
    standoff_m: float = 10.0
    has_zones: bool = False
    _free: dict[tuple[int, ...], BaseGeometry] = field(default_factory=dict, repr=False, init=False)

    def free(self, height_m: float, margin_m: float | None = None) -> BaseGeometry:
        """Where a path at ``height_m`` may be: ``margin_m`` from the fence, clear of what is taller."""
        margin = self.margin_m if margin_m is None else margin_m
        tall = tuple(i for i, s in enumerate(self.structures) if height_m < s.top_m + self.standoff_m)
        key = (round(1000 * margin), *tall)
        if key not in self._free:
            area: BaseGeometry = self.fence_area
            if self.has_zones:
                area = area.buffer(-margin)
            standoff = self.standoff_m + (margin - self.margin_m)
            for index in tall:
                area = area.difference(
                    self.structures[index].outline.buffer(max(standoff, 0.0) / math.cos(math.pi / 32))
                )
            shapely.prepare(area)
            self._free[key] = area
        return self._free[key]

    def clear(self, start_m: FloatArray, end_m: FloatArray) -> bool:
        """Whether the straight leg (3,) to (3,) stays where it may be."""
        # A hair less margin, so that a path along the margin is not refused for rounding.
        area = self.free(min(start_m[2], end_m[2]), self.margin_m - 0.01)
        return bool(area.covers(LineString([start_m[:2], end_m[:2]])))

    def route(self, start_m: FloatArray, end_m: FloatArray) -> FloatArray | None:
        """Corners (k, 2) between two places (3,) along the shortest allowed way; None: there is none."""
        if self.clear(start_m, end_m):
            return np.zeros((0, 2))
        height = min(start_m[2], end_m[2])
        area = self.free(height, self.margin_m - 0.01)
        # Where one stands too near to a structure already (on take-off), the first move is away from it.
        leave, enter = (self._way_out(at_m, area) for at_m in (start_m[:2], end_m[:2]))
        if leave is None or enter is None:
            return None
        ends = [start_m[:2], *leave][-1], [end_m[:2], *enter][-1]
        way = _shortest(np.concatenate([np.array(ends), _corners(self.free(height))]), area)
        return None if way is None else np.concatenate([leave, way, enter])

    def _way_out(self, at_m: FloatArray, area: BaseGeometry) -> FloatArray | None:
        """From a place (2,) outside ``area`` straight into it, (0 or 1, 2); None: there is no such way."""
        place = Point(at_m)
        if area.covers(place):
            return np.zeros((0, 2))
        if area.is_empty or any(s.outline.intersects(place) for s in self.structures):
            return None
        line = shapely.get_coordinates(shapely.shortest_line(place, area))
        away = line[1] - line[0]
        # A hair farther than the edge, so that the place is inside.
        there: FloatArray = line[1] + 0.02 * away / max(float(np.hypot(*away)), 1e-9)
        if not self.fence_area.covers(LineString([at_m, there])) or not area.covers(Point(there)):
            return None
        return there[None]


def make_space(
    fence: Fence, structures: tuple[Structure, ...], frame: LocalFrame, margin_m: float, standoff_m: float
) -> Space:
    """The space around ``frame``'s origin.

    Raises:
        InputError: fence polygons cross themselves, or the zones leave nothing over.
    """
    e = _EVERYWHERE_M
    area: BaseGeometry = shapely.box(-e, -e, e, e)
    zones = [(_polygon(p, frame, "keep-in"), True) for p in fence.keep_in]
    zones += [(_polygon(p, frame, "keep-out"), False) for p in fence.keep_out]
    zones += [(_disc(circle, frame), circle.inside) for circle in fence.circles]
    for zone, inside in zones:
        area = area.intersection(zone) if inside else area.difference(zone)
    parts = [p for p in shapely.get_parts(area) if isinstance(p, Polygon) and p.area > 0]
    if not parts:
        raise InputError(
            "The fence leaves no place to fly: its keep-in and keep-out zones exclude each other."
        )
    return Space(MultiPolygon(parts), structures, fence.ceiling_m, margin_m, standoff_m, bool(zones))


def _polygon(corners: tuple[tuple[float, float], ...], frame: LocalFrame, what: str) -> Polygon:
    latitude, longitude = np.array(corners).T
    polygon = Polygon(local_points_m(frame, latitude, longitude))
    if not polygon.is_valid:
        raise InputError(f"A {what} polygon of the fence crosses itself; draw it again.")
    return polygon


def _disc(circle: Circle, frame: LocalFrame) -> Polygon:
    at = local_points_m(frame, np.array([circle.latitude_deg]), np.array([circle.longitude_deg]))[0]
    outside = 1.0 if circle.inside else 1 / math.cos(math.pi / (4 * _QUARTER))
    disc: Polygon = Point(at).buffer(circle.radius_m * outside, quad_segs=_QUARTER)
    return disc


def _corners(area: BaseGeometry) -> FloatArray:
    """Corners that a shortest way can touch: those that bend into the area, thinned to a number."""
    found: list[FloatArray] = []
    for part in shapely.get_parts(area):
        polygon = shapely.orient_polygons(part)
        for ring in (polygon.exterior, *polygon.interiors):
            xy = np.asarray(ring.coords)[:-1, :2]
            before, after = xy - np.roll(xy, 1, axis=0), np.roll(xy, -1, axis=0) - xy
            # The area lies left of its outline and of its holes' outlines alike: right turns bend inwards.
            found.append(xy[before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0] < 0])
    corners = np.concatenate(found) if found else np.zeros((0, 2))
    return corners[:: max(1, -(-len(corners) // _MOST_CORNERS))]


def _shortest(nodes: FloatArray, area: BaseGeometry) -> FloatArray | None:
    """A* from node 0 to node 1 over straight lines inside ``area``; legs are tried when reached."""
    goal = np.hypot(*(nodes - nodes[1]).T)
    best = np.full(len(nodes), np.inf)
    best[0] = 0.0
    came = np.zeros(len(nodes), dtype=int)
    done = np.zeros(len(nodes), dtype=bool)
    queue = [(goal[0], 0)]
    while queue:
        _, here = heapq.heappop(queue)
        if here == 1:
            way = [1]
            while way[-1] != 0:
                way.append(int(came[way[-1]]))
            return nodes[way[::-1][1:-1]]
        if done[here]:
            continue
        done[here] = True
        length = best[here] + np.hypot(*(nodes - nodes[here]).T)
        others = np.flatnonzero(~done & (length < best - 1e-9))
        legs = shapely.linestrings(
            np.stack([np.broadcast_to(nodes[here], (len(others), 2)), nodes[others]], axis=1)
        )
        for there in others[shapely.covers(area, legs)]:
            best[there], came[there] = length[there], here
            heapq.heappush(queue, (best[there] + goal[there], int(there)))
    return None

"""Where extra photos join a path, and what they cost in the air."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np

from calib.camera import FloatArray
from mission.plan import Plan, Shot, Vehicle, Waypoint

#: Improvements of an order that are tried; the fourth seldom comes.
_POLISHES = 8


@dataclass(frozen=True)
class Gap:
    """A leg without photos, where extra ones may be flown. ``index``: waypoint before which they go."""

    start_m: FloatArray
    end_m: FloatArray
    index: int


def legs_s(vehicle: Vehicle, start_m: FloatArray, end_m: FloatArray) -> FloatArray:
    """Time (...) from rest to rest between places (..., 3): trapezoids of speed, level and vertical.

    A vehicle whose acceleration or speeds are not positive is refused with ValueError.
    """
    if min(vehicle.acceleration_m_s2, vehicle.speed_m_s, vehicle.climb_m_s, vehicle.descent_m_s) <= 0:
        raise ValueError("speeds and acceleration of the vehicle must be positive")
    way = end_m - start_m
    level = _trapezoid_s(np.hypot(way[..., 0], way[..., 1]), vehicle.speed_m_s, vehicle.acceleration_m_s2)
    speed = np.where(way[..., 2] > 0, vehicle.climb_m_s, vehicle.descent_m_s)
    upright = _trapezoid_s(np.abs(way[..., 2]), speed, vehicle.acceleration_m_s2)
    return np.maximum(level, upright)


def _trapezoid_s(length_m: FloatArray, speed: FloatArray | float, acceleration: float) -> FloatArray:
    short = length_m < np.square(speed) / acceleration
    time: FloatArray = np.where(
        short, 2 * np.sqrt(length_m / acceleration), length_m / speed + speed / acceleration
    )
    return time


def plan_gaps(plan: Plan) -> tuple[Gap, ...]:
    """Legs of a plan in which no photo is taken: to the first waypoint, turns, the way home."""
    path = plan.path_m
    found = []
    for index in range(len(plan.waypoints) + 1):
        if index == 0 or plan.waypoints[index - 1].shot is not Shot.LINE:
            found.append(Gap(path[index], path[index + 1], index))
    return tuple(found)


class Detours:
    """Cheapest ways through any of some stations, starting from the gaps of a path.

    Cheapest insertion from either end of the list, then single stations are moved and runs of
    them turned round as long as that helps. Deterministic.
    """

    def __init__(self, vehicle: Vehicle, gaps: Sequence[Gap], stations_m: FloatArray) -> None:
        """``stations_m`` (c, 3)."""
        self.vehicle, self.gaps = vehicle, tuple(gaps)
        self._stations = np.zeros((0, 3))
        self._between = np.zeros((0, 0))
        starts = np.array([g.start_m for g in gaps])
        ends = np.array([g.end_m for g in gaps])
        self._direct = legs_s(vehicle, starts, ends)
        self._starts, self._ends = starts, ends
        self._known: dict[tuple[int, ...], tuple[float, tuple[tuple[int, ...], ...]]] = {}
        self.add(stations_m)

    def add(self, stations_m: FloatArray) -> None:
        """More stations, numbered on."""
        s = np.concatenate([self._stations, stations_m.reshape(-1, 3)])
        self._stations = s
        self._between = legs_s(self.vehicle, s[:, None], s[None])
        self._from = legs_s(self.vehicle, self._starts[:, None], s[None])
        self._to = legs_s(self.vehicle, s[None], self._ends[:, None])

    def keep(self, count: int) -> None:
        """Forget all stations but the first ``count``."""
        kept, self._stations = self._stations[:count], np.zeros((0, 3))
        self._known.clear()
        self.add(kept)

    def seconds(self, chosen: Sequence[int]) -> float:
        """Extra time in the air for the photos ``chosen``."""
        return self._best(tuple(sorted(chosen)))[0]

    def order(self, chosen: Sequence[int]) -> tuple[tuple[int, ...], ...]:
        """The chosen photos in each gap, in the order in which they are flown."""
        return self._best(tuple(sorted(chosen)))[1]

    def insertion_s(self, chosen: Sequence[int]) -> FloatArray:
        """What each station (c,) would cost on top of ``chosen``, the others' order kept."""
        cheapest = np.full(len(self._stations), np.inf)
        for gap, way in enumerate(self.order(chosen)):
            for before, after in pairwise([-1, *way, -1]):
                out = self._from[gap] if before < 0 else self._between[before]
                back = self._to[gap] if after < 0 else self._between[:, after]
                cheapest = np.minimum(cheapest, out + back - self._leg(gap, before, after))
        return cheapest + self.vehicle.settle_s

    def _leg(self, gap: int, a: int, b: int) -> float:
        """Time from ``a`` to ``b`` in a gap; -1 stands for its start or end."""
        if a < 0:
            return float(self._direct[gap] if b < 0 else self._from[gap, b])
        return float(self._to[gap, a] if b < 0 else self._between[a, b])

    def _insert(self, ways: list[list[int]], station: int) -> float:
        """Put a station where it costs least; returns the cost."""
        best, at = math.inf, (0, 0)
        for gap, way in enumerate(ways):
            stops = [-1, *way, -1]
            for place in range(len(way) + 1):
                before, after = stops[place], stops[place + 1]
                cost = self._leg(gap, before, station) + self._leg(gap, station, after)
                cost -= self._leg(gap, before, after)
                if cost < best - 1e-9:
                    best, at = cost, (gap, place)
        ways[at[0]].insert(at[1], station)
        return best

    def _total(self, ways: list[list[int]]) -> float:
        total = 0.0
        for gap, way in enumerate(ways):
            if way:
                stops = [-1, *way, -1]
                total += sum(self._leg(gap, a, b) for a, b in pairwise(stops))
                total += self.vehicle.settle_s * len(way) - float(self._direct[gap])
        return total

    def _neighbours(self, ways: list[list[int]], chosen: tuple[int, ...]) -> Iterator[list[list[int]]]:
        for station in chosen:
            moved = [[s for s in way if s != station] for way in ways]
            self._insert(moved, station)
            yield moved
        for gap, way in enumerate(ways):
            for first, last in combinations(range(len(way)), 2):
                turned = way[:first] + way[first : last + 1][::-1] + way[last + 1 :]
                yield [*ways[:gap], turned, *ways[gap + 1 :]]

    def _polished(self, chosen: tuple[int, ...]) -> tuple[float, list[list[int]]]:
        """Ways through the stations, inserted in the given order."""
        ways: list[list[int]] = [[] for _ in self.gaps]
        for station in chosen:
            self._insert(ways, station)
        total = self._total(ways)
        for _ in range(_POLISHES):
            for trial in self._neighbours(ways, chosen):
                cost = self._total(trial)
                if cost < total - 1e-9:
                    ways, total = trial, cost
                    break
            else:
                break
        return total, ways

    def _best(self, chosen: tuple[int, ...]) -> tuple[float, tuple[tuple[int, ...], ...]]:
        if chosen in self._known:
            return self._known[chosen]
        total, ways = min(self._polished(start) for start in (chosen, chosen[::-1]))
        self._known[chosen] = (total, tuple(tuple(way) for way in ways))
        return self._known[chosen]


def with_stops(plan: Plan, gaps: Sequence[Gap], stops: Sequence[Sequence[Waypoint]]) -> Plan:
    """The plan with waypoints flown in its gaps, in the given order."""
    at = {gap.index: list(way) for gap, way in zip(gaps, stops, strict=True)}
    waypoints: list[Waypoint] = []
    for index in range(len(plan.waypoints) + 1):
        waypoints += at.get(index, [])
        waypoints += plan.waypoints[index : index + 1]
    return replace(plan, waypoints=tuple(waypoints))

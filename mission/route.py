"""Where extra photos join a path, and what they cost in the air."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

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
        self._from = self._to = np.zeros((len(self.gaps), 0))
        starts = np.array([g.start_m for g in gaps])
        ends = np.array([g.end_m for g in gaps])
        self._direct = legs_s(vehicle, starts, ends)
        self._starts, self._ends = starts, ends
        self._known: dict[tuple[int, ...], tuple[float, tuple[tuple[int, ...], ...]]] = {}
        self.add(stations_m)

    def add(self, stations_m: FloatArray) -> None:
        """More stations, numbered on."""
        new = stations_m.reshape(-1, 3)
        s, old = np.concatenate([self._stations, new]), len(self._stations)
        between = np.empty((len(s), len(s)))
        between[:old, :old] = self._between
        between[old:] = legs_s(self.vehicle, new[:, None], s[None])
        between[:old, old:] = legs_s(self.vehicle, s[:old, None], new[None])
        self._stations, self._between = s, between
        begin = legs_s(self.vehicle, self._starts[:, None], new[None])
        finish = legs_s(self.vehicle, new[None], self._ends[:, None])
        self._from = np.concatenate([self._from, begin], axis=1)
        self._to = np.concatenate([self._to, finish], axis=1)

    def keep(self, count: int) -> None:
        """Forget all stations but the first ``count``."""
        self._known.clear()
        self._stations, self._between = self._stations[:count], self._between[:count, :count]
        self._from, self._to = self._from[:, :count], self._to[:, :count]

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

    def _legs(self, chosen: tuple[int, ...]) -> _Legs:
        """The times among a few stations."""
        some = np.array(chosen, dtype=np.intp)
        tables = []
        for gap in range(len(self.gaps)):
            table = np.empty((len(some) + 1, len(some) + 1))
            table[:-1, :-1] = self._between[np.ix_(some, some)]
            table[-1, :-1], table[:-1, -1] = self._from[gap, some], self._to[gap, some]
            table[-1, -1] = self._direct[gap]
            tables.append(table.tolist())
        return _Legs(tables, self.vehicle.settle_s)

    def _best(self, chosen: tuple[int, ...]) -> tuple[float, tuple[tuple[int, ...], ...]]:
        if chosen in self._known:
            return self._known[chosen]
        legs = self._legs(chosen)
        places = range(len(chosen))
        total, ways = min(legs.polished(start) for start in (tuple(places), tuple(places[::-1])))
        self._known[chosen] = (total, tuple(tuple(chosen[p] for p in way) for way in ways))
        return self._known[chosen]


@dataclass(frozen=True)
class _Legs:
    """Times among a few stations, as plain numbers, which are looked up faster than arrays' elements.

    ``seconds[gap][a][b]``: from station a to station b; -1 stands for the gap's start or end.
    """

    seconds: list[list[list[float]]]
    settle_s: float

    def insert(self, ways: list[list[int]], station: int) -> None:
        """Put a station where it costs least."""
        best, at = math.inf, (0, 0)
        for gap, way in enumerate(ways):
            leg = self.seconds[gap]
            into = leg[station]
            before = -1
            for place, after in enumerate([*way, -1]):
                cost = leg[before][station] + into[after] - leg[before][after]
                if cost < best - 1e-9:
                    best, at = cost, (gap, place)
                before = after
        ways[at[0]].insert(at[1], station)

    def total(self, ways: list[list[int]]) -> float:
        total = 0.0
        for leg, way in zip(self.seconds, ways, strict=True):
            if way:
                total += sum([leg[a][b] for a, b in pairwise([-1, *way, -1])])
                total += self.settle_s * len(way) - leg[-1][-1]
        return total

    def moved(self, ways: list[list[int]], chosen: tuple[int, ...], total: float) -> list[list[int]] | None:
        """The ways with the first station moved that is better elsewhere."""
        for station in chosen:
            trial = [[s for s in way if s != station] for way in ways]
            self.insert(trial, station)
            if self.total(trial) < total - 1e-9:
                return trial
        return None

    def turned(self, ways: list[list[int]]) -> list[list[int]] | None:
        """The ways with the first run of stations turned round that is better so."""
        for gap, (leg, way) in enumerate(zip(self.seconds, ways, strict=True)):
            stops = [-1, *way, -1]
            for first in range(len(way)):
                before, inner = leg[stops[first]], 0.0
                for last in range(first + 1, len(way)):
                    one, after = way[last], stops[last + 2]
                    inner += leg[one][way[last - 1]] - leg[way[last - 1]][one]
                    now = before[way[first]] + leg[one][after]
                    if before[one] + leg[way[first]][after] + inner < now - 1e-9:
                        turned = way[:first] + way[first : last + 1][::-1] + way[last + 1 :]
                        return [*ways[:gap], turned, *ways[gap + 1 :]]
        return None

    def polished(self, chosen: tuple[int, ...]) -> tuple[float, list[list[int]]]:
        """Ways through the stations, inserted in the given order."""
        ways: list[list[int]] = [[] for _ in self.seconds]
        for station in chosen:
            self.insert(ways, station)
        total = self.total(ways)
        for _ in range(_POLISHES):
            better = self.moved(ways, chosen, total) or self.turned(ways)
            if better is None:
                break
            ways, total = better, self.total(better)
        return total, ways


def with_stops(plan: Plan, gaps: Sequence[Gap], stops: Sequence[Sequence[Waypoint]]) -> Plan:
    """The plan with waypoints flown in its gaps, in the given order."""
    at = {gap.index: list(way) for gap, way in zip(gaps, stops, strict=True)}
    waypoints: list[Waypoint] = []
    for index in range(len(plan.waypoints) + 1):
        waypoints += at.get(index, [])
        waypoints += plan.waypoints[index : index + 1]
    return replace(plan, waypoints=tuple(waypoints))

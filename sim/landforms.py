"""Grounds made of simpler ones: a levee, a river valley, a levelled place, sums."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib.camera import FloatArray
from sim.relief import HeightField

_Field = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True)
class Sum:
    """Grounds on top of each other."""

    parts: tuple[HeightField, ...]

    @property
    def lowest_m(self) -> float:
        return sum(part.lowest_m for part in self.parts)

    @property
    def highest_m(self) -> float:
        return sum(part.highest_m for part in self.parts)

    @property
    def steepest(self) -> float:
        return sum(part.steepest for part in self.parts)

    def height_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        total = np.zeros(np.shape(east_m))
        for part in self.parts:
            total += part.height_m(east_m, north_m)
        return total

    def height_and_gradient(self, east_m: FloatArray, north_m: FloatArray) -> _Field:
        total, by_east, by_north = (np.zeros(np.shape(east_m)) for _ in range(3))
        for part in self.parts:
            height, slope_east, slope_north = part.height_and_gradient(east_m, north_m)
            total += height
            by_east += slope_east
            by_north += slope_north
        return total, by_east, by_north


@dataclass(frozen=True)
class Levelled:
    """A ground that is made level at height 0 around the origin, as a building's place is.

    Heights are within 1 % of what they were beyond about three times ``radius_m``, and below 0.5 %
    of it within a quarter of it.
    """

    ground: HeightField
    radius_m: float

    @property
    def lowest_m(self) -> float:
        return min(self.ground.lowest_m, 0.0)

    @property
    def highest_m(self) -> float:
        return max(self.ground.highest_m, 0.0)

    @property
    def steepest(self) -> float:
        # The share r^4 / (r^4 + R^4) rises by 1.07 / R at most.
        return self.ground.steepest + 1.07 * max(-self.lowest_m, self.highest_m) / self.radius_m

    def height_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        r4 = (east_m**2 + north_m**2) ** 2
        return self.ground.height_m(east_m, north_m) * (r4 / (r4 + self.radius_m**4))

    def height_and_gradient(self, east_m: FloatArray, north_m: FloatArray) -> _Field:
        height, by_east, by_north = self.ground.height_and_gradient(east_m, north_m)
        r2, limit = east_m**2 + north_m**2, self.radius_m**4
        share = r2 * r2 / (r2 * r2 + limit)
        steeper = height * 4 * r2 * limit / (r2 * r2 + limit) ** 2
        return height * share, by_east * share + steeper * east_m, by_north * share + steeper * north_m


@dataclass(frozen=True)
class Course:
    """A winding line through the site: that of a levee's crest or of a river.

    The line is where ``across_m`` is zero: distance across the heading ``azimuth_deg`` (compass), less
    ``swing_m`` times a sine of wavelength ``bend_m`` along it.
    """

    azimuth_deg: float
    offset_m: float
    swing_m: float
    bend_m: float
    phase_rad: float

    @cached_property
    def _axes(self) -> tuple[float, float]:
        return float(np.sin(np.radians(self.azimuth_deg))), float(np.cos(np.radians(self.azimuth_deg)))

    @property
    def stretch(self) -> float:
        """The gradient of ``across_m`` is no longer than this."""
        return float(np.hypot(1.0, self.swing_m * 2 * np.pi / self.bend_m))

    def across_and_gradient(self, east_m: FloatArray, north_m: FloatArray) -> _Field:
        """Signed distance to the right of the line (m; exact where it runs straight) and its gradient."""
        ahead_east, ahead_north = self._axes
        number = 2 * np.pi / self.bend_m
        angle = number * (ahead_east * east_m + ahead_north * north_m) + self.phase_rad
        across = ahead_north * east_m - ahead_east * north_m - self.offset_m - self.swing_m * np.sin(angle)
        turn = self.swing_m * number * np.cos(angle)
        return across, ahead_north - turn * ahead_east, -ahead_east - turn * ahead_north


@dataclass(frozen=True)
class Ridge:
    """A bank along a course, with a crest and two slopes; negative heights make a trough.

    ``crest_height_m`` above the land beside it, crest ``2 half_crest_m`` wide, foot ``half_foot_m`` from the
    course; corners are rounded over about ``round_m``.
    """

    course: Course
    crest_height_m: float
    half_crest_m: float
    half_foot_m: float
    round_m: float = 0.4

    @property
    def lowest_m(self) -> float:
        return min(self.crest_height_m, 0.0)

    @property
    def highest_m(self) -> float:
        return max(self.crest_height_m, 0.0)

    @property
    def steepest(self) -> float:
        return abs(self.crest_height_m) / (self.half_foot_m - self.half_crest_m) * self.course.stretch

    def height_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        return self.height_and_gradient(east_m, north_m)[0]

    def height_and_gradient(self, east_m: FloatArray, north_m: FloatArray) -> _Field:
        across, by_east, by_north = self.course.across_and_gradient(east_m, north_m)
        height, slope = np.zeros(np.shape(across)), np.zeros(np.shape(across))
        # A trapezium is the sum of four angles |d - corner|, each rounded to a hyperbola.
        scale = self.crest_height_m / (2 * (self.half_foot_m - self.half_crest_m))
        for corner, sign in (
            (-self.half_foot_m, scale),
            (self.half_foot_m, scale),
            (-self.half_crest_m, -scale),
            (self.half_crest_m, -scale),
        ):
            rounded = np.hypot(across - corner, self.round_m)
            height += sign * rounded
            slope += sign * (across - corner) / rounded
        return height, slope * by_east, slope * by_north


def levee(seed: int, crest_height_m: float) -> Ridge:
    """A flood-defence bank through the site's middle: crest 4 m wide, slopes 1 in 3."""
    rng = np.random.default_rng([seed, 12])
    course = Course(
        azimuth_deg=float(rng.uniform(20, 70)),
        offset_m=float(rng.uniform(-8, 8)),
        swing_m=float(rng.uniform(4, 9)),
        bend_m=float(rng.uniform(180, 260)),
        phase_rad=float(rng.uniform(0, 2 * np.pi)),
    )
    return Ridge(course, crest_height_m, 2.0, 2.0 + 3.0 * crest_height_m)


def valley(seed: int, depth_m: float) -> tuple[Ridge, Ridge]:
    """A river valley through the site's middle, and the river's bed in its floor.

    The floor lies at height 0 and the land beside it at ``depth_m`` (the first trough is to be raised by
    so much); floor 50 m wide, sides 40 m wide each, bed 10 m wide and a metre deep.
    """
    rng = np.random.default_rng([seed, 13])
    azimuth, phase = float(rng.uniform(-40, 40)), float(rng.uniform(0, 2 * np.pi))
    wide = Course(azimuth, 0.0, float(rng.uniform(8, 14)), 320.0, phase)
    narrow = Course(azimuth, 0.0, float(rng.uniform(9, 14)), 130.0, phase)
    sides = Ridge(wide, -depth_m, 25.0, 65.0, 6.0)
    return sides, Ridge(narrow, -1.0, 5.0, 7.5, 0.4)


@dataclass(frozen=True)
class Plane:
    """Level ground at a height."""

    z_m: float = 0.0

    @property
    def lowest_m(self) -> float:
        return self.z_m

    @property
    def highest_m(self) -> float:
        return self.z_m

    @property
    def steepest(self) -> float:
        return 0.0

    def height_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        return np.full(np.broadcast(east_m, north_m).shape, self.z_m)

    def height_and_gradient(self, east_m: FloatArray, north_m: FloatArray) -> _Field:
        zero = np.zeros(np.broadcast(east_m, north_m).shape)
        return np.full(np.broadcast(east_m, north_m).shape, self.z_m), zero, zero

"""Grounds of the papers' sites, which no general kind of world has, and heights to score against."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.camera import FloatArray
from sim.landforms import Course, Ridge, Sum
from sim.truth import HeightGrid
from sim.world import World
from sim.worlds import build_world

#: [C&D] site A slopes eastwards, site B ends at a flood levee "approximately 1 meter high".
SITE_A_FALL_M = 9.0
SITE_B_LEVEE_M, SITE_B_LEVEE_NORTH_M = 1.0, 30.0


@dataclass(frozen=True)
class Hillside:
    """Ground that falls eastwards, steepest at the middle and levelling out to either side.

    ``fall_m`` from far west to far east, most of it over ``width_m``.
    """

    fall_m: float
    width_m: float

    @property
    def lowest_m(self) -> float:
        return -self.fall_m / 2

    @property
    def highest_m(self) -> float:
        return self.fall_m / 2

    @property
    def steepest(self) -> float:
        return self.fall_m / self.width_m

    def height_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """Height (m) at positions of any (equal) shape."""
        return self.height_and_gradient(east_m, north_m)[0]

    def height_and_gradient(
        self, east_m: FloatArray, north_m: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Height, d height / d east and d height / d north (m, m/m, m/m)."""
        share = np.tanh(2 * np.asarray(east_m, dtype=float) / self.width_m) + 0 * north_m
        slope = -self.steepest * (1 - share * share)
        return -self.fall_m / 2 * share, slope, np.zeros_like(slope)


def site_world(
    kind: str,
    seed: int,
    *,
    half_m: float,
    texel_m: float,
    relief_m: float,
    roughness: float,
    scale: float = 1.0,
    dem: Path | None = None,
    ortho: Path | None = None,
) -> World:
    """A world of a kind of :data:`sim.worlds.KINDS`, or of the papers' ``site-a`` and ``site-b``.

    ``scale``: of the site's extent; heights stay.

    Raises:
        InputError: no such kind, or a DEM or orthophoto that cannot be used.
    """
    general = {"site-a": "rolling", "site-b": "flat"}.get(kind, kind)
    world = build_world(
        general,
        seed,
        half_m=half_m,
        texel_m=texel_m,
        relief_m=relief_m,
        roughness=roughness,
        dem=dem,
        ortho=ortho,
    )
    if kind == "site-a":
        return replace(world, relief=Sum((world.relief, Hillside(SITE_A_FALL_M, 160.0 * scale))))
    if kind == "site-b":
        # Heading east, so that the offset to the right is southwards.
        course = Course(90.0, -SITE_B_LEVEE_NORTH_M * scale, 0.0, 200.0, 0.0)
        bank = Ridge(course, SITE_B_LEVEE_M, 1.5, 1.5 + 3.0 * SITE_B_LEVEE_M)
        return replace(world, relief=Sum((world.relief, bank)))
    return world


def height_grid(world: World, outline_m: FloatArray, cells: int = 120) -> HeightGrid:
    """True heights over the rectangle around an outline (n, 2), at most ``cells`` + 1 each way."""
    low, high = outline_m.min(axis=0), outline_m.max(axis=0)
    step = float((high - low).max()) / cells
    east, north = (
        a + step * np.arange(int((b - a) / step + 1e-9) + 1) for a, b in zip(low, high, strict=True)
    )
    grid_east, grid_north = np.meshgrid(east, north)
    return HeightGrid(east, north, world.height_m(grid_east, grid_north, structures=True))


def check_points(world: World, outline_m: FloatArray, seed: int, count: int = 300) -> FloatArray:
    """Random ground points (at most ``count``, 3) inside a convex outline, away from edges of structures.

    A tenth of the way from the outline to its middle is left out: the photos end there.
    """
    rng = np.random.default_rng([seed, 17])
    middle = outline_m.mean(axis=0)
    inner = middle + 0.9 * (outline_m - middle)
    tried = rng.uniform(inner.min(axis=0), inner.max(axis=0), (4 * count, 2))
    side = np.roll(inner, -1, axis=0) - inner
    offset = tried[:, None, :] - inner
    inside = (side[:, 0] * offset[..., 1] - side[:, 1] * offset[..., 0] >= 0).all(axis=1)
    east, north = tried[inside].T
    steps = (-0.5, 0.0, 0.5)
    around = [world.height_m(east + a, north + b, structures=True) for a in steps for b in steps]
    even = np.ptp(around, axis=0) < 0.5
    points: FloatArray = np.column_stack([east, north, around[len(around) // 2]])[even][:count]
    return points

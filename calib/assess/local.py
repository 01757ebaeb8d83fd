"""How high a cloud lies at a place: a smooth surface through its points within a radius.

Of second order where there are points enough: a plane cuts off crests and fills hollows, which would show as
a scale of the relief that is too small.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calib.camera import FloatArray
from calib.clouds import LoadedCloud

#: A surface is put through about so many points unless the user gives a radius, and at most so many.
POINTS_A_SURFACE = 40
_MOST_NEIGHBOURS = 80
#: A height needs at least so many, and their middle no further off than this share of the radius.
_FEWEST_NEIGHBOURS = 6
#: With fewer a plane is taken for the second-order surface.
_FEWEST_SECOND_ORDER = 15
_OFF_CENTRE = 0.4
#: Least product of the spreads along and across, as a share of the square of their sum.
_ON_A_LINE = 0.02
#: Points further from their surface than so many robust sigmas are left out (grass, wires, mismatches).
_OUTLIER_SIGMAS = 3.5
#: Points kept around the places of one registration.
_MOST_POINTS = 4_000_000
_MOST_CELLS = 2000
_BLOCK = 20_000


@dataclass(frozen=True)
class Heights:
    """Height (n,) and slopes (n, 2; along x and y) at n places, NaN where there is no cloud.

    ``slope_covariance`` (n, 2, 2): what the noise of the cloud leaves open of the slopes.
    """

    height_m: FloatArray
    slope: FloatArray
    slope_covariance: FloatArray

    @property
    def found(self) -> NDArray[np.bool_]:
        return np.isfinite(self.height_m)


@dataclass(frozen=True)
class Neighbourhood:
    """The points of a cloud around some places. ``density``: points on a square metre of them."""

    points: FloatArray
    density: float

    @property
    def natural_radius_m(self) -> float:
        """The radius that holds about ``POINTS_A_SURFACE`` points."""
        return math.sqrt(POINTS_A_SURFACE / (math.pi * self.density))

    def thinned(self, radius_m: float, seed: int = 0) -> Sampler:
        """Ready to be asked for surfaces of a radius; points that would be too many there are left out."""
        share = POINTS_A_SURFACE / (math.pi * radius_m**2 * self.density)
        if share >= 1:
            return Sampler(self.points, radius_m)
        kept = np.random.default_rng(seed).random(len(self.points)) < share
        return Sampler(self.points[kept] if int(kept.sum()) > _FEWEST_NEIGHBOURS else self.points, radius_m)


class Sampler:
    """Local surfaces of one radius through points (n, 3)."""

    def __init__(self, points: FloatArray, radius_m: float) -> None:
        self.radius_m = radius_m
        self._points = points
        self._tree = cKDTree(points[:, :2])

    def heights(self, xy_m: FloatArray) -> Heights:
        """At places (n, 2)."""
        parts = [self._some(xy_m[i : i + _BLOCK]) for i in range(0, len(xy_m), _BLOCK)]
        joined = (np.concatenate(group) for group in zip(*parts, strict=True))
        return Heights(*joined)

    def _some(self, xy_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        most = min(_MOST_NEIGHBOURS, len(self._points))
        distance, index = self._tree.query(
            xy_m, k=list(range(1, most + 1)), distance_upper_bound=self.radius_m
        )
        near = np.isfinite(distance)
        around = self._points[np.where(near, index, 0)]
        around[..., :2] -= xy_m[:, None, :]
        x, y = np.moveaxis(around[..., :2] / self.radius_m, -1, 0)
        design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
        number = near.sum(axis=1)
        # Without the second order where points are few: its terms are held at zero.
        held = np.zeros((len(xy_m), 6, 6))
        held[number < _FEWEST_SECOND_ORDER, [[3], [4], [5]], [[3], [4], [5]]] = 1e9
        middle = np.where(near, np.stack([x, y]), 0).sum(axis=2) / np.maximum(number, 1)
        xx, xy, yy = (np.where(near, v, 0).sum(axis=1) for v in (x * x, x * y, y * y))
        # All around the place, and not on one line.
        enough = (number >= _FEWEST_NEIGHBOURS) & (np.hypot(*middle) < _OFF_CENTRE)
        enough &= xx * yy - xy**2 > _ON_A_LINE * (xx + yy) ** 2
        weight = near.astype(float)
        for _ in range(3):
            weighted = design * weight[..., None]
            normal = np.einsum("nki,nkj->nij", weighted, design) + held
            normal += 1e-9 * np.eye(6)
            right = np.einsum("nki,nk->ni", weighted, around[..., 2])
            found = np.linalg.solve(normal, right[..., None])[..., 0]
            rest = around[..., 2] - np.einsum("nki,ni->nk", design, found)
            size = np.where(near, np.abs(rest), np.nan)
            size[~enough] = 0.0
            spread = 1.4826 * np.nanmedian(size, axis=1)
            weight = (near & (np.abs(rest) <= _OUTLIER_SIGMAS * spread[:, None] + 1e-9)).astype(float)
        height = np.where(enough, found[:, 0], np.nan)
        inverse = np.linalg.inv(normal)[:, 1:3, 1:3]
        covariance = inverse * (spread**2)[:, None, None] / self.radius_m**2
        return height, found[:, 1:3] / self.radius_m, covariance


def near_places(cloud: LoadedCloud, xy_m: FloatArray, reach_m: float, seed: int = 0) -> Neighbourhood | None:
    """The cloud's points within about ``reach_m`` of places (n, 2) about its origin; None: there are none."""
    low = xy_m.min(axis=0) - 2 * reach_m
    extent = float(np.ptp(xy_m, axis=0).max()) + 4 * reach_m
    cell = max(reach_m, extent / _MOST_CELLS)
    shape = np.ceil((xy_m.max(axis=0) + 2 * reach_m - low) / cell).astype(int) + 1
    wanted = np.zeros(shape, bool)
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            wanted[tuple(((xy_m - low) / cell).astype(int).T + np.array([[i], [j]]))] = True
    full = np.zeros(shape, bool)
    kept: list[FloatArray] = []
    for block in cloud.blocks():
        at = np.floor((block[:, :2] - low) / cell)
        inside = ((at >= 0) & (at < shape)).all(axis=1)
        column, row = at[inside].astype(int).T
        mine = wanted[column, row]
        full[column[mine], row[mine]] = True
        kept.append(block[inside][mine])
    points = np.concatenate(kept)
    if not len(points):
        return None
    density = len(points) / (int(full.sum()) * cell**2)
    if len(points) > _MOST_POINTS:
        some = np.random.default_rng(seed).random(len(points)) < _MOST_POINTS / len(points)
        density *= float(some.mean())
        points = points[some]
    return Neighbourhood(points, density)

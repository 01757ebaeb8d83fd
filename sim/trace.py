"""Where rays meet the ground: a search that misses no hill, and its cheap form for whole photos."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.camera import FloatArray
from sim.relief import HeightField

#: Ground farther away than this (m) is not seen: haze.
FARTHEST_M = 6000.0
#: Ground farther away than this (m), seen at less than 14 degrees, is interpolated whatever it is.
_EXACT_M = 500.0
#: Interpolation as wrong as this (px) is not mended by one step of Newton's method.
_FAR_OFF_PX = 2.0
_ITERATIONS = 160
_CLOSE = 2e-5  # gap per distance at which the search hands over to Newton's method


def trace(
    ground: HeightField,
    start_m: FloatArray,
    direction: FloatArray,
    within: FloatArray | float = np.inf,
) -> tuple[FloatArray, FloatArray]:
    """Nearest hits of rays (n, 3): distance (n,) in lengths of ``direction``, inf for the sky, and
    (n,) by what angle (rad) the ray passed over nearer ground, inf if it never came closer and left.

    No step is longer than the gap to the ground allows at the steepest slope, so that nothing is
    jumped over. Hits farther than ``within`` (n,) may be given as sky.
    """
    flat = np.hypot(direction[:, 0], direction[:, 1])
    length = np.hypot(flat, direction[:, 2])
    fall = direction[:, 2]
    closing = ground.steepest * flat - fall
    above_m = start_m[:, 2] - ground.highest_m
    with np.errstate(divide="ignore", invalid="ignore"):
        first = np.where(above_m > 0, above_m / -fall, 0.0)
        # Beyond this a falling ray is below all ground, a rising one above it.
        level = np.where(fall < 0, ground.lowest_m, ground.highest_m)
        last = np.where(fall == 0, np.inf, (level - start_m[:, 2]) / fall)
    last = np.minimum(np.minimum(last, within), FARTHEST_M / np.maximum(flat, 1e-9)) + 1e-6
    possible = (closing > 0) & ~((above_m > 0) & (fall >= 0)) & (first <= last)

    distance = np.full(len(start_m), np.inf)
    missed_by = np.full(len(start_m), np.inf)
    active = np.flatnonzero(possible)
    t = first[active]
    gap_before = np.full(len(active), np.inf)
    for _ in range(_ITERATIONS):
        if not len(active):
            break
        at = start_m[active] + t[:, None] * direction[active]
        gap = at[:, 2] - ground.height_m(at[:, 0], at[:, 1])
        leaving = gap > gap_before
        # Between two steps the ray may have come closer than at either of them.
        angle = 0.5 * gap_before / np.maximum(t * length[active], 1e-9)
        missed_by[active] = np.where(leaving, np.minimum(missed_by[active], angle), missed_by[active])
        there = gap < _CLOSE * t * length[active]
        distance[active[there]] = t[there]
        t = t + np.maximum(gap, 0) / closing[active]
        on = ~there & (t <= last[active])
        active, t, gap_before = active[on], t[on], gap[on]
    distance[active] = t  # grazing rays that would need still more steps: within a hair of the ground
    hit = np.flatnonzero(np.isfinite(distance))
    for _ in range(2):
        distance[hit] = newton(ground, start_m[hit], direction[hit], distance[hit])
    return distance, missed_by


def newton(
    ground: HeightField, start_m: FloatArray, direction: FloatArray, distance: FloatArray
) -> FloatArray:
    """One step of rays (n, 3) from near a hit towards it; (n,)."""
    at = start_m + distance[:, None] * direction
    height, by_east, by_north = ground.height_and_gradient(at[:, 0], at[:, 1])
    gap = at[:, 2] - height
    rate = direction[:, 2] - by_east * direction[:, 0] - by_north * direction[:, 1]
    # Rays that graze or come from behind: no steeper than a hundredth, so that no step runs away.
    return distance - gap / np.minimum(rate, -0.01)


@dataclass(frozen=True)
class GroundMap:
    """Distances to the ground over a whole photo, known at nodes and good to about 0.01 px between.

    rows (a,), columns (b,): pixels of the nodes. inverse (a, b): 1 / distance, 0 for the sky; linear
    over a plane. care (a - 1, b - 1): 0 where interpolation is good enough, 1 where pixels need a
    step of Newton's method, 2 where they need the whole search (behind a crest), 3 at a far horizon,
    where the ground is taken as level at ``far_level_m``.
    """

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    inverse: FloatArray
    care: NDArray[np.uint8]
    far_level_m: float

    def cell_rows(self, rows: NDArray[np.intp]) -> NDArray[np.intp]:
        """In which row of cells rows of pixels (n,) are."""
        return np.clip(np.searchsorted(self.rows, rows, side="right") - 1, 0, len(self.rows) - 2)

    def cell_columns(self, columns: NDArray[np.intp]) -> NDArray[np.intp]:
        """In which column of cells columns of pixels (n,) are."""
        return np.clip(np.searchsorted(self.columns, columns, side="right") - 1, 0, len(self.columns) - 2)

    def band(
        self,
        first: int,
        ground: HeightField,
        start_m: FloatArray,
        direction: FloatArray,
        hidden_from: FloatArray,
    ) -> FloatArray:
        """Distance (h, w) of the rays ``direction`` (h, w, 3) of rows ``first`` onwards that start at
        ``start_m`` (h, 3); inf for the sky. Beyond ``hidden_from`` (h, w) it need not be right."""
        height, width = direction.shape[:2]
        row_at = np.arange(first, first + height)
        cell = self.cell_rows(row_at)
        share = ((row_at - self.rows[cell]) / (self.rows[cell + 1] - self.rows[cell]))[:, None]
        along = self.inverse[cell] * (1 - share) + self.inverse[cell + 1] * share
        column_at = np.arange(width)
        right = self.cell_columns(column_at)
        across = (column_at - self.columns[right]) / (self.columns[right + 1] - self.columns[right])
        inverse = along[:, right] * (1 - across) + along[:, right + 1] * across
        with np.errstate(divide="ignore"):
            distance: FloatArray = 1 / inverse
        care = self.care[np.ix_(cell, right)] if self.care[cell].any() else None
        if care is not None:
            for method in (1, 2, 3):
                v, u = np.nonzero(care == method)
                if not len(v):
                    continue
                if method == 1:
                    better = newton(ground, start_m[v], direction[v, u], distance[v, u])
                elif method == 2:
                    better, _ = trace(ground, start_m[v], direction[v, u], hidden_from[v, u])
                else:
                    fall = np.minimum(direction[v, u, 2], -1e-12)
                    better = (self.far_level_m - start_m[v, 2]) / fall
                    flat = np.hypot(direction[v, u, 0], direction[v, u, 1])
                    better[(better < 0) | (better * flat > FARTHEST_M)] = np.inf
                distance[v, u] = better
        return distance


def ground_map(
    ground: HeightField,
    start_m: FloatArray,
    rays: FloatArray,
    rotation_cam_from_world: FloatArray,
    step: int,
    tolerance_px: float = 0.01,
) -> GroundMap:
    """The map of a photo with rays (h, w, 2) whose rows start at ``start_m`` (h, 3)."""
    height, width = rays.shape[:2]
    rows = np.unique(np.rint(np.linspace(0, height - 1, max(height // step, 8))).astype(int))
    columns = np.unique(np.rint(np.linspace(0, width - 1, max(width // step, 8))).astype(int))
    shape = (len(rows), len(columns))
    direction = directions(rays[np.ix_(rows, columns)], rotation_cam_from_world).reshape(-1, 3)
    start = np.repeat(start_m[rows], len(columns), axis=0)
    distance, missed_by = trace(ground, start, direction)
    inverse = (1 / distance).reshape(shape)

    # The angle of a pixel, from the spacing of the nodes.
    pixel_rad = float(np.median(np.abs(np.diff(rays[rows][:, columns, 0], axis=1)))) / step
    centre_rows, centre_columns = (rows[:-1] + rows[1:]) // 2, (columns[:-1] + columns[1:]) // 2
    share_v = ((centre_rows - rows[:-1]) / np.diff(rows))[:, None]
    share_u = (centre_columns - columns[:-1]) / np.diff(columns)
    left = inverse[:-1] * (1 - share_v) + inverse[1:] * share_v
    between = left[:, :-1] * (1 - share_u) + left[:, 1:] * share_u
    towards = directions(rays[np.ix_(centre_rows, centre_columns)], rotation_cam_from_world)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = start_m[centre_rows][:, None] + towards / between[..., None]
        gap = at[..., 2] - ground.height_m(at[..., 0], at[..., 1])
        # A wrong height shifts what a pixel sees by its part across the ray.
        flat = np.hypot(towards[..., 0], towards[..., 1])
        length2 = flat**2 + towards[..., 2] ** 2
        error_px = np.abs(gap) * flat * between / length2 / pixel_rad
    hits = (inverse > 0).reshape(shape)
    grazing = (missed_by < 1.5 * step * pixel_rad).reshape(shape)

    def any_corner(flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return flags[:-1, :-1] | flags[1:, :-1] | flags[:-1, 1:] | flags[1:, 1:]

    care = np.zeros(between.shape, np.uint8)
    care[error_px > tolerance_px] = 1
    outline = any_corner(hits) & any_corner(~hits)
    care[(error_px > _FAR_OFF_PX) | any_corner(grazing) | outline] = 2
    care[~any_corner(hits) & ~any_corner(grazing)] = 0
    # Far away at grazing incidence single bumps would take most of the time and are not seen.
    near = inverse > 1 / _EXACT_M
    far = ~any_corner(near) & (flat > 4 * np.abs(towards[..., 2]))
    care[far] = 0
    care[far & outline] = 3
    at_m = start[:, 2] + np.where(np.isfinite(distance), distance, 0.0) * direction[:, 2]
    remote = np.isfinite(distance) & (distance > _EXACT_M)
    far_level_m = float(np.median(at_m[remote])) if remote.any() else 0.0
    return GroundMap(rows, columns, inverse, care, far_level_m)


def directions(rays: FloatArray, rotation_cam_from_world: FloatArray) -> FloatArray:
    """World directions (..., 3) of camera rays (..., 2); their depth in the camera is 1."""
    out: FloatArray = rays @ rotation_cam_from_world[:2] + rotation_cam_from_world[2]
    return out

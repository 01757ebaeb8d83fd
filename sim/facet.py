"""Upright structures: flat, convex, textured pieces with rectangular openings."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib.camera import FloatArray
from sim.texture import ByteImage, Texture, pyramid_of


@dataclass(frozen=True)
class Facet:
    """A flat piece of a structure in world coordinates (m).

    ``origin_m`` (3,): where its coordinates s and t are 0. ``along``, ``up`` (3,): unit vectors of s
    and t at a right angle; seen from the front, s runs to the right and t up (front = along x up).
    ``outline_m`` (p, 2): corners (s, t) of a convex polygon, counterclockwise. ``openings_m`` (h, 4):
    rectangles s0, t0, s1, t1 through which one sees. Both sides show the texture.
    """

    origin_m: FloatArray
    along: FloatArray
    up: FloatArray
    outline_m: FloatArray
    texture: Texture
    openings_m: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))

    @cached_property
    def front(self) -> FloatArray:
        """Unit normal (3,)."""
        return np.cross(self.along, self.up)

    @property
    def corners_m(self) -> FloatArray:
        """Corners (p, 3) in world coordinates."""
        return self.points_m(self.outline_m)

    def points_m(self, on_facet_m: FloatArray) -> FloatArray:
        """World points (n, 3) of facet coordinates (n, 2)."""
        return self.origin_m + on_facet_m[:, :1] * self.along + on_facet_m[:, 1:] * self.up

    def hit(self, start_m: FloatArray, direction: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Distance (in lengths of ``direction``), s and t where rays (..., 3) meet the facet's plane.

        The distance is inf where they do not.
        """
        towards = direction @ self.front
        ahead = (self.origin_m - start_m) @ self.front
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.where(towards * ahead > 0, ahead / towards, np.inf)
        from_origin = start_m - self.origin_m
        reach = np.where(np.isfinite(distance), distance, 0.0)
        s = from_origin @ self.along + reach * (direction @ self.along)
        t = from_origin @ self.up + reach * (direction @ self.up)
        return distance, s, t

    def covers(self, s: FloatArray, t: FloatArray) -> NDArray[np.bool_]:
        """Whether positions of equal shape are on the facet and not in an opening."""
        inside = np.ones(np.shape(s), bool)
        for (s0, t0), (s1, t1) in zip(self.outline_m, np.roll(self.outline_m, -1, axis=0), strict=True):
            inside &= (s1 - s0) * (t - t0) >= (t1 - t0) * (s - s0)
        for s0, t0, s1, t1 in self.openings_m:
            inside &= ~((s > s0) & (s < s1) & (t > t0) & (t < t1))
        return inside

    def height_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """Height of the facet above or below positions of equal shape; -inf beside it and on
        upright facets."""
        if abs(self.front[2]) < 1e-6:
            return np.full(np.shape(east_m), -np.inf)
        down = np.zeros((*np.shape(east_m), 3))
        down[..., 2] = -1.0
        top = np.stack([east_m, north_m, np.full(np.shape(east_m), 1e4)], axis=-1)
        distance, s, t = self.hit(top, down)
        return np.where(self.covers(s, t), 1e4 - distance, -np.inf)

    def with_dots(self, on_facet_m: FloatArray, sigma_m: float) -> Facet:
        """The facet grey with white Gaussian dots at facet coordinates (n, 2): for tests."""
        texture = self.texture
        where = np.column_stack([on_facet_m[:, 0] - texture.left_m, texture.top_m - on_facet_m[:, 1]])
        return replace(
            self,
            texture=replace(
                texture,
                pyramid=pyramid_of(
                    dotted(texture.pyramid[0].shape[:2], where / texture.texel_m, sigma_m / texture.texel_m)
                ),
                detail_seed=None,
            ),
        )


def dotted(shape: tuple[int, int], where_texels: FloatArray, sigma_texels: float) -> ByteImage:
    """Grey raster with white dots at (n, 2) texels right and down of its upper left corner."""
    canvas = np.full(shape, 60.0)
    reach = int(np.ceil(5 * sigma_texels))
    offsets = np.arange(-reach, reach + 1)
    for column, row in where_texels - 0.5:
        columns, rows = round(float(column)) + offsets, round(float(row)) + offsets
        columns = columns[(columns >= 0) & (columns < shape[1])]
        rows = rows[(rows >= 0) & (rows < shape[0])]
        if not len(columns) or not len(rows):
            continue
        along = np.exp(-0.5 * ((columns - column) / sigma_texels) ** 2)
        below = np.exp(-0.5 * ((rows - row) / sigma_texels) ** 2)
        canvas[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += 190 * np.outer(below, along)
    grey = np.clip(np.rint(canvas), 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)

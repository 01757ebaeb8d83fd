"""Ground through the posts of a raster that has a place on Earth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Transformer
from scipy import ndimage

from calib.camera import FloatArray
from calib.frames import LocalFrame

_PAD = 12  # posts around the raster: the spline's border effects die away within them
#: (x, y) -> (column, row), for arrays too.
_PixelFromCrs = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True)
class PixelMap:
    """Columns and rows of a raster, (0.5, 0.5) its first pixel's centre, as cubic polynomials of the
    position in the local frame: good to a millimetre over some kilometres."""

    reach_m: float
    coefficients: FloatArray  # (10, 2)

    @classmethod
    def fitted(
        cls, crs: CRS, pixel_from_crs: _PixelFromCrs, origin: tuple[float, float], reach_m: float
    ) -> PixelMap:
        """For a raster of a CRS, around ``origin`` (latitude, longitude) and so far each way."""
        ticks = np.linspace(-reach_m, reach_m, 9)
        where = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
        geodetic = LocalFrame(*origin).geodetic(np.column_stack([where, np.zeros(len(where))]))
        x, y = Transformer.from_crs(CRS.from_epsg(4326), crs, always_xy=True).transform(
            geodetic[:, 1], geodetic[:, 0]
        )
        columns, rows = pixel_from_crs(np.asarray(x), np.asarray(y))
        pixels = np.column_stack([columns, rows]).astype(np.float64)
        terms = np.stack(_terms(where[:, 0] / reach_m, where[:, 1] / reach_m), axis=-1)
        coefficients = np.linalg.lstsq(terms, pixels, rcond=None)[0].astype(np.float64)
        return cls(reach_m, coefficients)

    def __call__(self, east_m: FloatArray, north_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Column and row of positions of any equal shape."""
        terms = _terms(np.asarray(east_m) / self.reach_m, np.asarray(north_m) / self.reach_m)
        column, row = (
            np.sum([c * term for c, term in zip(self.coefficients[:, a], terms, strict=True)], axis=0)
            for a in (0, 1)
        )
        return column, row

    @property
    def linear(self) -> FloatArray:
        """d (column, row) / d (east, north) at the origin, (2, 2)."""
        return self.coefficients[1:3].T / self.reach_m


def _terms(x: FloatArray, y: FloatArray) -> list[FloatArray]:
    return [np.ones_like(x), x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3]


@dataclass(frozen=True)
class RasterRelief:
    """A cubic spline through the posts, level beyond the raster's border.

    spline: (rows, columns) coefficients, padded by ``_PAD`` posts; heights in m above the origin's.
    """

    spline: FloatArray
    pixels: PixelMap
    lowest_m: float
    highest_m: float
    steepest: float

    @classmethod
    def through(cls, heights_m: FloatArray, pixels: PixelMap) -> RasterRelief:
        """Through heights (rows, columns) at the raster's pixel centres."""
        spline = ndimage.spline_filter(np.pad(heights_m, _PAD, mode="edge"), order=3, mode="mirror")
        # A B-spline stays within its coefficients, and its slope within their differences.
        per_pixel = np.hypot(*(np.abs(np.diff(spline, axis=axis)).max() for axis in (0, 1)))
        steepest = float(per_pixel * np.linalg.norm(pixels.linear, 2) * 1.001)
        return cls(spline, pixels, float(spline.min()), float(spline.max()), steepest)

    def height_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        return self._spline(east_m, north_m, False)[0]

    def height_and_gradient(
        self, east_m: FloatArray, north_m: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        height, by_row, by_column = self._spline(east_m, north_m, True)
        (column_east, column_north), (row_east, row_north) = self.pixels.linear
        return (
            height,
            by_column * column_east + by_row * row_east,
            by_column * column_north + by_row * row_north,
        )

    def _spline(
        self, east_m: FloatArray, north_m: FloatArray, slopes: bool
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Height and its slopes per pixel down and right; the latter are 0 unless asked for."""
        column, row = self.pixels(east_m, north_m)
        rows, columns = self.spline.shape
        row, column = row - 0.5 + _PAD, column - 0.5 + _PAD
        held_row = np.clip(row, _PAD, rows - 1 - _PAD)
        held_column = np.clip(column, _PAD, columns - 1 - _PAD)
        first_row, first_column = (np.floor(n).astype(np.intp) for n in (held_row, held_column))
        down, down_slope = _weights(held_row - first_row)
        right, right_slope = _weights(held_column - first_column)
        base = (first_row - 1) * columns + first_column - 1
        flat = self.spline.ravel()
        height, by_row, by_column = (np.zeros(np.shape(base)) for _ in range(3))
        for a in range(4):
            value, slope = np.zeros(np.shape(base)), np.zeros(np.shape(base))
            for b in range(4):
                coefficient = flat[base + (a * columns + b)]
                value += right[b] * coefficient
                if slopes:
                    slope += right_slope[b] * coefficient
            height += down[a] * value
            if slopes:
                by_row += down_slope[a] * value
                by_column += down[a] * slope
        return height, by_row * (held_row == row), by_column * (held_column == column)


def _weights(share: FloatArray) -> tuple[list[FloatArray], list[FloatArray]]:
    """Weights of the four coefficients around a place in a cubic B-spline, and their slopes."""
    rest = 1 - share
    weights = [
        rest**3 / 6,
        2 / 3 - share * share * (1 - share / 2),
        2 / 3 - rest * rest * (1 - rest / 2),
        share**3 / 6,
    ]
    slopes = [
        -rest * rest / 2,
        share * (1.5 * share - 2),
        rest * (2 - 1.5 * rest),
        share * share / 2,
    ]
    return weights, slopes

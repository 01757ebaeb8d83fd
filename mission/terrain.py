"""The ground under a mission: a terrain model from a file, or flat.

Heights are "up" in the frame around the launch point, in metres above the ground there, like a
waypoint's ``height_m``. That frame is a plane which leaves the Earth by 2 m at 5 km
(:func:`below_plane_m`). Only differences of altitude count, so a model's vertical datum does not.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import rasterio
from pyproj import Transformer
from pyproj.exceptions import ProjError
from rasterio.enums import Resampling
from rasterio.errors import RasterioError
from rasterio.windows import Window

from calib.camera import FloatArray
from calib.errors import InputError
from calib.frames import LocalFrame

#: Pixels of the window along each side at most; finer models are averaged down to it while reading.
MOST_PIXELS = 3000
#: Read around the asked place as well, for the interpolation.
_EDGE_PIXELS = 2
_EARTH_RADIUS_M = 6_371_000.0
_VERTICAL_UNITS_M = {"ft": 0.3048, "foot": 0.3048, "feet": 0.3048, "us survey foot": 0.3048006096, "cm": 0.01}


def below_plane_m(east_north_m: FloatArray) -> FloatArray:
    """How far a place (..., 2) at the launch point's altitude lies below the plane of the frame."""
    return np.asarray((np.asarray(east_north_m)[..., :2] ** 2).sum(axis=-1) / (2 * _EARTH_RADIUS_M))


class Terrain(Protocol):
    """What the rest of ``mission`` needs of a terrain."""

    @property
    def name(self) -> str:
        """For people: the file, or "flat"."""
        ...

    @property
    def resolution_m(self) -> float:
        """Distance between two heights that are known; infinite for flat ground."""
        ...

    def height_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """Height of the ground (...) above the launch point's at east (...), north (...), all in m.

        Raises:
            InputError: the terrain model does not cover a point.
        """
        ...


@dataclass(frozen=True)
class FlatTerrain:
    """The same height everywhere."""

    name: str = "flat"
    resolution_m: float = math.inf

    def height_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        return np.zeros(np.broadcast(east_m, north_m).shape)


@dataclass(frozen=True, eq=False)
class DemTerrain:
    """A window of a terrain model. ``altitudes_m`` (rows, columns), NaN where nothing is known.

    ``column0, row0``: pixel coordinates of the window's corner; ``factor`` (columns, rows): pixels of
    the file per value. ``to_pixel``: the six numbers of the map -> pixel transform.
    """

    name: str
    frame: LocalFrame
    altitudes_m: FloatArray
    crs: str
    to_pixel: tuple[float, ...]
    column0: float
    row0: float
    factor: tuple[float, float]
    launch_altitude_m: float
    resolution_m: float

    def height_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        points = np.stack(np.broadcast_arrays(east_m, north_m), axis=-1).astype(float)
        flat = points.reshape(-1, 2)
        altitudes = self._altitudes(flat)
        missing = np.isnan(altitudes)
        if missing.any():
            at = self.frame.geodetic(np.append(flat[missing][0], 0.0))
            raise InputError(
                f"The terrain model {self.name} has no height at {at[0]:.6f}, {at[1]:.6f}, "
                f"{np.hypot(*flat[missing][0]):.0f} m from the launch point; take a model that covers "
                "the mission and its margins."
            )
        up = altitudes - self.launch_altitude_m - below_plane_m(flat)
        return up.reshape(points.shape[:-1])

    def _altitudes(self, points_m: FloatArray) -> FloatArray:
        """Bilinear between pixel centres; NaN outside or beside a missing value."""
        column, row = _pixels(self.frame, points_m, self.crs, self.to_pixel)
        x = (column - self.column0) / self.factor[0] - 0.5
        y = (row - self.row0) / self.factor[1] - 0.5
        rows, columns = self.altitudes_m.shape
        # Within half a pixel of the model's edge the outermost value goes on.
        inside = (x > -0.5 - 1e-6) & (x < columns - 0.5 + 1e-6) & (y > -0.5 - 1e-6) & (y < rows - 0.5 + 1e-6)
        x, y = (np.where(inside, v, 0).clip(0, n - 1) for v, n in ((x, columns), (y, rows)))
        i, j = np.minimum(y.astype(int), max(rows - 2, 0)), np.minimum(x.astype(int), max(columns - 2, 0))
        i1, j1 = np.minimum(i + 1, rows - 1), np.minimum(j + 1, columns - 1)
        fy, fx = y - i, x - j
        z = self.altitudes_m
        found = (1 - fy) * ((1 - fx) * z[i, j] + fx * z[i, j1]) + fy * ((1 - fx) * z[i1, j] + fx * z[i1, j1])
        return np.where(inside, found, np.nan)


def load_terrain(path: Path, frame: LocalFrame, bounds_m: tuple[float, float, float, float]) -> DemTerrain:
    """The part of a DEM (GeoTIFF, SRTM .hgt, whatever GDAL reads) inside ``bounds_m``.

    ``bounds_m``: west, south, east, north around the launch point. Only that window is read, so
    the size of the file does not matter.

    Raises:
        InputError: not a raster, no projection, no cover of the launch point or the window.
    """
    if not path.is_file():
        raise InputError(f"There is no terrain model {path}.")
    try:
        with rasterio.open(path) as source:
            return _window(source, path, frame, bounds_m)
    except RasterioError as error:
        raise InputError(f"{path} is no terrain model that can be read (GeoTIFF or SRTM .hgt).") from error
    except ProjError as error:
        raise InputError(f"The projection of the terrain model {path} is not known to fieldcal.") from error


def _window(
    source: Any, path: Path, frame: LocalFrame, bounds_m: tuple[float, float, float, float]
) -> DemTerrain:
    if source.crs is None:
        raise InputError(
            f"The projection of the terrain model {path} is not known: the file does not name it."
        )
    crs = source.crs.to_wkt()
    to_pixel = tuple(float(v) for v in tuple(~source.transform)[:6])
    west, south, east, north = bounds_m
    side = np.linspace(0, 1, 17)
    outline = np.concatenate(
        [
            np.stack([west + (east - west) * x, south + (north - south) * y], axis=-1)
            for x, y in ((side, 0 * side), (side, 0 * side + 1), (0 * side, side), (0 * side + 1, side))
        ]
    )
    column, row = _pixels(frame, np.concatenate([outline, [[0.0, 0.0]]]), crs, to_pixel)
    low = [max(math.floor(v.min()) - _EDGE_PIXELS, 0) for v in (column, row)]
    high = [
        min(math.ceil(v.max()) + _EDGE_PIXELS, n) for v, n in ((column, source.width), (row, source.height))
    ]
    if not np.isfinite([column, row]).all() or high[0] <= low[0] or high[1] <= low[1]:
        raise InputError(
            f"The terrain model {path} does not cover the area around {frame.latitude_deg:.5f}, "
            f"{frame.longitude_deg:.5f}."
        )
    size = [last - first for first, last in zip(low, high, strict=True)]
    shape = [min(n, MOST_PIXELS) for n in size]
    data = source.read(
        1,
        window=Window(low[0], low[1], size[0], size[1]),
        out_shape=(shape[1], shape[0]),
        masked=True,
        resampling=Resampling.average,
    )
    unit = _VERTICAL_UNITS_M.get((source.units[0] or "m").strip().lower(), 1.0)
    altitudes = np.ma.filled(data.astype(float), np.nan) * source.scales[0] + source.offsets[0]
    factor = (size[0] / shape[0], size[1] / shape[1])
    terrain = DemTerrain(
        str(path), frame, altitudes * unit, crs, to_pixel, low[0], low[1], factor, 0.0,
        _resolution_m(frame, crs, to_pixel, factor),
    )  # fmt: skip
    launch = float(terrain._altitudes(np.zeros((1, 2)))[0])
    if math.isnan(launch):
        raise InputError(
            f"The terrain model {path} has no height at the launch point {frame.latitude_deg:.6f}, "
            f"{frame.longitude_deg:.6f}."
        )
    return replace(terrain, launch_altitude_m=launch)


def _resolution_m(
    frame: LocalFrame, crs: str, to_pixel: tuple[float, ...], factor: tuple[float, float]
) -> float:
    """Metres on the ground per value, the coarser side."""
    step = 10.0
    column, row = _pixels(frame, np.array([[0.0, 0.0], [step, 0.0], [0.0, step]]), crs, to_pixel)
    per_metre = np.array([np.diff(column[[0, 1]]), np.diff(row[[0, 2]])])[:, 0] / step
    return float(np.max(np.array(factor) / np.maximum(np.abs(per_metre), 1e-9)))


def _pixels(
    frame: LocalFrame, points_m: FloatArray, crs: str, to_pixel: tuple[float, ...]
) -> tuple[FloatArray, FloatArray]:
    """Ground points (n, 2) -> pixel coordinates, columns (n,) and rows (n,), (0, 0) the outer corner."""
    geodetic = frame.geodetic(np.column_stack([points_m, np.zeros(len(points_m))]))
    x, y = _to_map(crs).transform(geodetic[:, 1], geodetic[:, 0])
    a, b, c, d, e, f = to_pixel
    return a * x + b * y + c, d * x + e * y + f


@functools.lru_cache(maxsize=8)
def _to_map(crs: str) -> Transformer:
    return Transformer.from_crs("EPSG:4326", crs, always_xy=True)


def profile_m(
    terrain: Terrain, start_m: FloatArray, end_m: FloatArray, step_m: float
) -> tuple[FloatArray, FloatArray]:
    """Ground along a straight leg: distances from the start (n,) and heights (n,), in m.

    ``start_m, end_m``: (2,) or (3,), of which east and north are used; samples at most ``step_m`` apart,
    both ends included.
    """
    length = float(np.hypot(*(end_m[:2] - start_m[:2])))
    share = np.linspace(0, 1, max(math.ceil(length / step_m), 1) + 1)
    points = start_m[:2] + share[:, None] * (end_m[:2] - start_m[:2])
    return share * length, terrain.height_m(points[:, 0], points[:, 1])

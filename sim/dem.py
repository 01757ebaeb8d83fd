"""Real ground: heights from a DEM GeoTIFF, colours from an orthophoto GeoTIFF (rasterio's only door)."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from rasterio.enums import Resampling
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.windows import Window
from scipy import ndimage

from calib.camera import FloatArray
from calib.errors import InputError
from sim.raster_relief import PixelMap, RasterRelief
from sim.texture import ByteImage, Image32

_MOST_POSTS = 4000  # each way
_PLAUSIBLE_M = (-500.0, 9000.0)


def dem_ground(path: Path, half_m: float) -> tuple[RasterRelief, tuple[float, float, float]]:
    """Ground around a DEM's middle, and latitude, longitude (deg) and height (m) of that.

    Heights count from the middle's. The Earth's curvature is left out: it is 2 mm at 150 m.

    Raises:
        InputError: the file is missing, no raster, without heights or without a place on Earth.
    """
    with _opened(path, "DEM") as data:
        crs = _crs(data, path, "DEM")
        if min(data.width, data.height) < 4:
            raise InputError(
                f"The DEM {path} has only {data.width} x {data.height} posts: at least 4 x 4 are needed."
            )
        middle = _apply(data.transform)(data.width / 2, data.height / 2)
        longitude, latitude = _geodetic(crs, middle, path, "DEM")
        pixel_from_crs = ~data.transform
        near = PixelMap.fitted(crs, _apply(pixel_from_crs), (latitude, longitude), 100.0)
        # So many posts are needed each way; a DEM of a whole county is not read.
        reach = int(np.ceil(1.5 * half_m * np.abs(near.linear).sum(axis=1).max())) + 2
        reach = min(reach, _MOST_POSTS // 2)
        first_column, first_row = (max(n // 2 - reach, 0) for n in (data.width, data.height))
        last_column, last_row = (min(n // 2 + reach, n) for n in (data.width, data.height))
        window = Window(first_column, first_row, last_column - first_column, last_row - first_row)
        values, there = _read(data, path, "DEM", window, [1], None)
    heights = np.where(there, values[0], np.nan).astype(np.float64)
    heights[(heights < _PLAUSIBLE_M[0]) | (heights > _PLAUSIBLE_M[1])] = np.nan
    missing = ~np.isfinite(heights)
    if missing.all():
        raise InputError(f"The DEM {path} holds no heights in its middle: choose another file or crop it.")
    if missing.any():
        nearest = ndimage.distance_transform_edt(missing, return_distances=False, return_indices=True)
        heights = heights[tuple(nearest)]
    pixels = PixelMap.fitted(
        crs, _apply(pixel_from_crs, first_column, first_row), (latitude, longitude), max(1.5 * half_m, 100.0)
    )
    absolute = RasterRelief.through(heights, pixels)
    datum_m = float(absolute.height_m(np.zeros(1), np.zeros(1))[0])
    return RasterRelief.through(heights - datum_m, pixels), (latitude, longitude, datum_m)


def ortho_colours(
    path: Path, origin_wgs84: tuple[float, float, float], under: ByteImage, texel_m: float
) -> ByteImage:
    """``under`` (side, side, 3), whose middle is the origin, painted over where the orthophoto reaches.

    Raises:
        InputError: the file is missing, no colour raster, or somewhere else on Earth.
    """
    with _opened(path, "orthophoto") as data:
        crs = _crs(data, path, "orthophoto")
        if data.count not in (1, 3, 4) or data.dtypes[0] not in ("uint8", "uint16"):
            raise InputError(
                f"The orthophoto {path} has {data.count} bands of {data.dtypes[0]}: "
                "1, 3 or 4 bands of 8 or 16 bits are needed."
            )
        half_m = len(under) * texel_m / 2
        full = PixelMap.fitted(crs, _apply(~data.transform), origin_wgs84[:2], half_m)
        corners = np.array([[-1.0, -1], [-1, 1], [1, -1], [1, 1], [0, 1], [0, -1], [1, 0], [-1, 0]]) * half_m
        columns, rows = full(corners[:, 0], corners[:, 1])
        left, top = (int(max(np.floor(n.min()) - 2, 0)) for n in (columns, rows))
        right, bottom = int(min(columns.max() + 2, data.width)), int(min(rows.max() + 2, data.height))
        if right - left < 4 or bottom - top < 4:
            raise InputError(f"The orthophoto {path} does not cover the middle of the DEM: are they a pair?")
        window = Window(left, top, right - left, bottom - top)
        # No finer than the world's texels: a raster of millimetres is read reduced.
        shrink = max((right - left) / len(under), (bottom - top) / len(under), 1.0)
        shape = (max(int((bottom - top) / shrink), 4), max(int((right - left) / shrink), 4))
        bands = [1, 2, 3] if data.count >= 3 else [1]
        read, there = _read(data, path, "orthophoto", window, bands, shape)
        deep = data.dtypes[0] == "uint16"
    scale = 255 / max(float(np.percentile(read, 99.9)), 1.0) if deep else 1.0
    colours = np.clip(read * scale, 0, 255).astype(np.uint8)
    valid = there.astype(np.uint8)
    photo = np.ascontiguousarray(np.moveaxis(colours, 0, -1))
    if len(bands) == 1:
        photo = np.repeat(photo, 3, axis=2)
    to_read = (shape[1] / (right - left), shape[0] / (bottom - top))
    canvas = under.copy()
    ticks = (np.arange(len(under)) + 0.5) * texel_m - half_m
    for first in range(0, len(under), 256):
        east, north = np.meshgrid(ticks, -ticks[first : first + 256])
        column, row = full(east, north)
        # cv2.remap counts from the centre of the first pixel: half a pixel less.
        place = [((column - left) * to_read[0] - 0.5), ((row - top) * to_read[1] - 0.5)]
        u, v = (axis.astype(np.float32) for axis in place)
        found = cv2.remap(photo, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        there = cv2.remap(valid, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0) > 0
        canvas[first : first + 256][there] = found[there]
    return canvas


def _apply(transform: rasterio.Affine, left: float = 0.0, top: float = 0.0) -> Callable[..., Any]:
    """The transform of numbers or arrays, counted from ``left`` and ``top``."""

    def applied(x: FloatArray | float, y: FloatArray | float) -> tuple[Any, Any]:
        t = transform
        return t.a * x + t.b * y + t.c - left, t.d * x + t.e * y + t.f - top

    return applied


def _opened(path: Path, what: str) -> rasterio.DatasetReader:
    if not path.is_file():
        raise InputError(f"The {what} {path} is not there.")
    try:
        with warnings.catch_warnings():
            # A raster without a place on Earth is told to the user as an error of ours.
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            return rasterio.open(path)
    except RasterioError as error:
        raise InputError(f"The {what} {path} cannot be read as a GeoTIFF.") from error


def _crs(data: rasterio.DatasetReader, path: Path, what: str) -> CRS:
    if data.crs is None or data.transform.is_identity:
        raise InputError(
            f"The {what} {path} does not say where on Earth it is: it has no coordinate reference system."
        )
    try:
        return CRS.from_wkt(data.crs.to_wkt())
    except (ProjError, RasterioError) as error:
        raise InputError(
            f"The coordinate reference system of the {what} {path} is not understood."
        ) from error


def _geodetic(crs: CRS, position: tuple[float, float], path: Path, what: str) -> tuple[float, float]:
    """Longitude and latitude (deg) of a position in a CRS."""
    longitude, latitude = Transformer.from_crs(crs, CRS.from_epsg(4326), always_xy=True).transform(*position)
    if not (np.isfinite(longitude) and abs(latitude) < 89.9):
        raise InputError(f"The {what} {path} lies at no place on Earth: its coordinates are wrong.")
    return float(longitude), float(latitude)


def _read(
    data: rasterio.DatasetReader,
    path: Path,
    what: str,
    window: Window,
    bands: list[int],
    shape: tuple[int, int] | None,
) -> tuple[Image32, NDArray[np.bool_]]:
    """Values (bands, rows, columns) of a window, resampled to ``shape``, and where there are any."""
    resampled = None if shape is None else (len(bands), *shape)
    try:
        values = data.read(bands, window=window, out_shape=resampled, resampling=Resampling.average)
        there = data.dataset_mask(window=window, out_shape=shape) > 0
    except RasterioError as error:
        raise InputError(f"The {what} {path} is damaged: its data cannot be read.") from error
    return np.asarray(values, np.float32), np.asarray(there)

"""Height models as GeoTIFF through rasterio: the centres of the cells that have a height."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rasterio
from pyproj import CRS
from pyproj.exceptions import CRSError
from rasterio.errors import RasterioError
from rasterio.windows import Window

from calib.camera import FloatArray
from calib.clouds.kinds import CloudFile, Kind
from calib.errors import InputError


def describe(path: Path) -> CloudFile:
    with _errors(path), rasterio.open(path) as source:
        if source.count != 1:
            raise InputError(
                f"{path} has {source.count} bands: it is a picture, not a height model with one band."
            )
        try:
            crs = None if source.crs is None else CRS.from_user_input(source.crs.to_wkt())
        except CRSError:
            crs = None
        return CloudFile(path, Kind.GEOTIFF, crs, source.width * source.height)


def chunks(cloud: CloudFile, size: int) -> Iterator[FloatArray]:
    with _errors(cloud.path), rasterio.open(cloud.path) as source:
        rows = max(1, size // source.width)
        for top in range(0, source.height, rows):
            window = Window(0, top, source.width, min(rows, source.height - top))
            heights = source.read(1, window=window, masked=True).astype(float)
            row, column = np.nonzero(~np.ma.getmaskarray(heights))
            to_map, u, v = source.transform, column + 0.5, row + top + 0.5
            x, y = to_map.a * u + to_map.b * v + to_map.c, to_map.d * u + to_map.e * v + to_map.f
            yield np.column_stack([x, y, heights.data[row, column]])


@contextmanager
def _errors(path: Path) -> Iterator[None]:
    try:
        yield
    except RasterioError as error:
        raise InputError(f"{path} is damaged or no GeoTIFF that can be read; export it again.") from error

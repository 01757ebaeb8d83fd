"""One door to all cloud files: what kind it is, where it lies, and its points in pieces.

LAS and LAZ (laspy), PLY, text (XYZ, CSV) and GeoTIFF (rasterio; the cells' centres are the points). The kind
is told by the content, not by the name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from calib.camera import FloatArray
from calib.clouds import las, ply, raster, xyz
from calib.clouds.kinds import CloudFile, Kind
from calib.errors import InputError
from calib.files import staged
from calib.similarity import Similarity

#: Points kept in memory at most (12 bytes each); of larger clouds every second, third, ... is taken.
MOST_POINTS = 50_000_000
#: Points of a piece.
CHUNK = 1_000_000
_READERS: dict[Kind, ModuleType] = {
    Kind.LAS: las,
    Kind.LAZ: las,
    Kind.PLY: ply,
    Kind.XYZ: xyz,
    Kind.GEOTIFF: raster,
}
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


@dataclass(frozen=True)
class LoadedCloud:
    """Points of a cloud in memory: ``xyz`` (n, 3) single precision, about ``origin`` (3,).

    ``total``: points in the file with numbers for coordinates; ``not_numbers``: those without;
    ``step``: every how manieth was kept.
    """

    file: CloudFile
    origin: FloatArray
    xyz: NDArray[np.float32]
    total: int
    not_numbers: int
    step: int
    notes: tuple[str, ...] = field(default=())

    def blocks(self, size: int = CHUNK) -> Iterator[FloatArray]:
        """The points (b, 3) about ``origin`` in double precision, piece by piece."""
        for start in range(0, len(self.xyz), size):
            yield self.xyz[start : start + size].astype(float)


def open_cloud(path: Path) -> CloudFile:
    """What a file is, without reading its points.

    Raises:
        InputError: no such file, empty, not a cloud, damaged header; one sentence.
    """
    try:
        if path.is_dir():
            raise InputError(f"{path} is a folder; give the cloud's file.")
        size = path.stat().st_size
        with path.open("rb") as file:
            start = file.read(4096)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {(error.strerror or str(error)).lower()}.") from error
    if size == 0:
        raise InputError(f"{path} is empty.")
    if start.startswith(b"LASF"):
        return las.describe(path)
    if start.startswith((b"ply\n", b"ply\r\n")):
        return ply.describe(path)
    if start.startswith(_TIFF):
        return raster.describe(path)
    if start.startswith(b"ASTM-E57"):
        raise InputError(f"{path} is an E57 file, which fieldcal does not read; save it as LAZ, LAS or PLY.")
    if b"\0" in start:
        raise InputError(f"{path} is not a point cloud that fieldcal reads (LAS, LAZ, PLY, XYZ, GeoTIFF).")
    return xyz.describe(path)


def chunks(cloud: CloudFile, size: int = CHUNK) -> Iterator[FloatArray]:
    """All points (b, 3) piece by piece, as they are in the file, NaN included.

    Raises:
        InputError: the file is damaged or cut off.
    """
    pieces: Iterator[FloatArray] = _READERS[cloud.kind].chunks(cloud, size)
    return pieces


def load_cloud(
    cloud: CloudFile, most: int = MOST_POINTS, tick: Callable[[int], None] | None = None
) -> LoadedCloud:
    """Read a cloud into memory, at most ``most`` points of it. ``tick`` hears how many were read.

    Raises:
        InputError: damaged, or no point has numbers for coordinates.
    """
    step = 1 if cloud.count is None else max(1, -(-cloud.count // most))
    kept: list[NDArray[np.float32]] = []
    origin: FloatArray | None = None
    total = seen = held = 0
    for piece in chunks(cloud):
        seen += len(piece)
        good = piece[np.isfinite(piece).all(axis=1)]
        if len(good):
            if origin is None:
                origin = np.floor(good[0])
            first = -total % step
            part = (good[first::step] - origin).astype(np.float32)
            total += len(good)
            held += len(part)
            kept.append(part)
            while held > most:
                # The count was not known beforehand; from here on half as many.
                kept = [np.concatenate(kept)[::2]]
                held, step = len(kept[0]), 2 * step
        if tick is not None:
            tick(seen)
    if origin is None:
        raise InputError(f"{cloud.path} holds no point with numbers for coordinates.")
    notes = list(cloud.notes)
    if seen > total:
        notes.append(f"{seen - total} of {seen} points have no number for a coordinate and are left out.")
    if step > 1:
        notes.append(f"The cloud has {total} points; one in {step} was used.")
    joined = kept[0] if len(kept) == 1 else np.concatenate(kept)
    return LoadedCloud(cloud, origin, joined, total, seen - total, step, tuple(notes))


def rewrite(cloud: CloudFile, out: Path, moved: Similarity, size: int = CHUNK) -> None:
    """Write the cloud to ``out``, in its own format, with every point moved; all else stays as it is.

    ``out`` is there whole or not at all.

    Raises:
        InputError: the cloud is damaged, or a GeoTIFF (a tilted grid is no grid).
        OutputError: ``out`` cannot be written.
    """
    if cloud.kind is Kind.GEOTIFF:
        raise InputError(
            f"{cloud.path} is a GeoTIFF: its grid cannot be turned; correct the cloud that it was made from."
        )
    with staged(out) as fresh:
        _READERS[cloud.kind].rewrite(cloud, fresh, moved, size)

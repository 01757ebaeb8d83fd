"""What is known of a cloud file before its points are read."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from pyproj import CRS

from calib.camera import FloatArray

#: Coordinates kept as 32 bit floats are steps this much too coarse beyond.
_COARSE_FLOAT32 = 100_000.0


class Kind(StrEnum):
    LAS = "LAS"
    LAZ = "LAZ"
    PLY = "PLY"
    XYZ = "text"
    GEOTIFF = "GeoTIFF"


@dataclass(frozen=True)
class CloudFile:
    """A cloud file. ``crs``: None where the file names none; ``count``: None where it is not said."""

    path: Path
    kind: Kind
    crs: CRS | None = None
    count: int | None = None
    notes: tuple[str, ...] = ()


def coarse_float32(first: FloatArray) -> str | None:
    """A warning where coordinates (3,) are too large for the 32 bit floats that they are written in."""
    largest = float(abs(first).max())
    if largest < _COARSE_FLOAT32:
        return None
    step = 2.0**-23 * largest
    return (
        f"The file holds coordinates near {largest:.0f} as 32 bit floats, in steps of about {step:.2g} m: "
        "export it with 64 bit floats, as LAZ, or with a local origin."
    )

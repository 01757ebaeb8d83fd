"""Photos for the eye, whatever their size: halved again and again, in tiles; thumbnails and cut-outs.

Pixels stay as stored: the orientation in the metadata is for whoever shows them.
"""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from calib.errors import PhotoError

Picture = NDArray[np.uint8]
TILE_PX = 512
_QUALITY = 92
#: Grey values of deeper pictures (thermal) are stretched between these percentiles.
_STRETCH = (0.5, 99.5)


def decode(path: Path, longer_side_px: int | None = None) -> Picture:
    """Pixels (h, w, 3) red, green, blue as stored, reduced to ``longer_side_px`` where that is less.

    Raises:
        PhotoError: the image data cannot be decoded; one sentence.
    """
    try:
        with Image.open(path) as image:
            if longer_side_px is not None:
                image.draft("RGB", (longer_side_px, longer_side_px))
            deep = image.mode.startswith(("I", "F"))
            picture = _stretched(np.asarray(image, np.float32)) if deep else np.asarray(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise PhotoError(
            f"{path}: the image data cannot be decoded; copy the file from the card again."
        ) from error
    if longer_side_px is None or max(picture.shape[:2]) <= longer_side_px:
        return picture
    small = Image.fromarray(picture)
    small.thumbnail((longer_side_px, longer_side_px), reducing_gap=2)
    return np.asarray(small)


def levels(picture: Picture) -> tuple[Picture, ...]:
    """The picture, half of it, a quarter, ... until one tile holds it; sizes are rounded up."""
    found = [picture]
    while max(found[-1].shape[:2]) > TILE_PX:
        height, width = ((size + 1) // 2 for size in found[-1].shape[:2])
        found.append(
            np.asarray(cv2.resize(found[-1], (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        )
    return tuple(found)


def tile(level: Picture, column: int, row: int) -> bytes | None:
    """A tile as JPEG; None outside of the picture."""
    part = level[row * TILE_PX : (row + 1) * TILE_PX, column * TILE_PX : (column + 1) * TILE_PX]
    return jpeg(part) if part.size else None


def cut_out(picture: Picture, u: int, v: int, half_px: int) -> bytes:
    """A square around the pixel (u, v) as JPEG, grey beyond the picture's edge."""
    made = np.full((2 * half_px, 2 * half_px, 3), 128, np.uint8)
    height, width = picture.shape[:2]
    left, top = max(u - half_px, 0), max(v - half_px, 0)
    right, bottom = min(u + half_px, width), min(v + half_px, height)
    if left < right and top < bottom:
        rows, columns = (
            slice(top - v + half_px, bottom - v + half_px),
            slice(left - u + half_px, right - u + half_px),
        )
        made[rows, columns] = picture[top:bottom, left:right]
    return jpeg(made)


def jpeg(picture: Picture) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "JPEG", quality=_QUALITY, subsampling=0)
    return file.getvalue()


def _stretched(gray: NDArray[np.float32]) -> Picture:
    finite = gray[np.isfinite(gray)]
    low, high = np.percentile(finite, _STRETCH) if finite.size else (0.0, 1.0)
    scaled = np.clip((np.nan_to_num(gray) - low) / max(float(high - low), 1e-6), 0, 1)
    made = (255 * scaled).astype(np.uint8)
    return np.repeat(made[..., None], 3, axis=2)

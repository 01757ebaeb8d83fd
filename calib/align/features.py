"""Features of one photo: decode once on reduced scale, SIFT, spread over the image.

Keypoints are returned in pixels of the full-size image in fieldcal's convention (first pixel
centred on 0.5, 0.5); OpenCV's convention (0, 0) ends in this module.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.camera import FloatArray
from calib.errors import PhotoError
from calib.photos.photo import Photo
from calib.photos.radiometric import grey

#: Longer side of the image that features are sought on. SIFT doubles it inside.
WORKING_SIDE_PX = 1600
MAX_FEATURES = 6000
COARSE_FEATURES = 1200


@dataclass(frozen=True)
class Features:
    """pixels (n, 2) full-size px; scale_px (n,) feature diameter in full-size px; descriptors
    (n, 128) RootSIFT, unit length; ``coarse`` (c,) indices of the few that are matched first."""

    pixels: FloatArray
    scale_px: FloatArray
    descriptors: NDArray[np.float32]
    coarse: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.pixels)


def decode_gray(path: Path, longer_side_px: int | None) -> tuple[NDArray[np.uint8], float]:
    """Grayscale pixels as stored (EXIF orientation ignored) and the factor reduced / full size.

    Args:
        longer_side_px: reduce to at most this (None: full size).

    Raises:
        PhotoError: the image data cannot be decoded.
    """
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise PhotoError(f"{path}: cannot be read ({error.strerror}).") from error
    try:
        image = cv2.imdecode(data, flags) if len(data) else None
    except cv2.error:  # A size that it refuses to allocate.
        image = None
    if image is None:
        raise PhotoError(f"{path}: the image data cannot be decoded; copy the file from the card again.")
    full = np.asarray(image, dtype=np.uint8)
    if longer_side_px is None or max(full.shape) <= longer_side_px:
        return full, 1.0
    return reduced(full, longer_side_px), longer_side_px / max(full.shape)


def photo_gray(photo: Photo, longer_side_px: int | None) -> tuple[NDArray[np.uint8], float]:
    """As :func:`decode_gray`; of thermal photos the raw counts, stretched alike in the whole set.

    Raises:
        PhotoError: the image data cannot be decoded.
    """
    counts = grey(photo)
    if counts is None:
        return decode_gray(photo.path, longer_side_px)
    if longer_side_px is None or max(counts.shape) <= longer_side_px:
        return counts, 1.0
    return reduced(counts, longer_side_px), longer_side_px / max(counts.shape)


def reduced(image: NDArray[np.uint8], longer_side_px: int) -> NDArray[np.uint8]:
    """``image`` averaged down to a longer side of ``longer_side_px`` (as it is where it is smaller)."""
    factor = longer_side_px / max(image.shape)
    if factor >= 1:
        return image
    size = (round(image.shape[1] * factor), round(image.shape[0] * factor))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _spread(pixels: FloatArray, response: FloatArray, count: int, shape: tuple[int, int]) -> NDArray[np.intp]:
    """Indices of ``count`` strong features, spread over a grid of cells."""
    if len(pixels) <= count:
        return np.arange(len(pixels))
    cells = 24
    column = np.minimum((pixels[:, 0] * cells / shape[1]).astype(int), cells - 1)
    row = np.minimum((pixels[:, 1] * cells / shape[0]).astype(int), cells - 1)
    order = np.lexsort((-response, row * cells + column))
    cell = (row * cells + column)[order]
    rank = np.arange(len(order)) - np.searchsorted(cell, cell)
    # The best of every cell first, then the second best of every cell, ...
    chosen = order[np.lexsort((-response[order], rank))][:count]
    return np.sort(chosen)


def extract(gray: NDArray[np.uint8], factor: float) -> Features:
    """SIFT features of a reduced grayscale image (``factor`` = reduced / full size)."""
    height, width = gray.shape
    # Dull, hazy or thermal pictures have contrast in few grey levels only.
    low, high = np.percentile(gray[::8, ::8], [1, 99])
    contrast = 0.03 if high - low > 60 else 0.01
    # Without the precise upscale OpenCV's keypoints are off by a quarter pixel, the same way in
    # every image: unseen between photos flown alike, half a pixel between opposite headings.
    keypoints, descriptors = cv2.SIFT.create(
        contrastThreshold=contrast, enable_precise_upscale=True
    ).detectAndCompute(gray, None)
    if descriptors is None or not keypoints:
        empty = np.zeros((0, 2))
        return Features(empty, np.zeros(0), np.zeros((0, 128), np.float32), np.zeros(0, np.intp))
    position = np.array([k.pt for k in keypoints])
    scale = np.array([k.size for k in keypoints])
    response = np.array([k.response for k in keypoints])
    # One place can give several orientations; keep one feature each for tracks' sake.
    _, unique = np.unique(np.round(position * 4).astype(np.int64), axis=0, return_index=True)
    kept = unique[_spread(position[unique], response[unique], MAX_FEATURES, (height, width))]
    position, scale, response = position[kept], scale[kept], response[kept]
    root = np.sqrt(descriptors[kept] / np.maximum(descriptors[kept].sum(axis=1, keepdims=True), 1e-9))
    coarse = _spread(position, response * np.sqrt(scale), COARSE_FEATURES, (height, width))
    # OpenCV: centre of the first pixel is 0; here it is 0.5. The half pixel is one of the reduced image.
    full = (position + 0.5) / factor
    return Features(full, scale / factor, np.asarray(root, np.float32), coarse)

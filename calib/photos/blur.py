"""Sharpness of a reduced grayscale image, and which photos of a set are blurred.

Photographed ground has about as much contrast at one scale as at twice that scale, so the ratio
of fine to coarse differences hardly depends on what is in the picture, while blur takes the fine
ones away. Motion blur takes them away along one direction only, so the worst direction counts.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

#: Directions (rows, columns) in which differences are taken.
_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
#: Blurred: below this share of the set's median, and below this ratio in absolute terms.
RELATIVE_LIMIT = 0.6
ABSOLUTE_LIMIT = 0.3


def sharpness(gray: NDArray[np.uint8]) -> float:
    """Ratio of fine to coarse contrast, in the direction where it is least.

    Args:
        gray: image (rows, columns), reduced to 1000-1600 px; at least 32 px each way.

    Returns:
        About 0.3-0.6 for a sharp photo, 0.1-0.2 for a blurred one; NaN for an image without
        contrast, of which nothing can be said.
    """
    image = np.asarray(gray, dtype=np.float32)
    if min(image.shape) < 32:
        return float("nan")
    ratios = []
    for rows, columns in _DIRECTIONS:
        fine = _second_difference(image, rows, columns, 1)
        coarse = _second_difference(image, rows, columns, 4)
        if coarse < 0.5:
            return float("nan")
        ratios.append(fine / coarse)
    return float(min(ratios))


def _second_difference(image: NDArray[np.float32], rows: int, columns: int, step: int) -> float:
    """Mean absolute second difference along a direction; every second row, which is plenty."""
    dy, dx = rows * step, columns * step
    height, width = image.shape
    margin = 4
    y = slice(margin, height - margin, 2)
    x = slice(margin, width - margin)

    def shifted(by_y: int, by_x: int) -> NDArray[np.float32]:
        return image[y.start + by_y : y.stop + by_y : 2, x.start + by_x : x.stop + by_x]

    return float(np.abs(2 * image[y, x] - shifted(dy, dx) - shifted(-dy, -dx)).mean())


def blurred(values: Sequence[float]) -> NDArray[np.bool_]:
    """Which photos of one flight are blurred, from their sharpness (n,) -> (n,).

    Only photos that fall far behind the set (less than 0.6 of the median, and more than five robust
    standard deviations below it) and are blurred in absolute terms; unknown (NaN) ones never.
    """
    sharp = np.asarray(values, dtype=float)
    known = sharp[np.isfinite(sharp)]
    if len(known) < 4:
        return np.zeros(sharp.shape, dtype=bool)
    median = float(np.median(known))
    spread = 1.4826 * float(np.median(np.abs(known - median)))
    limit = min(RELATIVE_LIMIT * median, median - 5 * spread, ABSOLUTE_LIMIT)
    return np.where(np.isfinite(sharp), sharp, np.inf) < limit

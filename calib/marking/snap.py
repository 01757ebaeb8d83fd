"""A mark set by hand moved onto what it was meant for: the middle of a target, or a corner.

Pixels count from the corner of the first pixel, as everywhere; OpenCV's count from its middle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.camera import FloatArray
from calib.marking.pictures import Picture

#: Grey (h, w).
Gray = NDArray[np.uint8]
#: A target or corner stands out from its surroundings by so many grey values at least.
_LEAST_CONTRAST = 15.0
#: And a target by so many times the median spread of what is around it.
_LEAST_CLARITY = 6.0
_LEAST_AREA_PX = 9
#: Share of the contrast by which background and target may vary without drawing the centroid.
_UNEVEN = 0.15
#: A click as far from a target's rim is still meant for it, px (and half the target's radius).
_BESIDE_PX = 3.0
#: Area of a blob over that of the ellipse with its moments: 1 for ellipses, 0.95 for squares.
_ELLIPTIC = (0.86, 1.14)
_LONGEST_ASPECT = 5.0
#: Share of the gradients that miss a corner's tip: 0 at a crossing of edges, about 1 in the middle of a disc.
_MOST_MISSING = 0.08
#: Smaller over larger eigenvalue of the gradients around a corner; on a plain edge nearly 0.
_LEAST_CORNERED = 0.06


@dataclass(frozen=True)
class Snapped:
    """Where a mark went, px, and onto what."""

    u_px: float
    v_px: float
    onto: Literal["target", "corner"]


def snap(picture: Picture, u_px: float, v_px: float, reach_px: float) -> Snapped | None:
    """The nearest middle of a target or tip of a corner within ``reach_px``; None where there is neither.

    ``picture`` (h, w, 3). Targets are blobs of one brightness on another (discs, squares) that were clicked
    on or nearly: centroid weighted by grey values. Corners are where edges meet: the point that all
    gradients around it are at right angles to (``cornerSubPix``).
    """
    half = math.ceil(2 * reach_px) + 4
    left, top = max(int(u_px) - half, 0), max(int(v_px) - half, 0)
    cut = picture[top : int(v_px) + half + 1, left : int(u_px) + half + 1]
    if min(cut.shape[:2]) < 12:
        return None
    part = np.asarray(cv2.cvtColor(cut, cv2.COLOR_RGB2GRAY), np.uint8)
    # In the crop, in OpenCV's pixels.
    at = np.array([u_px - left - 0.5, v_px - top - 0.5])
    best: Snapped | None = None
    least = reach_px
    for onto, found in (("target", _target(part, at)), ("corner", _corner(part, at, reach_px))):
        if found is None:
            continue
        distance = float(np.hypot(*(found - at)))
        if distance <= least:
            least = distance
            u, v = found + 0.5 + [left, top]
            best = Snapped(float(u), float(v), "target" if onto == "target" else "corner")
    return best


def _target(part: Gray, at: FloatArray) -> FloatArray | None:
    """Centroid (2,) of the blob that was clicked on, or nearly: dark or bright, whole within the crop."""
    threshold, bright = cv2.threshold(part, 0, 1, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    best, least = None, math.inf
    for mask in (bright, 1 - bright):
        number, labels, stats, middles = cv2.connectedComponentsWithStats(
            mask.astype(np.uint8), connectivity=4
        )
        for label in range(1, number):
            left, top, width, height, area = stats[label]
            inside = left > 0 and top > 0 and left + width < part.shape[1] and top + height < part.shape[0]
            distance = float(np.hypot(*(middles[label] - at)))
            inside = inside and distance < 0.75 * max(width, height) + _BESIDE_PX
            if inside and area >= _LEAST_AREA_PX and distance < least and _is_round(labels == label):
                found = _centroid(part, labels == label, threshold)
                if found is not None:
                    best, least = found, distance
    return best


def _is_round(blob: NDArray[np.bool_]) -> bool:
    rows, columns = np.nonzero(blob)
    # A pixel is a square of its own, hence the twelfth.
    spread = np.cov(np.stack([columns, rows]), ddof=0) + np.eye(2) / 12
    small, large = np.linalg.eigvalsh(spread)
    ellipse = 4 * math.pi * math.sqrt(small * large)
    return bool(_ELLIPTIC[0] < len(rows) / ellipse < _ELLIPTIC[1] and large < _LONGEST_ASPECT**2 * small)


def _centroid(part: Gray, blob: NDArray[np.bool_], threshold: float) -> FloatArray | None:
    """Weighted by how far each pixel is from the background's grey to the target's."""
    around = cv2.dilate(blob.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    further = cv2.dilate(around.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    rim = part[further & ~around]
    # The background is what lies on the other side of the threshold; neighbours of the target's own
    # brightness (a frame, another target) are not.
    bright = bool(part[blob].mean() > threshold)
    rim = rim[(rim <= threshold) == bright]
    if not len(rim):
        return None
    background, own = float(np.median(rim)), float(np.median(part[blob]))
    spread = float(np.median(np.abs(rim - background)))
    if abs(own - background) < max(_LEAST_CONTRAST, _LEAST_CLARITY * spread):
        return None
    share = (part.astype(float) - background) / (own - background)
    # Unevenness of background and target is cut off; only the rim counts by halves.
    weight = np.clip((share - _UNEVEN) / (1 - 2 * _UNEVEN), 0, 1) * around
    rows, columns = np.mgrid[: part.shape[0], : part.shape[1]]
    middle: FloatArray = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
    return middle


def _corner(part: Gray, at: FloatArray, reach_px: float) -> FloatArray | None:
    """Tip (2,) of the corner nearest to ``at``."""
    size = int(np.clip(round(reach_px / 2), 3, 8))
    room = size + 2
    shape = np.array(part.shape[::-1])
    if (at < room).any() or (at > shape - 1 - room).any():
        return None
    start = _strongest(part, at, reach_px)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 0.005)
    first = start.astype(np.float32).reshape(1, 1, 2)
    found = cv2.cornerSubPix(part, first, (size, size), (-1, -1), criteria).reshape(2).astype(float)
    if (found < room).any() or (found > shape - 1 - room).any():
        return None
    return found if _is_corner(part, found, size) else None


def _strongest(part: Gray, at: FloatArray, reach_px: float) -> FloatArray:
    """The pixel within reach where edges of two directions are strongest, nearer ones preferred."""
    strength = cv2.cornerMinEigenVal(cv2.GaussianBlur(part, (0, 0), 1), 5)
    rows, columns = np.mgrid[: part.shape[0], : part.shape[1]]
    distance = np.hypot(columns - at[0], rows - at[1])
    weighed = strength * np.clip(1 - distance / (1.2 * reach_px), 0, None)
    row, column = np.unravel_index(int(weighed.argmax()), weighed.shape)
    return np.array([column, row], float)


def _is_corner(part: Gray, tip: FloatArray, size: int) -> bool:
    """Whether edges of two directions meet at ``tip``, and hardly any edge passes it by."""
    column, row = np.round(tip).astype(int)
    window = part[row - size - 1 : row + size + 2, column - size - 1 : column + size + 2].astype(float)
    if np.ptp(window) < 2 * _LEAST_CONTRAST:
        return False
    gradient = np.stack(
        [(window[1:-1, 2:] - window[1:-1, :-2]) / 2, (window[2:, 1:-1] - window[:-2, 1:-1]) / 2], -1
    )
    ticks = np.arange(-size, size + 1)
    away = np.stack(np.meshgrid(ticks + column - tip[0], ticks + row - tip[1]), axis=-1)
    distance = np.maximum(np.linalg.norm(away, axis=-1), 1.0)
    towards = np.sum(gradient * away, axis=-1) / distance
    # Where edges meet they turn within a pixel or two: not counted.
    counted = distance > 1.5
    total = float(np.sum(gradient[counted] ** 2))
    small, large = np.linalg.eigvalsh(np.einsum("ni,nj->ij", gradient[counted], gradient[counted]))
    return bool(np.sum(towards[counted] ** 2) < _MOST_MISSING * total and small > _LEAST_CORNERED * large)

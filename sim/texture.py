"""Rasters on a plane, averaged over a pixel's footprint at any distance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.camera import FloatArray

ByteImage = NDArray[np.uint8]
Image32 = NDArray[np.float32]

_ROWS = 1024  # cv2.remap takes no more than 32767 rows or columns: lists are folded to this width
_TILE = 2048
_FINEST_M = 0.0004


@dataclass(frozen=True)
class Texture:
    """Colours on a plane with axes s (right) and t (up), m.

    pyramid: RGB rasters (rows, columns, 3), row 0 at the top, each level half the one before.
    ``left_m``, ``top_m``: s of the left and t of the upper border. Beyond its border the raster is
    mirrored. ``detail_seed``: grain finer than the texels, made up where photos are near enough to
    see it; None leaves it out.
    """

    pyramid: tuple[ByteImage, ...]
    texel_m: float
    left_m: float
    top_m: float
    detail_seed: int | None = None

    def colours(self, s: FloatArray, t: FloatArray, slopes: tuple[FloatArray, ...]) -> Image32:
        """Colours (h, w, 3) at positions (h, w): the mean of four samples in the pixel's footprint,
        bilinear between texels and between levels.

        slopes: ds/du, ds/dv, dt/du, dt/dv (m per px), (h, w) each, u along rows and v down columns.
        """
        # Samples are half a pixel apart; the level's texels are as large as their spacing, for
        # oblique views the geometric mean of both directions.
        s_u, s_v, t_u, t_v = slopes
        spacing = 0.5 * np.sqrt(np.abs(s_u * t_v - s_v * t_u) + 1e-14)
        total = _averaged(self.pyramid, self.texel_m, s - self.left_m, self.top_m - t, slopes, spacing, False)
        if self.detail_seed is not None:
            self._add_detail(total, s, t, slopes, spacing)
        return total

    def _add_detail(
        self,
        total: Image32,
        s: FloatArray,
        t: FloatArray,
        slopes: tuple[FloatArray, ...],
        spacing: FloatArray,
    ) -> None:
        texel = self.texel_m / 32
        nearest = float(spacing.min())
        layer = 0
        while texel > _FINEST_M / 2 and nearest < 8 * texel:
            # Each layer is turned by another angle, so that the tiles never repeat together.
            turn = 0.7 + 1.9 * layer
            cos, sin = np.cos(turn), np.sin(turn)
            s_u, s_v, t_u, t_v = slopes
            turned = (
                cos * s_u - sin * t_u,
                cos * s_v - sin * t_v,
                sin * s_u + cos * t_u,
                sin * s_v + cos * t_v,
            )
            right, down = cos * s - sin * t, -(sin * s + cos * t)
            seed = (self.detail_seed or 0) + layer
            grain = _averaged(_detail_tile(seed % 3), texel, right, down, turned, spacing, True)
            total *= (1 + (grain - 128) * np.float32(1 / 180))[..., None]
            texel /= 16
            layer += 1


def as_list(count: int) -> tuple[int, int]:
    """Shape (h, w) with w bounded that holds a list of ``count`` positions, for :func:`folded`."""
    width = min(count, _ROWS)
    return -(-count // width), width


def folded(values: FloatArray) -> FloatArray:
    """A list (n,) as an array (h, w), its last element repeated to fill it."""
    height, width = as_list(len(values))
    return np.concatenate([values, np.full(height * width - len(values), values[-1])]).reshape(height, width)


def _averaged(
    pyramid: tuple[ByteImage, ...],
    texel_m: float,
    right_m: FloatArray,
    down_m: FloatArray,
    slopes: tuple[FloatArray, ...],
    spacing: FloatArray,
    wrap: bool,
) -> Image32:
    """Means (h, w[, 3]) around positions counted from the raster's upper left corner."""
    s_u, s_v, t_u, t_v = slopes
    top = len(pyramid) - 1
    level = np.asarray(np.clip(np.log2(spacing / texel_m), 0, top), np.float32)
    shape = right_m.shape + pyramid[0].shape[2:]
    total = np.zeros(shape, np.float32)
    lowest, highest = int(level.min()), min(int(np.ceil(level.max())), top)
    for step in range(lowest, highest + 1):
        # One weight for all pixels where all of them are on one level.
        weight = np.maximum(1 - np.abs(level - step), 0) if highest > lowest else np.ones_like(level)
        texel = texel_m * 2**step
        side = _TILE >> step
        part = np.zeros(shape, np.float32)
        for du in (-0.25, 0.25):
            for dv in (-0.25, 0.25):
                # cv2.remap counts from the centre of the first texel: half a texel less.
                column = (right_m + (du * s_u + dv * s_v)) / texel - 0.5
                row = (down_m - (du * t_u + dv * t_v)) / texel - 0.5
                if wrap:
                    column, row = column % side, row % side
                part += cv2.remap(
                    pyramid[step],
                    column.astype(np.float32),
                    row.astype(np.float32),
                    cv2.INTER_LINEAR,
                    borderMode=cv2.BORDER_REFLECT,
                )
        weight *= np.float32(0.25)
        total += part * (weight[..., None] if total.ndim == 3 else weight)
    return total


def pyramid_of(base: ByteImage, levels: int = 6) -> tuple[ByteImage, ...]:
    """The raster and its halves; sides that are no multiples of 2^(levels - 1) lose their rest.

    The rest would have to be a texel that covers other ground than its neighbours.
    """
    step = 2 ** (levels - 1)
    rows, columns = (max(n // step, 1) * step for n in base.shape[:2])
    out = [np.ascontiguousarray(base[:rows, :columns])]
    for _ in range(levels - 1):
        rows, columns = (max(n // 2, 1) for n in out[-1].shape[:2])
        out.append(np.asarray(cv2.resize(out[-1], (columns, rows), interpolation=cv2.INTER_AREA), np.uint8))
    return tuple(out)


@lru_cache(maxsize=3)
def _detail_tile(seed: int) -> tuple[ByteImage, ...]:
    """Grain of 2 to 16 texels that tiles without seams, 128 in the mean, and its halves.

    Each level has one more row and column, the first again, so that bilinear samples need no wrapping.
    """
    rng = np.random.default_rng([seed, 14])
    total = np.zeros((_TILE, _TILE), np.float32)
    for cells in (_TILE // 2, _TILE // 4, _TILE // 8, _TILE // 16):
        nodes = np.pad(rng.standard_normal((cells, cells), dtype=np.float32), 2, mode="wrap")
        scale = _TILE // cells
        wide = cv2.resize(nodes, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        total += wide[2 * scale : -2 * scale, 2 * scale : -2 * scale]
    tile = np.clip(128 + 18 * total, 0, 255)
    levels = []
    for step in range(5):
        side = _TILE >> step
        level = tile if step == 0 else cv2.resize(tile, (side, side), interpolation=cv2.INTER_AREA)
        levels.append(np.pad(np.rint(level).astype(np.uint8), ((0, 1), (0, 1)), mode="wrap"))
    flat = np.full((_TILE >> 5,) * 2, 128, np.uint8)  # farther away there is no grain
    return (*levels, np.pad(flat, ((0, 1), (0, 1)), mode="wrap"))

"""Textures of walls, roofs, windows and doors."""

from __future__ import annotations

import cv2
import numpy as np

from calib.camera import FloatArray
from sim.texture import ByteImage, Image32

#: Rasters have at most so many texels; bigger surfaces get bigger texels.
_LARGEST = 24_000_000


def texel_for(width_m: float, height_m: float, texel_m: float) -> float:
    """The texel asked for, or a larger one if the raster would be too big."""
    return max(texel_m, float(np.sqrt(width_m * height_m / _LARGEST)))


def stonework(
    seed: int,
    width_m: float,
    height_m: float,
    texel_m: float,
    *,
    course_m: float = 0.32,
    tint: tuple[float, float, float] = (150.0, 142.0, 134.0),
) -> ByteImage:
    """Coursed stone with lighter mortar: courses and stones of unequal size, each of its own tone."""
    rng = np.random.default_rng([seed, 21])
    rows, columns = round(height_m / texel_m), round(width_m / texel_m)
    image = np.empty((rows, columns, 3), np.float32)
    joint = max(0.016 / texel_m, 1.2)
    mortar = np.array(tint) * 1.22
    image[:] = mortar
    top = 0.0
    while top < rows:
        height = course_m / texel_m * rng.uniform(0.65, 1.35)
        left = -rng.uniform(0, 2) * course_m / texel_m
        while left < columns:
            width = height * rng.uniform(0.9, 2.8)
            tone = rng.normal(1.0, 0.16) * (
                np.array(tint) + rng.normal(0, 9) * np.array([1.0, 0.5, -0.4]) + rng.normal(0, 2.5, 3)
            )
            _block(image, left, top, width - joint, height - joint, np.clip(tone, 30, 235), rng)
            left += width
        top += height
    return _weathered(rng, image, texel_m)


def brickwork(seed: int, width_m: float, height_m: float, texel_m: float) -> ByteImage:
    """Bricks of 215 x 65 mm in stretcher bond, some burnt darker, some painted over."""
    rng = np.random.default_rng([seed, 22])
    rows, columns = round(height_m / texel_m), round(width_m / texel_m)
    image = np.empty((rows, columns, 3), np.float32)
    image[:] = (188, 180, 168)
    length, height, joint = 0.225 / texel_m, 0.075 / texel_m, max(0.010 / texel_m, 0.8)
    tints = np.array([[158, 88, 68], [140, 74, 60], [172, 104, 78], [112, 66, 60], [150, 96, 84]], float)
    for i in range(int(rows / height) + 1):
        for j in range(-1, int(columns / length) + 1):
            tint = tints[rng.choice(5, p=[0.34, 0.24, 0.2, 0.12, 0.1])] * rng.normal(1.0, 0.1)
            left = (j + 0.5 * (i % 2)) * length + rng.normal(0, 0.1) * joint
            _block(image, left, i * height, length - joint, height - joint, np.clip(tint, 20, 240), None)
    return _weathered(rng, image, texel_m)


def slates(seed: int, width_m: float, height_m: float, texel_m: float) -> ByteImage:
    """A slate roof: overlapping rows, single slates darker, lichen."""
    rng = np.random.default_rng([seed, 23])
    rows, columns = round(height_m / texel_m), round(width_m / texel_m)
    image = np.empty((rows, columns, 3), np.float32)
    image[:] = (46, 48, 54)
    length, height, joint = 0.28 / texel_m, 0.22 / texel_m, max(0.008 / texel_m, 0.7)
    for i in range(int(rows / height) + 1):
        for j in range(-1, int(columns / length) + 1):
            tone = np.array([98, 101, 108]) * rng.normal(1.0, 0.16) + rng.normal(0, 1.5, 3)
            left = (j + 0.5 * (i % 2) + rng.normal(0, 0.02)) * length
            _block(image, left, i * height, length - joint, height - joint, np.clip(tone, 30, 200), None)
    for _ in range(int(width_m * height_m * 2)):  # lichen
        at = rng.uniform(0, [columns, rows])
        _disc(image, at, rng.uniform(0.03, 0.14) / texel_m, np.array([136, 138, 118]) * rng.uniform(0.8, 1.2))
    return _weathered(rng, image, texel_m)


def window(seed: int, width_m: float, height_m: float, texel_m: float) -> ByteImage:
    """A sash window: white frame and bars, dark panes that mirror some sky, no two alike."""
    rng = np.random.default_rng([seed, 24])
    rows, columns = max(round(height_m / texel_m), 8), max(round(width_m / texel_m), 8)
    image = np.empty((rows, columns, 3), np.float32)
    image[:] = (218, 216, 208)
    frame, bar = 0.07 / texel_m, 0.03 / texel_m
    for i in range(4):
        for j in range(3):
            sky = rng.uniform(0.15, 1.0)
            pane = np.array([30, 36, 44]) * (1 - sky * 0.5) + np.array([120, 136, 152]) * sky * 0.5
            left = frame + j * (columns - 2 * frame) / 3 + bar / 2
            top = frame + i * (rows - 2 * frame) / 4 + bar / 2
            size = (columns - 2 * frame) / 3 - bar, (rows - 2 * frame) / 4 - bar
            _block(image, left, top, *size, pane, None)
    return _weathered(rng, image, texel_m, 0.5)


def door(seed: int, width_m: float, height_m: float, texel_m: float) -> ByteImage:
    """A boarded door with two hinges."""
    rng = np.random.default_rng([seed, 25])
    rows, columns = max(round(height_m / texel_m), 8), max(round(width_m / texel_m), 8)
    image = np.empty((rows, columns, 3), np.float32)
    image[:] = (40, 26, 20)
    board = columns / 7
    for j in range(7):
        tint = np.array([96, 62, 44]) * rng.normal(1.0, 0.1)
        _block(image, j * board, 0, board - max(0.008 / texel_m, 0.8), rows, np.clip(tint, 20, 200), None)
    for at in (0.16, 0.8):
        _block(image, 0, at * rows, 0.75 * columns, 0.05 / texel_m, np.array([34.0, 34, 36]), None)
    return _weathered(rng, image, texel_m)


def _block(
    image: Image32,
    left: float,
    top: float,
    width: float,
    height: float,
    tint: FloatArray,
    rng: np.random.Generator | None,
) -> None:
    """A filled rectangle at sub-texel position; with ``rng`` its corners are uneven."""
    corners = np.array([[left, top], [left + width, top], [left + width, top + height], [left, top + height]])
    if rng is not None:
        corners += rng.normal(0, 0.03 * height, (4, 2))
    # fillConvexPoly counts from the centre of the first texel, in 1/16 texels.
    points = np.rint((corners - 0.5) * 16).astype(np.int32)
    cv2.fillConvexPoly(image, points, [float(c) for c in tint], cv2.LINE_8, 4)


def _disc(image: Image32, at: FloatArray, radius: float, tint: FloatArray) -> None:
    centre = (int(at[0] * 16), int(at[1] * 16))
    cv2.circle(image, centre, max(int(radius * 16), 8), [float(c) for c in tint], -1, cv2.LINE_8, 4)


def _weathered(rng: np.random.Generator, image: Image32, texel_m: float, strength: float = 1.0) -> ByteImage:
    """Stains of all sizes from metres to a texel, darker and lighter runs down the surface."""
    rows, columns = image.shape[:2]
    shade = np.zeros((rows, columns), np.float32)
    size = 4.0
    while size > 0.8 * texel_m:
        # Large stains are drawn out downwards, as rain does.
        across = int(columns * texel_m / size) + 3
        down = int(rows * texel_m / (size * (2.5 if size > 0.3 else 1.0))) + 3
        if across >= columns or down >= rows:
            break
        nodes = rng.standard_normal((down, across), dtype=np.float32)
        shade += cv2.resize(nodes, (columns, rows), interpolation=cv2.INTER_CUBIC)
        size /= 2
    shade += rng.standard_normal((rows, columns), dtype=np.float32)
    shade *= np.float32(0.055 * strength)
    image *= (1 + shade)[..., None]
    out: ByteImage = np.clip(image + 0.5, 0, 255).astype(np.uint8)
    return out

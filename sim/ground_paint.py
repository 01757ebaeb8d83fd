"""What relief and structures do to the ground's colours: light, shadows, tracks, water."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from calib.camera import FloatArray
from sim.buildings import SUN
from sim.facet import Facet
from sim.landforms import Course
from sim.relief import HeightField
from sim.texture import ByteImage, Image32

_COARSE_M = 0.5
_MOST = 1500
_BAND = 256


def _ticks(canvas: ByteImage, texel_m: float) -> FloatArray:
    """Positions (n,) of a coarse grid over the canvas, from -half to half."""
    half = len(canvas) * texel_m / 2
    return np.linspace(-half, half, int(np.clip(2 * half / max(_COARSE_M, texel_m), 32, _MOST)))


def _enlarged(coarse: FloatArray, canvas: ByteImage) -> Image32:
    side = len(canvas)
    return np.asarray(cv2.resize(coarse.astype(np.float32), (side, side), interpolation=cv2.INTER_LINEAR))


def shade(canvas: ByteImage, texel_m: float, ground: HeightField) -> None:
    """Slopes towards the sun are lighter than level ground, others darker."""
    ticks = _ticks(canvas, texel_m)
    east, north = np.meshgrid(ticks, ticks[::-1])
    _, by_east, by_north = ground.height_and_gradient(east, north)
    facing = (SUN[2] - by_east * SUN[0] - by_north * SUN[1]) / np.sqrt(1 + by_east**2 + by_north**2)
    light = (0.5 + 0.7 * np.maximum(facing, 0)) / (0.5 + 0.7 * SUN[2])
    _multiply(canvas, _enlarged(light, canvas))


def shadows(canvas: ByteImage, texel_m: float, facets: Iterable[Facet]) -> None:
    """The structures' shadows on level ground at height 0, with soft borders."""
    half = len(canvas) * texel_m / 2
    mask = np.zeros(canvas.shape[:2], np.uint8)
    for facet in facets:
        corners = facet.corners_m
        on_ground = corners[:, :2] - np.maximum(corners[:, 2:], 0) * SUN[:2] / SUN[2]
        texels = np.column_stack([on_ground[:, 0] + half, half - on_ground[:, 1]]) / texel_m - 0.5
        if cv2.contourArea(texels.astype(np.float32)) > 1:
            cv2.fillConvexPoly(mask, np.rint(texels * 16).astype(np.int32), 255, cv2.LINE_AA, 4)
    soft = cv2.GaussianBlur(mask, (0, 0), max(0.06 / texel_m, 0.5))
    _multiply(canvas, 1 - soft.astype(np.float32) * np.float32(0.5 / 255))


def strip(
    canvas: ByteImage,
    texel_m: float,
    course: Course,
    half_width_m: float,
    colour: tuple[float, float, float],
    cover: float,
    soft_m: float = 0.3,
) -> None:
    """A track or a river along a course; ``cover``: how much of the ground's own colour it hides."""
    ticks = _ticks(canvas, texel_m)
    east, north = np.meshgrid(ticks, ticks[::-1])
    across, by_east, by_north = course.across_and_gradient(east, north)
    distance = np.abs(across) / np.hypot(by_east, by_north)
    weight = cover * np.clip((half_width_m + soft_m - distance) / (2 * soft_m), 0, 1)
    _blend(canvas, _enlarged(weight, canvas), np.array(colour, np.float32))


def yard(canvas: ByteImage, texel_m: float, reach_m: tuple[float, float]) -> None:
    """Gravel around the origin, (east, north) so far, fading out over two metres."""
    ticks = _ticks(canvas, texel_m)
    east, north = np.meshgrid(ticks, ticks[::-1])
    wobble = 0.5 * np.sin(0.9 * east + 1.3) + 0.5 * np.sin(1.1 * north + 0.4)
    beyond = np.hypot(np.maximum(np.abs(east) - reach_m[0], 0), np.maximum(np.abs(north) - reach_m[1], 0))
    weight = 0.75 * np.clip(1 - (beyond + wobble) / 2, 0, 1)
    _blend(canvas, _enlarged(weight, canvas), np.array([162, 152, 136], np.float32))


def _multiply(canvas: ByteImage, light: Image32) -> None:
    for first in range(0, len(canvas), _BAND):  # in bands: floats of the whole would be gigabytes
        band = np.s_[first : first + _BAND]
        canvas[band] = np.clip(canvas[band] * light[band, :, None] + 0.5, 0, 255)


def _blend(canvas: ByteImage, weight: Image32, colour: Image32) -> None:
    """Paint over, with the ground's brightness showing through as texture of what is painted."""
    for first in range(0, len(canvas), _BAND):
        band = np.s_[first : first + _BAND]
        share = weight[band, :, None]
        if not share.any():
            continue
        under = canvas[band].astype(np.float32)
        # Half of the ground's contrast survives.
        grain = 1 + 0.5 * (under.mean(axis=2, keepdims=True) / 112 - 1)
        canvas[band] = np.clip(under * (1 - share) + colour * grain * share, 0, 255)

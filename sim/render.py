"""Photos of a :class:`~sim.world.World` through a known lens.

Every pixel's ray is intersected with the relief, from the place where the camera was when that
pixel's row was read, and the texture is averaged over the pixel's footprint.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from calib.camera import FloatArray
from calib.field import Lens
from sim.world import ByteImage, World

_STEP = 8  # px between the nodes on which smooth maps are computed before they are interpolated
_BAND = 64  # rows filtered together
_SKY = np.array([188, 203, 219], np.uint8)


@dataclass(frozen=True)
class RenderOptions:
    """``blur_px``: Gaussian sigma of optics and motion. ``noise_levels``: sensor noise, standard
    deviation in grey levels of 255. ``vignetting``: loss of light in the corners (0..1).
    ``readout_s``: rolling shutter, first row to last; the pose is the middle row's."""

    blur_px: float = 0.5
    noise_levels: float = 2.0
    vignetting: float = 0.2
    readout_s: float = 0.0


def lens_rays(lens: Lens, pattern: Callable[[FloatArray], FloatArray] | None = None) -> FloatArray:
    """The ray of every pixel's centre, (height, width, 2): made once, used for all photos of a lens.

    ``pattern`` is what the total mapping has beyond ``lens``: pixels = lens(ray) + pattern(lens(ray)).
    """
    width, height = lens.brown.width, lens.brown.height
    u, v = _nodes(width), _nodes(height)
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    behind = pixels
    if pattern is not None:
        for _ in range(30):  # the pattern's slope is below 1 %: two digits a round
            behind = pixels - pattern(behind)
    rays = lens.unproject(behind)
    # (0.5, 0.5) is the centre of the first pixel.
    centres_u, centres_v = np.arange(width) + 0.5, np.arange(height) + 0.5
    return np.stack([RectBivariateSpline(v, u, rays[..., a])(centres_v, centres_u) for a in (0, 1)], axis=-1)


def _nodes(size: int) -> FloatArray:
    return np.linspace(0.5, size - 0.5, max(size // _STEP, 8))


def render(
    world: World,
    rays: FloatArray,
    rotation_cam_from_world: FloatArray,
    centre_m: FloatArray,
    *,
    velocity_m_s: FloatArray | None = None,
    options: RenderOptions | None = None,
    seed: int = 0,
) -> ByteImage:
    """One photo, RGB (height, width, 3).

    rays: (height, width, 2) from :func:`lens_rays`. rotation (3, 3), centre (3,) of the middle row;
    velocity (3,) matters with a rolling shutter.
    """
    options = options or RenderOptions()
    east, north, sky = _ground(
        world, rays, rotation_cam_from_world, centre_m, velocity_m_s, options.readout_s
    )
    image = _look_up(world, east, north)
    image[sky] = _SKY
    height, width = image.shape[:2]
    if options.blur_px > 0:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), options.blur_px), np.float32)
    if options.vignetting > 0:
        u = (np.arange(width, dtype=np.float32) + 0.5) / width - 0.5
        v = (np.arange(height, dtype=np.float32) + 0.5) / height - 0.5
        radius2 = (u * u * width**2 + (v * v * height**2)[:, None]) * 4 / (width**2 + height**2)
        image *= (1 - np.float32(options.vignetting) * radius2 * radius2)[..., None]
    if options.noise_levels > 0:
        rng = np.random.default_rng([seed, 6])
        # One draw for all three channels: what matters is the noise of the brightness.
        image += np.float32(options.noise_levels) * rng.standard_normal((height, width, 1), dtype=np.float32)
    photo: ByteImage = np.clip(image + 0.5, 0, 255).astype(np.uint8)
    return photo


def _ground(
    world: World,
    rays: FloatArray,
    rotation: FloatArray,
    centre: FloatArray,
    velocity: FloatArray | None,
    readout_s: float,
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Ground position east and north of every pixel, (height, width) each, and where there is none."""
    height, width = rays.shape[:2]
    x, y = rays[..., 0], rays[..., 1]
    direction = [x * rotation[0, a] + y * rotation[1, a] + rotation[2, a] for a in range(3)]
    sky = direction[2] > -0.1 * np.sqrt(direction[0] ** 2 + direction[1] ** 2)
    down = np.where(sky, -0.1, direction[2])
    time_s = ((np.arange(height) + 0.5) / height - 0.5) * readout_s
    start = centre + time_s[:, None] * (np.zeros(3) if velocity is None else velocity)

    rows = np.unique(np.rint(np.linspace(0, height - 1, max(height // _STEP, 8))).astype(int))
    columns = np.unique(np.rint(np.linspace(0, width - 1, max(width // _STEP, 8))).astype(int))
    at = np.ix_(rows, columns)
    coarse = -start[rows, 2:3] / down[at]
    for _ in range(8):
        coarse = _newton(world, start[rows], direction[0][at], direction[1][at], down[at], coarse)
    # Between the nodes the distance is interpolated and made exact by one more step.
    distance = RectBivariateSpline(rows, columns, coarse, kx=1, ky=1)(np.arange(height), np.arange(width))
    distance = _newton(world, start, direction[0], direction[1], down, distance)
    return start[:, 0:1] + distance * direction[0], start[:, 1:2] + distance * direction[1], sky


def _newton(
    world: World,
    start: FloatArray,
    to_east: FloatArray,
    to_north: FloatArray,
    down: FloatArray,
    t: FloatArray,
) -> FloatArray:
    """One step towards the distance t at which start + t * direction meets the relief."""
    east, north = start[:, 0:1] + t * to_east, start[:, 1:2] + t * to_north
    height, by_east, by_north = world.relief.height_and_gradient(east, north)
    above = start[:, 2:3] + t * down - height
    # The relief's slopes are gentle; a view along a slope would need a search instead.
    return t - above / np.minimum(down - by_east * to_east - by_north * to_north, -0.02)


def _look_up(world: World, east: FloatArray, north: FloatArray) -> NDArray[np.float32]:
    """Texture (height, width, 3) averaged over every pixel: four samples each, bilinear between texels
    and levels of the pyramid."""
    height, width = east.shape
    image = np.empty((height, width, 3), np.float32)
    top = len(world.pyramid) - 1
    for first in range(0, height, _BAND):
        last = min(first + _BAND, height)
        low, high = max(first - 1, 0), min(last + 1, height)  # a row more for the slopes
        inner = slice(first - low, last - low)
        slopes = [np.asarray(m) for ground in (east, north) for m in np.gradient(ground[low:high])]
        e_v, e_u, n_v, n_u = (slope[inner] for slope in slopes)
        e, n = east[first:last], north[first:last]
        # Samples are half a pixel apart; the level's texels are as large as their spacing, for
        # oblique views the geometric mean of both directions.
        spacing = 0.5 * np.sqrt(np.abs(e_u * n_v - e_v * n_u) + 1e-12)
        level = np.asarray(np.clip(np.log2(spacing / world.texel_m), 0, top), np.float32)
        total = np.zeros((last - first, width, 3), np.float32)
        for step in range(int(level.min()), min(int(np.ceil(level.max())), top) + 1):
            weight = np.maximum(1 - np.abs(level - step), 0)
            texel = world.texel_m * 2**step
            for du in (-0.25, 0.25):
                for dv in (-0.25, 0.25):
                    # cv2.remap counts from the centre of the first texel: half a texel less.
                    column = (e + du * e_u + dv * e_v + world.half_m) / texel - 0.5
                    row = (world.half_m - n - du * n_u - dv * n_v) / texel - 0.5
                    sample = cv2.remap(
                        world.pyramid[step],
                        column.astype(np.float32),
                        row.astype(np.float32),
                        cv2.INTER_LINEAR,
                        borderMode=cv2.BORDER_REFLECT,
                    )
                    total += (0.25 * weight)[..., None] * sample
        image[first:last] = total
    return image

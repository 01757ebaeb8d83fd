"""Tie points measured again, to a fraction of a pixel, on the full-size images.

Features are found on reduced images. Here every track gets one patch from one photo (its
template), carried into the other photos through the block's own geometry (the ground's tangent
plane as both photos see it) and moved until grey values agree: least-squares matching with
brightness and contrast free (Gruen 1985), inverse compositional, all patches of a photo at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calib.align.features import photo_gray
from calib.camera import FloatArray
from calib.field import Lens
from calib.photos.photo import Photo
from calib.solution import IntArray, Observations

HALF = 8
STEP_PX = 1.25
ITERATIONS = 8
#: A patch that wants to move further than this (full-size px) was a mismatch.
MAX_MOVE_PX = 4.0
MIN_CORRELATION = 0.8


@dataclass(frozen=True)
class Refined:
    """Observations with refined pixels; ``ok`` (n,) False where a patch could not be matched."""

    observations: Observations
    ok: NDArray[np.bool_]


def surface_normals(points_m: FloatArray, neighbours: int = 24) -> FloatArray:
    """Unit normals (m, 3) of the ground around every point, from its neighbours' plane."""
    k = min(neighbours, len(points_m))
    _, index = cKDTree(points_m).query(points_m, k=k)
    around = points_m[index] - points_m[index].mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    normals: FloatArray = vectors[:, :, 0]
    return normals


@dataclass(frozen=True)
class _Tangents:
    """The ground's tangent plane at every point, as photos see it.

    first, second (m, 3): unit vectors that span it. ``maps`` (n, 2, 2): d pixel / d plane
    coordinates of every observation.
    """

    points_m: FloatArray
    first: FloatArray
    second: FloatArray
    maps: FloatArray

    @classmethod
    def of(
        cls, lens: Lens, rotations: FloatArray, centres_m: FloatArray, obs: Observations, points_m: FloatArray
    ) -> _Tangents:
        normal = surface_normals(points_m)
        helper = np.where(np.abs(normal[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
        first = np.cross(normal, helper)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second = np.cross(normal, first)
        offset = points_m[obs.point] - centres_m[obs.photo]
        turned = rotations[obs.photo]
        in_cam = (turned @ offset[:, :, None])[:, :, 0]
        rays = in_cam[:, :2] / in_cam[:, 2:]
        _, by_ray, _ = lens.derivatives(rays)
        by_cam = np.empty((len(obs), 2, 3))
        by_cam[:, :, :2] = by_ray / in_cam[:, 2][:, None, None]
        by_cam[:, :, 2] = -(by_ray @ rays[:, :, None])[:, :, 0] / in_cam[:, 2:]
        tangent = np.stack([first, second], axis=2)[obs.point]
        return cls(points_m, first, second, by_cam @ turned @ tangent)

    def seen_px(
        self, lens: Lens, rotation: FloatArray, centre_m: FloatArray, point: IntArray, where: FloatArray
    ) -> FloatArray:
        """Pixels (n, s, 2), relative to the point's own, of plane coordinates ``where`` (n, s, 2).

        ``rotation`` (3, 3) and ``centre_m`` (3,) of one photo, or (n, 3, 3) and (n, 3) of several.
        """
        origin = (rotation @ (self.points_m[point] - centre_m)[:, :, None])[:, None, :, 0]
        axes = rotation @ np.stack([self.first, self.second], axis=2)[point]
        in_cam = origin + where @ axes.transpose(0, 2, 1)
        pixels = lens.project(in_cam[..., :2] / in_cam[..., 2:])
        relative: FloatArray = pixels - lens.project(origin[..., :2] / origin[..., 2:])
        return relative


class _Images:
    """Full-size grey images, kept while they fit into ``budget`` bytes."""

    def __init__(self, photos: Sequence[Photo], budget: int) -> None:
        self._photos, self._budget = photos, budget
        self._kept: dict[int, NDArray[np.uint8]] = {}

    def __getitem__(self, index: int) -> NDArray[np.uint8]:
        if index in self._kept:
            return self._kept[index]
        image, _ = photo_gray(self._photos[index], None)
        if sum(i.nbytes for i in self._kept.values()) + image.nbytes <= self._budget:
            self._kept[index] = image
        return image


def _sample(image: NDArray[np.uint8], pixels: FloatArray) -> NDArray[np.float32]:
    """Grey values (n, s) at ``pixels`` (n, s, 2), bicubic."""
    # OpenCV counts from the centre of the first pixel.
    maps = np.asarray(pixels - 0.5, np.float32)
    out = np.empty(maps.shape[:2], np.float32)
    for start in range(0, len(maps), 16000):  # remap allows 32767 rows
        part = maps[start : start + 16000]
        out[start : start + 16000] = cv2.remap(
            image, part[:, :, 0], part[:, :, 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
        )
    return out


def _grid(axis: FloatArray) -> FloatArray:
    x, y = np.meshgrid(axis, axis)
    return np.stack([x.ravel(), y.ravel()], axis=-1)


def _between_nodes(grid: FloatArray, reach: float) -> FloatArray:
    """Weights (s, 9) of values at the nodes (-reach, 0, reach) squared for positions (s, 2)."""
    t = grid / reach
    along = np.stack([0.5 * t * (t - 1), 1 - t * t, 0.5 * t * (t + 1)], axis=-1)  # (s, 2, 3)
    weights: FloatArray = (along[:, 1, :, None] * along[:, 0, None, :]).reshape(len(grid), 9)
    return weights


def refine(
    photos: Sequence[Photo],
    lens: Lens,
    rotations: FloatArray,
    centres_m: FloatArray,
    points_m: FloatArray,
    obs: Observations,
    memory_bytes: int = 1_000_000_000,
    tick: Callable[[int], None] | None = None,
) -> Refined:
    """Refine all observations of a block whose geometry is known to a few pixels.

    The template of a track is its observation nearest to the image centre; it stays where it is.
    ``photos`` in the order of the photo indices. ``tick(photo)`` is called as photos are done.
    """
    n = len(obs)
    tangents = _Tangents.of(lens, rotations, centres_m, obs, points_m)
    middle = np.array([lens.brown.width / 2, lens.brown.height / 2])
    order = np.lexsort((np.linalg.norm(obs.pixels - middle, axis=1), obs.point))
    head = np.concatenate([[True], obs.point[order][1:] != obs.point[order][:-1]])
    template = np.zeros(len(points_m), np.intp)
    template[obs.point[order][head]] = order[head]

    grid = _grid(np.linspace(-HALF * STEP_PX, HALF * STEP_PX, 2 * HALF + 1))
    nodes = _grid(np.array([-1.0, 0.0, 1.0]) * HALF * STEP_PX)
    weights = _between_nodes(grid, HALF * STEP_PX)
    # Plane coordinates of the nodes around each template, to first order, and what that leaves.
    on_plane = nodes @ np.linalg.inv(tangents.maps[template]).transpose(0, 2, 1)
    host = obs.photo[template]
    every = np.arange(len(points_m))
    bent = tangents.seen_px(lens, rotations[host], centres_m[host], every, on_plane) - nodes
    images = _Images(photos, memory_bytes)
    size = 2 * HALF + 1
    patches = np.zeros((len(points_m), grid.shape[0]), np.float32)
    for photo in range(len(photos)):
        mine = np.flatnonzero(obs.photo[template] == photo)
        if len(mine):
            patches[mine] = _sample(images[photo], obs.pixels[template[mine]][:, None, :] + grid)
    patches -= patches.mean(axis=1, keepdims=True)
    contrast = np.sqrt(np.mean(patches**2, axis=1))
    textured = contrast > 1.5
    patches /= np.maximum(contrast, 1e-3)[:, None]
    square = patches.reshape(-1, size, size)
    gx = np.asarray(np.gradient(square, axis=2)).reshape(len(patches), -1) / STEP_PX
    gy = np.asarray(np.gradient(square, axis=1)).reshape(len(patches), -1) / STEP_PX
    normal = np.empty((len(patches), 2, 2))
    normal[:, 0, 0], normal[:, 1, 1] = np.sum(gx * gx, axis=1), np.sum(gy * gy, axis=1)
    normal[:, 0, 1] = normal[:, 1, 0] = np.sum(gx * gy, axis=1)
    textured &= np.linalg.eigvalsh(normal)[:, 0] > 0.02 * grid.shape[0] / 100
    inverse = np.linalg.inv(normal + 1e-6 * np.eye(2))

    pixels = obs.pixels.copy()
    ok = np.zeros(n, bool)
    ok[template] = textured
    for photo in range(len(photos)):
        mine = np.flatnonzero((obs.photo == photo) & textured[obs.point])
        mine = mine[template[obs.point[mine]] != mine]
        if len(mine):
            point = obs.point[mine]
            affine = tangents.maps[mine] @ np.linalg.inv(tangents.maps[template[point]])
            # Perspective and lens bend a patch; an affine map alone is off by hundredths of a
            # pixel in small images, the same way for all oblique views.
            seen = tangents.seen_px(lens, rotations[photo], centres_m[photo], point, on_plane[point])
            offsets = weights @ (seen - bent[point] @ affine.transpose(0, 2, 1))
            moved, good = _follow(
                images[photo],
                obs.pixels[mine],
                affine,
                offsets,
                patches[point],
                gx[point],
                gy[point],
                inverse[point],
            )
            pixels[mine[good]] = moved[good]
            ok[mine] = good
        if tick is not None:
            tick(photo)
    return Refined(Observations(obs.photo, obs.point, pixels, obs.sigma_px), ok)


def _follow(
    image: NDArray[np.uint8],
    start: FloatArray,
    affine: FloatArray,
    offsets: FloatArray,
    template: NDArray[np.float32],
    gx: FloatArray,
    gy: FloatArray,
    inverse: FloatArray,
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Move patches from ``start`` (n, 2) until they agree with their templates.

    ``affine`` (n, 2, 2) and ``offsets`` (n, s, 2): the template's pixels around its middle carried
    into this photo, to first order and in full.
    """
    scale = np.sqrt(np.abs(np.linalg.det(affine)))
    sane = np.isfinite(scale) & (scale > 0.4) & (scale < 2.5)
    sane &= np.isfinite(offsets).all(axis=(1, 2))
    affine = np.where(sane[:, None, None], affine, np.eye(2))
    offsets = np.where(sane[:, None, None], offsets, 0.0)
    at = start.copy()
    last = np.full(len(start), np.inf)
    correlation = np.zeros(len(start))
    live = np.flatnonzero(sane)
    for _ in range(ITERATIONS):
        grey = _sample(image, at[live, None, :] + offsets[live])
        grey -= grey.mean(axis=1, keepdims=True)
        grey /= np.maximum(np.sqrt(np.mean(grey**2, axis=1)), 1e-3)[:, None]
        correlation[live] = np.mean(grey * template[live], axis=1)
        error = grey - template[live]
        right = np.stack([np.sum(gx[live] * error, axis=1), np.sum(gy[live] * error, axis=1)], axis=1)
        # Shift in the template's frame that would explain the error; the photo moves the other way.
        shift = (inverse[live] @ right[:, :, None])[:, :, 0]
        step = -(affine[live] @ shift[:, :, None])[:, :, 0]
        length = np.linalg.norm(step, axis=1)
        step *= np.minimum(1.0, 1.5 / np.maximum(length, 1e-9))[:, None]
        at[live] += step
        last[live] = length
        away = np.linalg.norm(at - start, axis=1)
        live = live[(last[live] > 0.01) & (away[live] <= MAX_MOVE_PX)]
        if not len(live):
            break
    away = np.linalg.norm(at - start, axis=1)
    good = sane & (last < 0.1) & (away <= MAX_MOVE_PX) & (correlation > MIN_CORRELATION)
    height, width = image.shape
    reach = np.abs(offsets).max(axis=1)
    inside = ((at - reach > 0) & (at + reach < [width, height])).all(axis=1)
    return at, good & inside

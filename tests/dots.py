"""Where dots on rendered surfaces must appear, and where they do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calib.camera import BrownCamera, FloatArray
from sim.flights import phantom3
from sim.trace import trace
from sim.world import World

#: Positions on a surface (n, 2) -> world points (n, 3).
Surface = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Eye:
    """A true camera: lens, pattern, pose of the middle row, and what a rolling shutter makes of it."""

    rotation: FloatArray
    centre_m: FloatArray
    camera: BrownCamera = field(default_factory=lambda: phantom3(1000, 750))
    pattern: Callable[[FloatArray], FloatArray] | None = None
    velocity_m_s: FloatArray = field(default_factory=lambda: np.zeros(3))
    readout_s: float = 0.0

    @property
    def size(self) -> FloatArray:
        return np.array([self.camera.width, self.camera.height], float)

    def project(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels (n, 2) and depths (n,) of world points (n, 3): each seen when its row is read."""
        centre = np.broadcast_to(self.centre_m, points_m.shape)
        for _ in range(7):
            local = (points_m - centre) @ self.rotation.T
            pixels = self.camera.project(local[:, :2] / local[:, 2:])
            if self.pattern is not None:
                pixels = pixels + self.pattern(pixels)
            time_s = (pixels[:, 1] / self.camera.height - 0.5) * self.readout_s
            centre = self.centre_m + time_s[:, None] * self.velocity_m_s
        return pixels, local[:, 2]

    def expected(self, surface: Surface, where_m: FloatArray, sigma_m: float) -> FloatArray:
        """Centres of gravity (n, 2) in px of Gaussian dots: perspective puts them off the images of
        their middles."""
        ticks = np.linspace(-4, 4, 17) * sigma_m
        offsets = np.stack(np.meshgrid(ticks, ticks), axis=-1)
        weight = np.exp(-0.5 * np.sum(offsets**2, axis=-1) / sigma_m**2)
        spots = (where_m[:, None, None] + offsets).reshape(-1, 2)
        pixels = self.project(surface(spots))[0].reshape(len(where_m), *offsets.shape)
        by_t, by_s = np.gradient(pixels, axis=(1, 2))
        area = np.abs(by_s[..., 0] * by_t[..., 1] - by_s[..., 1] * by_t[..., 0])
        share = weight * area
        return np.einsum("nij,nijk->nk", share, pixels) / share.sum(axis=(1, 2))[:, None]

    def usable(
        self, world: World, surface: Surface, where_m: FloatArray, sigma_m: float, reach_px: int
    ) -> NDArray[np.bool_]:
        """Dots in view: inside the image, neither hidden nor too flat, and of a size to be measured."""
        points = surface(where_m)
        pixels, depth = self.project(points)
        local = (points - self.centre_m) @ self.rotation.T
        # Beyond the lens's own field of view its polynomial folds back.
        narrow = (
            np.linalg.norm(local[:, :2], axis=1) < 1.02 * np.hypot(*self.size) / 2 / self.camera.f_px * depth
        )
        inside = (pixels > reach_px + 2).all(axis=1) & (pixels < self.size - reach_px - 2).all(axis=1)
        corners = [where_m + np.array(d) * sigma_m for d in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        seen = [self.project(surface(c))[0] for c in corners]
        along, across = 0.5 * (seen[0] - seen[1]), 0.5 * (seen[2] - seen[3])
        size = np.stack([along, across], axis=-1)
        wide = np.linalg.svd(np.where(np.isfinite(size), size, 0.0), compute_uv=False)
        measurable = (wide[:, 1] > 0.8) & (wide[:, 0] < reach_px / 3.2)
        good: NDArray[np.bool_] = (depth > 0) & narrow & inside & measurable
        around = [
            where_m,
            *(where_m + np.array(d) * 4 * sigma_m for d in ((1, 1), (1, -1), (-1, 1), (-1, -1))),
        ]
        for spots in around:
            if not good.any():
                break
            good[good] = ~hidden(world, self.centre_m, surface(spots[good]))
        return good


def hidden(world: World, eye_m: FloatArray, points_m: FloatArray) -> NDArray[np.bool_]:
    """Whether ground or structures are between the eye (3,) and points (n, 3)."""
    start = np.broadcast_to(eye_m, points_m.shape)
    towards = points_m - eye_m
    nearest = trace(world.relief, start, towards)[0]
    for facet in world.facets:
        distance, s, t = facet.hit(start, towards)
        nearest = np.where(facet.covers(s, t), np.minimum(nearest, distance), nearest)
    return nearest < 1 - 1e-5


def centroids(image: FloatArray, near_px: FloatArray, reach_px: int) -> FloatArray:
    """Centres of gravity (n, 2) of what is brighter than the dots' background around ``near_px``."""
    found = []
    for u, v in near_px:
        column, row = int(u), int(v)
        box = np.s_[row - reach_px : row + reach_px + 1, column - reach_px : column + reach_px + 1]
        patch = image[box]
        border = np.concatenate([patch[0], patch[-1], patch[:, 0], patch[:, -1]])
        weight = np.maximum(patch - np.median(border) - 1.5, 0)
        rows, columns = np.mgrid[box]
        # (0.5, 0.5) is the centre of the first pixel.
        found.append([(weight * (columns + 0.5)).sum(), (weight * (rows + 0.5)).sum()] / weight.sum())
    return np.array(found)

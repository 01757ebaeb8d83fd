"""Truth at rendered photos: where what one photo shows must be seen in another."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from calib.align.features import Features, decode_gray, extract
from calib.camera import FloatArray
from calib.field import Lens
from calib.photos.photo import Photo
from calib.solution import IntArray
from sim.relief import Relief
from sim.survey import SurveyOptions, SurveyTruth


@dataclass(frozen=True)
class Scene:
    """A rendered survey's truth with its ground."""

    truth: SurveyTruth

    @property
    def lens(self) -> Lens:
        return Lens(self.truth.camera)

    def ground_m(self, photo: IntArray, pixels: FloatArray) -> FloatArray:
        """What is seen at ``pixels`` (n, 2) of ``photo`` (n,): points (n, 3) on the relief."""
        relief = Relief.random(self.truth.seed, SurveyOptions().relief_m)
        rays = self.lens.unproject(pixels)
        direction = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
        rotations, centres = self.truth.rotations_cam_from_world[photo], self.truth.centres_m[photo]
        direction = np.einsum("nji,nj->ni", rotations, direction)
        height = np.zeros(len(rays))
        for _ in range(40):  # gentle slopes: each round gains a digit
            points: FloatArray = centres + direction * ((height - centres[:, 2]) / direction[:, 2])[:, None]
            height = relief.height_m(points[:, 0], points[:, 1])
        return points

    def seen_px(self, photo: IntArray, points_m: FloatArray) -> FloatArray:
        """Pixels (n, 2) of points (n, 3) in ``photo`` (n,)."""
        offset = points_m - self.truth.centres_m[photo]
        in_cam = np.einsum("nij,nj->ni", self.truth.rotations_cam_from_world[photo], offset)
        pixels: FloatArray = self.lens.project(in_cam[:, :2] / in_cam[:, 2:])
        return pixels

    def overlap(self, a: int, b: int) -> float:
        """Share of photo ``a`` that photo ``b`` sees too."""
        camera = self.truth.camera
        u, v = np.meshgrid(np.linspace(1, camera.width - 1, 16), np.linspace(1, camera.height - 1, 12))
        pixels = np.stack([u.ravel(), v.ravel()], axis=-1)
        points = self.ground_m(np.full(len(pixels), a), pixels)
        seen = self.seen_px(np.full(len(pixels), b), points)
        return float(((seen > 0) & (seen < [camera.width, camera.height])).all(axis=1).mean())


def features_of(photo: Photo, longer_side_px: int | None = None) -> Features:
    return _features_of(photo.path, longer_side_px)


@lru_cache(maxsize=64)
def _features_of(path: Path, longer_side_px: int | None) -> Features:
    return extract(*decode_gray(path, longer_side_px))

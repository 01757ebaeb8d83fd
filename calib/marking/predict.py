"""Where the points not yet marked in a photo must be, from those that are: its pose by resection."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.camera import BrownCamera, FloatArray
from calib.control_adjust import Block, MarkSet, in_camera, resected, residuals_px
from calib.control_files import ControlPoint
from calib.errors import AlignmentError

#: Marks on known points that place a photo; with one more, a wrong one shows.
LEAST_MARKS = 4


@dataclass(frozen=True)
class Prediction:
    """Pixels by point of all known points in view; ``doubtful``: marks that contradict the others."""

    pixels: Mapping[str, tuple[float, float]]
    doubtful: tuple[str, ...] = ()


def predict(
    points: Mapping[str, ControlPoint],
    marked: Mapping[str, tuple[float, float]],
    camera: BrownCamera,
) -> Prediction | None:
    """What the pose of one photo says about all points.

    ``marked``: pixels by point. None with fewer than four marks on known points, or where no four agree.
    What the lens does to nearby marks is passed on to the predicted ones.
    """
    names = list(points)
    known = [name for name in marked if name in points]
    if len(known) < LEAST_MARKS:
        return None
    xyz = np.array([points[name].xyz_m for name in names])
    marks = MarkSet(
        photo=np.zeros(len(known), int),
        point=np.array([names.index(name) for name in known]),
        pixels=np.array([marked[name] for name in known], float),
        sigma_px=1.0,
        points_m=xyz - xyz.mean(axis=0),
        sigmas_m=np.zeros_like(xyz),
        control=np.ones(len(names), bool),
    )
    try:
        block, agree = resected(marks, camera)
    except AlignmentError:
        return None
    pixels = _predicted(marks, block, residuals_px(marks, block)[agree], marks.pixels[agree])
    inside = np.all((pixels >= 0) & (pixels <= [camera.width, camera.height]), axis=1)
    return Prediction(
        {
            name: (float(u), float(v))
            for name, (u, v), good in zip(names, pixels, inside, strict=True)
            if good
        },
        tuple(name for name, good in zip(known, agree, strict=True) if not good),
    )


def _predicted(marks: MarkSet, block: Block, misses: FloatArray, near_px: FloatArray) -> FloatArray:
    """All points (t, 2) in the one photo, NaN behind it, moved by what the marks around them miss by."""
    count = len(marks.points_m)
    every = MarkSet(
        np.zeros(count, int),
        np.arange(count),
        np.zeros((count, 2)),
        1.0,
        marks.points_m,
        marks.sigmas_m,
        marks.control,
    )
    pixels = -residuals_px(every, block)
    distance = np.linalg.norm(pixels[:, None] - near_px, axis=2)
    weight = 1 / (distance**2 + (0.02 * block.camera.width) ** 2)
    moved = pixels + weight @ misses / weight.sum(axis=1, keepdims=True)
    return np.where(in_camera(every, block)[:, 2:] > 0, moved, np.nan)

"""Brown's parameters of a total distortion, and their covariance.

The adjustment estimates Brown plus a residual field; for the K1-K2 plane, for exports and for
comparing f, plain Brown is fitted to the total mapping over the image. The focal length of that
fit is what fieldcal calls f: it means the same for every model the lens was estimated under.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.camera import BROWN_NAMES, BrownCamera, FloatArray
from calib.field import Lens

FITTED = ("f", "cx", "cy", "k1", "k2", "k3", "p1", "p2", "b1", "b2")


def image_grid_rays(lens: Lens, columns: int = 28, rows: int = 21) -> FloatArray:
    """Rays (g, 2) of a uniform pixel grid; pixels that the model cannot reach are left out."""
    u = (np.arange(columns) + 0.5) / columns * lens.brown.width
    v = (np.arange(rows) + 0.5) / rows * lens.brown.height
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    rays = lens.unproject(pixels)
    good: FloatArray = rays[np.isfinite(rays).all(axis=1)]
    return good


def turned_rays(rays: FloatArray) -> FloatArray:
    """d rays / d rotation vector of a small turn of all rays about x, y and z: (g, 2) -> (g, 2, 3)."""
    x, y = rays.T
    by_x, by_y = np.stack([-x * y, -(1 + y * y)], axis=-1), np.stack([1 + x * x, x * y], axis=-1)
    return np.stack([by_x, by_y, np.stack([-y, x], axis=-1)], axis=-1)


def fit_brown(lens: Lens, keep_k4: bool = False, affinity: bool = True) -> tuple[BrownCamera, FloatArray]:
    """Brown camera nearest to the total mapping of ``lens``, and d fitted / d lens (11, 35).

    Least squares of pixel differences over a uniform grid. K4 is kept as it is where the lens was
    estimated with one (``keep_k4``). Without ``affinity``, b1 and b2 are zero and the rest makes up
    for them: many programs cannot hold them.
    """
    rays = image_grid_rays(lens)
    fitted = {n for n in FITTED if affinity or n not in ("b1", "b2")} | ({"k4"} if keep_k4 else set())
    columns = np.array([n in fitted for n in BROWN_NAMES])
    target, _, by_lens = lens.derivatives(rays)
    camera = lens.brown if affinity else replace(lens.brown, b1_px=0.0, b2_px=0.0)
    for _ in range(10):
        pixels, _, by_param = camera.derivatives(rays)
        design = by_param[:, :, columns].reshape(-1, int(columns.sum()))
        scale = 1 / np.linalg.norm(design, axis=0)
        step = np.linalg.lstsq(design * scale, (target - pixels).ravel(), rcond=None)[0] * scale
        vector = camera.vector
        vector[columns] += step
        camera = BrownCamera.from_vector(camera.width, camera.height, vector)
        if np.abs(step / scale).max(initial=0.0) < 1e-9 * len(rays):
            break
    _, _, by_param = camera.derivatives(rays)
    design = by_param[:, :, columns].reshape(-1, int(columns.sum()))
    scale = 1 / np.linalg.norm(design, axis=0)
    response = np.linalg.lstsq(design * scale, by_lens.reshape(-1, by_lens.shape[2]), rcond=None)[0]
    jacobian = np.zeros((len(BROWN_NAMES), by_lens.shape[2]))
    jacobian[columns] = response * scale[:, None]
    return camera, jacobian

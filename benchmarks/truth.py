"""A found lens against the true one, as mappings of rays to pixels."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from calib.brownfit import image_grid_rays, turned_rays
from calib.camera import FloatArray
from calib.field import Lens


def mapping_error(
    lens: Lens, truth: Callable[[FloatArray], FloatArray], covariance: FloatArray | None = None
) -> tuple[float, float]:
    """Rms error of the total mapping over the image, px, and its ratio to the reported rms.

    A rotation common to all cameras cannot be seen by any block, and a shift of the principal
    point is one to first order: the best rotation is taken out of the error and of the covariance
    ((35, 35) over the lens; without one the ratio is NaN).
    """
    rays = image_grid_rays(lens, 20, 15)
    difference = (lens.project(rays) - truth(rays)).ravel()
    _, by_ray, by_lens = lens.derivatives(rays)
    q, _ = np.linalg.qr((by_ray @ turned_rays(rays)).reshape(-1, 3))
    rest = difference - q @ (q.T @ difference)
    size = float(rest @ rest)
    rms = math.sqrt(size / len(rays))
    if covariance is None:
        return rms, math.nan
    jacobian = by_lens.reshape(-1, by_lens.shape[2])
    jacobian = jacobian - q @ (q.T @ jacobian)
    expected = float(np.einsum("ij,jk,ik->", jacobian, covariance, jacobian, optimize=True))
    return rms, math.sqrt(size / max(expected, 1e-300))

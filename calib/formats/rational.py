"""OpenCV's rational model, shared by OpenCV's and COLMAP's files.

x' = x (1 + k1 r2 + k2 r4 + k3 r6) / (1 + k4 r2 + k5 r4 + k6 r6) + 2 p1 x y + p2 (r2 + 2 x2)
(OpenCV, calib3d; COLMAP's FULL_OPENCV). With k4 = k5 = k6 = 0 it is Brown's model with K1-K3; its
k4 is not Brown's K4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.camera import BrownCamera, FloatArray
from calib.convert import image_grid_px
from calib.formats.common import fitted, usable


@dataclass(frozen=True)
class RationalModel:
    """``fx_px, fy_px, cx_px, cy_px`` in px with the first pixel's centre at (0.5, 0.5)."""

    width: int
    height: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    numerator: tuple[float, float, float] = (0.0, 0.0, 0.0)
    denominator: tuple[float, float, float] = (0.0, 0.0, 0.0)
    p1: float = 0.0
    p2: float = 0.0

    def project(self, rays: FloatArray) -> FloatArray:
        """Rays (n, 2) -> pixels (n, 2)."""
        x, y = rays[:, 0], rays[:, 1]
        r2 = x * x + y * y
        radial = np.ones_like(r2)
        below = np.ones_like(r2)
        for power, (k, d) in enumerate(zip(self.numerator, self.denominator, strict=True), 1):
            radial += k * r2**power
            below += d * r2**power
        radial /= below
        xd = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        yd = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        return np.stack([self.cx_px + self.fx_px * xd, self.cy_px + self.fy_px * yd], -1)


def brown_from_rational(model: RationalModel, tolerance_px: float, what: str) -> BrownCamera:
    """Exact where the denominator is one, else fitted.

    Raises:
        FormatError: the fit exceeds ``tolerance_px``.
    """
    k1, k2, k3 = model.numerator
    start = usable(
        BrownCamera(
            model.width,
            model.height,
            model.fx_px,
            model.cx_px,
            model.cy_px,
            k1,
            k2,
            k3,
            p1=model.p1,
            p2=model.p2,
            b1_px=model.fx_px - model.fy_px,
        )
    )
    if not any(model.denominator):
        return start
    return usable(fitted(model.project, start, tolerance_px, what))


def rational_from_brown(camera: BrownCamera) -> RationalModel:
    """Exact for K4 = b2 = 0; K4 goes into a denominator fitted over the image; b2 is lost.

    The caller checks what the loss costs.
    """
    numerator, denominator = (camera.k1, camera.k2, camera.k3), (0.0, 0.0, 0.0)
    if camera.k4:
        numerator, denominator = _with_denominator(camera)
    return RationalModel(
        camera.width,
        camera.height,
        camera.f_px,
        camera.fy_px,
        camera.cx_px,
        camera.cy_px,
        numerator,
        denominator,
        camera.p1,
        camera.p2,
    )


_Triple = tuple[float, float, float]


def _with_denominator(camera: BrownCamera) -> tuple[_Triple, _Triple]:
    """Numerator and denominator closest to 1 + K1 r2 + ... + K4 r8 over the image.

    One, two and three denominator terms are tried: more are not always better, and a pole within the
    image is never wanted.
    """
    rays = camera.unproject(image_grid_px(camera.width, camera.height))
    r2 = (rays**2).sum(axis=-1)
    r2 = r2[np.isfinite(r2)]
    radial = 1 + r2 * (camera.k1 + r2 * (camera.k2 + r2 * (camera.k3 + r2 * camera.k4)))
    powers = np.stack([r2, r2**2, r2**3], -1)
    best: tuple[float, FloatArray] = (np.inf, np.zeros(6))
    for terms in (1, 2, 3):
        # N(r) - radial D(r) = 0 is linear in the unknowns; weighted as displacements.
        design = np.sqrt(r2)[:, None] * np.hstack([powers, -radial[:, None] * powers[:, :terms]])
        scale = np.linalg.norm(design, axis=0)
        k = np.zeros(6)
        k[: 3 + terms] = np.linalg.lstsq(design / scale, np.sqrt(r2) * (radial - 1), rcond=None)[0] / scale
        below = 1 + powers @ k[3:]
        if below.min(initial=1.0) > 0.1:
            error = float((np.sqrt(r2) * np.abs((1 + powers @ k[:3]) / below - radial)).max(initial=0.0))
            best = min(best, (error, k), key=lambda found: found[0])
    k = best[1]
    return (float(k[0]), float(k[1]), float(k[2])), (float(k[3]), float(k[4]), float(k[5]))

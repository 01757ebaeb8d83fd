"""Brown-Conrady camera: projection, its derivatives and its inverse.

Conventions (the only ones used inside fieldcal):

* A ray is (x, y) = (X/Z, Y/Z) in the camera frame: x right, y down, z forward.
* Direction: undistorted -> distorted, as OpenCV and Metashape have it
  ([C&D] Table 1 prints the numbers of this direction).
* Pixels: the centre of the first pixel is (0.5, 0.5), so the image centre is (w/2, h/2),
  as COLMAP and Metashape have it. OpenCV's (0, 0) origin is converted where OpenCV is called.
* P1, P2 in OpenCV's (and [C&D] Table 1's) order: x += 2 P1 x y + P2 (r2 + 2 x2).
* ``f_px`` is the focal length along image rows (fx). A rolling shutter that reads row by row
  stretches columns only, so fx keeps its meaning where fy does not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

#: Names of the Brown parameters, in the order of every parameter vector and covariance.
BROWN_NAMES = ("f", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "b1", "b2")


@dataclass(frozen=True)
class BrownCamera:
    """A Brown-Conrady camera.

    u = cx + f xd + b2 yd,  v = cy + (f - b1) yd, with
    xd = x (1 + K1 r2 + K2 r4 + K3 r6 + K4 r8) + 2 P1 x y + P2 (r2 + 2 x2) and likewise for y
    ([C&D] Table 1; b1, b2 as Metashape has them, with f = fx here and fy = f - b1).

    ``f_px, cx_px, cy_px, b1_px, b2_px`` are in pixels, ``k1``..``k4``, ``p1``, ``p2`` in focal units.
    """

    width: int
    height: int
    f_px: float
    cx_px: float
    cy_px: float
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    b1_px: float = 0.0
    b2_px: float = 0.0

    @classmethod
    def ideal(cls, width: int, height: int, f_px: float) -> BrownCamera:
        """A camera without distortion, principal point at the image centre."""
        return cls(width, height, f_px, width / 2, height / 2)

    @classmethod
    def from_vector(cls, width: int, height: int, vector: FloatArray) -> BrownCamera:
        """Inverse of :meth:`vector`; ``vector`` is (11,) in the order of ``BROWN_NAMES``."""
        return cls(width, height, *(float(v) for v in vector))

    @property
    def vector(self) -> FloatArray:
        """Parameters as (11,) in the order of ``BROWN_NAMES``."""
        return np.array(
            [
                self.f_px,
                self.cx_px,
                self.cy_px,
                self.k1,
                self.k2,
                self.k3,
                self.k4,
                self.p1,
                self.p2,
                self.b1_px,
                self.b2_px,
            ]
        )

    @property
    def fy_px(self) -> float:
        return self.f_px - self.b1_px

    @property
    def k1_px(self) -> float:
        """K1 in pixel units, px^-2 ([C&D] eq. 1)."""
        return self.k1 / self.f_px**2

    @property
    def k2_px(self) -> float:
        """K2 in pixel units, px^-4 ([C&D] eq. 2)."""
        return self.k2 / self.f_px**4

    @property
    def k3_px(self) -> float:
        """K3 in pixel units, px^-6 ([C&D] eq. 3)."""
        return self.k3 / self.f_px**6

    @property
    def diagonal_px(self) -> float:
        return float(np.hypot(self.width, self.height))

    def project(self, rays: FloatArray) -> FloatArray:
        """Rays (..., 2) -> pixels (..., 2)."""
        x, y = rays[..., 0], rays[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * (self.k3 + r2 * self.k4)))
        xd = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        yd = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        return np.stack(
            [
                self.cx_px + self.f_px * xd + self.b2_px * yd,
                self.cy_px + (self.f_px - self.b1_px) * yd,
            ],
            axis=-1,
        )

    def derivatives(self, rays: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Projection with its derivatives.

        Args:
            rays: (n, 2).

        Returns:
            pixels (n, 2), d pixels / d ray (n, 2, 2), d pixels / d parameters (n, 2, 11).
        """
        x, y = rays[:, 0], rays[:, 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * (self.k3 + r2 * self.k4)))
        slope = self.k1 + r2 * (2 * self.k2 + r2 * (3 * self.k3 + r2 * 4 * self.k4))  # d radial / d r2
        dx_p1, dx_p2 = 2 * x * y, r2 + 2 * x * x
        dy_p1, dy_p2 = r2 + 2 * y * y, 2 * x * y
        xd = x * radial + self.p1 * dx_p1 + self.p2 * dx_p2
        yd = y * radial + self.p1 * dy_p1 + self.p2 * dy_p2
        xx = radial + 2 * x * x * slope + 2 * self.p1 * y + 6 * self.p2 * x
        xy = 2 * x * y * slope + 2 * self.p1 * x + 2 * self.p2 * y  # symmetric: d xd/dy = d yd/dx
        yy = radial + 2 * y * y * slope + 6 * self.p1 * y + 2 * self.p2 * x
        fx, fy, b2 = self.f_px, self.f_px - self.b1_px, self.b2_px
        n = len(x)
        pixels = np.stack([self.cx_px + fx * xd + b2 * yd, self.cy_px + fy * yd], axis=-1)
        by_ray = np.empty((n, 2, 2))
        by_ray[:, 0, 0] = fx * xx + b2 * xy
        by_ray[:, 0, 1] = fx * xy + b2 * yy
        by_ray[:, 1, 0] = fy * xy
        by_ray[:, 1, 1] = fy * yy
        by_param = np.zeros((n, 2, 11))
        by_param[:, 0, 0], by_param[:, 1, 0] = xd, yd
        by_param[:, 0, 1] = by_param[:, 1, 2] = 1
        power = r2
        for column in range(3, 7):
            by_param[:, 0, column] = (fx * x + b2 * y) * power
            by_param[:, 1, column] = fy * y * power
            power = power * r2
        by_param[:, 0, 7] = fx * dx_p1 + b2 * dy_p1
        by_param[:, 1, 7] = fy * dy_p1
        by_param[:, 0, 8] = fx * dx_p2 + b2 * dy_p2
        by_param[:, 1, 8] = fy * dy_p2
        by_param[:, 1, 9] = -yd
        by_param[:, 0, 10] = yd
        return pixels, by_ray, by_param

    def unproject(self, pixels: FloatArray, iterations: int = 50) -> FloatArray:
        """Pixels (..., 2) -> rays (..., 2) by Newton's method on the exact derivatives.

        Pixels that the lens model cannot reach (beyond the turning point of the radial
        polynomial) come back as NaN.
        """
        flat = np.asarray(pixels, dtype=float).reshape(-1, 2)
        fy = self.f_px - self.b1_px
        yd = (flat[:, 1] - self.cy_px) / fy
        xd = (flat[:, 0] - self.cx_px - self.b2_px * yd) / self.f_px
        rays = np.stack([xd, yd], axis=-1)
        for _ in range(iterations):
            at, by_ray, _ = self.derivatives(rays)
            residual = flat - at
            det = by_ray[:, 0, 0] * by_ray[:, 1, 1] - by_ray[:, 0, 1] * by_ray[:, 1, 0]
            det = np.where(np.abs(det) < 1e-6 * self.f_px**2, 1e-6 * self.f_px**2, det)
            step = np.stack(
                [
                    by_ray[:, 1, 1] * residual[:, 0] - by_ray[:, 0, 1] * residual[:, 1],
                    by_ray[:, 0, 0] * residual[:, 1] - by_ray[:, 1, 0] * residual[:, 0],
                ],
                axis=-1,
            )
            step /= det[:, None]
            # A step of more than half a focal length has left the region where Newton converges.
            rays = rays + np.clip(step, -0.5, 0.5)
            if np.abs(step).max(initial=0.0) < 1e-13:
                break
        miss = np.abs(self.project(rays) - flat).max(axis=-1)
        rays[~(miss < 1e-6)] = np.nan
        return rays.reshape(np.shape(pixels))

    def scaled(self, width: int, height: int) -> BrownCamera:
        """The same camera with its images resampled to ``width`` x ``height`` (no crop)."""
        sx, sy = width / self.width, height / self.height
        fy = self.fy_px * sy
        return replace(
            self,
            width=width,
            height=height,
            f_px=self.f_px * sx,
            cx_px=self.cx_px * sx,
            cy_px=self.cy_px * sy,
            b1_px=self.f_px * sx - fy,
            b2_px=self.b2_px * sx,
        )


def radial_profile_px(k1_px: float, k2_px: float, k3_px: float, radius_px: FloatArray) -> FloatArray:
    """Radial displacement K1 r^3 + K2 r^5 + K3 r^7 in px ([SEN] eq. 1), K in pixel units."""
    r2 = radius_px * radius_px
    return radius_px * r2 * (k1_px + r2 * (k2_px + r2 * k3_px))

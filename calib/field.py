"""The weak residual distortion field on top of Brown, and the lens made of both.

Products of Legendre polynomials of total degree 2 to 4 over the image, one set for u and one
for v: 24 coefficients in px. Degrees 0 and 1 are left out so that the principal point, the
focal length and the aspect keep their meaning. Why it is needed: docs/method.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from calib.camera import BROWN_NAMES, BrownCamera, FloatArray

DEGREES = tuple((i, d - i) for d in (2, 3, 4) for i in range(d, -1, -1))
#: Names of the field's coefficients, in the order of every parameter vector.
FIELD_NAMES = tuple(f"{axis}{i}{j}" for axis in "uv" for i, j in DEGREES)
LENS_NAMES = BROWN_NAMES + FIELD_NAMES


def _legendre(t: FloatArray) -> tuple[list[FloatArray], list[FloatArray]]:
    """Legendre polynomials 0..4 at ``t`` and their derivatives."""
    t2 = t * t
    one = np.ones_like(t)
    values = [one, t, 1.5 * t2 - 0.5, t * (2.5 * t2 - 1.5), (35 * t2 * t2 - 30 * t2 + 3) / 8]
    slopes = [0 * one, one, 3 * t, 7.5 * t2 - 1.5, t * (17.5 * t2 - 7.5)]
    return values, slopes


def field_basis(pixels: FloatArray, width: int, height: int) -> FloatArray:
    """The 12 products P_i(s) P_j(t) at ``pixels`` (n, 2), as (n, 12); s, t in -1..1 over the image."""
    s = 2 * pixels[:, 0] / width - 1
    t = 2 * pixels[:, 1] / height - 1
    ps, _ = _legendre(s)
    pt, _ = _legendre(t)
    return np.stack([ps[i] * pt[j] for i, j in DEGREES], axis=-1)


def _basis_slopes(pixels: FloatArray, width: int, height: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    s = 2 * pixels[:, 0] / width - 1
    t = 2 * pixels[:, 1] / height - 1
    ps, ds = _legendre(s)
    pt, dt = _legendre(t)
    basis = np.stack([ps[i] * pt[j] for i, j in DEGREES], axis=-1)
    by_u = np.stack([ds[i] * pt[j] for i, j in DEGREES], axis=-1) * (2 / width)
    by_v = np.stack([ps[i] * dt[j] for i, j in DEGREES], axis=-1) * (2 / height)
    return basis, by_u, by_v


@dataclass(frozen=True)
class Lens:
    """Brown plus residual field: pixels = brown(ray) + field(brown(ray)).

    ``field_px`` is (24,) in px, in the order of ``FIELD_NAMES``; zeros mean plain Brown.
    """

    brown: BrownCamera
    field_px: FloatArray = field(default_factory=lambda: np.zeros(len(FIELD_NAMES)))

    @property
    def vector(self) -> FloatArray:
        """All parameters, (35,) in the order of ``LENS_NAMES``."""
        return np.concatenate([self.brown.vector, self.field_px])

    def with_vector(self, vector: FloatArray) -> Lens:
        nb = len(BROWN_NAMES)
        brown = BrownCamera.from_vector(self.brown.width, self.brown.height, vector[:nb])
        return replace(self, brown=brown, field_px=np.array(vector[nb:]))

    def project(self, rays: FloatArray) -> FloatArray:
        """Rays (..., 2) -> pixels (..., 2): the total mapping."""
        pixels = self.brown.project(rays)
        if not self.field_px.any():
            return pixels
        flat = pixels.reshape(-1, 2)
        basis = field_basis(flat, self.brown.width, self.brown.height)
        shift = np.stack([basis @ self.field_px[:12], basis @ self.field_px[12:]], axis=-1)
        return (flat + shift).reshape(pixels.shape)

    def derivatives(self, rays: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """As :meth:`BrownCamera.derivatives`, with 35 parameters."""
        brown_px, by_ray, by_brown = self.brown.derivatives(rays)
        basis, by_u, by_v = _basis_slopes(brown_px, self.brown.width, self.brown.height)
        cu, cv = self.field_px[:12], self.field_px[12:]
        through = np.empty((len(rays), 2, 2))
        through[:, 0, 0], through[:, 0, 1] = 1 + by_u @ cu, by_v @ cu
        through[:, 1, 0], through[:, 1, 1] = by_u @ cv, 1 + by_v @ cv
        pixels = brown_px + np.stack([basis @ cu, basis @ cv], axis=-1)
        by_param = np.zeros((len(rays), 2, len(LENS_NAMES)))
        nb = len(BROWN_NAMES)
        by_param[:, :, :nb] = through @ by_brown
        by_param[:, 0, nb : nb + 12] = basis
        by_param[:, 1, nb + 12 :] = basis
        return pixels, through @ by_ray, by_param

    def unproject(self, pixels: FloatArray) -> FloatArray:
        """Pixels (..., 2) -> rays (..., 2); NaN where the model cannot reach."""
        flat = np.asarray(pixels, dtype=float).reshape(-1, 2)
        if not self.field_px.any():
            return self.brown.unproject(flat).reshape(np.shape(pixels))
        brown_px = flat.copy()
        # The field's slope is a few 1e-3 at most, so the fixed point is reached in a few rounds.
        for _ in range(20):
            basis = field_basis(brown_px, self.brown.width, self.brown.height)
            shift = np.stack([basis @ self.field_px[:12], basis @ self.field_px[12:]], axis=-1)
            brown_px = flat - shift
        return self.brown.unproject(brown_px).reshape(np.shape(pixels))

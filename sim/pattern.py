"""A smooth lens pattern that no Brown parameter and no rotation of the camera can imitate."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from calib.brownfit import turned_rays
from calib.camera import BROWN_NAMES, BrownCamera, FloatArray

#: Brown parameters that the pattern is orthogonal to (K4 is not in the papers' models).
_TANGENT = ("f", "cx", "cy", "k1", "k2", "k3", "p1", "p2", "b1", "b2")
_DEGREE = 9


@dataclass(frozen=True)
class Pattern:
    """Shift in px as a function of the pixel: a Legendre polynomial over the image.

    coefficients: (10, 10, 2), by degree along the row, degree along the column, and u or v.
    """

    width: int
    height: int
    coefficients: FloatArray

    def __call__(self, pixels: FloatArray) -> FloatArray:
        """Pixels (..., 2) -> shift (..., 2) in px; held at the border's value a little outside of it."""
        s = np.clip(2 * pixels[..., 0] / self.width - 1, -1.05, 1.05)
        t = np.clip(2 * pixels[..., 1] / self.height - 1, -1.05, 1.05)
        ps = np.polynomial.legendre.legvander(s, _DEGREE)
        pt = np.polynomial.legendre.legvander(t, _DEGREE)
        return np.stack([np.sum((ps @ self.coefficients[..., a]) * pt, axis=-1) for a in (0, 1)], axis=-1)

    def scaled(self, width: int, height: int) -> Pattern:
        """The same pattern with the images resampled to another size."""
        factor = np.array([width / self.width, height / self.height])
        return Pattern(width, height, self.coefficients * factor)


def pixel_grid(width: int, height: int, columns: int = 61, rows: int = 46) -> FloatArray:
    """Cell centres of a regular grid over the image, (columns * rows, 2)."""
    u = (np.arange(columns) + 0.5) * width / columns
    v = (np.arange(rows) + 0.5) * height / rows
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def tangent_space(camera: BrownCamera, pixels: FloatArray) -> FloatArray:
    """What Brown's parameters and the three rotations of the camera can do at ``pixels``: (n, 2, 13).

    A rotation common to all photos is a change of poses, not of the lens: no block can see it.
    """
    rays = camera.unproject(pixels)
    _, by_ray, by_param = camera.derivatives(rays)
    chosen = [BROWN_NAMES.index(name) for name in _TANGENT]
    return np.concatenate([by_param[:, :, chosen], by_ray @ turned_rays(rays)], axis=-1)


@lru_cache(maxsize=64)
def random_pattern(seed: int, camera: BrownCamera, max_px: float, shortest: float = 0.8) -> Pattern:
    """A random smooth pattern of the stated maximum length over the image.

    Random waves no shorter than ``shortest`` image widths are fitted by polynomials of total degree
    up to 9 and made orthogonal, over the image, to Brown's parameters, so that the focal length of
    ``camera`` stays the one that fits the total mapping best.
    """
    rng = np.random.default_rng([seed, 2])
    pixels = pixel_grid(camera.width, camera.height)
    waves = 8
    length = camera.width * rng.uniform(shortest, 2.5 * shortest, (2, waves))
    azimuth = rng.uniform(0, 2 * np.pi, (2, waves))
    phase = rng.uniform(0, 2 * np.pi, (2, waves))
    amplitude = rng.normal(size=(2, waves))
    along = pixels[:, 0, None, None] * np.cos(azimuth) + pixels[:, 1, None, None] * np.sin(azimuth)
    raw = np.sum(amplitude * np.sin(2 * np.pi * along / length + phase), axis=-1)  # (n, 2)

    s, t = 2 * pixels[:, 0] / camera.width - 1, 2 * pixels[:, 1] / camera.height - 1
    powers = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    ps = np.polynomial.legendre.legvander(s, _DEGREE)
    pt = np.polynomial.legendre.legvander(t, _DEGREE)
    terms = np.stack([ps[:, i] * pt[:, j] for i, j in powers], axis=-1)
    # Least squares of the waves under the condition that the inner products with the tangent
    # space vanish: with terms = Q R, the polynomial's values are Q z, and z loses its part in
    # the span of the conditions.
    q, r = np.linalg.qr(terms)
    tangent = tangent_space(camera, pixels)
    conditions = np.concatenate([q.T @ tangent[:, 0], q.T @ tangent[:, 1]])
    span, _ = np.linalg.qr(conditions / np.linalg.norm(conditions, axis=0))
    z = np.concatenate([q.T @ raw[:, 0], q.T @ raw[:, 1]])
    z -= span @ (span.T @ z)
    c = np.linalg.solve(r, z.reshape(2, -1).T)
    coefficients = np.zeros((_DEGREE + 1, _DEGREE + 1, 2))
    for (i, j), value in zip(powers, c, strict=True):
        coefficients[i, j] = value
    unit = Pattern(camera.width, camera.height, coefficients)
    # The polynomial is largest at the border, which cell centres miss.
    border = np.stack(
        np.meshgrid(np.linspace(0, camera.width, 121), np.linspace(0, camera.height, 91)), axis=-1
    )
    largest = np.linalg.norm(unit(border), axis=-1).max()
    return Pattern(camera.width, camera.height, coefficients * (max_px / largest))

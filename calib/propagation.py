"""Sigmas of Brown parameters and of what is derived from them: K in pixel units, the radial profile."""

from __future__ import annotations

import numpy as np

from calib.camera import BROWN_NAMES, BrownCamera, FloatArray
from calib.solution import Estimate

#: Attributes of ``BrownCamera`` with their units, in the order of ``BROWN_NAMES``.
BROWN_KEYS = ("f_px", "cx_px", "cy_px", "k1", "k2", "k3", "k4", "p1", "p2", "b1_px", "b2_px")
PIXEL_KEYS = ("k1_px", "k2_px", "k3_px")

_F = BROWN_NAMES.index("f")
_K = [BROWN_NAMES.index(name) for name in ("k1", "k2", "k3", "k4")]


def radial_px(brown: BrownCamera) -> FloatArray:
    """K1..K4 in pixel units: (4,) in px^-2, px^-4, px^-6, px^-8 ([C&D] eq. 1-3)."""
    return np.array([brown.k1, brown.k2, brown.k3, brown.k4]) / brown.f_px ** np.array([2, 4, 6, 8])


def radial_px_covariance(brown: BrownCamera, covariance: FloatArray) -> FloatArray:
    """Covariance (4, 4) of :func:`radial_px` from that of the parameters (11, 11, ``BROWN_NAMES``).

    The focal length takes part: d(K_n / f^2n) / df = -2n K_n / f^(2n+1).
    """
    powers = np.array([2, 4, 6, 8])
    jacobian = np.zeros((4, len(BROWN_NAMES)))
    jacobian[:, _F] = -powers * radial_px(brown) / brown.f_px
    jacobian[np.arange(4), _K] = brown.f_px ** -powers.astype(float)
    return np.asarray(jacobian @ covariance @ jacobian.T)


def profile_px(brown: BrownCamera, radius_px: FloatArray) -> FloatArray:
    """Radial displacement K1 r^3 + ... + K4 r^9 in px at ``radius_px`` (n,) ([SEN] eq. 1)."""
    return np.asarray(_powers(radius_px) @ radial_px(brown))


def profile_sigma_px(brown: BrownCamera, covariance: FloatArray, radius_px: FloatArray) -> FloatArray:
    """Standard deviation (n,) of :func:`profile_px`; NaN where the covariance is not usable."""
    design = _powers(radius_px)
    variance = np.sum((design @ radial_px_covariance(brown, covariance)) * design, axis=1)
    return np.asarray(np.sqrt(np.where(variance >= 0, variance, np.nan)))


def _powers(radius_px: FloatArray) -> FloatArray:
    return np.asarray(np.asarray(radius_px, dtype=float)[:, None] ** np.array([3, 5, 7, 9]))


def parameter_sigmas(estimate: Estimate) -> dict[str, float]:
    """Standard deviations by ``BROWN_KEYS`` and ``PIXEL_KEYS``; NaN where unknown, 0 where held."""
    variances = np.concatenate(
        [
            np.diag(estimate.covariance),
            np.diag(radial_px_covariance(estimate.brown, estimate.covariance))[: len(PIXEL_KEYS)],
        ]
    )
    sigmas = np.sqrt(np.where(variances >= 0, variances, np.nan))
    return {key: float(sigma) for key, sigma in zip(BROWN_KEYS + PIXEL_KEYS, sigmas, strict=True)}


def correlations(covariance: FloatArray) -> tuple[tuple[str, ...], FloatArray]:
    """Keys of the e estimated parameters and their correlations (e, e); all finite, within -1..1."""
    variance = np.diag(covariance)
    index = [i for i in range(len(BROWN_KEYS)) if np.isfinite(variance[i]) and variance[i] > 0]
    sigma = np.sqrt(variance[index])
    matrix = covariance[np.ix_(index, index)] / np.outer(sigma, sigma)
    return tuple(BROWN_KEYS[i] for i in index), np.clip(np.nan_to_num(matrix), -1.0, 1.0)

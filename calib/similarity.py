"""Seven-parameter transformations between point sets (M7 of [C&D] eq. 4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.camera import FloatArray


@dataclass(frozen=True)
class Similarity:
    """target = scale * rotation @ source + shift."""

    scale: float
    rotation: FloatArray
    shift: FloatArray

    def apply(self, points: FloatArray) -> FloatArray:
        """Transform points (..., 3)."""
        moved: FloatArray = self.scale * points @ self.rotation.T + self.shift
        return moved


def fit_similarity(source: FloatArray, target: FloatArray, weights: FloatArray | None = None) -> Similarity:
    """Least-squares similarity of point sets (n, 3) (Umeyama 1991)."""
    w = np.ones(len(source)) if weights is None else weights
    w = w / w.sum()
    mean_s, mean_t = w @ source, w @ target
    ds, dt = source - mean_s, target - mean_t
    u, singular, vt = np.linalg.svd((dt * w[:, None]).T @ ds)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ np.diag(sign) @ vt
    scale = float((singular * sign).sum() / max(float(w @ np.sum(ds**2, axis=1)), 1e-300))
    return Similarity(scale, rotation, mean_t - scale * rotation @ mean_s)


def fit_robust(
    source: FloatArray, target: FloatArray, sigma: FloatArray, rounds: int = 20
) -> tuple[Similarity, FloatArray]:
    """Similarity that a minority of wrong points cannot pull far; also the residuals (n, 3).

    Args:
        sigma: (n, 3) standard deviations of ``target``; weights fall as Cauchy's beyond three of them.
    """
    weights = np.ones(len(source))
    for _ in range(rounds):
        fitted = fit_similarity(source, target, weights)
        residual = target - fitted.apply(source)
        size = np.linalg.norm(residual / sigma, axis=1)
        weights = 1 / (1 + (size / 3) ** 2)
    return fitted, residual


def mean_rotation(rotations: FloatArray) -> FloatArray:
    """Chordal mean (3, 3) of rotations (n, 3, 3)."""
    u, _, vt = np.linalg.svd(rotations.sum(axis=0))
    mean: FloatArray = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return mean

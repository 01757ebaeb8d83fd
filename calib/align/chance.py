"""Whether two estimates of one lens from the same photos differ by more than chance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.brownfit import fit_brown, image_grid_rays
from calib.camera import FloatArray
from calib.field import Lens

#: A move of an estimate that exceeds this many of its expected sigmas is model error, not chance.
CHANCE = 3.0


def projection_jacobian(lens: Lens) -> FloatArray:
    """d total mapping / d lens on a grid of the image, (2 g, 35)."""
    _, _, by_lens = lens.derivatives(image_grid_rays(lens, 12, 9))
    flat: FloatArray = by_lens.reshape(-1, by_lens.shape[2])
    return flat


@dataclass(frozen=True)
class Lengths:
    """Two lengths of a change of the lens: in f (of the Brown fit), and in the total mapping.

    f_px (35,) and mapping (2 g, 35): derivatives by the lens.
    """

    f_px: FloatArray
    mapping: FloatArray

    @staticmethod
    def of(lens: Lens) -> Lengths:
        """Lengths in the neighbourhood of ``lens``."""
        return Lengths(fit_brown(lens)[1][0], projection_jacobian(lens))

    def squares(self, move: FloatArray) -> tuple[float, float]:
        """Squared lengths of a change (35,), px^2."""
        return float((self.f_px @ move) ** 2), float(np.sum((self.mapping @ move) ** 2))

    def variances(self, covariance: FloatArray) -> tuple[float, float]:
        """Expected squared lengths under a covariance (35, 35), px^2."""
        return (
            float(self.f_px @ covariance @ self.f_px),
            float(np.einsum("ij,jk,ik->", self.mapping, covariance, self.mapping, optimize=True)),
        )


def beyond_chance(lengths: Lengths, move: FloatArray, first: FloatArray, second: FloatArray) -> bool:
    """Whether two estimates, one using more of the information than the other, contradict each other.

    Noise alone moves the estimate by the root of the difference of the variances (Hausman 1978).

    Args:
        move: (35,) from one to the other.
        first, second: their covariances (35, 35).
    """
    pairs = zip(lengths.squares(move), lengths.variances(first), lengths.variances(second), strict=True)
    return any(size > CHANCE**2 * abs(one - other) for size, one, other in pairs)

"""Residuals that agree among neighbours, and what they cost in information."""

from __future__ import annotations

import numpy as np

from calib.camera import FloatArray

#: Noise that is correlated over cells is more so over whole photos, where poses and points hide it:
#: the excess counts this many times (chosen on simulated nadir blocks, see benchmarks/honest_sigma.md).
SMOOTHER_STILL = 2.0


def correlation_factor(
    residuals: FloatArray,
    weights: FloatArray,
    photo: np.ndarray,
    pixels: FloatArray,
    size: tuple[int, int],
    photo_unknowns: int = 6,
) -> float:
    """Variance factor (>= 1) from residuals averaged over cells of each photo.

    With independent noise the mean of n residuals has variance s2 / n; the factor is the largest
    excess over cell sizes of a third to a seventh of the image. The share that pose parameters
    take out of such means is allowed for.
    """
    good = weights > 0.5
    residuals, photo, pixels = residuals[good], photo[good], pixels[good]
    variance = float(np.mean(residuals**2))
    per_photo = np.bincount(photo)
    # Of a photo's unknowns, the counted cells hold as much as they hold of its measurements.
    pose_share = min(photo_unknowns / 2 * int((per_photo > 0).sum()) / max(len(photo), 1), 0.5)
    worst = 1.0
    for cells in (3, 4, 5, 7):
        index = np.minimum((pixels / np.array(size) * cells).astype(int), cells - 1)
        slot = (photo * cells + index[:, 1]) * cells + index[:, 0]
        count = np.bincount(slot)
        sums = np.stack([np.bincount(slot, residuals[:, i]) for i in range(2)], axis=1)
        enough = count >= 4
        if enough.sum() < 20:
            continue
        energy = np.sum(sums[enough] ** 2 / count[enough, None]) / (2 * variance)
        n_cells = int(enough.sum())
        covered = np.bincount(photo, enough[slot]) / np.maximum(per_photo, 1)
        expected = (n_cells - photo_unknowns / 2 * float(covered.sum())) / (1 - pose_share)
        if expected < 10:
            continue
        # What chance alone reaches in one of forty blocks is no sign of correlation.
        allowance = 2 * np.sqrt(1.0 / expected)
        worst = max(worst, float(energy / expected) - allowance)
    return 1 + SMOOTHER_STILL * (worst - 1)

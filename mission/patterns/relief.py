"""How much of the flying height is left above the highest ground that a photo sees."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calib.camera import FloatArray
from calib.errors import InputError
from mission.patterns.profile import tolerance_m
from mission.terrain import Terrain

#: Below this share of the height above the highest ground in sight a grid makes no sense.
LEAST_SHARE = 0.3
#: Samples of the ground along a side at most.
_MOST_SAMPLES = 700


@dataclass(frozen=True, eq=False)
class Relief:
    """The smallest share of the height left on lines at ``u`` (n,), equally spaced: ``share`` (n,)."""

    u: FloatArray
    share: FloatArray

    def at(self, u: float, around: float) -> float:
        """The smallest share within ``around`` of ``u``."""
        step = self.u[1] - self.u[0]
        first = int(np.clip(math.floor((u - around - self.u[0]) / step), 0, len(self.u) - 1))
        last = int(np.clip(math.ceil((u + around - self.u[0]) / step), 0, len(self.u) - 1))
        return float(self.share[first : last + 1].min())


def level() -> Relief:
    """No relief at all."""
    return Relief(np.array([-1.0, 1.0]), np.ones(2))


def relief(
    terrain: Terrain,
    bounds: tuple[float, float, float, float],
    to_map: Callable[[FloatArray], FloatArray],
    height_m: float,
    reach_m: float,
    margin_m: float,
) -> Relief:
    """Relief of a grid in its own coordinates (u across, v along).

    ``bounds`` of the area in (u, v); ``to_map`` takes (n, 2) to east, north; ``reach_m`` is how far a
    photo sees; lines may lie ``margin_m`` beyond the area.

    Raises:
        InputError: the ground rises nearly to the flying height within a photo, or is not known.
    """
    west, south, east, north = bounds
    longest = max(east - west, north - south) + 2 * margin_m
    step = max(reach_m / 12, longest / _MOST_SAMPLES, 0.25)
    u = np.arange(west - margin_m, east + margin_m + step, step)
    v = np.arange(south - margin_m, north + margin_m + step, step)
    points = to_map(np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2))
    ground = terrain.height_m(points[:, 0], points[:, 1]).reshape(len(u), len(v))
    from scipy import ndimage  # Slow to load, and flat ground does without.

    size = 2 * math.ceil(reach_m / step) + 1
    highest = ndimage.maximum_filter(ground, size=size, mode="nearest")
    share = ((ground + height_m - tolerance_m(height_m) - highest) / height_m).min(axis=1)
    if share.min() < LEAST_SHARE:
        rise = float((highest - ground).max())
        raise InputError(
            f"The ground rises by {rise:.0f} m within what one photo sees from {height_m:g} m; fly at "
            f"{rise / (1 - LEAST_SHARE) * 1.1:.0f} m or higher, or plan the steep part on its own."
        )
    return Relief(u, np.minimum(share, 1.0))

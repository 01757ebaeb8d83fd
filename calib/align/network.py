"""How the photos look at the ground: tilt, heights, ground resolution."""

from __future__ import annotations

import numpy as np

from calib.camera import FloatArray
from calib.solution import Network, Observations

#: [C&D] discussion: convergent views are 20-45 degrees off nadir.
CONVERGENT_FROM_DEG = 20.0


def measure_network(
    rotations: FloatArray, centres_m: FloatArray, points_m: FloatArray, obs: Observations, f_px: float
) -> Network:
    """Tilt of every photo and its height over the points that it sees.

    Photos beyond 45 degrees are counted as convergent too: they strengthen the block no less.
    """
    axis = rotations[:, 2, :]  # optical axes in the world
    tilt = np.degrees(np.arccos(np.clip(-axis[:, 2], -1, 1)))
    ground = np.array([np.median(points_m[obs.point[obs.photo == i], 2]) for i in range(len(centres_m))])
    height = centres_m[:, 2] - ground
    depth = np.median(np.linalg.norm(points_m[obs.point] - centres_m[obs.photo], axis=1))
    convergent = int((tilt >= CONVERGENT_FROM_DEG).sum())
    return Network(
        tilt_deg=tilt,
        height_agl_m=height,
        gsd_m=float(depth / f_px),
        heights_agl_m=height_levels(height),
        nadir=len(tilt) - convergent,
        convergent=convergent,
    )


def height_levels(height_m: FloatArray) -> tuple[float, ...]:
    """Flying heights as levels: photos within 10 % of each other share one, rare ones are left out."""
    levels: list[FloatArray] = []
    for value in np.sort(height_m):
        if levels and value < 1.1 * float(np.mean(levels[-1])):
            levels[-1] = np.append(levels[-1], value)
        else:
            levels.append(np.array([value]))
    kept = [level for level in levels if len(level) >= max(1, 0.05 * len(height_m))]
    return tuple(round(float(np.median(level)), 1) for level in kept)

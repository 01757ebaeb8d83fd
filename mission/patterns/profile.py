"""Lines over terrain: few straight stretches that keep the height above ground."""

from __future__ import annotations

import numpy as np

from calib.camera import FloatArray
from mission.plan import Shot, Waypoint
from mission.site import Site


def tolerance_m(height_m: float) -> float:
    """How far a line may leave its height above ground."""
    return max(0.02 * height_m, 0.5)


def line_waypoints(
    site: Site, photos_m: FloatArray, height_m: float, yaw_deg: float, off_nadir_deg: float, pattern: str
) -> tuple[Waypoint, ...]:
    """Waypoints of a line with photos at exactly ``photos_m`` (n, 2), equally spaced.

    A stretch is a LINE from one photo to another; the way to the next stretch has no photo of its
    own, so no place is taken twice. A photo on its own is a STOP.
    """
    ground = site.terrain.height_m(photos_m[:, 0], photos_m[:, 1])
    heights = ground + height_m
    found: list[Waypoint] = []
    first = 0
    while first < len(photos_m):
        last = _stretch_end(heights, first, tolerance_m(height_m))
        if last == first:
            found.append(_waypoint(photos_m, heights, first, yaw_deg, off_nadir_deg, Shot.STOP, 0.0, pattern))
        else:
            ends = np.column_stack([photos_m, heights])[[first, last]]
            spacing = float(np.linalg.norm(ends[1] - ends[0])) / (last - first)
            found.append(
                _waypoint(photos_m, heights, first, yaw_deg, off_nadir_deg, Shot.LINE, spacing, pattern)
            )
            found.append(_waypoint(photos_m, heights, last, yaw_deg, off_nadir_deg, Shot.NONE, 0.0, pattern))
        first = last + 1
    return tuple(found)


def _stretch_end(heights_m: FloatArray, first: int, tolerance: float) -> int:
    """The last photo of the longest straight stretch from ``first`` that keeps the tolerance."""
    last = first
    for end in range(first + 1, len(heights_m)):
        straight = np.linspace(heights_m[first], heights_m[end], end - first + 1)
        if np.abs(straight - heights_m[first : end + 1]).max() > tolerance:
            break
        last = end
    # A single photo left over would have to be a stop: give it a neighbour.
    if last == len(heights_m) - 2 and last - first >= 2:
        last -= 1
    return last


def _waypoint(
    photos_m: FloatArray,
    heights_m: FloatArray,
    index: int,
    yaw_deg: float,
    off_nadir_deg: float,
    shot: Shot,
    spacing_m: float,
    pattern: str,
) -> Waypoint:
    east, north = (float(v) for v in photos_m[index])
    return Waypoint(
        east, north, float(heights_m[index]), yaw_deg % 360, off_nadir_deg - 90, shot, spacing_m, pattern
    )

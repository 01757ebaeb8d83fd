"""What is known beforehand of each camera's way while a rolling shutter reads its rows.

A multirotor on a line goes along the line, as fast as it likes, and hardly aside or up; one that stands
does not go at all. What the gimbal turns meanwhile looks, over level ground, like a way aside. Left open
in every direction instead, the ways of all photos cost most of what tells the focal length.
"""

from __future__ import annotations

import math

import numpy as np

from calib.camera import FloatArray
from calib.solution import BoolArray

#: Standard deviations. Along a line, or level where there is none, as a share of the distance to the ground:
#: 8 m/s for 30 ms at 60 m. That is of the mean of all ways, too: they go forward in every photo, and small
#: ways expected of each by itself would make a small mean near certain, and f wrong by several sigmas.
WAY = 0.004
#: Aside, as such a share: 0.2 degrees a second (gimbals are good to 0.02 degrees at some hertz) and 0.2 m/s
#: at 60 m, both for 30 ms. Where a line begins or ends the vehicle may still turn in: 1 m/s.
ASIDE, ASIDE_AT_ENDS = 0.00015, 0.0005
#: Up and down, m: 0.7 m/s for 30 ms; never more than along.
CLIMB_M = 0.02
#: Steps from photo to photo are of one line where they differ by less than this angle and this factor.
_STRAIGHT_COS, _EVEN = float(np.cos(np.radians(15.0))), 1.5


def standing_information(distance_m: float) -> FloatArray:
    """Inverse covariance (3, 3), 1/m2, of the way of a camera that stands; x, y level, z up."""
    aside, climb = ASIDE * distance_m, min(CLIMB_M, WAY * distance_m)
    return np.diag([aside**-2.0, aside**-2.0, climb**-2.0])


def way_information(
    centres_m: FloatArray, distance_m: float, standing: BoolArray | None = None, upright: bool = True
) -> FloatArray:
    """Inverse covariances (k, 3, 3), 1/m2, of the ways of cameras in the order in which they were taken.

    Args:
        centres_m: (k, 3), z up.
        distance_m: to the ground.
        standing: (k,): known to stand while the photo is taken.
        upright: False where z may be anywhere: every way is then open in all directions.
    """
    k = len(centres_m)
    way = open_way_m(k if standing is None else k - int(standing.sum()), distance_m)
    if not upright:
        return np.tile(np.eye(3) / way**2, (k, 1, 1))
    along, inner = line_directions(centres_m)
    climb = min(CLIMB_M, WAY * distance_m)
    found = np.tile(np.diag([way, way, climb]) ** 2.0, (k, 1, 1))
    aside = np.where(inner, ASIDE, ASIDE_AT_ENDS) * distance_m
    for i in np.flatnonzero(along.any(axis=1)):
        level = np.diag([aside[i], aside[i], climb]) ** 2.0
        found[i] = level + way**2 * np.outer(along[i], along[i])
    found = np.asarray(np.linalg.inv(found), dtype=float)
    if standing is not None:
        found[standing] = standing_information(distance_m)
    return found


def open_way_m(moving: int, distance_m: float) -> float:
    """Standard deviation, m, of each of so many ways where it is open."""
    return WAY * distance_m * math.sqrt(max(moving, 1))


def line_directions(centres_m: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Unit vectors (k, 3) along the lines on which cameras are, zero where they are on none.

    Also (k,): inside its line, not at an end of it.
    """
    k = len(centres_m)
    steps = np.diff(centres_m, axis=0)
    length = np.linalg.norm(steps, axis=1)
    unit = steps / np.maximum(length, 1e-9)[:, None]
    even = np.zeros(max(k - 2, 0), bool)
    if k > 2:
        ratio = length[1:] / np.maximum(length[:-1], 1e-9)
        even = (np.sum(unit[1:] * unit[:-1], axis=1) > _STRAIGHT_COS) & (ratio < _EVEN) & (ratio > 1 / _EVEN)
    inner = np.zeros(k, bool)
    inner[1:-1] = even
    along = np.zeros((k, 3))
    middle = np.flatnonzero(inner)
    chord = centres_m[middle + 1] - centres_m[middle - 1]
    along[middle] = chord / np.maximum(np.linalg.norm(chord, axis=1), 1e-9)[:, None]
    for i in middle:
        for end in (i - 1, i + 1):
            if not inner[end]:
                along[end] = along[i]
    return along, inner

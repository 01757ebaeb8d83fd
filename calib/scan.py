"""Control points from a laser scan: roughly known places moved onto its surface, with its spread as sigma."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from calib.camera import FloatArray
from calib.clouds import chunks, open_cloud
from calib.control_files import ControlPoint
from calib.errors import InputError

#: The scan around a point that its surface is laid through, m.
SCAN_RADIUS_M = 0.05
_FEWEST_NEIGHBOURS = 6
#: Points further from their plane than so many robust sigmas do not count (stray points, an edge behind).
_OUTLIER_SIGMAS = 3.5
#: Least extent across, as a share of that along: less is a line.
_ON_A_LINE = 0.1
#: More spread than this share of the radius is no surface but an edge, a corner, a plant.
_NO_SURFACE = 0.2
#: A point of a scan is never held as known exactly.
_LEAST_SIGMA_M = 0.0005


@dataclass(frozen=True)
class _Surface:
    """A plane: middle (3,), unit normal (3,), spread along it, mean distance between the scan's points."""

    middle: FloatArray
    normal: FloatArray
    spread_m: float
    spacing_m: float


def points_from_scan(
    points: Sequence[ControlPoint],
    scan: Path,
    radius_m: float = SCAN_RADIUS_M,
    tick: Callable[[int, int], None] | None = None,
) -> tuple[tuple[ControlPoint, ...], tuple[str, ...]]:
    """The points on the scan, and remarks.

    Each is moved at right angles onto the plane through the scan within ``radius_m`` of it. Across the plane
    its sigma is the spread of the scan about it; along the plane the point's own, or half the distance
    between the scan's points where it states none. Where the scan is no surface the point stays, with the
    spread as sigma all around; where there is no scan it is left out. ``tick`` hears how many points of the
    scan were read, and of how many (0: not known).

    Raises:
        InputError: the scan cannot be read, or lies nowhere near the points.
    """
    file = open_cloud(scan)
    places = np.array([point.xyz_m for point in points])
    tree = cKDTree(places)
    near: list[FloatArray] = []
    low, high, seen = np.full(3, np.inf), np.full(3, -np.inf), 0
    for piece in chunks(file):
        seen += len(piece)
        good = piece[np.isfinite(piece).all(axis=1)]
        if len(good):
            low, high = np.minimum(low, good.min(axis=0)), np.maximum(high, good.max(axis=0))
        around = np.all(
            (good > places.min(axis=0) - radius_m) & (good < places.max(axis=0) + radius_m), axis=1
        )
        good = good[around]
        near.append(good[tree.query(good, distance_upper_bound=radius_m)[0] <= radius_m])
        if tick is not None:
            tick(seen, file.count or 0)
    cloud = np.concatenate(near) if near else np.empty((0, 3))
    found: list[ControlPoint] = []
    moves: list[float] = []
    spreads: list[float] = []
    missing: list[str] = []
    rough: list[str] = []
    neighbours = cKDTree(cloud).query_ball_point(places, radius_m) if len(cloud) else [[] for _ in points]
    for point, place, index in zip(points, places, neighbours, strict=True):
        surface = _surface(cloud[index], radius_m)
        if surface is None:
            missing.append(point.name)
            continue
        if surface.spread_m > _NO_SURFACE * radius_m:
            rough.append(point.name)
        on_scan = _on_surface(point, place, surface, radius_m)
        moves.append(math.dist(on_scan.xyz_m, point.xyz_m))
        spreads.append(surface.spread_m)
        found.append(on_scan)
    if not found:
        raise InputError(_nothing(scan, points, radius_m, low, high))
    notes = [
        *file.notes,
        f"{len(found)} points were taken from {scan.name}: moved by {_mm(moves)} onto it, its spread "
        f"there is {_mm(spreads)} (medians).",
    ]
    if missing:
        notes.append(f"No surface of the scan within {1000 * radius_m:g} mm of {_some(missing)}: left out.")
    if rough:
        notes.append(
            f"The scan is no even surface at {_some(rough)}: taken as given, with its spread as sigma."
        )
    return tuple(found), tuple(notes)


def _surface(around: FloatArray, radius_m: float) -> _Surface | None:
    """The plane through points (n, 3), stray ones left out; None where they are too few or on one line."""
    kept = around
    for _ in range(4):
        if len(kept) < _FEWEST_NEIGHBOURS:
            return None
        middle = kept.mean(axis=0)
        _, size, axes = np.linalg.svd(kept - middle, full_matrices=False)
        if size[1] < _ON_A_LINE * size[0]:
            return None
        off = np.abs((around - middle) @ axes[2])
        spread = 1.4826 * float(np.median(np.abs((kept - middle) @ axes[2])))
        kept = around[off <= _OUTLIER_SIGMAS * spread + 1e-6]
    spacing = math.sqrt(math.pi * radius_m**2 / len(around))
    return _Surface(middle, axes[2], spread, spacing)


def _on_surface(point: ControlPoint, place: FloatArray, surface: _Surface, radius_m: float) -> ControlPoint:
    along = np.array(point.sigmas_m) if point.sigmas_m is not None else np.full(3, surface.spacing_m / 2)
    across = max(surface.spread_m, _LEAST_SIGMA_M)
    if surface.spread_m > _NO_SURFACE * radius_m:
        x, y, z = place
        sx, sy, sz = np.maximum(along, across)
    else:
        share = surface.normal**2
        x, y, z = place - ((place - surface.middle) @ surface.normal) * surface.normal
        sx, sy, sz = np.sqrt(share * across**2 + (1 - share) * np.maximum(along, _LEAST_SIGMA_M) ** 2)
    return replace(point, xyz_m=(float(x), float(y), float(z)), sigmas_m=(float(sx), float(sy), float(sz)))


def _nothing(
    scan: Path, points: Sequence[ControlPoint], radius_m: float, low: FloatArray, high: FloatArray
) -> str:
    apart = np.mean([point.xyz_m for point in points], axis=0) - (low + high) / 2
    where = ", ".join(f"{abs(d):.4g} m in {axis}" for d, axis in zip(apart, "xyz", strict=True))
    return (
        f"None of the points lies within {1000 * radius_m:g} mm of a surface of {scan}: are both in the same "
        f"coordinate system (their middles are apart by {where}), or is --scan-radius too small?"
    )


def _mm(lengths_m: Sequence[float]) -> str:
    return f"{1000 * float(np.median(lengths_m)):.1f} mm"


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (" ..." if len(names) > 5 else "")

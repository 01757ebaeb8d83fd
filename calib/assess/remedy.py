"""Shift, scale and tilt taken out of a cloud by what a surveyor has on site, and what then remains.

[C&D] discussion: one known point removes the shift, two points or a scale object the scale, two levelled
scale objects at an angle the tilt. What none of these fixes stays as it was, and is named with its size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib.assess.local import near_places
from calib.assess.model import SEVEN_NAMES
from calib.camera import FloatArray
from calib.clouds import LoadedCloud
from calib.errors import InputError
from calib.similarity import Similarity

#: What the seven came to at the worst of the papers' eight flights without control ([C&D] Table 4).
WORST_PUBLISHED = np.array([4.0, 6.4, 8.9, 1.34, 1.42, 1.11, 5.1])
#: A cloud that is so much too large or small, percent, or tilted, degrees, was measured wrongly by its user.
_MOST_SCALE_PERCENT, _MOST_TILT_DEG = 50.0, 45.0
_LEAST_ANGLE_DEG = 20.0
_DEM_POINTS = 4000
_DEM_ROUNDS = 8


@dataclass(frozen=True)
class Bar:
    """Two ends (3,) as measured in the cloud; ``length_m``: the true distance (None: a level without one)."""

    name: str
    start_m: FloatArray
    end_m: FloatArray
    length_m: float | None = None

    @property
    def measured_m(self) -> float:
        return float(np.linalg.norm(self.end_m - self.start_m))


@dataclass(frozen=True)
class Remains:
    """One of the seven after the correction: its sigma, m, degrees or percent, and at the edge of the cloud.

    ``fixed_by``: what determined it; None: nothing did, and ``sigma`` is what such clouds had at worst.
    """

    name: str
    fixed_by: str | None
    sigma: float
    at_edge_m: float


@dataclass(frozen=True)
class Correction:
    """cloud -> corrected, and what it did: degrees of tilt, factor of scale, shift (3,) at ``pivot_m``."""

    moved: Similarity
    pivot_m: FloatArray
    shift_m: FloatArray | None
    scale: float | None
    tilt_deg: float | None
    remains: tuple[Remains, ...]
    notes: tuple[str, ...]


def correction(
    cloud: LoadedCloud,
    point: tuple[FloatArray, FloatArray] | None,
    bars: Sequence[Bar],
    levels: Sequence[Bar],
    dem: LoadedCloud | None,
    reading_sigma_m: float,
) -> Correction:
    """The correction that the given measurements make possible.

    Args:
        point: one point as measured in the cloud and as it truly is, (3,) each.
        bars: of known length; the scale is their mean by length.
        levels: two bars that are level in truth, at an angle; tilt.
        dem: a trusted height model; tilt, and the height where ``point`` is not given.
        reading_sigma_m: how well a point can be picked in the cloud.

    Raises:
        InputError: nothing given, bars too short or parallel, values that are no errors of a survey.
    """
    if point is None and not bars and not levels and dem is None:
        raise InputError("Nothing to correct by: give --point, --bar, two --level, or --dem.")
    some = cloud.xyz[:: max(1, len(cloud.xyz) // 100_000)].astype(float) + cloud.origin
    middle = np.median(some, axis=0)
    edge = float(np.percentile(np.linalg.norm((some - middle)[:, :2], axis=1), 95))
    pivot = middle if point is None else point[0]
    scale, scale_percent = _scale(bars, reading_sigma_m)
    turn, tilt_sigma, by, rise = _tilt(cloud, levels, dem, reading_sigma_m, pivot, point is None)
    shift = None
    if point is not None:
        shift = point[1] - point[0]
    elif rise is not None:
        shift = np.array([0.0, 0.0, rise])
    factor = 1.0 if scale is None else scale
    target = pivot if shift is None else pivot + shift
    moved = Similarity(factor, turn, target - factor * turn @ pivot)
    tilt = None if by is None else float(np.degrees(np.arccos(np.clip(turn[2, 2], -1, 1))))
    notes = _notes(cloud, factor, shift, edge)
    remains = _remains(
        point is not None, rise is not None, scale_percent, by, tilt_sigma, reading_sigma_m, edge
    )
    return Correction(moved, pivot, shift, scale, tilt, remains, notes)


def _scale(bars: Sequence[Bar], reading_sigma_m: float) -> tuple[float | None, float]:
    """Factor (None: no bar) and its sigma, percent."""
    if not bars:
        return None, float("inf")
    measured, true = np.array([b.measured_m for b in bars]), np.array([b.length_m for b in bars], float)
    for bar, length in zip(bars, measured, strict=True):
        if not length > 5 * reading_sigma_m:
            raise InputError(
                f"The bar {bar.name} is {length:.3f} m long in the cloud, too short against a reading "
                f"precision of {reading_sigma_m:g} m."
            )
    # Weights by length squared: a reading error matters the less, the longer the bar.
    factor = float(true @ measured / (measured @ measured))
    if abs(100 * (factor - 1)) > _MOST_SCALE_PERCENT:
        raise InputError(
            f"By these bars the cloud would have to be scaled by {factor:.4g}: check units and ends."
        )
    sigma = np.sqrt(2) * reading_sigma_m / float(np.sqrt(measured @ measured))
    return factor, 100 * sigma


def _tilt(
    cloud: LoadedCloud, levels: Sequence[Bar], dem: LoadedCloud | None, reading_sigma_m: float,
    pivot: FloatArray, with_rise: bool,
) -> tuple[FloatArray, FloatArray, str | None, float | None]:  # fmt: skip
    """Rotation (3, 3), sigmas of the tilts about x and y in degrees, what fixed them, rise in m."""
    nothing = np.eye(3), np.full(2, np.inf), None, None
    if levels and dem is not None:
        raise InputError("The tilt comes either from levels or from a height model, not from both.")
    if dem is not None:
        return _from_dem(cloud, dem, pivot, with_rise)
    if not levels:
        return nothing
    if len(levels) < 2:
        raise InputError("One level fixes the tilt along itself only; give two at an angle (--level twice).")
    directions = np.array([(bar.end_m - bar.start_m) / bar.measured_m for bar in levels])
    _, size, axes = np.linalg.svd(directions, full_matrices=False)
    angle = np.degrees(np.arctan2(size[1], size[0])) * 2
    if angle < _LEAST_ANGLE_DEG:
        raise InputError("The levels are nearly parallel; take two at a right angle.")
    up = axes[2] if axes.shape[0] > 2 else np.cross(axes[0], axes[1])
    up = up / np.linalg.norm(up) * (1 if up[2] >= 0 else -1)
    turn = _upright(up)
    # Slopes of the plane through the levels, each good to its reading error over its length.
    rows = directions[:, :2]
    weight = np.array([bar.measured_m / (np.sqrt(2) * reading_sigma_m) for bar in levels])[:, None]
    slopes = np.linalg.inv((rows * weight).T @ (rows * weight))
    # A tilt about x is a slope along y.
    return turn, np.degrees(np.sqrt(np.diag(slopes)))[::-1], "levels", None


def _upright(up: FloatArray) -> FloatArray:
    """The smallest rotation (3, 3) that brings ``up`` (3,) to the vertical.

    Raises:
        InputError: it is so large that something else is wrong.
    """
    axis = np.cross(up, [0, 0, 1])
    length = float(np.linalg.norm(axis))
    angle = float(np.arctan2(length, up[2]))
    if np.degrees(angle) > _MOST_TILT_DEG:
        raise InputError(
            f"The cloud would have to be tilted by {np.degrees(angle):.0f} degrees: check the levels."
        )
    turn: FloatArray = Rotation.from_rotvec(axis / max(length, 1e-300) * angle).as_matrix()
    return turn


def _from_dem(
    cloud: LoadedCloud, dem: LoadedCloud, pivot: FloatArray, with_rise: bool
) -> tuple[FloatArray, FloatArray, str | None, float | None]:
    """The plane between cloud and height model, robustly; its slope is the tilt."""
    rng = np.random.default_rng(0)
    some = cloud.xyz[rng.choice(len(cloud.xyz), min(_DEM_POINTS, len(cloud.xyz)), replace=False)].astype(
        float
    )
    places = some[:, :2] + (cloud.origin - dem.origin)[:2]
    around = near_places(dem, places, 5.0)
    if around is None:
        raise InputError(f"{dem.file.path} does not cover the cloud, or is in another coordinate system.")
    heights = around.thinned(around.natural_radius_m).heights(places)
    difference = some[:, 2] + cloud.origin[2] - dem.origin[2] - heights.height_m
    good = np.isfinite(difference)
    if int(good.sum()) < 50:
        raise InputError(f"{dem.file.path} does not cover the cloud, or is in another coordinate system.")
    offset = some[good, :2] + cloud.origin[:2] - pivot[:2]
    design = np.column_stack([np.ones(len(offset)), offset])
    value = difference[good]
    weight = np.ones(len(value))
    for _ in range(_DEM_ROUNDS):
        root = np.sqrt(weight)[:, None]
        found = np.linalg.lstsq(design * root, value * root[:, 0], rcond=None)[0]
        rest = value - design @ found
        spread = max(1.4826 * float(np.median(np.abs(rest))), 1e-6)
        weight = 1 / (1 + (rest / (2 * spread)) ** 2)
    # Neighbours share what grass, houses and the model's own errors do: a tenth of a site is one observation.
    inverse = np.linalg.inv(design.T @ design)
    sigma = spread * np.sqrt(np.diag(inverse) * len(value) / 100)
    turn = _upright(np.array([-found[1], -found[2], 1.0]) / np.sqrt(1 + found[1] ** 2 + found[2] ** 2))
    return turn, np.degrees(sigma[1:])[::-1], "height model", -float(found[0]) if with_rise else None


def _notes(cloud: LoadedCloud, factor: float, shift: FloatArray | None, edge: float) -> tuple[str, ...]:
    notes = list(cloud.notes)
    if abs(factor - 1) > 0.1:
        notes.append(
            f"The cloud is scaled by {factor:.4g}: more than a survey's error, so check the bars' units."
        )
    if shift is not None and float(np.linalg.norm(shift[:2])) > 2 * edge + 50:
        notes.append(
            f"The cloud is shifted by {np.linalg.norm(shift):.0f} m, further than it is wide: check that "
            "the point is given in the cloud's coordinate system."
        )
    return tuple(notes)


def _remains(
    by_point: bool, by_rise: bool, scale_percent: float, tilt_by: str | None, tilt_sigma: FloatArray,
    reading_sigma_m: float, edge: float,
) -> tuple[Remains, ...]:  # fmt: skip
    fixed: list[str | None] = [None] * 7
    sigma = WORST_PUBLISHED.copy()
    if by_point:
        fixed[:3], sigma[:3] = ["point"] * 3, reading_sigma_m
    elif by_rise:
        fixed[2], sigma[2] = "height model", 3 * reading_sigma_m
    if tilt_by is not None:
        fixed[4:6], sigma[4:6] = [tilt_by] * 2, tilt_sigma
    if np.isfinite(scale_percent):
        fixed[6], sigma[6] = "bars", scale_percent
    at_edge = np.concatenate([sigma[:3], edge * np.radians(sigma[3:6]), [edge * sigma[6] / 100]])
    return tuple(
        Remains(name, fixed[i], float(sigma[i]), float(at_edge[i])) for i, name in enumerate(SEVEN_NAMES)
    )

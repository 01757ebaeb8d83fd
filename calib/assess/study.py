"""A whole assessment: M7, eta over the cloud, dome or dish, profiles, residual against elevation.

eta is the cloud's height over the Delaunay surface of the reference points after M7, of every point of the
cloud ([C&D] eq. 4). What has to be judged by its sigma (dome, trend with elevation) is taken at the reference
points, because there are only so many independent measurements, however many points the cloud has.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from calib.align.dome import site_radius_m
from calib.assess.elevation import robust_trend
from calib.assess.model import ElevationTrend, Surface, profile
from calib.assess.register import PRIOR_SIGMAS, Registration, correlation, register
from calib.assess.truth import DATUM_M, Truth
from calib.camera import FloatArray
from calib.clouds import LoadedCloud
from calib.errors import InputError
from calib.solution import BoolArray

#: Cells of the map along each side, and of those how many make a block of the jackknife.
MAP_CELLS, _BLOCK_CELLS = 80, 10
#: Points kept for the figure of eta against elevation, and for profiles and the robust spread.
SHOWN_POINTS, _SOME_POINTS = 3000, 4_000_000
PROFILE_BINS = 60
#: Second-order terms need so many points.
_FEWEST_DOME = 12
SECOND_ORDER = ("x2", "xy", "y2")


@dataclass(frozen=True)
class Line:
    """A profile's ends (2,) in the cloud's coordinates, and what it is called."""

    name: str
    start_m: FloatArray
    end_m: FloatArray


@dataclass(frozen=True)
class Profile:
    """eta along a line: ``along_m``, ``eta_m``, ``spread_m`` (b,), NaN where there are no points."""

    line: Line
    width_m: float
    along_m: FloatArray
    eta_m: FloatArray
    spread_m: FloatArray


@dataclass(frozen=True)
class Eta:
    """eta over the cloud: ``eta_p_m`` its standard deviation, with the sigma of that.

    ``robust_m``: from the median deviation, which grass and mismatches do not raise. ``outside``: points of
    the cloud beyond the reference surface.
    """

    points: int
    outside: int
    mean_m: float
    eta_p_m: float
    sigma_m: float
    robust_m: float


@dataclass(frozen=True)
class Bowl:
    """Second-order surface through the residuals at the reference points.

    ``terms_m`` (3,) in the order of ``SECOND_ORDER``, at the site's radius, with ``covariance`` (3, 3);
    ``amplitude_m``: middle over rim, a dome above zero; ``chance`` that there is nothing.
    """

    radius_m: float
    terms_m: FloatArray
    covariance: FloatArray
    amplitude_m: float
    sigma_m: float
    chance: float


@dataclass(frozen=True)
class Map:
    """Mean eta of cells: ``east_m``, ``north_m`` (k,) of their middles, ``eta_m`` (k, k), NaN where empty."""

    east_m: FloatArray
    north_m: FloatArray
    eta_m: FloatArray


@dataclass(frozen=True)
class CloudAssessment:
    """Everything found. ``shown`` (s, 2): elevation and eta of some points of the cloud."""

    cloud: LoadedCloud
    truth: Truth
    registration: Registration
    by_picked: bool
    eta: Eta
    map: Map
    bowl: Bowl | None
    trend: ElevationTrend | None
    profiles: tuple[Profile, ...]
    shown: FloatArray
    site_radius_m: float
    height_agl_m: float | None
    notes: tuple[str, ...]

    @property
    def at_points_m(self) -> float:
        """Standard deviation of eta at the reference points, those left out excepted."""
        residual = self.registration.residual_m[~self.registration.outlier]
        return float(np.nanstd(residual))

    @property
    def relief_m(self) -> float:
        """Between the reference points' heights, the lowest and highest twentieth left aside."""
        return float(np.ptp(np.percentile(self.truth.xyz_m[:, 2], [5, 95])))

    @property
    def at_edge_m(self) -> FloatArray:
        """What each of the seven amounts to at the edge of the site, metres (7,)."""
        values = self.registration.seven.values
        turns = np.radians(values[3:6])
        stretch = self.site_radius_m * (values[6] / 100 - 1)
        sizes: FloatArray = np.abs(np.concatenate([values[:3], self.site_radius_m * turns, [stretch]]))
        return sizes


def assess_cloud(
    cloud: LoadedCloud,
    truth: Truth,
    on: BoolArray | None = None,
    picked_m: FloatArray | None = None,
    radius_m: float | None = None,
    lines: Sequence[Line] = (),
    width_m: float | None = None,
    height_agl_m: float | None = None,
    tick: Callable[[str, int, int], None] | None = None,
) -> CloudAssessment:
    """Hold a cloud against reference points. ``tick`` hears the stage, how much is done and of how much.

    Args:
        on: (n,) the points that M7 rests on; None: all ([C&D] took the paths around their sites).
        picked_m: (n, 3) the points as measured in the cloud, NaN where they were not.
        radius_m: of the surfaces through the cloud's points that give its height at a place.
        lines: profiles; none: west to east and south to north through the middle.
        width_m: of the profiles; None: a fortieth of their length.
        height_agl_m: flying height, for errors in percent of it.

    Raises:
        InputError: too few points, or they do not lie over the cloud.
    """
    tell = tick or _silent
    points = truth.xyz_m
    on = np.ones(len(points), bool) if on is None else on
    tell("registering", 0, 0)
    registration = register(points, cloud, on, radius_m, picked_m)
    reference = points - registration.origin
    moved = registration.seven.similarity.apply(reference)
    good = ~registration.outlier
    eta, cells, some = _eta(cloud, moved[good], registration.origin, tell)
    there = np.isfinite(registration.residual_m) & good
    radius = site_radius_m(reference)
    lines = tuple(lines) or _default_lines(points[there])
    profiles = tuple(_profile(some, line, width_m, registration.origin) for line in lines)
    residual = registration.residual_m[there]
    bowl = trend = None
    if int(there.sum()) >= _FEWEST_DOME:
        bowl = _bowl(reference[there], residual, registration, registration.derivatives[there], radius)
        # Points picked in the cloud have settled the seven; a surface leaves them as free as they were.
        free = registration.seven.covariance if picked_m is not None else np.diag(PRIOR_SIGMAS**2)
        trend = robust_trend(reference[there], residual, registration.derivatives[there], free)
    step = max(1, len(some) // SHOWN_POINTS)
    # Of the ground, not of a cloud that may be tilted.
    ground = registration.seven.similarity
    elevation = ((some[::step, :3] - ground.shift) @ ground.rotation / ground.scale)[:, 2]
    shown = np.column_stack([elevation + registration.origin[2], some[::step, 3]])
    return CloudAssessment(
        cloud, truth, registration, picked_m is not None, eta, cells, bowl, trend, profiles, shown, radius,
        height_agl_m, (*cloud.notes, *truth.notes, *_remarks(registration, truth)),
    )  # fmt: skip


def _silent(stage: str, done: int, total: int) -> None:
    del stage, done, total


def _remarks(registration: Registration, truth: Truth) -> list[str]:
    notes = []
    missing = ~np.isfinite(registration.residual_m)
    if missing.any():
        names = [name for name, gone in zip(truth.names, missing, strict=True) if gone]
        notes.append(f"{len(names)} of {len(truth.names)} points have no cloud around them: {_few(names)}.")
    if registration.outlier.any():
        names = [
            f"{truth.names[i]} ({registration.residual_m[i]:+.2f} m)"
            for i in np.flatnonzero(registration.outlier)
        ]
        notes.append(f"Left out because they lie too far off: {_few(names)}.")
    offset = registration.seven.values[2]
    if abs(offset) > DATUM_M:
        notes.append(
            f"The cloud lies {abs(offset):.1f} m too {'high' if offset > 0 else 'low'}. Heights above the "
            "ellipsoid against heights above the sea differ by as much, and so do wrong take-off heights."
        )
    return notes


def _few(names: Sequence[str], most: int = 8) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def _eta(
    cloud: LoadedCloud, moved: FloatArray, origin: FloatArray, tell: Callable[[str, int, int], None]
) -> tuple[Eta, Map, FloatArray]:
    """eta of every point, its map, and some of the points (s, 4) about ``origin`` with their eta."""
    surface = Surface(moved)
    low, high = moved[:, :2].min(axis=0), moved[:, :2].max(axis=0)
    cell = (high - low) / MAP_CELLS
    count = np.zeros(MAP_CELLS**2)
    total, square = np.zeros(MAP_CELLS**2), np.zeros(MAP_CELLS**2)
    shift = cloud.origin - origin
    step = max(1, len(cloud.xyz) // _SOME_POINTS)
    some = []
    seen = 0
    for block in cloud.blocks():
        points = block + shift
        seen += len(points)
        inside = ((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)
        points = points[inside]
        column, row = np.minimum(((points[:, :2] - low) / cell).astype(int), MAP_CELLS - 1).T
        slot = row * MAP_CELLS + column
        # Neighbours after one another: the search in the triangles starts where the last one ended.
        order = np.argsort(slot.astype(np.int16), kind="stable")
        points, slot = points[order], slot[order]
        eta = surface.signed_distance_m(points)
        over = np.isfinite(eta)
        slot, eta = slot[over], eta[over]
        count += np.bincount(slot, minlength=MAP_CELLS**2)
        total += np.bincount(slot, eta, MAP_CELLS**2)
        square += np.bincount(slot, eta**2, MAP_CELLS**2)
        some.append(np.column_stack([points[over], eta])[::step])
        tell("comparing", seen, len(cloud.xyz))
    n = int(count.sum())
    if n == 0:
        raise InputError("No point of the cloud lies over the surface between the reference points.")
    kept = np.concatenate(some)
    with np.errstate(invalid="ignore"):
        mean = np.where(count > 0, total / np.where(count > 0, count, 1), np.nan).reshape(
            MAP_CELLS, MAP_CELLS
        )
    middles = low + (np.arange(MAP_CELLS)[:, None] + 0.5) * cell + origin[:2]
    found = Eta(
        n,
        seen - n,
        float(total.sum()) / n,
        _deviation(n, total.sum(), square.sum()),
        _jackknife(count, total, square),
        1.4826 * float(np.median(np.abs(kept[:, 3] - np.median(kept[:, 3])))),
    )
    return found, Map(middles[:, 0], middles[:, 1], mean), kept


def _deviation(count: float, total: float, square: float) -> float:
    return float(np.sqrt(max(square / count - (total / count) ** 2, 0.0)))


def _jackknife(count: FloatArray, total: FloatArray, square: FloatArray) -> float:
    """Sigma of the standard deviation: each block of cells left out once, so neighbours may share errors."""
    shape = (MAP_CELLS // _BLOCK_CELLS, _BLOCK_CELLS) * 2
    n, s, q = (v.reshape(shape).sum(axis=(1, 3)).ravel() for v in (count, total, square))
    filled = np.flatnonzero((n > 0) & (n < n.sum()))
    if len(filled) < 2:
        return float("inf")
    without = np.array([_deviation(n.sum() - n[i], s.sum() - s[i], q.sum() - q[i]) for i in filled])
    return float(np.sqrt((len(filled) - 1) / len(filled) * np.sum((without - without.mean()) ** 2)))


def _bowl(
    reference: FloatArray,
    residual: FloatArray,
    registration: Registration,
    derivatives: FloatArray,
    radius: float,
) -> Bowl:
    u, v = ((reference[:, :2] - np.median(reference[:, :2], axis=0)) / radius).T
    design = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    inverse = np.linalg.pinv(design.T @ design)
    functional = inverse @ design.T
    found = functional @ residual
    rest = residual - design @ found
    variance = float(rest @ rest) / max(len(rest) - 6, 1) * correlation(reference, rest, 6)
    # What M7 leaves open of scale, azimuth and shift bends the residuals over curved ground.
    open_ = functional @ derivatives
    covariance = (variance * inverse + open_ @ registration.seven.covariance @ open_.T)[3:, 3:]
    terms = found[3:]
    middle_over_rim = np.array([-0.5, 0.0, -0.5])
    square = float(terms @ np.linalg.pinv(covariance) @ terms)
    return Bowl(
        radius, terms, covariance, float(middle_over_rim @ terms),
        float(np.sqrt(middle_over_rim @ covariance @ middle_over_rim)), float(chdtrc(3, max(square, 0.0))),
    )  # fmt: skip


def _default_lines(points: FloatArray) -> tuple[Line, ...]:
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    middle = (low + high) / 2
    return (
        Line("west to east", np.array([low[0], middle[1]]), np.array([high[0], middle[1]])),
        Line("south to north", np.array([middle[0], low[1]]), np.array([middle[0], high[1]])),
    )


def _profile(some: FloatArray, line: Line, width_m: float | None, origin: FloatArray) -> Profile:
    length = float(np.linalg.norm(line.end_m - line.start_m))
    if not length > 0:
        raise InputError(f"The profile {line.name} has no length.")
    width = width_m or length / 40
    ends = line.start_m - origin[:2], line.end_m - origin[:2]
    return Profile(line, width, *profile(some[:, :3], some[:, 3], *ends, width, PROFILE_BINS))

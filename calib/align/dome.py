"""The dome or dish that a calibration error bends into the model ([C&D] fig. 2, 7)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib.align.rotations import similarity_tangent
from calib.align.selfcal import Calibrated, hold
from calib.camera import FloatArray
from calib.evidence import CONVERGENT_DEG
from calib.field import Lens
from calib.similarity import fit_similarity
from calib.solution import BoolArray, Dome, Observations

#: Points that the lens leaves open so many times as much as the middle one do not count for the dome.
UNSETTLED = 100.0
#: A surface with six coefficients needs so many points of the survey.
FEWEST_OF_SITE = 30


def site_radius_m(points_m: FloatArray) -> float:
    """Radius of the surveyed area: 95 % of the points are nearer to their centre (horizontally)."""
    offset = points_m[:, :2] - np.median(points_m[:, :2], axis=0)
    return float(np.percentile(np.linalg.norm(offset, axis=1), 95))


def second_order_design(points_m: FloatArray, radius_m: float) -> FloatArray:
    """1, x, y, x2 + y2, x2 - y2, x y in units of the site's radius, (m, 6)."""
    x, y = ((points_m[:, :2] - np.median(points_m[:, :2], axis=0)) / radius_m).T
    return np.stack([np.ones_like(x), x, y, x * x + y * y, x * x - y * y, x * y], axis=1)


def dome_amplitude_m(points_m: FloatArray, height_error_m: FloatArray) -> FloatArray:
    """Height of the middle of the site over its edge in a field of height errors.

    ``height_error_m`` (m,) or (m, c); the answer is a scalar array or (c,). It is minus the
    coefficient of r2 in a second-order surface ([C&D] methods), r in units of the site's radius.
    """
    design = second_order_design(points_m, site_radius_m(points_m))
    coefficients = np.linalg.lstsq(design, height_error_m, rcond=None)[0]
    amplitude: FloatArray = -coefficients[3]
    return amplitude


def aligned_difference_m(points_m: FloatArray, reference_m: FloatArray) -> FloatArray:
    """points - reference (m, 3) after the best seven-parameter transformation of the points."""
    difference: FloatArray = fit_similarity(points_m, reference_m).apply(points_m) - reference_m
    return difference


def _tangent_rest(points_m: FloatArray, moves_m: FloatArray) -> FloatArray:
    """Small moves (m, 3, c) of points less their seven-parameter part, heights only (m, c)."""
    m = len(points_m)
    flat = similarity_tangent(points_m - points_m.mean(axis=0)).reshape(3 * m, 7)
    moves = moves_m.reshape(3 * m, -1)
    rest = moves - flat @ np.linalg.lstsq(flat, moves, rcond=None)[0]
    heights: FloatArray = rest.reshape(m, 3, -1)[:, 2]
    return heights


def _settled(response: FloatArray, covariance: FloatArray) -> BoolArray:
    """Points (m,) that the lens leaves open about as much as it does the others.

    One whose rays are down-weighted to hardly any parallax hangs in the air: it says nothing of the site,
    and a least-squares surface would follow nothing else. Response (m, 3, p), covariance (p, p).
    """
    open_m = np.sqrt(np.maximum(np.einsum("mip,pq,miq->m", response, covariance, response), 0.0))
    kept: BoolArray = open_m <= UNSETTLED * max(float(np.median(open_m)), 1e-12)
    return kept


def of_the_site(
    rotations: FloatArray, observations: Observations, n_points: int, standing: BoolArray | None = None
) -> BoolArray:
    """Points (m,) of the ground that was surveyed.

    Where most photos (cam_from_world (k, 3, 3), z up) look down, ground that only the others see, far aside,
    is not what anybody surveyed, and the dome over it grows with the square of its distance. Neither is
    ground that only an extra pass sees, where its photos are known (``standing`` (k,)).
    """
    known = standing is not None and bool(standing.any()) and not bool(standing.all())
    survey = ~standing if standing is not None and known else np.ones(len(rotations), bool)
    down = survey & (-rotations[:, 2, 2] > np.cos(np.radians(CONVERGENT_DEG)))
    if 2 * down.sum() > survey.sum():
        survey = down
    found: BoolArray = np.bincount(observations.point[survey[observations.photo]], minlength=n_points) >= 2
    # A pass may see more than the survey; photos that nothing is known of do not outvote the others.
    enough = found.sum() >= FEWEST_OF_SITE if known else 2 * found.sum() > n_points
    return found if enough else np.ones(n_points, bool)


def predict_dome(
    block: Calibrated,
    lens_covariance: FloatArray,
    reference: Lens | None,
    flying_height_m: float,
    tick: Callable[[], None] | None = None,
    reference_covariance: FloatArray | None = None,
) -> Dome:
    """Dome of the free solution against the solution held at ``reference``, with sigma.

    Sigma is what the inflated lens covariance (35, 35) leaves open, carried to the points with
    poses and points re-adjusted around the lens, and likewise what the reference's own leaves open.
    """
    adjusted = block.adjusted
    if adjusted.point_response is None:
        raise ValueError("the block was adjusted without its response")
    kept = _settled(adjusted.point_response, lens_covariance)
    kept &= of_the_site(adjusted.state.rotations, block.observations, len(kept), block.standing)
    points = adjusted.state.points_m[kept]
    gain = dome_amplitude_m(points, _tangent_rest(points, adjusted.point_response[kept]))
    alone = float(gain @ lens_covariance @ gain)
    given = 0.0
    if reference is not None and reference_covariance is not None:
        given = float(gain @ reference_covariance @ gain)
    left_open, sigma = (float(np.sqrt(max(v, 0.0))) for v in (alone, alone + given))
    radius = site_radius_m(points)
    if reference is None:
        return Dome(None, sigma, left_open, flying_height_m, radius)
    there = hold(block, reference, tick).state.points_m[kept]
    difference = aligned_difference_m(points, there)[:, 2]
    east, north, grid = _grid(there, difference, radius)
    amplitude = float(dome_amplitude_m(there, difference))
    return Dome(amplitude, sigma, left_open, flying_height_m, radius, east, north, grid)


def _grid(
    points_m: FloatArray, difference: FloatArray, radius_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Difference on a 41 x 41 grid over the site, NaN outside the points."""
    centre = np.median(points_m[:, :2], axis=0)
    axis = np.linspace(-1.05 * radius_m, 1.05 * radius_m, 41)
    # Medians over cells keep single bad points from spiking the map.
    cell = np.clip(((points_m[:, :2] - centre) / radius_m * 12 + 13).astype(int), 0, 26)
    slot = cell[:, 1] * 27 + cell[:, 0]
    order = np.argsort(slot, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(slot[order])) + 1)
    nodes = np.array([np.median(points_m[g, :2], axis=0) for g in groups])
    values = np.array([np.median(difference[g]) for g in groups])
    east, north = np.meshgrid(centre[0] + axis, centre[1] + axis)
    if len(nodes) < 4:
        return axis + centre[0], axis + centre[1], np.full(east.shape, np.nan)
    from scipy.interpolate import LinearNDInterpolator  # Slow to load, and only maps need it.

    grid: FloatArray = LinearNDInterpolator(nodes, values)(east, north)
    return axis + centre[0], axis + centre[1], grid

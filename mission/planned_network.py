"""A planned mission as a camera network: poses, ground points, and what will be known of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import shapely
from scipy.spatial import cKDTree
from shapely import Polygon

from calib.align.rays import ray_angle_deg
from calib.align.readout import standing_information
from calib.align.rotations import rotation_exp
from calib.align.selfcal import BASIC, LEAST_ANGLE_DEG, lens_priors, mask
from calib.brownfit import fit_brown
from calib.camera import BrownCamera, FloatArray
from calib.errors import InputError
from calib.field import Lens
from calib.frames import rotation_cam_from_world
from calib.network_design import CameraNetwork, Known, dome_functional
from calib.network_views import SIMULATED, Matching, nearest_view_deg, seen_points
from calib.photos.photo import GimbalAngles
from calib.solution import IntArray, Observations
from mission.plan import Station
from mission.terrain_height import Terrain

#: How much larger errors are than formal sigmas say, for what the lens model does not contain.
#: Source: benchmarks/honest_sigma.md, "Errors that the lens model does not contain", the convergent
#: rows: reported over formal sigma is 1.0 (none, aspect, pattern), 1.1 (rolling shutter) and 2.7
#: (correlated noise), root mean square 1.5 over the five rows of 8 surveys each.
MODEL_ERROR_FACTOR = 1.5
#: Blocks of more photos are thinned; the photos kept stand for their neighbours, with their weight.
MANY_PHOTOS = 1000
#: How far apart these are at most, in shorter sides of a photo on the ground.
WIDEST_SPACING = 0.45
#: Irrational steps of the evenest sequence in the plane (Roberts 2018, The R2 sequence).
_R2 = np.array([0.7548776662466927, 0.5698402909980532])


@dataclass(frozen=True)
class Assumptions:
    """What a prediction takes for granted.

    ``tie_points_per_photo``: matched points of a photo among others that look alike; a straight-down
    photo is modelled with ``points_per_photo`` of the corresponding weight. ``position_sigma_m`` and
    ``attitude_sigma_deg`` are the priors that an alignment will have; ``attitude_scatter_deg`` is how
    far the photos will look beside their stations (perfectly alike views of perfectly flat ground
    would be worth less than real ones). ``model_error_factor``
    multiplies every sigma.
    """

    noise_px: float = 0.5
    tie_points_per_photo: float = 400.0
    matching: Matching = SIMULATED
    position_sigma_m: float = 5.0
    attitude_sigma_deg: float = 5.0
    attitude_scatter_deg: float = 1.5
    model_error_factor: float = MODEL_ERROR_FACTOR
    points_per_photo: int = 40

    @property
    def sigma_px(self) -> float:
        """Standard deviation of one modelled point, which stands for several real ones."""
        return self.noise_px * math.sqrt(self.points_per_photo / self.tie_points_per_photo)


@dataclass(frozen=True)
class PlannedNetwork:
    """A network with what belongs to it. ``functionals`` (1, m, 3): the dome.

    ``f_gradient`` (q,): d reported f / d free lens parameters. ``height_agl_m``: median of the photos.
    ``beyond`` (q, q): covariance of what the lens model cannot follow and no photo takes away; None: nothing.
    ``reference`` (q, q): covariance of the lens that the dome is held against; None: it is held against none.
    ``own_share``: share of their views that the network's own photos match at the angles between them, where
    ``assumptions.tie_points_per_photo`` counts what they really matched.
    """

    network: CameraNetwork
    known: Known
    functionals: FloatArray
    f_gradient: FloatArray
    height_agl_m: float
    assumptions: Assumptions
    beyond: FloatArray | None = None
    own_share: float = 1.0
    reference: FloatArray | None = None

    @property
    def new_way_information(self) -> FloatArray | None:
        """Of a photo that is added, which is taken standing: as in ``Known.way_information``, (3, 3)."""
        return None if self.known.way_information is None else standing_information(self.height_agl_m)

    def worth(self, head: FloatArray) -> tuple[float, float]:
        """Sigma f in percent and dome sigma in percent of the height, model error included.

        ``head`` (q + 1, q + 1): covariance of free lens parameters and dome.
        """
        q = len(self.f_gradient)
        lens = head[:q, :q]
        error = self.assumptions.model_error_factor**2
        dome = error * float(head[q, q])
        f = error * float(self.f_gradient @ lens @ self.f_gradient)
        if self.beyond is not None:
            f += float(self.f_gradient @ self.beyond @ self.f_gradient)
        lasting = [part for part in (self.beyond, self.reference) if part is not None]
        if lasting:
            gain = self._gain(head)
            # Of weak surveys so much of the points' covariance cancels in the dome's that rounding may leave
            # less than the lens alone explains, or nothing.
            dome = max(dome, error * float(gain @ head[:q, q]))
            dome += sum(float(gain @ part @ gain) for part in lasting)
        f, dome = math.sqrt(max(f, 0.0)), math.sqrt(max(dome, 0.0))
        return 100 * f / self.network.lens.brown.f_px, 100 * dome / self.height_agl_m

    @property
    def reference_sigma_f_percent(self) -> float:
        """Sigma of the reference's f; 0 where there is none."""
        if self.reference is None:
            return 0.0
        f2 = float(self.f_gradient @ self.reference @ self.f_gradient)
        return 100 * math.sqrt(max(f2, 0.0)) / self.network.lens.brown.f_px

    def dome_beyond_percent(self, head: FloatArray) -> float:
        """The part of the dome's sigma that comes from what the lens model cannot follow."""
        return self._dome_percent(head, self.beyond)

    def dome_reference_percent(self, head: FloatArray) -> float:
        """The part of the dome's sigma that is the reference's own."""
        return self._dome_percent(head, self.reference)

    def _dome_percent(self, head: FloatArray, part: FloatArray | None) -> float:
        if part is None:
            return 0.0
        gain = self._gain(head)
        return 100 * math.sqrt(max(float(gain @ part @ gain), 0.0)) / self.height_agl_m

    def _gain(self, head: FloatArray) -> FloatArray:
        """d dome / d free lens parameters (q,), with the block re-adjusted around them."""
        q = len(self.f_gradient)
        lens = head[:q, :q]
        scale = 1 / np.sqrt(np.diag(lens))
        # Positive definite and called thousands of times: LAPACK's own solver, without the checks.
        _, scaled, info = scipy.linalg.lapack.dposv(lens * np.outer(scale, scale), head[q, :q] * scale)
        if info:
            raise np.linalg.LinAlgError("the covariance of the lens is not positive definite")
        found: FloatArray = scaled * scale
        return found


def poses(stations: Sequence[Station], attitude_scatter_deg: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """cam_from_world rotations (k, 3, 3) and centres (k, 3), turned as wind and gimbal will turn them.

    The scatter (standard deviation about each axis) belongs to the station: the same every time.
    """
    rotations = np.array(
        [rotation_cam_from_world(GimbalAngles(s.yaw_deg, s.pitch_deg, 0.0)) for s in stations]
    ).reshape(-1, 3, 3)
    centres = np.array([(s.east_m, s.north_m, s.height_m) for s in stations], dtype=float).reshape(-1, 3)
    if attitude_scatter_deg > 0:
        angles = np.array([(s.yaw_deg, s.pitch_deg) for s in stations])
        rotations = rotation_exp(math.radians(attitude_scatter_deg) * _scatter(centres, angles)) @ rotations
    return rotations, centres


def _scatter(centres_m: FloatArray, angles_deg: FloatArray) -> FloatArray:
    """Normal numbers (k, 3) that depend on nothing but the station: hashed, then Box and Muller 1958."""
    seed = centres_m @ [12.9898, 78.233, 37.719] + angles_deg @ [4.581, 9.157]
    unit = np.abs(np.sin(seed[:, None] + np.array([0.0, 1.7, 3.1, 5.3, 7.9, 9.7])) * 43758.5453) % 1.0
    size, turn = np.sqrt(-2 * np.log(np.clip(unit[:, :3], 1e-9, 1.0))), 2 * math.pi * unit[:, 3:]
    normal: FloatArray = np.clip(size * np.cos(turn), -3.0, 3.0)
    return normal


def even_points(outline: Polygon, per_point_m2: float) -> FloatArray:
    """Points (m, 2) spread evenly over a polygon, the same every time."""
    west, south, east, north = outline.bounds
    count = max(math.ceil((east - west) * (north - south) / per_point_m2), 1)
    unit = (0.5 + np.arange(1, count + 1)[:, None] * _R2) % 1.0
    points = np.array([west, south]) + unit * [east - west, north - south]
    shapely.prepare(outline)
    inside: FloatArray = points[shapely.contains_xy(outline, points[:, 0], points[:, 1])]
    return inside


def ground_points(outline: Polygon, per_point_m2: float, terrain: Terrain) -> FloatArray:
    """Even points (m, 3) on the terrain; where the model ends, the middle's height is taken."""
    level = even_points(outline, per_point_m2)
    try:
        height = terrain.height_m(level[:, 0], level[:, 1])
    except InputError:
        height = np.array([_height_or_nan(terrain, e, n) for e, n in level])
        height = np.where(np.isnan(height), np.nanmedian(height), height)
    return np.column_stack([level, height])


def _height_or_nan(terrain: Terrain, east: float, north: float) -> float:
    try:
        return float(terrain.height_m(np.array([east]), np.array([north]))[0])
    except InputError:
        return math.nan


def footprint_m2(camera: BrownCamera, height_m: float) -> float:
    """Ground that a photo sees straight down, lens distortion neglected."""
    return camera.width * camera.height * (height_m / camera.f_px) ** 2


def representatives(
    rotations: FloatArray, centres_m: FloatArray, spacing_m: float
) -> tuple[IntArray, FloatArray]:
    """Photos (r,) that stand for all, and for how many each (r,).

    A photo is stood for by an earlier one within ``spacing_m`` that looks the same way (10 degrees).
    """
    axis = rotations[:, 2, :]
    near = cKDTree(centres_m).query_ball_point(centres_m, spacing_m, return_sorted=True)
    owner = np.full(len(centres_m), -1)
    for i, others in enumerate(near):
        if owner[i] >= 0:
            continue
        mine = np.array(others)
        mine = mine[(owner[mine] < 0) & (axis[mine] @ axis[i] > math.cos(math.radians(10.0)))]
        owner[mine] = i
        owner[i] = i
    kept, counts = np.unique(owner, return_counts=True)
    return kept, counts.astype(float)


def _thinned(
    rotations: FloatArray, centres_m: FloatArray, camera: BrownCamera, height_m: float
) -> tuple[IntArray, FloatArray]:
    """Representatives of a large block: as few as needed, but still with generous overlap."""
    everyone = np.arange(len(centres_m)), np.ones(len(centres_m))
    widest = WIDEST_SPACING * min(camera.width, camera.height) / camera.f_px * height_m
    found = everyone
    for share in (0.4, 0.6, 0.8, 1.0):
        if len(found[0]) <= MANY_PHOTOS:
            break
        found = representatives(rotations, centres_m, share * widest)
    return found


def planned_network(
    stations: Sequence[Station],
    camera: BrownCamera,
    terrain: Terrain,
    assumptions: Assumptions,
) -> PlannedNetwork:
    """The network that ``stations`` make over ``terrain``.

    Raises:
        InputError: no two photos overlap.
    """
    rotations, centres = poses(stations, assumptions.attitude_scatter_deg)
    agl = centres[:, 2] - ground_heights_m(terrain, centres)
    height = float(np.median(agl))
    if len(stations) < 2 or height <= 0:
        raise InputError(
            "The plan has fewer than two photos above the ground, so there is nothing to predict."
        )
    kept, stands_for = _thinned(rotations, centres, camera, height)
    rotations, centres = rotations[kept], centres[kept]
    per_point = footprint_m2(camera, height) / assumptions.points_per_photo
    hull = shapely.MultiPoint(centres[:, :2]).convex_hull.buffer(1.3 * height)
    points = ground_points(hull, per_point, terrain)
    photo, point = seen_points(camera, rotations, centres, points, assumptions.matching.max_incidence_deg)
    share = assumptions.matching.share(nearest_view_deg(photo, point, centres, points))
    # Who stands for others has had those others beside it.
    share = np.where(stands_for[photo] > 1, assumptions.matching.shares[0], share)
    used = share > 0.05
    used &= (np.bincount(point[used], minlength=len(points)) >= 2)[point]
    seen = Observations(photo[used], point[used], np.zeros((int(used.sum()), 2)), np.ones(int(used.sum())))
    # As the adjustment does it: such points have no height of their own.
    used &= (ray_angle_deg(centres, points, seen) > LEAST_ANGLE_DEG)[point]
    if not used.any():
        raise InputError("No two photos of the plan overlap, so there is nothing to predict.")
    old, point = np.unique(point[used], return_inverse=True)
    lens = Lens(camera)
    lens_sigma = lens_priors(camera.width, camera.f_px)[1]
    free = mask((*BASIC, "k3", "p1", "p2", "b1", "b2"), field=True)
    certain = 1 / np.sqrt(stands_for)
    known = Known(
        centre_sigma_m=np.repeat(assumptions.position_sigma_m * certain[:, None], 3, axis=1),
        rotation_sigma_rad=math.radians(assumptions.attitude_sigma_deg) * certain,
        lens_sigma=lens_sigma,
        free=free,
    )
    sigma = assumptions.sigma_px * certain[photo[used]] / np.sqrt(share[used])
    network = CameraNetwork(lens, rotations, centres, points[old], photo[used], point, sigma)
    gradient = fit_brown(lens)[1][0, free]
    return PlannedNetwork(
        network, known, dome_functional(network.points_m)[None], gradient, height, assumptions
    )


def ground_heights_m(terrain: Terrain, places_m: FloatArray) -> FloatArray:
    """Ground heights (n,) under places (n, 3)."""
    return np.asarray(terrain.height_m(places_m[:, 0], places_m[:, 1]), dtype=float)

"""Which ground points a photo sees, flown or planned, and how surely it is matched there.

The simulator and the planner share the geometry: a point is seen where it falls into the image and
is not looked at too flatly. A view becomes a tie point with a probability that falls with the angle
to the nearest other view of the same point (:class:`Matching`).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from calib.camera import BrownCamera, FloatArray
from calib.solution import IntArray


@dataclass(frozen=True)
class Matching:
    """Share of the views of a ground point that become tie points.

    By the angle to the nearest other view of the same point, against views that differ little: linear
    between ``angles_deg``, falling. Views flatter than ``max_incidence_deg`` off the vertical never do.
    """

    angles_deg: tuple[float, ...]
    shares: tuple[float, ...]
    max_incidence_deg: float = 70.0

    def share(self, angle_deg: FloatArray) -> FloatArray:
        """Shares (n,) at angles (n,)."""
        return np.interp(angle_deg, self.angles_deg, self.shares)


#: What the alignment matches of the rendered demo survey (20 photos, nadir and 40 degrees off):
#: 0.80 of the views up to 9 degrees, 0.61-0.66 to 18, 0.53-0.61 to 25, 0.40 to 30, 0.13 to 35, 0.05 to 40.
SIMULATED = Matching((9.0, 14.0, 24.0, 28.0, 33.0, 38.0, 45.0), (1.0, 0.8, 0.72, 0.5, 0.16, 0.06, 0.0))
#: The same of a real, strongly oblique set over vegetation (lewis_oblique, 22 photos): 0.61 of the
#: views up to 3 degrees, 0.43 to 6, 0.17 to 9, 0.13 to 15, 0.02 to 30.
VEGETATION = Matching((1.5, 4.5, 7.5, 13.0, 16.5, 30.0, 40.0), (1.0, 0.7, 0.28, 0.21, 0.04, 0.03, 0.0))
#: Every view is matched: what formal sigmas assume.
EVERY_VIEW = Matching((180.0,), (1.0,))


@functools.lru_cache(maxsize=16)
def rays_limit(camera: BrownCamera) -> FloatArray:
    """Largest |x|, |y| (2,) of rays into the image; beyond it the radial polynomial may fold back."""
    corners = np.array([[0, 0], [0, 1], [1, 0], [1, 1], [0.5, 0], [0, 0.5], [1, 0.5], [0.5, 1]])
    edge = camera.unproject(corners * [camera.width, camera.height])
    limit: FloatArray = 1.02 * np.nanmax(np.abs(edge), axis=0)
    limit.flags.writeable = False
    return limit


def seen_points(
    camera: BrownCamera,
    rotations: FloatArray,
    centres_m: FloatArray,
    points_m: FloatArray,
    max_incidence_deg: float = 70.0,
) -> tuple[IntArray, IntArray]:
    """Photo (n,) and point (n,) of all views, sorted by point, then photo.

    Args:
        rotations: cam_from_world (k, 3, 3).
        centres_m, points_m: (k, 3), (m, 3) in one frame with z up. Nothing stands in the way.
    """
    limit = rays_limit(camera)
    least_cosine = np.cos(np.radians(max_incidence_deg))
    lowest = float(points_m[:, 2].min(initial=0.0))
    tree = cKDTree(points_m[:, :2])
    middle, reach = _footprints(limit, rotations, centres_m, lowest, max_incidence_deg)
    photos, points = [], []
    for i, near in enumerate(tree.query_ball_point(middle, reach)):
        index = np.asarray(near, dtype=np.intp)
        offset = points_m[index] - centres_m[i]
        in_cam = offset @ rotations[i].T
        z = in_cam[:, 2]
        seen = (z > 0) & (np.abs(in_cam[:, 0]) < limit[0] * z) & (np.abs(in_cam[:, 1]) < limit[1] * z)
        seen &= -offset[:, 2] > least_cosine * np.linalg.norm(offset, axis=1)
        pixels = camera.project(in_cam[seen, :2] / z[seen, None])
        inside = np.all((pixels >= 0) & (pixels <= [camera.width, camera.height]), axis=1)
        index = index[seen][inside]
        points.append(index)
        photos.append(np.full(len(index), i, dtype=np.intp))
    photo, point = np.concatenate(photos), np.concatenate(points)
    order = np.lexsort((photo, point))
    return photo[order], point[order]


def _footprints(
    limit: FloatArray, rotations: FloatArray, centres_m: FloatArray, ground_m: float, incidence_deg: float
) -> tuple[FloatArray, FloatArray]:
    """Circles on the ground, middle (k, 2) and radius (k,), that hold all a photo can see."""
    height = np.maximum(centres_m[:, 2] - ground_m, 1e-3)
    corner = np.array([[x, y, 1.0] for x in (-limit[0], limit[0]) for y in (-limit[1], limit[1])])
    way = np.einsum("kji,cj->kci", rotations, corner)  # camera to world
    level = np.linalg.norm(way[..., :2], axis=-1)
    farthest = np.tan(np.radians(incidence_deg))
    slope = np.where(way[..., 2] < 0, level / np.maximum(-way[..., 2], 1e-9), np.inf)
    direction = way[..., :2] / np.maximum(level, 1e-12)[..., None]
    hits = direction * np.minimum(slope, farthest)[..., None]  # per metre of height, from below the camera
    hits = np.concatenate([hits, np.zeros((len(hits), 1, 2))], axis=1)
    middle = hits.mean(axis=1)
    reach = np.linalg.norm(hits - middle[:, None], axis=-1).max(axis=1)
    # Points above the lowest one are nearer; a flat arc between two corners bulges out of the circle.
    bulge = np.where((slope > farthest).any(axis=1), farthest, 0.0)
    return centres_m[:, :2] + middle * height[:, None], (np.maximum(reach, bulge) * 1.1 + 0.05) * height


def nearest_view_deg(
    photo: IntArray, point: IntArray, centres_m: FloatArray, points_m: FloatArray
) -> FloatArray:
    """Angle (n,) of each view to the nearest other view of its point, 180 where there is none.

    Views are sorted by point.
    """
    ray = centres_m[photo] - points_m[point]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    closest = np.full(len(photo), 180.0)
    counts = np.bincount(point, minlength=len(points_m))
    start = np.concatenate([[0], np.cumsum(counts)[:-1]])
    for length in np.unique(counts[counts > 1]):
        rows = start[counts == length][:, None] + np.arange(length)
        cosine = np.einsum("gai,gbi->gab", ray[rows], ray[rows])
        cosine[:, np.arange(length), np.arange(length)] = -1.0
        closest[rows] = np.degrees(np.arccos(np.clip(cosine.max(axis=2), -1.0, 1.0)))
    return closest


def view_table(rays: FloatArray, point: IntArray, n_points: int) -> FloatArray:
    """Views of each point side by side, (n_points, most views, 3), NaN where a point has fewer.

    Unit vectors from the point to the camera (v, 3) and their points (v,), sorted by point.
    """
    counts = np.bincount(point, minlength=n_points)
    start = np.concatenate([[0], np.cumsum(counts)[:-1]])
    table = np.full((n_points, max(int(counts.max(initial=0)), 1), 3), np.nan)
    table[point, np.arange(len(point)) - start[point]] = rays
    return table


def angle_to_views_deg(rays: FloatArray, point: IntArray, views: FloatArray) -> FloatArray:
    """Angle (n,) of new rays (n, 3) at ``point`` (n,) to the nearest of the views there.

    ``views``: see :func:`view_table`; rays alike. 180 where a point has none.
    """
    cosine = np.einsum("nvi,ni->nv", views[point], rays)
    np.nan_to_num(cosine, copy=False, nan=-1.0)
    angle: FloatArray = np.degrees(np.arccos(np.clip(cosine.max(axis=1), -1.0, 1.0)))
    return angle

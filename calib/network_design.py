"""What a network of photos, flown or planned, tells about its camera: the information matrix.

The normal equations of the self-calibrating adjustment without its measurements: Jacobians of the
projection, poses and points eliminated (Schur complement), intrinsics left. Functionals of the
points, such as the dome over the site, ride along as further columns. Points are swept along the
site's longer axis and photos eliminated behind the sweep (a frontal method: Irons 1970, A frontal
solution program), so that the work grows with the number of photos times the square of those abreast.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from calib.align.dome import site_radius_m
from calib.align.rotations import similarity_tangent
from calib.camera import FloatArray
from calib.field import LENS_NAMES, Lens
from calib.solution import BoolArray, IntArray

#: Photos eliminated at a time: enough for fast matrix products, few enough for a narrow front.
GROUP = 40


@dataclass(frozen=True)
class Known:
    """What is known besides the images, as standard deviations; infinite: nothing.

    centre_sigma_m (k, 3), rotation_sigma_rad (k,), lens_sigma (35,) over ``LENS_NAMES``; ``free``
    (35,): lens parameters that are estimated. ``way_information`` (k, 3, 3): inverse covariance of the way
    of each camera while its rows are read, three more unknowns of a photo, 1/m2; None: global shutter.
    """

    centre_sigma_m: FloatArray
    rotation_sigma_rad: FloatArray
    lens_sigma: FloatArray
    free: BoolArray
    way_information: FloatArray | None = None

    @property
    def per_photo(self) -> int:
        """Unknowns of a photo: 6, or 9 with a rolling shutter."""
        return 6 if self.way_information is None else 9

    @property
    def pose_information(self) -> FloatArray:
        """(k, p, p), p 6 or 9: rotation, centre, way during the readout."""
        each = self.per_photo
        found = np.zeros((len(self.centre_sigma_m), each, each))
        axes = np.arange(3)
        found[:, axes, axes] = self.rotation_sigma_rad[:, None] ** -2.0
        found[:, axes + 3, axes + 3] = self.centre_sigma_m**-2.0
        if self.way_information is not None:
            found[:, 6:, 6:] = self.way_information
        return found


@dataclass(frozen=True)
class CameraNetwork:
    """k photos, m points and n views of them, sorted by point.

    rotations cam_from_world (k, 3, 3), centres_m (k, 3), points_m (m, 3), z up; photo, point (n,);
    sigma_px (n,): standard deviation per coordinate. Thinned points and uncertain matches are
    expressed in it: a view that stands for w views has sigma / sqrt(w). Every point has at least
    two views.
    """

    lens: Lens
    rotations: FloatArray
    centres_m: FloatArray
    points_m: FloatArray
    photo: IntArray
    point: IntArray
    sigma_px: FloatArray


@dataclass(frozen=True)
class LensInformation:
    """What the network leaves open of the lens and of functionals of the points.

    ``normal`` (q, q): reduced normal matrix of the free parameters. ``gain`` (c, q): d functional /
    d lens with the block re-adjusted around it. ``given_lens`` (c, c): covariance of the functionals
    were the lens known.
    """

    free: BoolArray
    normal: FloatArray
    gain: FloatArray
    given_lens: FloatArray

    @property
    def covariance(self) -> FloatArray:
        """(35, 35) over ``LENS_NAMES``; held parameters have zero rows.

        Raises numpy's LinAlgError where a free parameter is not observable at all.
        """
        full = np.zeros((len(LENS_NAMES), len(LENS_NAMES)))
        full[np.ix_(self.free, self.free)] = inverse(self.normal)
        return full

    @property
    def sigma(self) -> FloatArray:
        """(c,): of each functional with all that is open: lens, poses and points."""
        total: FloatArray = np.sqrt(self.functional_sigma**2 + np.diag(self.given_lens))
        return total

    @property
    def functional_sigma(self) -> FloatArray:
        """(c,): what the lens leaves open of each functional, as ``calib.align.dome`` has it."""
        sigma: FloatArray = np.sqrt(np.einsum("ci,ij,cj->c", self.gain, inverse(self.normal), self.gain))
        return sigma


@dataclass(frozen=True)
class Reduced:
    """Normal equations of the kept photos (p each), the free lens and the functionals, points gone.

    ``matrix`` (p kept + q + c) square, ``kept`` (photo indices in its order).
    """

    matrix: FloatArray
    kept: IntArray
    n_lens: int


def inverse(matrix: FloatArray) -> FloatArray:
    """Inverse of a positive definite matrix, scaled to a unit diagonal first."""
    scale = 1 / np.sqrt(np.diag(matrix))
    factor = scipy.linalg.cho_factor(matrix * np.outer(scale, scale), lower=True)
    found: FloatArray = scipy.linalg.cho_solve(factor, np.diag(scale)) * scale[:, None]
    return found


def view_derivatives(
    lens: Lens,
    rotations: FloatArray,
    centres_m: FloatArray,
    points_m: FloatArray,
    sigma_px: FloatArray,
    *,
    shutter: bool = False,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """d pixels / d pose (n, 2, 6 or 9), lens (n, 2, 35), point (n, 2, 3), in sigmas; all inputs (n, ...).

    Pose: rotation vector applied on the camera's side, then centre, with ``shutter`` then the way while the
    rows are read, as in ``calib.align.adjust``.
    """
    in_cam = np.einsum("nij,nj->ni", rotations, points_m - centres_m)
    inv_z = 1 / in_cam[:, 2]
    rays = in_cam[:, :2] * inv_z[:, None]
    pixels, by_ray, by_lens = lens.derivatives(rays)
    root = 1 / sigma_px
    by_cam = np.empty((len(rays), 2, 3))
    by_cam[:, :, :2] = by_ray * inv_z[:, None, None]
    by_cam[:, :, 2] = -np.einsum("nij,nj->ni", by_ray, rays) * inv_z[:, None]
    by_cam *= root[:, None, None]
    by_point = by_cam @ rotations
    parts = [np.cross(in_cam[:, None, :], by_cam), -by_point]
    if shutter:
        parts.append(-by_point * (pixels[:, 1] / lens.brown.height - 0.5)[:, None, None])
    by_pose = np.concatenate(parts, axis=2)
    return by_pose, by_lens * root[:, None, None], by_point


def dome_functional(points_m: FloatArray) -> FloatArray:
    """The dome over the site as a linear functional g (m, 3) of small moves of its points.

    g . moves is ``calib.align.dome``'s amplitude: heights after a seven-parameter fit, second-order
    surface, its middle over its edge.
    """
    radius = site_radius_m(points_m)
    x, y = ((points_m[:, :2] - np.median(points_m[:, :2], axis=0)) / radius).T
    design = np.stack([np.ones_like(x), x, y, x * x + y * y, x * x - y * y, x * y], axis=1)
    heights = np.zeros((len(points_m), 3))
    heights[:, 2] = -np.linalg.pinv(design)[3]
    similar = similarity_tangent(points_m - points_m.mean(axis=0)).reshape(-1, 7)
    flat = heights.ravel()
    g: FloatArray = (flat - similar @ np.linalg.lstsq(similar, flat, rcond=None)[0]).reshape(-1, 3)
    return g


def lens_information(
    network: CameraNetwork, known: Known, functionals: FloatArray | None = None
) -> LensInformation:
    """Information on the lens; ``functionals`` (c, m, 3): see :func:`dome_functional`."""
    reduced = reduce_network(network, known, functionals)
    q = reduced.n_lens
    s = reduced.matrix
    return LensInformation(known.free, s[:q, :q], s[q:, :q], -s[q:, q:])


def reduce_network(
    network: CameraNetwork,
    known: Known,
    functionals: FloatArray | None = None,
    kept: IntArray | None = None,
) -> Reduced:
    """Eliminate all points and all photos but ``kept``.

    Raises:
        ValueError: a point with fewer than two views, or views that are not sorted by point.
        numpy.linalg.LinAlgError: a photo that nothing holds.
    """
    m = len(network.points_m)
    if np.any(np.diff(network.point) < 0) or np.bincount(network.point, minlength=m).min(initial=2) < 2:
        raise ValueError("views must be sorted by point, and every point needs two of them")
    g = np.zeros((0, m, 3)) if functionals is None else functionals
    q = int(known.free.sum())
    sweep = _Sweep(network, known, g, np.zeros(0, np.intp) if kept is None else np.asarray(kept))
    for points, leaving in sweep.steps():
        sweep.take_in(points)
        sweep.eliminate(leaving)
    sweep.eliminate(sweep.abreast[~np.isin(sweep.abreast, sweep.kept)])
    missing = np.setdiff1d(sweep.kept, sweep.abreast)
    sweep.enter(missing)
    return Reduced(sweep.front, sweep.abreast, q)


class _Sweep:
    """The front: dense normal matrix of the photos abreast, the lens and the functionals."""

    def __init__(self, network: CameraNetwork, known: Known, g: FloatArray, kept: IntArray) -> None:
        self.network, self.known, self.g, self.kept = network, known, g, kept
        self.prior, self.each = known.pose_information, known.per_photo
        self.border = int(known.free.sum()) + len(g)
        self.abreast: IntArray = np.zeros(0, np.intp)
        self.front = np.zeros((self.border, self.border))
        q = int(known.free.sum())
        self.front[np.arange(q), np.arange(q)] = known.lens_sigma[known.free] ** -2.0
        counts = np.bincount(network.point, minlength=len(network.points_m))
        self.start = np.concatenate([[0], np.cumsum(counts)])

    def steps(self) -> list[tuple[IntArray, IntArray]]:
        """Points to take in and photos that leave after them, along the site's longer axis."""
        net = self.network
        level = net.points_m[:, :2] - net.points_m[:, :2].mean(axis=0)
        axis = np.linalg.svd(level, full_matrices=False)[2][0] if len(level) > 1 else np.array([1.0, 0.0])
        along = level @ axis
        if len(self.kept):  # These stay on the front once they are there: towards them, not away.
            near = np.isin(net.photo, self.kept)
            along *= 1.0 if along[net.point[near]].sum() >= 0 else -1.0
        order = np.argsort(along, kind="stable")
        rank = np.empty(len(order), np.intp)
        rank[order] = np.arange(len(order))
        last = np.full(len(net.centres_m), -1)
        np.maximum.at(last, net.photo, rank[net.point])
        leaving = np.flatnonzero(last >= 0)
        leaving = leaving[~np.isin(leaving, self.kept)]
        leaving = leaving[np.argsort(last[leaving], kind="stable")]
        groups = [leaving[i : i + GROUP] for i in range(0, len(leaving), GROUP)]
        ends = [int(last[group[-1]]) + 1 for group in groups]
        if groups:
            ends[-1] = len(order)
        else:
            groups, ends = [leaving], [len(order)]
        starts = [0, *ends[:-1]]
        return [(order[a:b], group) for a, b, group in zip(starts, ends, groups, strict=True)]

    def enter(self, photos: IntArray) -> None:
        """Photos join the front with their priors."""
        if not len(photos):
            return
        old, new = self.each * len(self.abreast), self.each * len(photos)
        size = len(self.front) + new
        front = np.zeros((size, size))
        # Four slices: several times faster than one index.
        here, there = slice(old), slice(old + new, size)
        front[here, here], front[here, there] = self.front[:old, :old], self.front[:old, old:]
        front[there, here], front[there, there] = self.front[old:, :old], self.front[old:, old:]
        at = old + self.each * np.arange(len(photos))[:, None] + np.arange(self.each)
        front[at[:, :, None], at[:, None, :]] = self.prior[photos]
        self.front, self.abreast = front, np.concatenate([self.abreast, photos])

    def take_in(self, points: IntArray) -> None:
        """Add the views of ``points`` and eliminate these."""
        if not len(points):
            return
        net = self.network
        lengths = self.start[points + 1] - self.start[points]
        offset = np.repeat(np.cumsum(lengths) - lengths, lengths)
        rows = np.repeat(self.start[points], lengths) + np.arange(len(offset)) - offset
        column = np.repeat(np.arange(len(points)), lengths)  # of each view: its point's place here
        photo = net.photo[rows]
        self.enter(np.setdiff1d(photo, self.abreast))
        place = np.full(len(net.centres_m), -1)
        place[self.abreast] = np.arange(len(self.abreast))
        slot = place[photo]
        by_pose, by_lens, by_point = view_derivatives(
            net.lens,
            net.rotations[photo],
            net.centres_m[photo],
            net.points_m[net.point[rows]],
            net.sigma_px[rows],
            shutter=self.known.way_information is not None,
        )
        by_lens = by_lens[:, :, self.known.free]
        q, p, each = by_lens.shape[2], len(points), self.each
        poses = each * len(self.abreast)
        blocks = np.concatenate([by_pose, by_lens, by_point], axis=2)
        ends = np.concatenate([[0], np.cumsum(lengths)[:-1]])
        v = np.add.reduceat(by_point.transpose(0, 2, 1) @ by_point, ends, axis=0)
        root = point_roots(v)
        w_xl = np.add.reduceat(by_point.transpose(0, 2, 1) @ by_lens, ends, axis=0)
        # Everything that meets a point, times the inverse root of its matrix: (poses + border, 3 p).
        meets = np.zeros((poses + self.border, p, 3))
        w_cx = by_pose.transpose(0, 2, 1) @ by_point @ root.transpose(0, 2, 1)[column]
        meets[each * slot[:, None] + np.arange(each), column[:, None]] = w_cx
        meets[poses : poses + q] = (root @ w_xl).transpose(2, 0, 1)
        meets[poses + q :] = np.einsum("pij,cpj->cpi", root, self.g[:, points])
        flat = meets.reshape(len(meets), 3 * p)
        self.front -= flat @ flat.T
        by_slot = np.argsort(slot, kind="stable")
        present, first = np.unique(slot[by_slot], return_index=True)
        own = blocks[by_slot, :, :each].transpose(0, 2, 1) @ blocks[by_slot, :, : each + q]
        own = np.add.reduceat(own, first, axis=0)
        at = each * present[:, None] + np.arange(each)
        self.front[at[:, :, None], at[:, None, :]] += own[:, :, :each]
        lens = poses + np.arange(q)
        self.front[at[:, :, None], lens] += own[:, :, each:]
        self.front[lens[None, :, None], at[:, None, :]] += own[:, :, each:].transpose(0, 2, 1)
        flat_lens = by_lens.reshape(-1, q)
        self.front[poses : poses + q, poses : poses + q] += flat_lens.T @ flat_lens

    def eliminate(self, photos: IntArray) -> None:
        """Remove photos of the front (Schur complement)."""
        if not len(photos):
            return
        going = np.isin(self.abreast, photos)
        out = np.concatenate([np.repeat(going, self.each), np.zeros(self.border, bool)])
        inner = self.front[np.ix_(out, out)]
        scale = 1 / np.sqrt(np.diag(inner))
        factor = scipy.linalg.cholesky(inner * np.outer(scale, scale), lower=True, overwrite_a=True)
        cross = scipy.linalg.solve_triangular(
            factor, self.front[np.ix_(out, ~out)] * scale[:, None], lower=True, overwrite_b=True
        )
        self.front = self.front[np.ix_(~out, ~out)] - cross.T @ cross
        self.abreast = self.abreast[~going]


def point_roots(v: FloatArray) -> FloatArray:
    """L^-1 (m, 3, 3) with V = L L^T, parallel rays kept solvable as in ``calib.align.adjust``."""
    v = v.copy()
    axes = np.arange(3)
    largest = v[:, axes, axes].max(axis=1, keepdims=True)
    v[:, axes, axes] += 1e-12 * largest + 1e-300
    roots: FloatArray = np.linalg.inv(np.linalg.cholesky(v))
    return roots

"""The self-calibrating adjustment: Schur-complement Levenberg-Marquardt on arrays.

Why our own: no library at hand holds Brown with b1, b2, a residual field and priors on all of
them, and the valley of a nadir block is so flat that stopping has to be decided by the Newton
decrement, not by a small step. On the models that Ceres has too, tests hold ours against it.

Unknowns: lens (35, those in ``free``), poses (cam_from_world rotation and centre), points, and
where a rolling shutter is allowed for, the way that each camera went while its rows were read.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.sparse import bsr_array
from scipy.spatial.transform import Rotation

from calib.camera import FloatArray
from calib.field import Lens
from calib.solution import Observations

BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Priors:
    """What is known besides the image measurements.

    centres_m (k, 3) with centre_sigma_m (k, 3): measured camera positions; an infinite sigma
    means not measured. rotations (k, 3, 3) with rotation_sigma_rad (k,): measured attitudes.
    lens_mean, lens_sigma (35,) over ``LENS_NAMES``: infinite sigma means no prior.
    """

    centres_m: FloatArray
    centre_sigma_m: FloatArray
    rotations: FloatArray
    rotation_sigma_rad: FloatArray
    lens_mean: FloatArray
    lens_sigma: FloatArray
    #: Standard deviation of a camera's way during the readout, m; None: global shutter.
    shutter_sigma_m: float | None = None


@dataclass(frozen=True)
class State:
    """One set of values of all unknowns.

    ``shutter_m`` (k, 3): way of each camera from the first row to the last; the pose is the middle row's.
    """

    lens: Lens
    rotations: FloatArray
    centres_m: FloatArray
    points_m: FloatArray
    shutter_m: FloatArray | None = None


@dataclass(frozen=True)
class Adjusted:
    """Outcome of one adjustment.

    ``lens_normal`` (p, p): normal matrix of the free lens parameters with poses and points
    eliminated, for unit variance factor. ``chi2``: weighted square sum of everything at the end.
    ``sigma0``: square root of the variance factor, 1 when the a-priori sigmas are right.
    ``point_response`` (m, 3, p): d points / d lens with the block re-adjusted around it.
    """

    state: State
    free: BoolArray
    lens_normal: FloatArray
    residuals_px: FloatArray
    weights: FloatArray
    position_weights: FloatArray
    chi2: float
    sigma0: float
    redundancy: int
    iterations: int
    converged: bool
    point_response: FloatArray | None = None

    @property
    def covariance(self) -> FloatArray:
        """(35, 35) formal covariance of the lens, scaled by sigma0; held parameters are zero."""
        full = np.zeros((len(self.free), len(self.free)))
        if self.free.any():
            scale = 1 / np.sqrt(np.diag(self.lens_normal))
            inverse = scipy.linalg.inv(self.lens_normal * np.outer(scale, scale))
            full[np.ix_(self.free, self.free)] = inverse * np.outer(scale, scale) * self.sigma0**2
        return full


def rotation_exp(omega: FloatArray) -> FloatArray:
    """Rotation vectors (k, 3) -> matrices (k, 3, 3) (Rodrigues)."""
    angle = np.linalg.norm(omega, axis=1)
    safe = np.where(angle < 1e-12, 1.0, angle)
    x, y, z = (omega / safe[:, None]).T
    cross = np.zeros((len(omega), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2] = -z, y
    cross[:, 1, 0], cross[:, 1, 2] = z, -x
    cross[:, 2, 0], cross[:, 2, 1] = -y, x
    s, c = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    turned: FloatArray = np.eye(3) + s * cross + (1 - c) * (cross @ cross)
    return turned


def rotation_log(rotations: FloatArray) -> FloatArray:
    """Matrices (k, 3, 3) -> rotation vectors (k, 3)."""
    vectors: FloatArray = Rotation.from_matrix(rotations).as_rotvec()
    return vectors


def similarity_tangent(points: FloatArray) -> FloatArray:
    """d point / d (shift, rotation vector, log scale) of a similarity at points (m, 3), as (m, 3, 7)."""
    design = np.zeros((len(points), 3, 7))
    x, y, z = points.T
    design[:, [0, 1, 2], [0, 1, 2]] = 1
    design[:, 1, 3], design[:, 2, 3] = -z, y
    design[:, 0, 4], design[:, 2, 4] = z, -x
    design[:, 0, 5], design[:, 1, 5] = -y, x
    design[:, :, 6] = points
    return design


class Topology:
    """Index arrays of a fixed set of observations, built once and used in every iteration."""

    def __init__(self, obs: Observations, n_photos: int, n_points: int) -> None:
        if len(obs) == 0 or np.any(np.diff(obs.point) < 0):
            raise ValueError("observations must be there and sorted by point")
        self.n_photos, self.n_points = n_photos, n_points
        counts = np.bincount(obs.point, minlength=n_points)
        if counts.min() < 2:
            raise ValueError("every point needs at least two observations")
        self.point_start = np.concatenate([[0], np.cumsum(counts)[:-1]])
        self.by_photo = np.argsort(obs.photo, kind="stable")
        photo_counts = np.bincount(obs.photo, minlength=n_photos)
        if photo_counts.min() < 1:
            raise ValueError("every photo needs observations")
        self.photo_start = np.concatenate([[0], np.cumsum(photo_counts)[:-1]])
        self.photo_ends = np.concatenate([self.photo_start, [len(obs)]])
        self.point_ends = np.concatenate([self.point_start, [len(obs)]])
        self.point_of_photo = obs.point[self.by_photo]
        # Dense products are faster as long as the block is small; the pairs are not needed then.
        pairs = float(np.sum(counts.astype(float) * (counts + 1) / 2))
        self.dense = (6.0 * n_photos) ** 2 * 3 * n_points / 4e10 < pairs * 2.5e-7
        if self.dense:
            return
        # All ordered pairs of observations of one point, a <= b, grouped by their photo pair.
        first, second = [], []
        for length in np.unique(counts):
            starts = self.point_start[counts == length]
            a, b = np.triu_indices(int(length))
            first.append((starts[:, None] + a).ravel())
            second.append((starts[:, None] + b).ravel())
        a, b = np.concatenate(first), np.concatenate(second)
        swap = obs.photo[a] > obs.photo[b]
        a, b = np.where(swap, b, a), np.where(swap, a, b)
        key = obs.photo[a] * n_photos + obs.photo[b]
        order = np.argsort(key, kind="stable")
        self.pair_a, self.pair_b, key = a[order], b[order], key[order]
        self.pair_key, self.pair_start = np.unique(key, return_index=True)

    def photos_by_points(self, blocks: FloatArray) -> bsr_array:
        """Sparse (q k, 3 m) from one (q, 3) block an observation."""
        return bsr_array(
            (blocks[self.by_photo], self.point_of_photo, self.photo_ends),
            shape=(blocks.shape[1] * self.n_photos, 3 * self.n_points),
        )

    def photo_sums(self, left: FloatArray, right: FloatArray) -> FloatArray:
        """Sum over each photo of left^T right, (k, a, p), from (n, 2, a) and (n, 2, p)."""
        n, _, a = left.shape
        blocks = np.ascontiguousarray(left.transpose(0, 2, 1)[self.by_photo])
        sparse = bsr_array((blocks, self.by_photo, self.photo_ends), shape=(a * self.n_photos, 2 * n))
        summed: FloatArray = sparse @ right.reshape(2 * n, -1)
        return summed.reshape(self.n_photos, a, -1)

    def point_sums(self, left: FloatArray, right: FloatArray) -> FloatArray:
        """Sum over each point of left^T right, (m, a, p), from (n, 2, a) and (n, 2, p)."""
        n, _, a = left.shape
        blocks = np.ascontiguousarray(left.transpose(0, 2, 1))
        sparse = bsr_array((blocks, np.arange(n), self.point_ends), shape=(a * self.n_points, 2 * n))
        summed: FloatArray = sparse @ right.reshape(2 * n, -1)
        return summed.reshape(self.n_points, a, -1)

    def pose_products(self, b_c: FloatArray, sparse: bsr_array) -> FloatArray:
        """B_c B_c^T over all points, (q k, q k)."""
        k = self.n_photos
        if self.dense:
            full = sparse.toarray()
            product: FloatArray = full @ full.T
            return product
        blocks = np.add.reduceat(
            b_c[self.pair_a] @ b_c[self.pair_b].transpose(0, 2, 1), self.pair_start, axis=0
        )
        q = b_c.shape[1]
        product = np.zeros((q * k, q * k))
        view = product.reshape(k, q, k, q).transpose(0, 2, 1, 3)
        rows, cols = self.pair_key // k, self.pair_key % k
        view[rows, cols] = blocks
        off = rows != cols
        view[cols[off], rows[off]] = blocks[off].transpose(0, 2, 1)
        return product


@dataclass(frozen=True)
class _Linear:
    """Normal equations before damping. c: poses (k, q), l: lens (p), x: points."""

    u_cc: FloatArray  # (k, q, q)
    u_cl: FloatArray  # (k, q, p)
    u_ll: FloatArray  # (p, p)
    v: FloatArray  # (m, 3, 3)
    w_cx: FloatArray  # (n, q, 3)
    w_xl: FloatArray  # (m, 3, p)
    g_c: FloatArray  # (k, q)
    g_l: FloatArray  # (p,)
    g_x: FloatArray  # (m, 3)
    # Weighted derivatives of the measurements, for right sides other than the residuals'.
    by_pose: FloatArray  # (n, 2, q)
    by_lens: FloatArray  # (n, 2, p)
    by_point: FloatArray  # (n, 2, 3)


@dataclass(frozen=True)
class _Step:
    """A change of all unknowns: poses (k, q), lens (p,), points (m, 3)."""

    pose: FloatArray
    lens: FloatArray
    point: FloatArray

    def scaled(self, factor: float) -> _Step:
        return _Step(factor * self.pose, factor * self.lens, factor * self.point)

    def plus(self, other: _Step, factor: float) -> _Step:
        return _Step(
            self.pose + factor * other.pose,
            self.lens + factor * other.lens,
            self.point + factor * other.point,
        )


@dataclass(frozen=True)
class _Factored:
    """Damped normal equations with the points eliminated, ready for right sides."""

    factor: FloatArray  # Cholesky, lower, of the reduced matrix scaled to a unit diagonal
    scale: FloatArray
    sparse: bsr_array  # B_c
    b_l: FloatArray  # (m, 3, p)
    inverse_root: FloatArray  # (m, 3, 3)

    def solve(self, g_c: FloatArray, g_l: FloatArray, g_x: FloatArray) -> _Step:
        k, q = g_c.shape
        h = (self.inverse_root @ g_x[:, :, None])[:, :, 0]
        flat = self.b_l.reshape(3 * len(g_x), len(g_l))
        right = np.concatenate([g_c.ravel() - self.sparse @ h.ravel(), g_l - flat.T @ h.ravel()])
        delta = scipy.linalg.cho_solve((self.factor, True), right * self.scale) * self.scale
        pose, lens = delta[: q * k].reshape(k, q), delta[q * k :]
        back = h - (self.sparse.T @ pose.ravel()).reshape(-1, 3) - self.b_l @ lens
        return _Step(pose, lens, (self.inverse_root.transpose(0, 2, 1) @ back[:, :, None])[:, :, 0])


class Adjustment:
    """One block to be adjusted, possibly several times under different lens models."""

    def __init__(
        self,
        obs: Observations,
        n_photos: int,
        n_points: int,
        priors: Priors,
        huber_sigmas: float = 2.5,
        robust_positions: bool = True,
        noise_factor: float = 1.0,
    ) -> None:
        """``noise_factor``: variance factor for correlated noise that ``obs.sigma_px`` contains already.

        It makes image measurements weigh less against the priors; sigma0 is given without it.
        """
        self.obs, self.priors = obs, priors
        self.topology = Topology(obs, n_photos, n_points)
        self.huber = huber_sigmas / np.sqrt(noise_factor)
        self.noise_factor = noise_factor
        self.robust_positions = robust_positions
        self._has_centre = np.isfinite(priors.centre_sigma_m).all(axis=1)
        self._has_rotation = np.isfinite(priors.rotation_sigma_rad)
        self._row: FloatArray | None = None

    def with_priors(self, priors: Priors) -> Adjustment:
        """The same observations under other priors of the lens; the index arrays are shared."""
        other = copy.copy(self)
        other.priors = priors
        return other

    @property
    def _q(self) -> int:
        """Unknowns a photo: 6, or 9 with a rolling shutter."""
        return 6 if self.priors.shutter_sigma_m is None else 9

    def _rows(self, lens: Lens) -> FloatArray:
        """When each observation's row was read, -0.5 (first) to 0.5 (last), (n,)."""
        if self._row is None:
            self._row = self.obs.pixels[:, 1] / lens.brown.height - 0.5
        return self._row

    # -- residuals -----------------------------------------------------------------------------

    def _rays(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Points in their cameras (n, 3) and rays (n, 2)."""
        offset = state.points_m[self.obs.point] - state.centres_m[self.obs.photo]
        if state.shutter_m is not None:
            offset -= state.shutter_m[self.obs.photo] * self._rows(state.lens)[:, None]
        in_cam = (state.rotations[self.obs.photo] @ offset[:, :, None])[:, :, 0]
        depth = in_cam[:, 2]
        # A point behind its camera is pushed away from the pole; its residual stays huge.
        safe = np.where(np.abs(depth) < 1e-6, 1e-6, depth)
        return in_cam, in_cam[:, :2] / safe[:, None]

    def residuals_px(self, state: State) -> FloatArray:
        """Measured minus projected, (n, 2)."""
        _, rays = self._rays(state)
        return self.obs.pixels - state.lens.project(rays)

    def depths(self, state: State) -> FloatArray:
        """Depth of every observation's point in front of its camera, (n,)."""
        return self._rays(state)[0][:, 2]

    def _weights(self, residuals_px: FloatArray) -> FloatArray:
        size = np.linalg.norm(residuals_px, axis=1) / self.obs.sigma_px
        weights: FloatArray = np.minimum(1.0, self.huber / np.maximum(size, 1e-12))
        return weights

    def _position_terms(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Normalised position residuals (k, 3) and robust weights (k,)."""
        k = len(state.centres_m)
        normalised = np.zeros((k, 3))
        weights = np.zeros(k)
        has = self._has_centre
        if has.any():
            normalised[has] = (
                self.priors.centres_m[has] - state.centres_m[has]
            ) / self.priors.centre_sigma_m[has]
            size = np.linalg.norm(normalised, axis=1)
            weights[has] = (
                np.minimum(1.0, 3.0 / np.maximum(size[has], 1e-12)) if self.robust_positions else 1.0
            )
        return normalised, weights

    def _rotation_terms(self, state: State) -> FloatArray:
        """Normalised attitude residuals (k, 3): measured minus current, rotation vector."""
        normalised = np.zeros((len(state.rotations), 3))
        has = self._has_rotation
        if has.any():
            turned = self.priors.rotations[has] @ state.rotations[has].transpose(0, 2, 1)
            normalised[has] = rotation_log(turned) / self.priors.rotation_sigma_rad[has, None]
        return normalised

    def _robust_weights(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Huber weights of the image measurements (n,) and of the positions (k,) at ``state``."""
        return self._weights(self.residuals_px(state)), self._position_terms(state)[1]

    def cost(self, state: State, weights: tuple[FloatArray, FloatArray]) -> float:
        """Weighted square sum of image measurements and priors."""
        residual = self.residuals_px(state)
        image = np.sum(weights[0] * np.sum(residual**2, axis=1) / self.obs.sigma_px**2)
        position = np.sum(weights[1] * np.sum(self._position_terms(state)[0] ** 2, axis=1))
        attitude = np.sum(self._rotation_terms(state) ** 2)
        has = np.isfinite(self.priors.lens_sigma)
        lens = np.sum(((state.lens.vector - self.priors.lens_mean)[has] / self.priors.lens_sigma[has]) ** 2)
        shutter = 0.0
        if self.priors.shutter_sigma_m is not None and state.shutter_m is not None:
            shutter = float(np.sum(state.shutter_m**2)) / self.priors.shutter_sigma_m**2
        total = float(image + position + attitude + lens + shutter)
        return total if np.isfinite(total) else np.inf

    # -- normal equations ----------------------------------------------------------------------

    def _linearise(self, state: State, free: BoolArray, weights: tuple[FloatArray, FloatArray]) -> _Linear:
        obs, top = self.obs, self.topology
        in_cam, rays = self._rays(state)
        pixels, by_ray, by_lens = state.lens.derivatives(rays)
        residual = obs.pixels - pixels
        root = np.sqrt(weights[0]) / obs.sigma_px
        residual = residual * root[:, None]
        inv_z = 1 / np.where(np.abs(in_cam[:, 2]) < 1e-6, 1e-6, in_cam[:, 2])
        by_cam = np.empty((len(obs), 2, 3))
        by_cam[:, :, :2] = by_ray * inv_z[:, None, None]
        by_cam[:, :, 2] = -np.einsum("nij,nj->ni", by_ray, rays) * inv_z[:, None]
        by_cam *= root[:, None, None]
        by_point = by_cam @ state.rotations[obs.photo]
        q = self._q
        by_pose = np.empty((len(obs), 2, q))
        # d in_cam / d omega = -[in_cam]x, hence by_cam @ -[q]x = cross(q, by_cam rows).
        by_pose[:, :, :3] = np.cross(in_cam[:, None, :], by_cam)
        by_pose[:, :, 3:6] = -by_point
        if q == 9:
            by_pose[:, :, 6:] = -by_point * self._rows(state.lens)[:, None, None]
        by_lens = by_lens[:, :, free] * root[:, None, None]

        p = int(free.sum())
        flat = by_lens.reshape(2 * len(obs), p)
        # One pass of each sparse product serves the matrix and the right side.
        to_the_right = np.concatenate([by_lens, residual[:, :, None]], axis=2)
        pose_sums = top.photo_sums(by_pose, np.concatenate([by_pose, to_the_right], axis=2))
        u_cc, u_cl, g_c = pose_sums[:, :, :q].copy(), pose_sums[:, :, q:-1], pose_sums[:, :, -1].copy()
        point_sums = top.point_sums(by_point, np.concatenate([by_point, to_the_right], axis=2))
        v, w_xl, g_x = point_sums[:, :, :3], point_sums[:, :, 3:-1], point_sums[:, :, -1]
        u_ll = flat.T @ flat
        g_l = flat.T @ residual.ravel()
        w_cx = (
            by_pose[:, 0, :, None] * by_point[:, 0, None, :]
            + by_pose[:, 1, :, None] * by_point[:, 1, None, :]
        )

        normalised, weight = self._position_terms(state)[0], weights[1]
        has = self._has_centre
        inv_sigma = np.zeros_like(normalised)
        inv_sigma[has] = 1 / self.priors.centre_sigma_m[has]
        axes = np.arange(3, 6)
        u_cc[:, axes, axes] += weight[:, None] * inv_sigma**2
        g_c[:, 3:6] += weight[:, None] * normalised * inv_sigma
        if self.priors.shutter_sigma_m is not None:
            axes = np.arange(6, 9)
            u_cc[:, axes, axes] += 1 / self.priors.shutter_sigma_m**2
            if state.shutter_m is not None:
                g_c[:, 6:] -= state.shutter_m / self.priors.shutter_sigma_m**2
        turn = np.zeros(top.n_photos)
        turn[self._has_rotation] = 1 / self.priors.rotation_sigma_rad[self._has_rotation]
        axes = np.arange(3)
        u_cc[:, axes, axes] += (turn**2)[:, None]
        g_c[:, :3] += self._rotation_terms(state) * turn[:, None]
        known = np.isfinite(self.priors.lens_sigma)
        inv_lens = np.where(known, 1 / np.where(known, self.priors.lens_sigma, 1.0), 0.0)[free]
        u_ll[np.diag_indices(p)] += inv_lens**2
        mean = np.where(known, self.priors.lens_mean, state.lens.vector)
        g_l += ((mean - state.lens.vector)[free]) * inv_lens**2
        return _Linear(u_cc, u_cl, u_ll, v, w_cx, w_xl, g_c, g_l, g_x, by_pose, by_lens, by_point)

    def _reduce(self, lin: _Linear, damping: float) -> tuple[FloatArray, bsr_array, FloatArray, FloatArray]:
        """Eliminate the points.

        Returns the reduced matrix (q k + p square), B_c (sparse) and B_l (m, 3, p), and the inverse
        Cholesky factors of V (m, 3, 3), from which points are solved back.
        """
        obs, top = self.obs, self.topology
        k, p = top.n_photos, len(lin.g_l)
        diagonal = np.einsum("mii->mi", lin.v)
        axes = np.arange(3)
        v = lin.v.copy()
        # The tiny floor keeps points with parallel rays solvable; it is far below any real curvature.
        v[:, axes, axes] += damping * diagonal + 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-300
        inverse_root = np.linalg.inv(np.linalg.cholesky(v))  # L^-1 with V = L L^T
        b_c = lin.w_cx @ inverse_root.transpose(0, 2, 1)[obs.point]
        b_l = inverse_root @ lin.w_xl

        sparse = top.photos_by_points(b_c)
        q = self._q
        size = q * k + p
        reduced = np.zeros((size, size))
        reduced[: q * k, : q * k] = -top.pose_products(b_c, sparse)
        blocks = reduced[: q * k, : q * k].reshape(k, q, k, q).transpose(0, 2, 1, 3)
        u_cc = lin.u_cc.copy()
        axes = np.arange(q)
        u_cc[:, axes, axes] *= 1 + damping
        blocks[np.arange(k), np.arange(k)] += u_cc
        flat = b_l.reshape(3 * top.n_points, p)
        cross = lin.u_cl.reshape(q * k, p) - sparse @ flat
        reduced[: q * k, q * k :] = cross
        reduced[q * k :, : q * k] = cross.T
        u_ll = lin.u_ll.copy()
        u_ll[np.diag_indices(p)] *= 1 + damping
        reduced[q * k :, q * k :] = u_ll - flat.T @ flat
        return reduced, sparse, b_l, inverse_root

    def _factored(self, lin: _Linear, damping: float) -> _Factored:
        """Raises numpy's LinAlgError where the damping is too small for the rank."""
        reduced, sparse, b_l, inverse_root = self._reduce(lin, damping)
        scale = 1 / np.sqrt(np.maximum(np.diag(reduced), 1e-300))
        factor, _ = scipy.linalg.cho_factor(reduced * np.outer(scale, scale), lower=True, overwrite_a=True)
        return _Factored(factor, scale, sparse, b_l, inverse_root)

    def _acceleration(
        self,
        state: State,
        free: BoolArray,
        weights: tuple[FloatArray, FloatArray],
        lin: _Linear,
        factored: _Factored,
        step: _Step,
    ) -> _Step:
        """Second-order part of a step: what the residuals' curvature along it calls for.

        A nadir block's valley is long and bent: straight steps leave it at once. Geodesic
        acceleration (Transtrum & Sethna 2012, eq. 12), the curvature by central differences.
        """
        h = 0.1
        ahead, behind = (self._apply(state, free, step.scaled(sign * h)) for sign in (1, -1))

        def curvature(of: Callable[[State], FloatArray]) -> FloatArray:
            bent: FloatArray = (of(ahead) - 2 * of(state) + of(behind)) / h**2
            return bent

        image = curvature(self.residuals_px) * (np.sqrt(weights[0]) / self.obs.sigma_px)[:, None]
        top = self.topology
        column = image[:, :, None]
        g_c = top.photo_sums(lin.by_pose, column)[:, :, 0]
        g_x = top.point_sums(lin.by_point, column)[:, :, 0]
        g_l = lin.by_lens.reshape(image.size, len(lin.g_l)).T @ image.ravel()
        has, turned = self._has_centre, self._has_rotation
        position = curvature(lambda at: self._position_terms(at)[0])
        g_c[has, 3:6] += weights[1][has, None] * position[has] / self.priors.centre_sigma_m[has]
        attitude = curvature(self._rotation_terms)
        g_c[turned, :3] += attitude[turned] / self.priors.rotation_sigma_rad[turned, None]
        return factored.solve(g_c, g_l, g_x)

    @staticmethod
    def _apply(state: State, free: BoolArray, step: _Step) -> State:
        """Add a step, its seven-parameter part as a finite transformation.

        The block as a whole is held only by its geotags. Points that move on tangents while the
        cameras turn on circles would break the images' agreement for a move that costs nothing.
        """
        vector = state.lens.vector
        d_pose, d_point = step.pose, step.point
        vector[free] += step.lens
        middle = state.points_m.mean(axis=0)
        offset, offset_c = state.points_m - middle, state.centres_m - middle
        design = similarity_tangent(np.concatenate([offset, offset_c]))
        moves = np.concatenate([d_point, d_pose[:, 3:6]])
        gauge = np.linalg.lstsq(design.reshape(-1, 7), moves.ravel(), rcond=None)[0]
        rest = moves - design @ gauge
        turn = rotation_exp(gauge[None, 3:6])[0]
        grown = np.exp(gauge[6])
        m = len(offset)
        rest_turn = d_pose[:, :3] + (state.rotations @ gauge[3:6])
        shutter = state.shutter_m
        if d_pose.shape[1] == 9:
            before = np.zeros((len(offset_c), 3)) if shutter is None else shutter
            # What the transformation does to the ways already, to first order, is not done twice.
            rest_shutter = d_pose[:, 6:] - np.cross(gauge[3:6], before) - gauge[6] * before
            shutter = grown * before @ turn.T + rest_shutter
        return State(
            lens=state.lens.with_vector(vector),
            rotations=rotation_exp(rest_turn) @ state.rotations @ turn.T,
            centres_m=middle + gauge[:3] + grown * offset_c @ turn.T + rest[m:],
            points_m=middle + gauge[:3] + grown * offset @ turn.T + rest[:m],
            shutter_m=shutter,
        )

    # -- the loop ------------------------------------------------------------------------------

    def run(
        self,
        start: State,
        free: BoolArray,
        max_iterations: int = 100,
        decrement: float = 1e-3,
        reweightings: int = 4,
        response: bool = False,
        weights: tuple[FloatArray, FloatArray] | None = None,
        damping: float = 1e-4,
        tick: Callable[[], None] | None = None,
    ) -> Adjusted:
        """Adjust from ``start`` with the lens parameters in ``free`` estimated.

        Robust weights are renewed up to ``reweightings`` times and constant in between: a plain
        least-squares problem converges in a few steps where Huber's does not in a hundred.
        Stops when the predicted decrease of chi-square falls below ``decrement`` with next to no
        damping: no parameter can then be further than sqrt(decrement) sigmas from its optimum.

        Args:
            response: also give d points / d lens (for the dome).
            weights: keep these weights of measurements (n,) and positions (k,): models compared by
                their chi-square must weigh alike.
            damping: at the start; next to none where ``start`` is near the optimum.
            tick: called once an iteration (progress, cancel by raising).
        """
        state, iterations, converged = start, 0, False
        fixed = weights is not None
        if weights is None:
            weights = self._robust_weights(state)
        for round_ in range(reweightings + 1):
            before = iterations
            last = fixed or round_ == reweightings
            # The first weights may come from a poor start: do not follow them far.
            limit = max_iterations if round_ >= 2 or last else min(max_iterations, iterations + 6)
            state, iterations, converged, damping = self._descend(
                state, free, weights, damping, iterations, limit, decrement if last else 10 * decrement, tick
            )
            if last or iterations >= max_iterations or (converged and round_ and iterations - before <= 1):
                break
            weights = self._robust_weights(state)
        lin = self._linearise(state, free, weights)
        return self._finish(state, free, weights, lin, iterations, converged, response)

    def _descend(
        self,
        state: State,
        free: BoolArray,
        weights: tuple[FloatArray, FloatArray],
        damping: float,
        iterations: int,
        max_iterations: int,
        decrement: float,
        tick: Callable[[], None] | None,
    ) -> tuple[State, int, bool, float]:
        """Levenberg-Marquardt with constant weights (damping after Nielsen 1999), from and to a damping."""
        growth, idle = 2.0, 0
        history: list[float] = []
        cost = self.cost(state, weights)
        lin = self._linearise(state, free, weights)
        while iterations < max_iterations:
            iterations += 1
            if tick is not None:
                tick()
            try:
                factored = self._factored(lin, damping)
            except np.linalg.LinAlgError:
                damping, growth = max(damping, 1e-9) * growth, growth * 2
                if damping > 1e8:
                    return state, iterations, False, damping
                continue
            step = factored.solve(lin.g_c, lin.g_l, lin.g_x)
            predicted = float(
                np.sum(lin.g_c * step.pose) + lin.g_l @ step.lens + np.sum(lin.g_x * step.point)
            )
            if predicted < decrement and damping < 1e-5:
                return state, iterations, True, damping
            trial = self._apply(state, free, step)
            trial_cost = self.cost(trial, weights)
            if cost - trial_cost < 0.7 * predicted:
                bent = self._acceleration(state, free, weights, lin, factored, step)
                other = self._apply(state, free, step.plus(bent, 0.5))
                other_cost = self.cost(other, weights)
                if other_cost < trial_cost:
                    trial, trial_cost = other, other_cost
            gain = (cost - trial_cost) / max(predicted, 1e-300)
            # Single points on nearly parallel rays can hop about for ever without moving anything else.
            idle = idle + 1 if cost - trial_cost < decrement and predicted < 20 * decrement else 0
            # In a curved valley every full step overshoots; half a sigma from the floor is near enough
            # when ten steps no longer gain a fraction of one.
            history.append(cost)
            crawling = len(history) > 10 and history[-11] - cost < 0.3 and predicted < 0.5
            if idle >= 4 or crawling:
                return (trial if trial_cost < cost else state), iterations, True, damping
            if trial_cost < cost:
                state, cost = trial, trial_cost
                damping *= max(1 / 9, 1 - (2 * min(gain, 1.5) - 1) ** 3) if gain > 0.05 else 4.0
                damping, growth = max(damping, 1e-12), 2.0
                lin = self._linearise(state, free, weights)
            elif predicted < decrement:
                # The step promises nothing any more and rounding decides: this is the floor.
                return state, iterations, damping < 1e-2, damping
            else:
                damping, growth = damping * growth, growth * 2
                if damping > 1e8:
                    return state, iterations, False, damping
        return state, iterations, False, damping

    def functional_covariance(self, adjusted: Adjusted, gradients: FloatArray) -> FloatArray:
        """Formal covariance (c, c) of linear functions of the points, scaled by sigma0.

        All unknowns take part: lens, poses and points.

        Args:
            adjusted: outcome of a run of this adjustment.
            gradients: (m, 3, c), d function / d point. Functions that a shift, turn or scale of the whole
                block changes are only as good as the priors on its place.

        Raises:
            numpy.linalg.LinAlgError: the block is too weak to be inverted.
        """
        weights = (adjusted.weights, adjusted.position_weights)
        lin = self._linearise(adjusted.state, adjusted.free, weights)
        # Next to no damping: weakly held deformations of the block must stay weak.
        factored = self._factored(lin, 1e-13)
        columns = np.moveaxis(gradients, -1, 0)
        solved = [factored.solve(np.zeros_like(lin.g_c), np.zeros_like(lin.g_l), g).point for g in columns]
        covariance = np.einsum("amj,bmj->ab", columns, np.array(solved))
        symmetric: FloatArray = (covariance + covariance.T) / 2 * adjusted.sigma0**2
        return symmetric

    def _finish(
        self,
        state: State,
        free: BoolArray,
        weights: tuple[FloatArray, FloatArray],
        lin: _Linear,
        iterations: int,
        converged: bool,
        response: bool,
    ) -> Adjusted:
        obs, top = self.obs, self.topology
        reduced, sparse, b_l, inverse_root = self._reduce(lin, 0.0)
        k, p = top.n_photos, int(free.sum())
        q = self._q
        cc, cl, ll = reduced[: q * k, : q * k], reduced[: q * k, q * k :], reduced[q * k :, q * k :]
        scale = 1 / np.sqrt(np.maximum(np.diag(cc), 1e-300))
        factor = scipy.linalg.cho_factor(cc * np.outer(scale, scale) + 1e-14 * np.eye(q * k), lower=True)
        pose_by_lens = -scipy.linalg.cho_solve(factor, cl * scale[:, None]) * scale[:, None]
        normal = ll + cl.T @ pose_by_lens
        normal = (normal + normal.T) / 2
        point_response = None
        if response:
            back = -(sparse.T @ pose_by_lens).reshape(-1, 3, p) - b_l
            point_response = inverse_root.transpose(0, 2, 1) @ back
        residual = self.residuals_px(state)
        redundancy = (
            2 * len(obs)
            - self._q * k
            - 3 * top.n_points
            - p
            + 3 * int(self._has_centre.sum())
            + 3 * int(self._has_rotation.sum())
            + int(np.isfinite(self.priors.lens_sigma)[free].sum())
        )
        image = float(np.sum(weights[0] * np.sum(residual**2, axis=1) / obs.sigma_px**2))
        # Position misfits tell of the receiver, not of the image measurements: sigma0 is the images' own.
        image_redundancy = max(2 * len(obs) - q * k - 3 * top.n_points - p + 7, 1)
        # Huber weights shrink the square sum of clean normal noise by a few percent.
        sigma0 = float(np.sqrt(image * self.noise_factor / image_redundancy))
        return Adjusted(
            state=state,
            free=free,
            lens_normal=normal,
            residuals_px=residual,
            weights=weights[0],
            position_weights=weights[1],
            chi2=self.cost(state, weights),
            sigma0=sigma0,
            redundancy=redundancy,
            iterations=iterations,
            converged=converged,
            point_response=point_response,
        )


def ray_angle_deg(centres_m: FloatArray, points_m: FloatArray, obs: Observations) -> FloatArray:
    """Twice the largest angle between a point's rays and their mean direction, (m,) degrees.

    ``obs`` need not be sorted; points without observations get 0.
    """
    direction = points_m[obs.point] - centres_m[obs.photo]
    direction = direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    direction = np.where(np.isfinite(direction), direction, 0.0)
    m = len(points_m)
    mean = np.stack([np.bincount(obs.point, direction[:, i], m) for i in range(3)], axis=1).astype(float)
    mean = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    cosine = np.clip(np.sum(direction * mean[obs.point], axis=1), -1, 1)
    angle = np.zeros(m)
    np.maximum.at(angle, obs.point, np.arccos(cosine))
    doubled: FloatArray = np.degrees(2 * angle)
    return doubled


def triangulate(
    lens: Lens, rotations: FloatArray, centres_m: FloatArray, obs: Observations, n_points: int
) -> FloatArray:
    """Points (m, 3) nearest to their rays (linear least squares); NaN where rays are parallel."""
    rays = lens.unproject(obs.pixels)
    direction = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    world = np.einsum("nji,nj->ni", rotations[obs.photo], direction)
    bad = ~np.isfinite(world).all(axis=1)
    world[bad] = 0.0
    across = np.eye(3) - world[:, :, None] * world[:, None, :]
    across[bad] = 0.0
    moment = np.einsum("nij,nj->ni", across, centres_m[obs.photo])
    matrix = np.zeros((n_points, 3, 3))
    right = np.zeros((n_points, 3))
    for i in range(3):
        right[:, i] = np.bincount(obs.point, moment[:, i], n_points)
        for j in range(3):
            matrix[:, i, j] = np.bincount(obs.point, across[:, i, j], n_points)
    values = np.linalg.eigvalsh(matrix)
    weak = values[:, 0] < 1e-7 * np.maximum(values[:, 2], 1e-12)
    matrix[weak] = np.eye(3)
    points = np.asarray(np.linalg.solve(matrix, right[:, :, None])[:, :, 0], float)
    points[weak] = np.nan
    return points

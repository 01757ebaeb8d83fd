"""Normal equations of a block: sums over photos and points, points eliminated, solved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from scipy.sparse import bsr_array

from calib.camera import FloatArray
from calib.solution import Observations


class Topology:
    """Index arrays of a fixed set of observations, built once and used in every iteration."""

    def __init__(self, obs: Observations, n_photos: int, n_points: int) -> None:
        if len(obs) == 0 or np.any(np.diff(obs.point) < 0):
            raise ValueError("observations must be there and sorted by point")
        self.n_photos, self.n_points, self.point = n_photos, n_points, obs.point
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
class Linear:
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
class Step:
    """A change of all unknowns: poses (k, q), lens (p,), points (m, 3)."""

    pose: FloatArray
    lens: FloatArray
    point: FloatArray

    def scaled(self, factor: float) -> Step:
        return Step(factor * self.pose, factor * self.lens, factor * self.point)

    def plus(self, other: Step, factor: float) -> Step:
        return Step(
            self.pose + factor * other.pose,
            self.lens + factor * other.lens,
            self.point + factor * other.point,
        )


@dataclass(frozen=True)
class Factored:
    """Damped normal equations with the points eliminated, ready for right sides."""

    factor: FloatArray  # Cholesky, lower, of the reduced matrix scaled to a unit diagonal
    scale: FloatArray
    sparse: bsr_array  # B_c
    b_l: FloatArray  # (m, 3, p)
    inverse_root: FloatArray  # (m, 3, 3)

    def solve(self, g_c: FloatArray, g_l: FloatArray, g_x: FloatArray) -> Step:
        k, q = g_c.shape
        h = (self.inverse_root @ g_x[:, :, None])[:, :, 0]
        flat = self.b_l.reshape(3 * len(g_x), len(g_l))
        right = np.concatenate([g_c.ravel() - self.sparse @ h.ravel(), g_l - flat.T @ h.ravel()])
        delta = scipy.linalg.cho_solve((self.factor, True), right * self.scale) * self.scale
        pose, lens = delta[: q * k].reshape(k, q), delta[q * k :]
        back = h - (self.sparse.T @ pose.ravel()).reshape(-1, 3) - self.b_l @ lens
        return Step(pose, lens, (self.inverse_root.transpose(0, 2, 1) @ back[:, :, None])[:, :, 0])


@dataclass(frozen=True)
class Reduced:
    """Damped normal equations of poses and lens with the points eliminated, and the way back to these."""

    matrix: FloatArray  # (q k + p square)
    sparse: bsr_array  # B_c
    b_l: FloatArray  # (m, 3, p)
    inverse_root: FloatArray  # (m, 3, 3), inverse Cholesky factors of V


def reduced(top: Topology, lin: Linear, damping: float) -> Reduced:
    """Eliminate the points.

    Raises:
        numpy.linalg.LinAlgError: a point's own matrix is not positive.
    """
    (k, q), p = lin.g_c.shape, len(lin.g_l)
    diagonal = np.einsum("mii->mi", lin.v)
    axes = np.arange(3)
    v = lin.v.copy()
    # The tiny floor keeps points with parallel rays solvable; it is far below any real curvature.
    v[:, axes, axes] += damping * diagonal + 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-300
    inverse_root = np.linalg.inv(np.linalg.cholesky(v))  # L^-1 with V = L L^T
    b_c = lin.w_cx @ inverse_root.transpose(0, 2, 1)[top.point]
    b_l = inverse_root @ lin.w_xl

    sparse = top.photos_by_points(b_c)
    size = q * k + p
    matrix = np.zeros((size, size))
    matrix[: q * k, : q * k] = -top.pose_products(b_c, sparse)
    blocks = matrix[: q * k, : q * k].reshape(k, q, k, q).transpose(0, 2, 1, 3)
    u_cc = lin.u_cc.copy()
    axes = np.arange(q)
    u_cc[:, axes, axes] *= 1 + damping
    blocks[np.arange(k), np.arange(k)] += u_cc
    flat = b_l.reshape(3 * top.n_points, p)
    cross = lin.u_cl.reshape(q * k, p) - sparse @ flat
    matrix[: q * k, q * k :] = cross
    matrix[q * k :, : q * k] = cross.T
    u_ll = lin.u_ll.copy()
    u_ll[np.diag_indices(p)] *= 1 + damping
    matrix[q * k :, q * k :] = u_ll - flat.T @ flat
    return Reduced(matrix, sparse, b_l, inverse_root)


def factored(top: Topology, lin: Linear, damping: float) -> Factored:
    """Raises numpy's LinAlgError where the damping is too small for the rank."""
    found = reduced(top, lin, damping)
    scale = 1 / np.sqrt(np.maximum(np.diag(found.matrix), 1e-300))
    scaled = found.matrix * np.outer(scale, scale)
    factor, _ = scipy.linalg.cho_factor(scaled, lower=True, overwrite_a=True)
    return Factored(factor, scale, found.sparse, found.b_l, found.inverse_root)

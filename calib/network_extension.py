"""Photos added to a network, or taken away again, without starting over.

The network's joint covariance of lens, functionals and some ground points is computed once; each
photo is then a measurement of lens and points, its own pose eliminated, and changes the covariance
by the Kalman (Woodbury) update. Exact, and as cheap as the photo has points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg

from calib.camera import FloatArray
from calib.field import Lens
from calib.network_design import CameraNetwork, Known, point_roots, reduce_network, view_derivatives
from calib.solution import IntArray


@dataclass(frozen=True)
class PhotoRows:
    """One photo as a measurement of unit weight: ``matrix`` (r, q + 3 n) times (lens, its n points).

    ``columns`` (q + 3 n,): where these are among the unknowns of the :class:`Joint`.
    """

    matrix: FloatArray
    columns: IntArray


@dataclass(frozen=True)
class Joint:
    """Joint covariance of (free lens q, functionals c, points 3 m), ``covariance`` (q + c + 3 m) square.

    ``points_m`` (m, 3): the points, in this order; ``indices`` (m,): which of the network's they are.
    """

    covariance: FloatArray
    n_lens: int
    n_functionals: int
    points_m: FloatArray
    indices: IntArray

    @property
    def head(self) -> FloatArray:
        """Covariance of lens and functionals, (q + c) square."""
        n = self.n_lens + self.n_functionals
        return self.covariance[:n, :n]

    def with_photo(self, rows: PhotoRows) -> Joint:
        """The network with one more photo."""
        return self._moved(rows, 1.0)

    def without_photo(self, rows: PhotoRows) -> Joint:
        """The network without a photo that was added before.

        Raises numpy's LinAlgError where it was not in it.
        """
        return self._moved(rows, -1.0)

    def _moved(self, rows: PhotoRows, sign: float) -> Joint:
        seen = rows.matrix @ self.covariance[rows.columns]  # H Sigma
        inner = np.eye(len(seen)) + sign * seen[:, rows.columns] @ rows.matrix.T
        half = scipy.linalg.solve_triangular(np.linalg.cholesky(inner), seen, lower=True)
        return replace(self, covariance=self.covariance - sign * half.T @ half)

    def head_with(self, rows: PhotoRows) -> FloatArray:
        """:attr:`head` of :meth:`with_photo`, at a fraction of its cost."""
        n = self.n_lens + self.n_functionals
        part = self.covariance[rows.columns[:, None], rows.columns]
        inner = np.eye(len(rows.matrix)) + rows.matrix @ part @ rows.matrix.T
        half, _ = scipy.linalg.lapack.dtrtrs(
            np.linalg.cholesky(inner), rows.matrix @ self.covariance[rows.columns, :n], lower=1
        )
        found: FloatArray = self.covariance[:n, :n] - half.T @ half
        return found


def joint_covariance(
    network: CameraNetwork,
    known: Known,
    functionals: FloatArray,
    points: IntArray,
    stands_for: float = 1.0,
) -> Joint:
    """Covariance of the lens, of ``functionals`` (c, m, 3) and of the chosen ``points`` (indices).

    Args:
        stands_for: points of the network for each one chosen. A chosen point is then their mean: what is
            its own, given poses and lens, is so many times better known.

    Raises:
        numpy.linalg.LinAlgError: lens or poses are not observable; give them priors.
    """
    chosen = np.zeros(len(network.points_m), bool)
    chosen[points] = True
    kept = np.unique(network.photo[chosen[network.point]])
    reduced = reduce_network(network, known, functionals, kept)
    q, c = reduced.n_lens, len(functionals)
    n = known.per_photo * len(reduced.kept) + q
    s = reduced.matrix
    meets, inverse_root = _points_in(network, known, points, reduced.kept)
    # Given poses and lens: point = -V^-1 W (poses, lens) + its own noise, functional = gain likewise.
    of_points = -np.einsum("mji,mjn->min", inverse_root, meets).reshape(-1, n)
    of_lens = np.zeros((q, n))
    of_lens[np.arange(q), n - q + np.arange(q)] = 1
    design = np.concatenate([of_lens, s[n:, :n], of_points])
    scale = 1 / np.sqrt(np.diag(s)[:n])
    factor = np.linalg.cholesky(s[:n, :n] * np.outer(scale, scale))
    half = scipy.linalg.solve_triangular(factor, (design * scale).T, lower=True)
    covariance = half.T @ half
    covariance[q : q + c, q : q + c] -= s[n:, n:]
    own = np.einsum("mji,mjk->mik", inverse_root, inverse_root)
    at = q + c + 3 * np.arange(len(points))[:, None] + np.arange(3)
    covariance[at[:, :, None], at[:, None, :]] += own / stands_for
    shared = np.einsum("mij,cmj->cmi", own, functionals[:, points]).reshape(c, -1)
    covariance[q : q + c, q + c :] += shared
    covariance[q + c :, q : q + c] += shared.T
    return Joint(covariance, q, c, network.points_m[points], np.asarray(points))


def _points_in(
    network: CameraNetwork, known: Known, points: IntArray, kept: IntArray
) -> tuple[FloatArray, FloatArray]:
    """V^-1/2 W (m, 3, p kept + q) and V^-1/2 (m, 3, 3) of the chosen points."""
    place = np.full(len(network.points_m), -1)
    place[points] = np.arange(len(points))
    rows = np.flatnonzero(place[network.point] >= 0)
    photo, column = network.photo[rows], place[network.point[rows]]
    by_pose, by_lens, by_point = view_derivatives(
        network.lens,
        network.rotations[photo],
        network.centres_m[photo],
        network.points_m[network.point[rows]],
        network.sigma_px[rows],
        shutter=known.shutter_sigma_m is not None,
    )
    each = known.per_photo
    slot = np.full(len(network.centres_m), -1)
    slot[kept] = np.arange(len(kept))
    turned = by_point.transpose(0, 2, 1)
    v = np.zeros((len(points), 3, 3))
    np.add.at(v, column, turned @ by_point)
    w = np.zeros((len(points), 3, each * len(kept) + int(known.free.sum())))
    place_of_pose = (each * slot[photo][:, None] + np.arange(each))[:, None, :]
    w[column[:, None, None], np.arange(3)[:, None], place_of_pose] = turned @ by_pose
    lens = w[:, :, each * len(kept) :]
    np.add.at(lens, column, turned @ by_lens[:, :, known.free])
    root = point_roots(v)
    return root @ w, root


def photo_rows(
    joint: Joint,
    lens: Lens,
    known: Known,
    rotation: FloatArray,
    centre_m: FloatArray,
    points: IntArray,
    sigma_px: FloatArray,
    pose_sigma: tuple[float, float] = (np.inf, np.inf),
) -> PhotoRows:
    """A photo that sees ``points`` (n,) of ``joint``, each with ``sigma_px`` (n,).

    Args:
        pose_sigma: prior of its attitude (rad) and of its position (m).
    """
    n = len(points)
    by_pose, by_lens, by_point = view_derivatives(
        lens,
        np.broadcast_to(rotation, (n, 3, 3)),
        np.broadcast_to(centre_m, (n, 3)),
        joint.points_m[points],
        sigma_px,
        shutter=known.shutter_sigma_m is not None,
    )
    prior = [*pose_sigma] if known.shutter_sigma_m is None else [*pose_sigma, known.shutter_sigma_m]
    each = known.per_photo
    q, first = joint.n_lens, joint.n_lens + joint.n_functionals
    unknowns = np.zeros((2 * n + each, q + 3 * n))
    unknowns[: 2 * n, :q] = by_lens[:, :, known.free].reshape(2 * n, q)
    row = np.arange(2 * n)
    for axis in range(3):
        unknowns[row, q + 3 * (row // 2) + axis] = by_point[:, :, axis].ravel()
    pose = np.zeros((2 * n + each, each))
    pose[: 2 * n] = by_pose.reshape(2 * n, each)
    pose[2 * n :] = np.diag(1 / np.repeat(prior, 3))
    rest = np.linalg.qr(pose / np.linalg.norm(pose, axis=0), mode="complete")[0][:, each:]
    columns = np.concatenate([np.arange(q), (first + 3 * points[:, None] + np.arange(3)).ravel()])
    return PhotoRows(rest.T @ unknowns, columns)


class PhotoPool:
    """Photos that may be added to one network, evaluated in any combination.

    ``joint``: of the network without them.
    """

    def __init__(self, joint: Joint, rows: list[PhotoRows]) -> None:
        self.joint, self.rows = joint, rows
        self._pairs: dict[tuple[int, int], FloatArray] = {}
        self._heads: dict[int, FloatArray] = {}

    def __len__(self) -> int:
        return len(self.rows)

    @cached_property
    def _n(self) -> int:
        return self.joint.n_lens + self.joint.n_functionals

    def _head(self, i: int) -> FloatArray:
        if i not in self._heads:
            rows = self.rows[i]
            self._heads[i] = rows.matrix @ self.joint.covariance[rows.columns, : self._n]
        return self._heads[i]

    def _pair(self, i: int, j: int) -> FloatArray:
        if (i, j) not in self._pairs:
            a, b = self.rows[i], self.rows[j]
            part = self.joint.covariance[a.columns[:, None], b.columns]
            self._pairs[i, j] = a.matrix @ part @ b.matrix.T
        return self._pairs[i, j]

    def combined(self, photos: tuple[int, ...]) -> Combined:
        """The network with ``photos`` added, at least one."""
        ends = np.concatenate([[0], np.cumsum([len(self.rows[i].matrix) for i in photos])])
        inner = np.eye(int(ends[-1]))
        for a, i in enumerate(photos):
            for b, j in enumerate(photos[: a + 1]):
                block = self._pair(max(i, j), min(i, j))
                # Only the lower triangle is read.
                inner[ends[a] : ends[a + 1], ends[b] : ends[b + 1]] += block if i >= j else block.T
        seen = np.concatenate([self._head(i) for i in photos])
        factor, info = scipy.linalg.lapack.dpotrf(inner, lower=1, clean=0, overwrite_a=1)
        if info:
            raise np.linalg.LinAlgError("a photo's measurements are not finite")
        lower, _ = scipy.linalg.lapack.dpotri(factor, lower=1, overwrite_c=1)
        taken = scipy.linalg.blas.dsymm(1.0, lower, seen, lower=1)
        return Combined(self.joint.head - seen.T @ taken, lower, taken, ends)


@dataclass(frozen=True)
class Combined:
    """A network with photos added together, any of which can be left out again.

    ``head``: covariance of lens and functionals with all of them. ``lower``: the lower triangle of
    the inverse covariance of their measurements.
    """

    head: FloatArray
    lower: FloatArray
    taken: FloatArray
    ends: IntArray

    def without(self, *places: int) -> FloatArray:
        """:attr:`head` without the photos at these places of the list."""
        rows = np.concatenate([np.arange(self.ends[a], self.ends[a + 1]) for a in sorted(places)])
        taken, block = self.taken[rows], self.lower[np.ix_(rows, rows)]
        block = np.tril(block) + np.tril(block, -1).T
        left: FloatArray = self.head + taken.T @ np.linalg.solve(block, taken)
        return left

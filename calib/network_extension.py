"""Photos added to a network, or taken away again, without starting over.

The network's joint covariance of lens, functionals and some ground points is computed once; each
photo is then a measurement of lens and points, its own pose eliminated, and changes the covariance
by the Kalman (Woodbury) update. Exact, and as cheap as the photo has points. Several photos at once are
summed in the covariance's inverse: as cheap as there are points, however many the photos.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import scipy.linalg
from scipy.linalg import lapack

from calib.camera import FloatArray
from calib.field import Lens
from calib.network_design import (
    CameraNetwork,
    Known,
    Reduced,
    point_roots,
    reduce_network,
    view_derivatives,
)
from calib.solution import IntArray

#: What photos add to the information is remembered, as much as fits here.
_KEPT_BYTES = 64_000_000


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
        return self._head_moved(rows, 1.0)

    def head_without(self, rows: PhotoRows) -> FloatArray:
        """:attr:`head` of :meth:`without_photo`, at a fraction of its cost."""
        return self._head_moved(rows, -1.0)

    def _head_moved(self, rows: PhotoRows, sign: float) -> FloatArray:
        n = self.n_lens + self.n_functionals
        part = self.covariance[rows.columns[:, None], rows.columns]
        inner = np.eye(len(rows.matrix)) + sign * (rows.matrix @ part @ rows.matrix.T)
        half, _ = lapack.dtrtrs(
            np.linalg.cholesky(inner), rows.matrix @ self.covariance[rows.columns, :n], lower=1
        )
        found: FloatArray = self.covariance[:n, :n] - sign * (half.T @ half)
        return found

    @cached_property
    def information(self) -> _Information:
        """The inverse, to which photos are added by mere sums."""
        q, n = self.n_lens, self.n_lens + self.n_functionals
        scale = 1 / np.sqrt(np.diag(self.covariance))
        # Functionals are told by the rest, exactly where it is all points: they stand aside.
        scale[q:n] = 1.0
        matrix = self.covariance * np.outer(scale, scale)
        cross = matrix[q:n].copy()
        cross[:, q:n] = 0.0
        matrix[q:n], matrix[:, q:n] = 0.0, 0.0
        matrix[np.arange(q, n), np.arange(q, n)] = 1.0
        matrix = _inverse_of(_factor_of(matrix))
        weights = cross @ matrix
        rest = self.covariance[q:n, q:n] - weights @ cross.T
        return _Information(
            np.ascontiguousarray(matrix[::-1, ::-1]), scale, np.outer(1 / scale, 1 / scale), weights, rest
        )


@dataclass(frozen=True)
class _Information:
    """Information of lens and points in units of their sigmas 1 / ``scale``; functionals ride along.

    ``matrix`` (n, n) over the unknowns of the :class:`Joint` in reversed order, the lens last; in the place
    of functionals the identity. ``unit`` (n, n): 1 / scale both ways. A functional is ``weights`` (c, n)
    times the unknowns and a rest of its own of covariance ``rest`` (c, c), which no photo of these points
    changes.
    """

    matrix: FloatArray
    scale: FloatArray
    unit: FloatArray
    weights: FloatArray
    rest: FloatArray


def _factor_of(matrix: FloatArray) -> FloatArray:
    """Lower Cholesky factor of a symmetric matrix, overwriting it: LAPACK without the checks."""
    # The transpose of a symmetric matrix in C's order is itself in Fortran's.
    factor, info = lapack.dpotrf(matrix.T, lower=1, clean=1, overwrite_a=1)
    if info:
        raise np.linalg.LinAlgError("the network's covariance is not positive definite")
    found: FloatArray = factor
    return found


def _inverse_of(factor: FloatArray) -> FloatArray:
    """Inverse of a matrix whose lower Cholesky factor this is, overwriting it."""
    lower, _ = lapack.dpotri(factor, lower=1, overwrite_c=1)
    diagonal = np.diag(lower).copy()
    found: FloatArray = lower + lower.T
    np.fill_diagonal(found, diagonal)
    return found


def joint_covariance(
    network: CameraNetwork,
    known: Known,
    functionals: FloatArray,
    points: IntArray,
    stands_for: float = 1.0,
    reduced: Reduced | None = None,
) -> Joint:
    """Covariance of the lens, of ``functionals`` (c, m, 3) and of the chosen ``points`` (indices).

    Args:
        stands_for: points of the network for each one chosen. A chosen point is then their mean: what is
            its own, given poses and lens, is so many times better known.
        reduced: the network reduced to these points' photos at least, where it is at hand.

    Raises:
        numpy.linalg.LinAlgError: lens or poses are not observable; give them priors.
    """
    if reduced is None:
        reduced = reduce_network(network, known, functionals, photos_of(network, points))
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


def photos_of(network: CameraNetwork, points: IntArray) -> IntArray:
    """The photos that see any of ``points``."""
    chosen = np.zeros(len(network.points_m), bool)
    chosen[points] = True
    found: IntArray = np.unique(network.photo[chosen[network.point]])
    return found


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
        shutter=known.way_information is not None,
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
    way_information: FloatArray | None = None,
) -> PhotoRows:
    """A photo that sees ``points`` (n,) of ``joint``, each with ``sigma_px`` (n,).

    Args:
        pose_sigma: prior of its attitude (rad) and of its position (m).
        way_information: (3, 3), inverse covariance of its way during the readout; None: global shutter.
    """
    several = np.zeros(len(points), np.intp)
    return rows_of_photos(
        joint, lens, known, rotation[None], centre_m[None], several, points, sigma_px, pose_sigma,
        way_information,
    )[0]  # fmt: skip


def rows_of_photos(
    joint: Joint,
    lens: Lens,
    known: Known,
    rotations: FloatArray,
    centres_m: FloatArray,
    photo: IntArray,
    point: IntArray,
    sigma_px: FloatArray,
    pose_sigma: tuple[float, float] = (np.inf, np.inf),
    way_information: FloatArray | None = None,
) -> list[PhotoRows]:
    """:func:`photo_rows` of k photos at once, from their views: photo, point, sigma_px (n,), by photo."""
    by_pose, by_lens, by_point = view_derivatives(
        lens,
        rotations[photo],
        centres_m[photo],
        joint.points_m[point],
        sigma_px,
        shutter=way_information is not None,
    )
    of_pose = np.diag(1 / np.repeat(pose_sigma, 3))
    if way_information is not None:
        of_pose = scipy.linalg.block_diag(of_pose, np.linalg.cholesky(way_information).T)
    by_lens = by_lens[:, :, known.free]
    ends = np.searchsorted(photo, np.arange(len(rotations) + 1))
    return [
        _without_pose(joint, by_pose[a:b], by_lens[a:b], by_point[a:b], point[a:b], of_pose)
        for a, b in pairwise(ends)
    ]


def _without_pose(
    joint: Joint,
    by_pose: FloatArray,
    by_lens: FloatArray,
    by_point: FloatArray,
    points: IntArray,
    of_pose: FloatArray,
) -> PhotoRows:
    """One photo's rows; its pose, known to ``of_pose`` of unit weight, is eliminated."""
    n, each = len(points), len(of_pose)
    q, first = joint.n_lens, joint.n_lens + joint.n_functionals
    unknowns = np.zeros((2 * n + each, q + 3 * n), order="F")
    unknowns[: 2 * n, :q] = by_lens.reshape(2 * n, q)
    row = np.arange(2 * n)
    for axis in range(3):
        unknowns[row, q + 3 * (row // 2) + axis] = by_point[:, :, axis].ravel()
    pose = np.concatenate([by_pose.reshape(2 * n, each), of_pose])
    reflected, tau, _, _ = lapack.dgeqrf(pose / np.linalg.norm(pose, axis=0))
    turned, _, _ = lapack.dormqr("L", "T", reflected, tau, unknowns, 64 * unknowns.shape[1], overwrite_c=1)
    columns = np.concatenate([np.arange(q), (first + 3 * points[:, None] + np.arange(3)).ravel()])
    return PhotoRows(np.ascontiguousarray(turned[each:]), columns)


class PhotoPool:
    """Photos that may be added to one network, evaluated in any combination.

    ``joint``: of the network without them.
    """

    def __init__(self, joint: Joint, rows: list[PhotoRows]) -> None:
        self.joint, self.rows = joint, rows
        self._added: dict[int, FloatArray] = {}

    def __len__(self) -> int:
        return len(self.rows)

    def _information(self, i: int) -> FloatArray:
        """What a photo adds to :attr:`Joint.information`; the last ones are kept."""
        if i not in self._added:
            rows, given = self.rows[i], self.joint.information
            scaled = rows.matrix / given.scale[rows.columns]
            places = len(given.scale) - 1 - rows.columns
            added = np.zeros_like(given.matrix)
            added[places[:, None], places] = scaled.T @ scaled
            while len(self._added) >= max(_KEPT_BYTES // added.nbytes, 8):
                del self._added[next(iter(self._added))]
            self._added[i] = added
        return self._added[i]

    def _factor(self, photos: Sequence[int]) -> FloatArray:
        """Of the information with ``photos``.

        Raises numpy's LinAlgError where a photo's measurements are not finite.
        """
        matrix = self.joint.information.matrix.copy()
        for i in photos:
            matrix += self._information(i)
        return _factor_of(matrix)

    def combined(self, photos: Sequence[int]) -> Joint:
        """The network with ``photos`` added; raises LinAlgError where their rows are not finite."""
        joint, given = self.joint, self.joint.information
        q, n = joint.n_lens, joint.n_lens + joint.n_functionals
        inverse = _inverse_of(self._factor(photos))[::-1, ::-1]
        covariance = inverse * given.unit
        with_functionals = given.weights @ inverse
        cross = with_functionals / given.scale
        covariance[q:n], covariance[:, q:n] = cross, cross.T
        covariance[q:n, q:n] = given.rest + with_functionals @ given.weights.T
        return replace(joint, covariance=covariance)

    def head(self, photos: Sequence[int]) -> FloatArray:
        """:attr:`Joint.head` of :meth:`combined`, at a third of its cost."""
        joint, given = self.joint, self.joint.information
        q, n = joint.n_lens, joint.n_lens + joint.n_functionals
        factor = self._factor(photos)
        # The lens comes last: its corner of the factor is that of the lens with all else eliminated.
        told, _ = lapack.dtrtrs(factor, given.weights.T[::-1], lower=1)
        corner = factor[-q:, -q:]
        half, _ = lapack.dtrtrs(corner, np.eye(q), lower=1)
        found = np.empty((n, n))
        found[:q, :q] = (half.T @ half)[::-1, ::-1] * given.unit[:q, :q]
        found[:q, q:] = (half.T @ told[-q:])[::-1] / given.scale[:q, None]
        found[q:, :q] = found[:q, q:].T
        found[q:, q:] = given.rest + told.T @ told
        return found

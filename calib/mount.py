"""Two cameras mounted together: their relative pose from photos taken at the same time, and what it places.

A thermal camera shows too little to be placed by itself in many of its photos. Where it hangs on the same
gimbal as another camera, that camera's poses place it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from scipy.spatial.transform import Rotation

from calib.camera import FloatArray
from calib.control_files import Mark

#: Photos of two cameras this near in time are a pair.
TOGETHER_S = 0.5
LEAST_PAIRS = 3
#: Pairs that scatter more do not come from cameras mounted together: degrees, and share of the distance.
SCATTER_DEG, SCATTER_SHARE = 2.0, 0.04


@dataclass(frozen=True)
class Poses:
    """Poses of k photos: rotations_cam_from_world (k, 3, 3), centres_m (k, 3), in the points' frame.

    ``covariance`` (6 k, 6 k), where known: of each photo the turn on the camera's side, then the centre.
    """

    rotations_cam_from_world: FloatArray
    centres_m: FloatArray
    covariance: FloatArray | None = None

    def of(self, photos: Sequence[int]) -> Poses:
        """Those of some photos, in this order."""
        chosen = np.array(photos, np.intp)
        rows = (6 * chosen[:, None] + np.arange(6)).ravel()
        covariance = None if self.covariance is None else self.covariance[np.ix_(rows, rows)]
        return Poses(self.rotations_cam_from_world[chosen], self.centres_m[chosen], covariance)


@dataclass(frozen=True)
class Mount:
    """How a second camera sits on a first.

    ``rotation_second_from_first`` (3, 3); ``offset_m`` (3,) of the second's centre in the first's axes (x
    right, y down, z ahead). ``scatter_deg`` and ``scatter_m`` (3,): standard deviation of one pair about and
    along the same axes; ``sigma_deg`` and ``sigma_m`` (3,): of the mean, with what all pairs have in common
    (the lenses' own errors).
    """

    rotation_second_from_first: FloatArray
    offset_m: FloatArray
    scatter_deg: FloatArray
    scatter_m: FloatArray
    sigma_deg: FloatArray
    sigma_m: FloatArray
    pairs: int

    def place(self, first: Poses) -> Poses:
        """Where the second camera is when the first has these poses."""
        turn = first.rotations_cam_from_world
        return Poses(
            self.rotation_second_from_first @ turn,
            first.centres_m + np.einsum("kji,j->ki", turn, self.offset_m),
        )


@dataclass(frozen=True)
class Mounted:
    """This camera beside another of the campaign.

    ``on``: the other camera's name. ``miss_px``: rms per coordinate of the marks where the other camera's
    poses put them. ``placed``: photos that only so could be placed. ``expected``: where the points should be
    in photos that have too few marks.
    """

    mount: Mount
    on: str
    miss_px: float
    placed: tuple[str, ...]
    expected: tuple[Mark, ...]


def same_moment(
    first: Sequence[datetime | None], second: Sequence[datetime | None], within_s: float = TOGETHER_S
) -> list[tuple[int, int]]:
    """Indices of photos that are each other's nearest in time, and near enough."""
    known = [[(t, i) for i, t in enumerate(times) if t is not None] for times in (first, second)]
    if not all(known):
        return []
    zero = known[0][0][0]
    a, b = (np.array([(t - zero).total_seconds() for t, _ in times]) for times in known)
    apart = np.abs(a[:, None] - b[None, :])
    return [
        (known[0][i][1], known[1][j][1])
        for i, j in enumerate(apart.argmin(axis=1))
        if apart[i, j] <= within_s and int(apart[:, j].argmin()) == i
    ]


def solve_mount(first: Poses, second: Poses, distance_m: float) -> Mount | None:
    """Constant rotation and offset of pairs of poses (row by row), outliers left out.

    None where there are fewer than ``LEAST_PAIRS``, or they scatter as those of separate cameras do.
    ``distance_m``: typical distance to the object.
    """
    turns = second.rotations_cam_from_world @ first.rotations_cam_from_world.transpose(0, 2, 1)
    offsets = np.einsum("kij,kj->ki", first.rotations_cam_from_world, second.centres_m - first.centres_m)
    good = np.ones(len(turns), bool)
    for _ in range(10):
        if good.sum() < LEAST_PAIRS:
            return None
        mean = Rotation.from_matrix(turns[good]).mean().as_matrix()
        # Turns about the first camera's axes.
        angles = np.degrees(Rotation.from_matrix(mean.T @ turns).as_rotvec())
        middle = np.median(offsets[good], axis=0)
        miss = np.stack([np.linalg.norm(angles, axis=1), np.linalg.norm(offsets - middle, axis=1)], axis=1)
        usual = np.maximum(np.median(miss[good], axis=0), [0.01, 0.001])
        kept = np.all(miss < 4 * usual, axis=1)
        if (kept == good).all():
            break
        good = kept
    angles, offsets = angles[good], offsets[good]
    freedom = max(int(good.sum()) - 1, 1)
    scatter_deg = np.sqrt(np.sum(angles**2, axis=0) / freedom)
    offset = offsets.mean(axis=0)
    scatter_m = np.sqrt(np.sum((offsets - offset) ** 2, axis=0) / freedom)
    if scatter_deg.max() > SCATTER_DEG or scatter_m.max() > SCATTER_SHARE * distance_m:
        return None
    pairs = int(good.sum())
    chosen = np.flatnonzero(good).tolist()
    formal = _formal_sigmas(mean, first.of(chosen), second.of(chosen))
    sigma_deg = np.maximum(scatter_deg / np.sqrt(pairs), np.degrees(formal[:3]))
    return Mount(
        mean,
        offset,
        scatter_deg,
        scatter_m,
        sigma_deg,
        np.maximum(scatter_m / np.sqrt(pairs), formal[3:]),
        pairs,
    )


def _formal_sigmas(rotation_second_from_first: FloatArray, first: Poses, second: Poses) -> FloatArray:
    """Of the mean's turn (rad) and offset (m) in the first camera's axes (6,), from the poses' covariances.

    Pairs share their lenses' errors, which no scatter among them shows. Zero where none are known.
    """
    if first.covariance is None or second.covariance is None:
        return np.zeros(6)
    k = len(first.centres_m)
    variance = np.zeros(6)
    for poses, turn in ((first, np.eye(3)), (second, rotation_second_from_first.T)):
        mean = np.zeros((6, 6 * k))
        for i in range(k):
            mean[:3, 6 * i : 6 * i + 3] = turn / k
            mean[3:, 6 * i + 3 : 6 * i + 6] = first.rotations_cam_from_world[i] / k
        assert poses.covariance is not None
        variance += np.einsum("ij,jk,ik->i", mean, poses.covariance, mean, optimize=True)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

"""Adjustment of marks on control points: poses, points within their precision, lens parameters in steps.

Small and dense: some dozens of photos and points. Least squares by Levenberg-Marquardt.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy.linalg

from calib.align.rotations import rotation_exp
from calib.camera import BROWN_NAMES, BrownCamera, FloatArray
from calib.errors import AlignmentError
from calib.solution import BoolArray, IntArray

#: rotation_cam_from_world (3, 3), centre_m (3,).
Pose = tuple[FloatArray, FloatArray]
#: A resection whose marks miss by more than this share of the image width is not believed.
_RESECTION_SHARE = 0.02


@dataclass(frozen=True)
class MarkSet:
    """n marks of t points in k photos: photo (n,), point (n,), pixels (n, 2), sigma_px.

    points_m (t, 3) as surveyed with sigmas_m (t, 3), 0 where held; ``control`` (t,): the others are check
    points, which take no part.
    """

    photo: IntArray
    point: IntArray
    pixels: FloatArray
    sigma_px: float
    points_m: FloatArray
    sigmas_m: FloatArray
    control: BoolArray

    def __len__(self) -> int:
        return len(self.photo)

    @property
    def photos(self) -> int:
        return int(self.photo.max(initial=-1)) + 1


@dataclass(frozen=True)
class Block:
    """Values of all unknowns: rotations_cam_from_world (k, 3, 3), centres_m (k, 3), points_m (t, 3)."""

    camera: BrownCamera
    rotations: FloatArray
    centres_m: FloatArray
    points_m: FloatArray


@dataclass(frozen=True)
class Fit:
    """A solved block. ``covariance`` (11, 11) over ``BROWN_NAMES``, scaled by sigma0; held ones are zero.

    ``residuals_px`` (n, 2) of all marks, measured minus computed; ``cofactors`` (n, 2, 2): their covariance
    in units of the marks' own (less than 1 for marks that took part, more for others). ``chi2``: weighted
    square sum. ``pose_covariance`` (6 k, 6 k), scaled by sigma0: of each photo the turn on the camera's side
    (rotation vector), then the centre in m.
    """

    block: Block
    covariance: FloatArray
    residuals_px: FloatArray
    cofactors: FloatArray
    chi2: float
    freedom: int
    pose_covariance: FloatArray

    def standardised(self) -> FloatArray:
        """Length (n,) of each mark's residual in sigmas of one px of noise: Rayleigh's where it is good."""
        # A mark that alone fixes something has no residual to tell.
        size, vectors = np.linalg.eigh(self.cofactors)
        along = np.einsum("nij,ni->nj", vectors, self.residuals_px)
        length: FloatArray = np.sqrt(np.sum(along**2 / np.maximum(size, 0.02), axis=1))
        return length

    @property
    def sigma0(self) -> float:
        return float(np.sqrt(self.chi2 / self.freedom)) if self.freedom > 0 else float("nan")


@dataclass(frozen=True)
class _Pose:
    """Of one photo: rotation (3, 3), centre (3,), which marks (n,) agree and their square sum of misses."""

    rotation: FloatArray
    centre_m: FloatArray
    agree: BoolArray
    miss: float


def in_camera(marks: MarkSet, block: Block) -> FloatArray:
    """Points of all marks in their cameras (n, 3)."""
    offset = block.points_m[marks.point] - block.centres_m[marks.photo]
    local: FloatArray = np.einsum("nij,nj->ni", block.rotations[marks.photo], offset)
    return local


def residuals_px(marks: MarkSet, block: Block) -> FloatArray:
    local = in_camera(marks, block)
    depth = np.where(local[:, 2] > 1e-6, local[:, 2], 1e-6)
    return np.asarray(marks.pixels - block.camera.project(local[:, :2] / depth[:, None]))


def resected(
    marks: MarkSet, camera: BrownCamera, seed: int = 0, starts: Mapping[int, Pose] | None = None
) -> tuple[Block, BoolArray]:
    """Poses from the control points of each photo, and which marks agree with them (n,).

    ``starts``: poses known otherwise (rotation_cam_from_world, centre_m), by the photos' indices, for photos
    with too few marks to be sure of a resection.

    Raises:
        AlignmentError: a photo cannot be placed; its index is in the message's photo number.
    """
    k = marks.photos
    rotations, centres = np.tile(np.eye(3), (k, 1, 1)), np.zeros((k, 3))
    agree = np.zeros(len(marks), bool)
    threshold = _RESECTION_SHARE * camera.width / camera.f_px
    for photo in range(k):
        mine = np.flatnonzero((marks.photo == photo) & marks.control[marks.point])
        rays = np.ascontiguousarray(camera.unproject(marks.pixels[mine]))
        points = np.ascontiguousarray(marks.points_m[marks.point[mine]])
        if starts is not None and photo in starts:
            rotations[photo], centres[photo] = starts[photo]
            near = _miss(points, rays, *starts[photo]) < threshold
            if near.sum() < 4:
                raise AlignmentError(f"{photo}")
            agree[mine[near]] = True
            continue
        tries = (_pose(points, rays, chosen, threshold) for chosen in _samples(points, rays, threshold, seed))
        best = max(filter(None, tries), key=lambda pose: (pose.agree.sum(), -pose.miss), default=None)
        if best is None or best.agree.sum() < 4:
            raise AlignmentError(f"{photo}")
        rotations[photo], centres[photo], agree[mine] = best.rotation, best.centre_m, best.agree
    return Block(camera, rotations, centres, marks.points_m.copy()), agree


def _samples(points_m: FloatArray, rays: FloatArray, threshold: float, seed: int) -> Iterator[IntArray]:
    """Which of a photo's marks to try to place it by."""
    every = np.arange(len(points_m))
    if len(every) > 5:
        cv2.setRNGSeed(seed)
        found, _, _, inliers = cv2.solvePnPRansac(
            points_m,
            rays,
            np.eye(3),
            np.zeros(4),
            iterationsCount=500,
            reprojectionError=threshold,
            confidence=0.9999,
            flags=cv2.SOLVEPNP_SQPNP,
        )
        if found and inliers is not None and len(inliers) >= 4:
            yield np.asarray(inliers.ravel(), np.int64)
    elif len(every) >= 4:
        # OpenCV's RANSAC takes four or five as they are, by methods that fail where they lie in a plane.
        yield every
        if len(every) == 5:
            yield from (np.delete(every, i) for i in every)


def _pose(points_m: FloatArray, rays: FloatArray, chosen: IntArray, threshold: float) -> _Pose | None:
    """A photo placed by its ``chosen`` marks; None where they cannot (all on one line)."""
    own = points_m[chosen], rays[chosen], np.eye(3), np.zeros(4)
    try:
        found, turn, shift = cv2.solvePnP(*own, flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:
        return None
    if not found:
        return None
    turn, shift = cv2.solvePnPRefineLM(*own, turn, shift)
    rotation = np.asarray(cv2.Rodrigues(turn)[0], float)
    centre_m = -(rotation.T @ shift).ravel()
    miss = _miss(points_m, rays, rotation, centre_m)
    agree = miss < threshold
    return _Pose(rotation, centre_m, agree, float(np.sum(miss[agree] ** 2)))


def _miss(points_m: FloatArray, rays: FloatArray, rotation: FloatArray, centre_m: FloatArray) -> FloatArray:
    """How far (n,) a pose puts points (n, 3) from their rays (n, 2); infinite behind the camera."""
    local = (points_m - centre_m) @ rotation.T
    front = local[:, 2] > 1e-6
    miss = np.linalg.norm(local[:, :2] / np.where(front, local[:, 2], 1.0)[:, None] - rays, axis=1)
    return np.where(front, miss, np.inf)


def adjust(marks: MarkSet, start: Block, free: tuple[str, ...], used: BoolArray) -> Fit:
    """Least squares over poses, loose control points and the ``free`` lens parameters.

    Args:
        used: (n,) marks that take part; those of check points must not.

    Raises:
        AlignmentError: fewer measurements than unknowns.
    """
    columns = np.array([name in free for name in BROWN_NAMES])
    loose = _loose(marks)
    k, p = len(start.rotations), int(columns.sum())
    size = 6 * k + p + 3 * len(loose)
    rows = 2 * int(used.sum()) + 3 * len(loose)
    if rows <= size:
        raise AlignmentError(
            f"{int(used.sum())} marks are too few for {k} photos and {p} lens parameters: mark more points."
        )
    block, damping = start, 1e-3
    right, design = linearised(marks, block, columns, used)
    cost = float(right @ right)
    for _ in range(200):
        scale = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
        scaled = design / scale
        normal, gradient = scaled.T @ scaled, scaled.T @ right
        step = scipy.linalg.solve(normal + damping * np.eye(size), gradient, assume_a="pos")
        trial = _moved(block, step / scale, columns, loose)
        new_right, new_design = linearised(marks, trial, columns, used)
        new_cost = float(new_right @ new_right)
        if not new_cost < cost:
            damping *= 10
            if damping > 1e8:
                break
            continue
        gain, cost = cost - new_cost, new_cost
        block, right, design, damping = trial, new_right, new_design, max(damping / 10, 1e-14)
        if gain < 1e-9 * max(cost, 1e-9) and damping < 1e-6:
            break
    scale = np.linalg.norm(design, axis=0)
    scale[scale == 0] = 1.0  # A photo that lost all its marks.
    inverse = scipy.linalg.pinvh((design / scale).T @ (design / scale)) / np.outer(scale, scale)
    freedom = rows - size
    covariance = np.zeros((len(BROWN_NAMES), len(BROWN_NAMES)))
    lens = slice(6 * k, 6 * k + p)
    covariance[np.ix_(columns, columns)] = inverse[lens, lens] * cost / freedom
    every = np.ones(len(marks), bool)
    rows_of = linearised(marks, block, columns, every)[1][: 2 * len(marks)].reshape(len(marks), 2, -1)
    carried = (rows_of.reshape(2 * len(marks), -1) @ inverse).reshape(rows_of.shape)
    hat = carried @ rows_of.transpose(0, 2, 1)
    cofactors = np.eye(2) + np.where(used, -1.0, 1.0)[:, None, None] * hat
    poses = inverse[: 6 * k, : 6 * k] * cost / freedom
    return Fit(block, covariance, residuals_px(marks, block), cofactors, cost, freedom, poses)


def _moved(block: Block, step: FloatArray, columns: BoolArray, loose: IntArray) -> Block:
    k, p = len(block.rotations), int(columns.sum())
    pose = step[: 6 * k].reshape(k, 6)
    vector = block.camera.vector
    vector[columns] += step[6 * k : 6 * k + p]
    points = block.points_m.copy()
    points[loose] += step[6 * k + p :].reshape(-1, 3)
    return Block(
        BrownCamera.from_vector(block.camera.width, block.camera.height, vector),
        rotation_exp(pose[:, :3]) @ block.rotations,
        block.centres_m + pose[:, 3:],
        points,
    )


def mark_derivatives(marks: MarkSet, block: Block) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Projections (n, 2) of all marks and their derivatives by pose (n, 2, 6), point (n, 2, 3) and camera
    (n, 2, 11). Pose: rotation vector on the camera's side, then centre."""
    turn = block.rotations[marks.photo]
    local = in_camera(marks, block)
    depth = np.where(local[:, 2] > 1e-6, local[:, 2], 1e-6)
    rays = local[:, :2] / depth[:, None]
    pixels, by_ray, by_lens = block.camera.derivatives(rays)
    by_cam = np.concatenate([by_ray, -(by_ray @ rays[:, :, None])], axis=2) / depth[:, None, None]
    by_point = by_cam @ turn
    by_pose = np.concatenate([np.cross(local[:, None, :], by_cam), -by_point], axis=2)
    return pixels, by_pose, by_point, by_lens


def _loose(marks: MarkSet) -> IntArray:
    """Control points that are not held."""
    return np.flatnonzero(marks.control & (marks.sigmas_m > 0).all(axis=1))


def linearised(
    marks: MarkSet, block: Block, columns: BoolArray, used: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Weighted residuals (r,) and design (r, 6 k + p + 3 loose): ``used`` marks first, then points' priors.

    ``columns`` (11,): which lens parameters are free. Unknowns: poses, lens, points that are not held.
    """
    loose = _loose(marks)
    k, p = len(block.rotations), int(columns.sum())
    index = np.flatnonzero(used)
    photo, point, n = marks.photo[index], marks.point[index], len(index)
    pixels, by_pose, by_point, by_lens = (part[index] for part in mark_derivatives(marks, block))
    design = np.zeros((n, 2, 6 * k + p + 3 * len(loose)))
    row = np.arange(n)
    for i in range(6):
        design[row, :, 6 * photo + i] = by_pose[:, :, i]
    design[:, :, 6 * k : 6 * k + p] = by_lens[:, :, columns]
    position = np.full(len(block.points_m), -1)
    position[loose] = np.arange(len(loose))
    mine = np.flatnonzero(position[point] >= 0)
    for i in range(3):
        design[mine, :, 6 * k + p + 3 * position[point[mine]] + i] = by_point[mine, :, i]
    prior = np.zeros((3 * len(loose), design.shape[2]))
    sigma = marks.sigmas_m[loose].ravel()
    prior[np.arange(len(prior)), 6 * k + p + np.arange(len(prior))] = 1 / np.maximum(sigma, 1e-12)
    off = (marks.points_m[loose] - block.points_m[loose]).ravel() / np.maximum(sigma, 1e-12)
    right = ((marks.pixels[index] - pixels) / marks.sigma_px).ravel()
    return (
        np.concatenate([right, off]),
        np.concatenate([design.reshape(2 * n, -1) / marks.sigma_px, prior]),
    )


def intersected(marks: MarkSet, block: Block, used: BoolArray) -> FloatArray:
    """Every point (t, 3) from its marks alone, the block as it is; NaN with fewer than two photos."""
    found = np.full_like(block.points_m, np.nan)
    for point in range(len(block.points_m)):
        mine = np.flatnonzero((marks.point == point) & used)
        if len(mine) < 2:
            continue
        at = block.points_m[point].copy()
        for _ in range(20):
            trial = replace(block, points_m=block.points_m.copy())
            trial.points_m[point] = at
            turn = block.rotations[marks.photo[mine]]
            local = np.einsum("nij,nj->ni", turn, at - block.centres_m[marks.photo[mine]])
            rays = local[:, :2] / local[:, 2:]
            pixels, by_ray, _ = block.camera.derivatives(rays)
            by_cam = (
                np.concatenate([by_ray, -(by_ray @ rays[:, :, None])], axis=2) / local[:, 2][:, None, None]
            )
            design = (by_cam @ turn).reshape(-1, 3)
            step = np.linalg.lstsq(design, (marks.pixels[mine] - pixels).ravel(), rcond=None)[0]
            at = at + step
            if np.linalg.norm(step) < 1e-9:
                break
        found[point] = at
    return found

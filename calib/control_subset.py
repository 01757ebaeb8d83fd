"""The photos that tell most of a calibration on control points, and what they tell alone ([SEN])."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.camera import BROWN_NAMES, BrownCamera, FloatArray
from calib.control import ControlCalibration, free_parameters
from calib.control_adjust import Block, MarkSet, adjust, mark_derivatives
from calib.errors import AlignmentError
from calib.solution import BoolArray

#: Sizes that [SEN] compare with the whole campaign.
SIZES = (14, 20)


@dataclass(frozen=True)
class Subset:
    """A calibration on some of the photos: ``photos`` in the order of what each adds.

    ``covariance`` (11, 11) over ``BROWN_NAMES``. ``apart_sigmas``: largest difference of a parameter from
    that of all photos, in sigmas of both together.
    """

    photos: tuple[int, ...]
    camera: BrownCamera
    covariance: FloatArray
    apart_sigmas: float


def subsets(made: ControlCalibration, sizes: tuple[int, ...] = SIZES) -> tuple[Subset, ...]:
    """The best so many photos, for each size that leaves some out, under the model of all of them."""
    free = free_parameters(made)
    used = made.used & made.marks.control[made.marks.point]
    order = information_order(photo_information(made.marks, made.fit.block, free, used))
    found = []
    for size in sizes:
        if size >= len(made.photos):
            break
        try:
            found.append(_alone(made, order[:size], free, used))
        except AlignmentError:  # Too few marks for the model.
            continue
    return tuple(found)


def photo_information(marks: MarkSet, block: Block, free: tuple[str, ...], used: BoolArray) -> FloatArray:
    """What each photo by itself adds to the normal matrix of the free parameters, (k, p, p).

    Its pose is eliminated (Schur complement); points are taken as known.
    """
    columns = np.array([name in free for name in BROWN_NAMES])
    _, by_pose, _, by_lens = mark_derivatives(marks, block)
    found = np.zeros((marks.photos, int(columns.sum()), int(columns.sum())))
    for photo in range(marks.photos):
        mine = used & (marks.photo == photo)
        pose = by_pose[mine].reshape(-1, 6) / marks.sigma_px
        lens = by_lens[mine][:, :, columns].reshape(len(pose), -1) / marks.sigma_px
        rest = lens - pose @ np.linalg.lstsq(pose, lens, rcond=None)[0]
        found[photo] = rest.T @ rest
    return found


def information_order(information: FloatArray) -> tuple[int, ...]:
    """All photos, each the one that adds most to the determinant (D-optimal, greedily)."""
    scale = np.sqrt(np.maximum(np.diagonal(information.sum(axis=0)), 1e-300))
    unit = information / np.outer(scale, scale)
    # A trace of knowledge, so that the first photos can be compared at all.
    total = 1e-6 * np.eye(len(scale))
    left, order = list(range(len(unit))), []
    while left:
        gains = np.linalg.slogdet(total + unit[left])[1]
        best = left.pop(int(np.argmax(gains)))
        total = total + unit[best]
        order.append(best)
    return tuple(order)


def _alone(
    made: ControlCalibration, photos: tuple[int, ...], free: tuple[str, ...], used: BoolArray
) -> Subset:
    kept = sorted(photos)
    mine = np.isin(made.marks.photo, kept) & used
    marks = replace(
        made.marks,
        photo=np.searchsorted(kept, made.marks.photo[mine]),
        point=made.marks.point[mine],
        pixels=made.marks.pixels[mine],
    )
    block = made.fit.block
    start = replace(block, rotations=block.rotations[kept], centres_m=block.centres_m[kept])
    fit = adjust(marks, start, free, np.ones(len(marks), bool))
    both = np.sqrt(np.diag(fit.covariance) + np.diag(made.fit.covariance))
    move = np.abs(fit.block.camera.vector - made.camera.vector)
    apart = float(np.max(move[both > 0] / both[both > 0], initial=0.0))
    return Subset(photos, fit.block.camera, fit.covariance, apart)

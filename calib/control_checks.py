"""Control that cannot be right: too little of it, axes swapped, other units, an adjustment that ran away."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.camera import BrownCamera, FloatArray
from calib.control_adjust import Block, Fit, MarkSet, adjust, in_camera, resected
from calib.errors import AlignmentError, InputError
from calib.solution import BoolArray

#: Lens parameters that every calibration on control points has.
RADIAL = ("f", "k1", "k2", "k3")
LEAST_POINTS = 6
#: Fewer of the marks than this agreeing with each other: something is wrong with all of them.
AGREE_SHARE = 0.8
#: A focal length further from the stated one than this factor, or vaguer than this share, is none.
FOCAL_RANGE, VAGUE_FOCAL = 2.0, 0.1
#: Thinner than this share of its length: the control lies on a line, or in a plane.
_FLAT = 0.02
#: Photos nearer to the points or further from them than this: their coordinates may not be metres.
_NEAR_M, _FAR_M = 0.1, 500.0


def require_shape(xyz_m: FloatArray) -> None:
    if len(xyz_m) < LEAST_POINTS:
        raise InputError(f"{len(xyz_m)} control points are marked; at least {LEAST_POINTS} are needed.")
    size = _extents(xyz_m)
    if size[1] < _FLAT * size[0]:
        raise InputError("All control points lie on one line; spread them over the object.")


def _extents(xyz_m: FloatArray) -> FloatArray:
    """How far points spread along their own three axes, largest first; only ratios count."""
    found: FloatArray = np.linalg.svd(xyz_m - xyz_m.mean(axis=0), compute_uv=False)
    return found


def require_agreement(marks: MarkSet, start: BrownCamera, used: BoolArray, on_control: BoolArray) -> None:
    """Refuse points that most marks contradict, and say where two axes are swapped (a mirrored object)."""
    share = float(np.mean(used[on_control]))
    if share >= AGREE_SHARE:
        return
    require_handedness(marks, start, share)
    raise InputError(
        f"Only {100 * share:.0f} % of the marks agree with the points. Check the points' names, the order of "
        "their coordinates (x east, y north, z up) and their units, or give the focal length with --focal-px."
    )


def require_handedness(marks: MarkSet, start: BrownCamera, share: float) -> None:
    """Say that two axes are swapped, where the marks fit the mirrored points, better than ``share`` of them.

    Which two cannot be told: all such swaps are the same mirrored object, turned.
    """
    on_control = marks.control[marks.point]
    mirrored = replace(marks, points_m=marks.points_m[:, [1, 0, 2]])
    try:
        block, used = resected(mirrored, start)
        if float(np.mean(used[on_control])) <= max(0.9, share):
            return
        fit = adjust(mirrored, block, RADIAL, used & on_control)
    except AlignmentError:
        return
    if _believable(fit, start):
        raise InputError(
            "The points fit the photos only mirrored, as with x and y swapped: give them as x east, y north, "
            "z up."
        )


def _believable(fit: Fit, start: BrownCamera) -> bool:
    """Whether a focal length came out that a lens may have."""
    sigma = float(np.sqrt(fit.covariance[0, 0]))
    f = fit.block.camera.f_px
    return bool(1 / FOCAL_RANGE < f / start.f_px < FOCAL_RANGE and sigma < VAGUE_FOCAL * f)


def require_lens(marks: MarkSet, fit: Fit, start: BrownCamera) -> None:
    """Refuse an adjustment that ran away: wrong points, or marks that do not tell the focal length."""
    if _believable(fit, start):
        return
    require_handedness(marks, start, 0.0)
    raise InputError(
        f"The marks give no believable focal length ({fit.block.camera.f_px:.4g} px, against "
        f"{start.f_px:.4g} px stated). Check the points' names, the order of their coordinates (x east, y "
        "north, z up) and their units; or photograph the points from more angles."
    )


def shape_notes(marks: MarkSet, block: Block) -> list[str]:
    """What is odd about where the points are."""
    size = _extents(marks.points_m[marks.control])
    depth = float(np.median(in_camera(marks, block)[:, 2]))
    notes = []
    if size[2] < _FLAT * size[0]:
        notes.append(
            "All control points lie in one plane: the focal length rests on photos that see it from "
            "different angles."
        )
    if not _NEAR_M < depth < _FAR_M:
        notes.append(f"The photos stand {depth:.3g} m from the points: are their coordinates in metres?")
    return notes

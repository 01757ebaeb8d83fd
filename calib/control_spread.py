"""What a calibration on control points does not know of its own model.

The formal covariance takes the chosen model for true. Decentring that was left out for want of significance
may still be there, and moves the principal point; a lens that Brown's model cannot follow moves everything.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from scipy.special import chdtrc

from calib.camera import BROWN_NAMES, FloatArray
from calib.control_adjust import Fit, MarkSet, adjust, linearised
from calib.errors import AlignmentError
from calib.field import FIELD_NAMES, field_basis
from calib.solution import BoolArray

#: Prior of a coefficient of the residual field, px, at 4000 px image width.
_FIELD_PRIOR_PX = 0.5
#: Chance explains the field's gain in fit with less than this: the lens is not Brown's.
FIELD_P = 0.01


@dataclass(frozen=True)
class Spread:
    """What other models of the lens would change.

    ``covariance`` (11, 11) over ``BROWN_NAMES``, to be added to the formal one: the move of the parameters
    when everything is released, and, where a residual field is significant, their move with it and what it
    leaves open. ``field_rms_px``: size of that field at the marks; ``field_chance`` that chance makes it.
    """

    covariance: FloatArray
    field_rms_px: float
    field_chance: float

    @property
    def beyond_brown(self) -> bool:
        return self.field_chance < FIELD_P


def model_spread(
    marks: MarkSet, fit: Fit, free: tuple[str, ...], every: tuple[str, ...], used: BoolArray
) -> Spread:
    """Of ``fit``, whose ``free`` parameters were kept of ``every`` one that may be."""
    covariance = np.zeros_like(fit.covariance)
    if set(free) != set(every):
        # Too few marks for more parameters: nothing to compare with.
        with contextlib.suppress(AlignmentError):
            released = adjust(marks, fit.block, every, used).block.camera
            move = released.vector - fit.block.camera.vector
            covariance += np.outer(move, move)
    more, rms_px, chance = _with_field(marks, fit, free, used)
    if chance < FIELD_P:
        covariance += more
    return Spread(covariance, rms_px, chance)


def _with_field(
    marks: MarkSet, fit: Fit, free: tuple[str, ...], used: BoolArray
) -> tuple[FloatArray, float, float]:
    """What a residual field adds to the covariance (11, 11), its rms at the marks in px, and its chance.

    One step suffices, for a field is small and enters linearly.
    """
    camera, terms = fit.block.camera, len(FIELD_NAMES)
    columns = np.array([name in free for name in BROWN_NAMES])
    right, design = linearised(marks, fit.block, columns, used)
    size, n = design.shape[1], int(used.sum())
    basis = field_basis(marks.pixels[used], camera.width, camera.height)
    shift = np.zeros((n, 2, terms))
    shift[:, 0, : terms // 2] = basis
    shift[:, 1, terms // 2 :] = basis
    whole = np.zeros((len(right) + terms, size + terms))
    whole[: len(right), :size] = design
    whole[: 2 * n, size:] = shift.reshape(2 * n, terms) / marks.sigma_px
    whole[len(right) :, size:] = np.eye(terms) / (_FIELD_PRIOR_PX * camera.width / 4000)
    target = np.append(right, np.zeros(terms))
    scale = np.linalg.norm(whole, axis=0)
    scale[scale == 0] = 1.0  # A photo that lost all its marks.
    scaled = whole / scale
    inverse = scipy.linalg.pinvh(scaled.T @ scaled)
    step = inverse @ (scaled.T @ target) / scale
    left = target - whole @ step
    remaining = float(left @ left)
    gain = (fit.chi2 - remaining) / max(remaining / max(fit.freedom - terms, 1), 1e-12)
    lens = slice(6 * marks.photos, 6 * marks.photos + int(columns.sum()))
    move = np.zeros(len(BROWN_NAMES))
    move[columns] = step[lens]
    open_ = np.zeros_like(fit.covariance)
    open_[np.ix_(columns, columns)] = (
        inverse[lens, lens] / np.outer(scale[lens], scale[lens])
    ) * fit.sigma0**2
    rms_px = float(np.sqrt(np.mean((shift @ step[size:]) ** 2)))
    return open_ - fit.covariance + np.outer(move, move), rms_px, float(chdtrc(terms, max(gain, 0.0)))

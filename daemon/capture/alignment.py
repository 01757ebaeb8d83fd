"""Monotone alignment of triggers and photos for one clock: forward-backward sums over all of them.

The hidden path visits (trigger, photo) pairs in order; whatever it jumps over is a gap. Gaps at the
ends (test shots before take-off, a log that starts late) are cheaper than gaps in the middle, and so is
what is lost in a row on one side only: a link that was cut, a folder of the card that is missing. All
weights are relative to the path without any pair, so that a cell weighs

    r = p(match) / (p(lone trigger) p(lone photo)) * density(photo | trigger) / density(photo alone)

and F(i, j) = r (sum of F over all earlier triggers and photos, weighted by :func:`log_jump`, + leading
gaps). Pairs outside a window of a few sigma weigh nothing, so the sums run over narrow bands.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from daemon.capture.paths import LOG_END, FloatArray, IntArray, path_sums

#: Share and width of pairs that are far later or earlier than the jitter says.
TAIL_SHARE, TAIL_SIGMA_S = 0.1, 0.2


@dataclass(frozen=True)
class Cells:
    """Possible pairs, by trigger and then photo: indices (m,), log weights (m,).

    Neither the first nor the last photo of a trigger is before that of an earlier trigger.
    """

    trigger: IntArray
    photo: IntArray
    log_weight: FloatArray


@dataclass(frozen=True)
class Aligned:
    """``log_evidence`` relative to no pair at all; ``probability`` (m,) of each cell."""

    log_evidence: float
    probability: FloatArray


def possible_pairs(
    predicted_s: FloatArray, photo_s: FloatArray, resolution_s: FloatArray, reach_s: float
) -> tuple[IntArray, IntArray]:
    """Indices of all pairs whose photo time (n_p,) is within reach of the predicted one (n_t,), sorted."""
    coarse = float(resolution_s.max(initial=0.0))
    low = np.searchsorted(photo_s, predicted_s - reach_s - coarse)
    high = np.searchsorted(photo_s, predicted_s + reach_s, side="right")
    counts = np.maximum(high - low, 0)
    trigger = np.repeat(np.arange(len(predicted_s)), counts)
    starts = np.repeat(low - np.concatenate([[0], np.cumsum(counts)[:-1]]), counts)
    return trigger.astype(np.int64), (starts + np.arange(len(trigger))).astype(np.int64)


def log_density(early_s: FloatArray, resolution_s: FloatArray, sigma_s: FloatArray) -> FloatArray:
    """Log density (1/s) of a clock reading cut off to its resolution.

    ``early_s``: reading minus predicted time; the exposure lies in [reading, reading + resolution).
    """

    def cut(sigma: FloatArray) -> FloatArray:
        upper, lower = (early_s + resolution_s) / sigma, early_s / sigma
        # The upper tail by symmetry, where differences of values near 1 lose their digits.
        flip = lower > 0
        mass = ndtr(np.where(flip, -lower, upper)) - ndtr(np.where(flip, -upper, lower))
        density: FloatArray = mass / resolution_s
        return density

    tail = np.full_like(sigma_s, TAIL_SIGMA_S) + sigma_s
    mixed: FloatArray = np.log((1 - TAIL_SHARE) * cut(sigma_s) + TAIL_SHARE * cut(tail) + 1e-300)
    return mixed


def coincident(cells: Cells) -> FloatArray:
    """1 for each cell (m,) that is likely in itself and the likeliest of its trigger and photo, else 0."""
    if not len(cells.trigger):
        return np.zeros(0)
    of_trigger = np.full(int(cells.trigger.max()) + 1, -np.inf)
    of_photo = np.full(int(cells.photo.max()) + 1, -np.inf)
    np.maximum.at(of_trigger, cells.trigger, cells.log_weight)
    np.maximum.at(of_photo, cells.photo, cells.log_weight)
    best = np.maximum(of_trigger[cells.trigger], of_photo[cells.photo])
    both: FloatArray = ((cells.log_weight >= best) & (cells.log_weight > 0)).astype(float)
    return both


def align(cells: Cells, n_triggers: int, n_photos: int) -> Aligned:
    """Sum over all monotone alignments; cells sorted by trigger, photos (n_p,) sorted by time."""
    if not len(cells.trigger):
        return Aligned(0.0, np.zeros(0))
    forward = path_sums(cells.trigger, cells.photo, cells.log_weight)
    # Backwards in time the same sums, with both sequences reversed.
    backward = path_sums(
        n_triggers - 1 - cells.trigger[::-1], n_photos - 1 - cells.photo[::-1], cells.log_weight[::-1]
    )[::-1]
    # A path's weight in a cell is in both sweeps: take it out once.
    log_joint = forward + backward - cells.log_weight
    trailing = LOG_END * ((n_triggers - 1 - cells.trigger) + (n_photos - 1 - cells.photo))
    # Or no pair at all: every trigger and every photo is a gap, at the ends' price.
    nothing = LOG_END * (n_triggers + n_photos)
    total = float(np.logaddexp(np.logaddexp.reduce(forward + trailing), nothing))
    return Aligned(total - nothing, np.exp(np.minimum(log_joint - total, 0.0)))

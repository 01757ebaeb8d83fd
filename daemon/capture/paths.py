"""Sums over all monotone paths through possible pairs, and what the gaps of a path weigh.

In plain numbers, not arrays: a trigger has one to ten possible photos, and numpy's calls on rows so short
cost several times what is computed in them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import exp, inf, log, log1p

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

P_MATCH, P_GAP, P_END_GAP = 0.88, 0.06, 0.6
LOG_PAIR = log(P_MATCH / P_GAP**2)
LOG_END = log(P_END_GAP / P_GAP)
#: For each further trigger or photo that is lost in a row, while at most so many are lost on the other side.
LOG_ROW, ROW_OTHERS = 0.85 * LOG_END, 1
#: The common scale of linear sums moves when they have grown by so much (of 709 that a float holds).
_RESCALE = 200.0


def log_jump(triggers: int, photos: int) -> float:
    """Log weight of so many lone triggers and photos between two pairs, against each being lost by itself."""
    if min(triggers, photos) > ROW_OTHERS or max(triggers, photos) <= ROW_OTHERS:
        return 0.0
    return float(np.logaddexp(0.0, LOG_ROW * (max(triggers, photos) - 1)))


def path_sums(trigger: IntArray, photo: IntArray, log_weight: FloatArray) -> FloatArray:
    """log F of each cell (m,): all paths that end in it, its own weight included.

    Cells as of :class:`daemon.capture.alignment.Cells`.
    """
    bounds = [0, *(np.flatnonzero(np.diff(trigger)) + 1).tolist(), len(trigger)]
    all_photos, weights = photo.tolist(), log_weight.tolist()
    out: list[float] = []
    # ended[j]: paths over earlier triggers that end at photo j, divided by exp(scale). Those before first,
    # which no later trigger can have, are summed up in base.
    ended, base, first, scale = [0.0] * (max(all_photos) + 1), 0.0, 0, -inf
    lost = _LostInARow([-inf] * len(ended))
    for start, stop, row in zip(bounds[:-1], bounds[1:], trigger[bounds[:-1]].tolist(), strict=True):
        photos = all_photos[start:stop]
        if scale == -inf:
            scale = LOG_END * (row + photos[-1])
        if photos[0] > first:
            base += sum(ended[first : photos[0]])
            first = photos[0]
        lost.pass_on(row)
        earlier, summed = base, first
        log_f = []
        for j, weight in zip(photos, weights[start:stop], strict=True):
            while summed < j:
                earlier += ended[summed]
                summed += 1
            before = LOG_END * (row + j)
            if earlier > 0:
                before = _log_add(log(earlier) + scale, before)
            if j <= lost.until or j >= lost.since:
                before = lost.joined(before, j)
            log_f.append(before + weight)
        peak = max(log_f)
        if peak > scale + _RESCALE:
            factor = exp(max(scale - peak, -700.0))
            base *= factor
            ended[first : photos[-1] + 1] = [factor * value for value in ended[first : photos[-1] + 1]]
            scale = peak
        for j, value in zip(photos, log_f, strict=True):
            ended[j] += exp(value - scale)
        lost.recent.append((row, photos, log_f))
        out += log_f
    return np.array(out)


def _log_add(one: float, other: float) -> float:
    if one < other:
        one, other = other, one
    # What is smaller by more changes no digit.
    return one + log1p(exp(other - one)) if other - one > -40.0 else one


@dataclass
class _LostInARow:
    """Paths whose next pair comes after many triggers, or many photos, that are lost in a row.

    ``columns``: paths that end at a photo, at a trigger more than ROW_OTHERS back: log F less LOG_ROW
    times the trigger; ``recent``: trigger, photos and log F of those that are not. Only photos up to
    ``until`` and from ``since`` on can be the next.
    """

    columns: list[float]
    recent: list[tuple[int, list[int], list[float]]] = field(default_factory=list)
    row: int = 0
    until: int = -1
    since: float = inf

    def pass_on(self, row: int) -> None:
        """To the next trigger."""
        self.row, recent = row, self.recent
        while recent and row - recent[0][0] - 1 > ROW_OTHERS:
            past, photos, log_f = recent.pop(0)
            for j, value in zip(photos, log_f, strict=True):
                self.columns[j] = _log_add(self.columns[j], value - LOG_ROW * past)
            self.until = max(self.until, photos[-1] + ROW_OTHERS + 1)
        self.since = recent[0][1][0] + ROW_OTHERS + 2 if recent else inf

    def joined(self, log_sum: float, photo: int) -> float:
        """``log_sum`` and those paths to this photo."""
        for _, photos, log_f in self.recent:
            for j, value in zip(photos, log_f, strict=True):
                if photo - j - 1 <= ROW_OTHERS:
                    break
                log_sum = _log_add(log_sum, value + LOG_ROW * (photo - j - 2))
        for j in range(max(photo - ROW_OTHERS - 1, 0), min(photo, len(self.columns))):
            log_sum = _log_add(log_sum, self.columns[j] + LOG_ROW * (self.row - 2))
        return log_sum

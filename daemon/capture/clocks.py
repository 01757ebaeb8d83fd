"""Candidate clocks (offset, drift, jitter) between two sequences of times, and their refinement.

Every clock that explains the times nearly as well as the best is kept: with equal intervals there
are many, each shifted by one interval, and only their weights together are honest.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np

from daemon.capture.alignment import Cells, log_density, possible_pairs
from daemon.capture.paths import LOG_PAIR, FloatArray, IntArray
from daemon.capture.records import KnownClock

#: Drift of a camera's clock against the vehicle's, beforehand.
DRIFT_SIGMA = 1e-4
MIN_JITTER_S, START_JITTER_S, MAX_JITTER_S = 0.01, 0.15, 0.4
#: Exposures are late by so much, one more than another.
_LATE_S = 0.1
_MAX_SCREENED, _MAX_KEPT, _KEEP_NATS = 60, 9, 60.0
#: Differences counted in the offset search at most: thinner triggers beyond.
_MAX_DIFFERENCES = 500_000


@dataclass(frozen=True)
class Times:
    """Both sequences sorted by time: triggers (n_t,) with sigma (n_t,), photos (n_p,) with resolution
    (n_p,) and ``log_alone`` (n_p,), the log density of their times without any trigger; s.

    Trigger times count from ``reference_s``, photo times from ``photo_reference_s``.
    """

    trigger_s: FloatArray
    sigma_s: FloatArray
    photo_s: FloatArray
    resolution_s: FloatArray
    log_alone: FloatArray
    reference_s: float
    photo_reference_s: float


@dataclass(frozen=True)
class Clock:
    """Photo time = trigger time + offset + drift * trigger time, on the axes of :class:`Times`."""

    offset_s: float
    drift: float = 0.0
    jitter_s: float = START_JITTER_S
    offset_sigma_s: float = START_JITTER_S
    drift_sigma: float = DRIFT_SIGMA

    def predict_s(self, trigger_s: FloatArray) -> FloatArray:
        return trigger_s + self.offset_s + self.drift * trigger_s

    def sigma_s(self, trigger_s: FloatArray, own_s: FloatArray) -> FloatArray:
        """Spread (n,) of single pairs: jitter, the trigger's own sigma and the clock's."""
        of_clock = np.hypot(self.offset_sigma_s, self.drift_sigma * trigger_s)
        spread: FloatArray = np.sqrt(self.jitter_s**2 + own_s**2 + of_clock**2)
        return spread


def log_density_alone(photo_s: FloatArray, resolution_s: FloatArray) -> FloatArray:
    """How expected each photo's time (n_p,) is from the rhythm of the photos alone, log of 1/s.

    The share of the *other* intervals like the one before it, mixed with a broad density. At a
    constant interval that is as sharp as any trigger's prediction, so that equal steps prove nothing.
    """
    if len(photo_s) < 2:
        return np.full(len(photo_s), -np.log(60.0))
    intervals = np.diff(photo_s)
    half = 1.5 * np.sqrt(2 * 0.03**2 + resolution_s[1:] ** 2 / 6)
    ordered = np.sort(intervals)
    alike = np.searchsorted(ordered, intervals + half, "right") - np.searchsorted(ordered, intervals - half)
    rhythm = (alike - 1) / (max(len(intervals) - 1, 1) * 2 * half)
    typical = max(float(np.median(intervals)), 0.1)
    broad = 1 / (typical * (1 + intervals / typical) ** 2)
    alone = np.log(0.9 * rhythm + 0.1 * broad)
    return np.concatenate([[alone.mean()], alone])


def candidate_clocks(times: Times, known: KnownClock | None) -> list[Clock]:
    """Clocks worth a full alignment, best first: peaks of the histogram of all time differences."""
    stride = max(1, len(times.trigger_s) * len(times.photo_s) // _MAX_DIFFERENCES)
    middle = times.photo_s + times.resolution_s / 2
    differences = (middle[None, :] - times.trigger_s[::stride, None]).ravel()
    if known is not None:
        offset_s = known.offset_s + times.reference_s - times.photo_reference_s
        differences = differences[np.abs(differences - offset_s) < 5 * known.sigma_s + 1.0]
    if not len(differences):
        return []
    # Hardly wider than what the times of one clock spread over: a window of a whole interval sees no peaks.
    spread = float(times.resolution_s.max()) + DRIFT_SIGMA * float(np.ptp(times.trigger_s))
    found = _peaks(np.sort(differences), spread + 2 * _LATE_S)
    screened = sorted((_screen(times, offset) for offset in found), key=lambda pair: -pair[0])
    best = screened[0][0]
    return [clock for value, clock in screened if value > best - _KEEP_NATS][:_MAX_KEPT]


def _peaks(ordered: FloatArray, window: float) -> list[float]:
    """Means of the windows that hold most of the ordered values (n,), the fullest first."""
    first = np.arange(len(ordered))
    past = np.searchsorted(ordered, ordered + window, "right")
    count = past - first
    sums = np.concatenate([[0.0], np.cumsum(ordered - ordered[0])])
    centre = ordered[0] + (sums[past] - sums[first]) / count
    found: list[float] = []
    while len(found) < _MAX_SCREENED and count[best := int(np.argmax(count))] > 0:
        found.append(float(centre[best]))
        near = np.searchsorted(ordered, [ordered[best] - window / 2, ordered[best] + window / 2])
        count[near[0] : near[1] + 1] = 0
    return found


def _screen(times: Times, offset_s: float) -> tuple[float, Clock]:
    """A clock refined with nearest photos only, and about how well it explains the times.

    Of triggers and photos nearest to each other: at short intervals every trigger has some photo near.
    """
    clock = Clock(offset_s)
    middle = times.photo_s + times.resolution_s / 2
    score = 0.0
    for _ in range(4):
        predicted = clock.predict_s(times.trigger_s)
        photo = _nearest(predicted, middle)
        trigger = np.flatnonzero(_nearest(middle, predicted)[photo] == np.arange(len(predicted)))
        cells = Cells(trigger, photo[trigger], np.zeros(len(trigger)))
        weight = weigh(times, clock, cells.trigger, cells.photo)
        score = float(np.maximum(weight, 0.0).sum())
        moved = fit(times, cells, (weight > 0).astype(float), clock)
        if moved is clock:  # nothing fits: so it stays
            break
        clock = moved
    return score, clock


def _nearest(values: FloatArray, ordered: FloatArray) -> IntArray:
    """Index (n,) into ordered (m,) of what is nearest to each value (n,)."""
    if len(ordered) == 1:
        return np.zeros(len(values), dtype=np.int64)
    right = np.minimum(np.maximum(np.searchsorted(ordered, values), 1), len(ordered) - 1)
    nearest: IntArray = right - (values - ordered[right - 1] < ordered[right] - values)
    return nearest


def weigh(times: Times, clock: Clock, trigger: IntArray, photo: IntArray) -> FloatArray:
    """Log weight (m,) of pairs against both being alone, see :mod:`daemon.capture.alignment`."""
    t = times.trigger_s[trigger]
    early = times.photo_s[photo] - clock.predict_s(t)
    sigma = clock.sigma_s(t, times.sigma_s[trigger])
    weight: FloatArray = (
        LOG_PAIR + log_density(early, times.resolution_s[photo], sigma) - times.log_alone[photo]
    )
    return weight


def cells_of(times: Times, clock: Clock) -> Cells:
    """All pairs that a clock does not rule out, with their weights."""
    spread = float(clock.sigma_s(times.trigger_s, times.sigma_s).max())
    trigger, photo = possible_pairs(
        clock.predict_s(times.trigger_s), times.photo_s, times.resolution_s, 4 * spread + 0.3
    )
    return Cells(trigger, photo, weigh(times, clock, trigger, photo))


def fit(times: Times, cells: Cells, probability: FloatArray, clock: Clock) -> Clock:
    """Weighted least squares of offset and drift (with its prior), then the jitter (one M step)."""
    use = probability > 0.05
    p, i, j = probability[use], cells.trigger[use], cells.photo[use]
    if p.sum() < 1.0:
        return clock
    t, own, resolution = times.trigger_s[i], times.sigma_s[i], times.resolution_s[j]
    cut = resolution**2 / 12
    residual = times.photo_s[j] + resolution / 2 - t
    # Far pairs count less, so that a late trigger does not pull the clock (Huber).
    variance = clock.jitter_s**2 + own**2 + cut
    off = np.abs(residual - clock.offset_s - clock.drift * t) / np.sqrt(variance)
    weight = p / variance / np.maximum(off / 2.0, 1.0)
    # Normal equations of offset and drift, two by two.
    weighted = weight * residual
    n_oo, n_od = float(weight.sum()), float(weight @ t)
    n_dd = float((weight * t) @ t) + DRIFT_SIGMA**-2
    right_o, right_d, determinant = float(weighted.sum()), float(weighted @ t), n_oo * n_dd - n_od**2
    offset, drift = (
        (n_dd * right_o - n_od * right_d) / determinant,
        (n_oo * right_d - n_od * right_o) / determinant,
    )
    squares = np.minimum((residual - offset - drift * t) ** 2, 9 * variance)
    # One pair says nothing about the spread: three pairs' worth of belief in the starting jitter.
    pairs = float(p.sum())
    jitter2 = (float(p @ (squares - cut - own**2)) + 3 * 0.05**2) / (pairs + 3)
    # Where readings are cut to whole seconds, the little that is left of the variance is noise of its own.
    floor = max(MIN_JITTER_S, 0.05 * float(resolution.max()))
    # How badly the clock fits beyond its own model widens its sigmas.
    worse = max(1.0, float(weight @ squares) / max(pairs - 2, 1.0))
    return Clock(
        offset,
        drift,
        sqrt(min(max(jitter2, floor**2), MAX_JITTER_S**2)),
        sqrt(n_dd / determinant * worse),
        sqrt(n_oo / determinant),
    )

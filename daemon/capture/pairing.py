"""Which photo belongs to which trigger: pure, the same for the same input."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from daemon.capture.alignment import Aligned, Cells, align, coincident
from daemon.capture.clocks import (
    DRIFT_SIGMA,
    MAX_JITTER_S,
    Clock,
    Times,
    candidate_clocks,
    cells_of,
    fit,
    log_density_alone,
)
from daemon.capture.paths import LOG_PAIR, P_GAP, FloatArray
from daemon.capture.records import Alternative, ClockFit, KnownClock, Pair, Pairing, Shot, Trigger

#: Within this the same image index means the same message sent again.
_SAME_S = 1e-3
#: An unknown clock may be off by this much either way, in s (for the weight of "no pair at all").
_CLOCK_RANGE_S = 86_400.0
_MAX_ROUNDS = 4
#: Intervals shorter than so many times what a moment may be off by are searched beside the best clock.
_COARSE_STEPS = 4.0
#: So many triggers beside as many photos without each other speak against a clock.
_BOTH_ALONE = 2
_FITS, _NOT_TWICE = float(np.log(20.0)), float(np.log(100.0))
#: No camera's clock drifts by more; a fit that does pairs one step off from somewhere on.
_MOST_DRIFT = 3 * DRIFT_SIGMA
#: An intervalometer keeps its time so well over a whole flight; no aircraft does.
_ON_TIME_S = 0.08
#: A clock that pairs as many photos, and to within so many times the jitter, is not dismissed: this likely.
_AS_SHARP, _NOT_DISMISSED = 1.5, float(np.log(0.05))
#: So many photos' worth of belief in the loss assumed beforehand.
_BELIEF = 5.0
_INDEX_DISAGREES = float(np.log(0.1))


def without_repeats(triggers: Iterable[Trigger]) -> list[Trigger]:
    """Triggers sorted by time, each once.

    The same image index at the same exposure time is one shot reported again. An index that comes
    back at another time has been reset or stuck; then both stay, and their index is not believed.
    """
    kept: list[Trigger] = []
    for trigger in sorted(triggers, key=lambda each: each.time_s):
        recent = [k for k in kept[-8:] if abs(k.time_s - trigger.time_s) <= _SAME_S]
        if not any(k.image_index == trigger.image_index for k in recent):
            kept.append(trigger)
    counts: dict[int | None, int] = {}
    for trigger in kept:
        counts[trigger.image_index] = counts.get(trigger.image_index, 0) + 1
    return [t if counts[t.image_index] == 1 else replace(t, image_index=None) for t in kept]


def pair(
    triggers: Sequence[Trigger],
    shots: Sequence[Shot],
    *,
    known: KnownClock | None = None,
    anchors: Sequence[tuple[int, str]] = (),
) -> Pairing:
    """Pair triggers with photos.

    ``known``: the clock offset where it is known; ``anchors``: (trigger key, file name) of pairs the
    operator is sure of; either settles a flight of equal intervals. Repeated triggers are dropped
    (:func:`without_repeats`) and in no list of the result. Probabilities are over all alignments of
    all clocks that explain the times, the chance included that nothing fits.
    """
    ordered = without_repeats(triggers)
    photos = sorted(shots, key=lambda shot: (shot.time_s, shot.order, shot.name))
    if not ordered or not photos:
        return Pairing((), tuple(ordered), tuple(photos), None)
    known = known or _anchored(ordered, photos, anchors)
    times = _times(ordered, photos)
    counters = _counter_shift(ordered, photos)
    fits = [_refine(times, clock, counters, known) for clock in candidate_clocks(times, known)]
    fits = _distinct(_with_neighbours(fits, times, counters, known))
    if not fits:
        return Pairing((), tuple(ordered), tuple(photos), None)
    fits = _cautious(fits, len(photos))
    evidence = np.array([0.0, *(value for value, *_ in fits)])
    weights = np.exp(evidence - np.logaddexp.reduce(evidence))[1:]
    step_s = _constant_step_s(times.trigger_s) if known is None else None
    if step_s is not None:
        weights = weights / 3
    if known is None and abs(fits[0][1].drift) > _MOST_DRIFT:
        weights = weights / 2
    joint: dict[tuple[int, int], float] = {}
    for weight, (_, _, cells, aligned) in zip(weights.tolist(), fits, strict=True):
        for i, j, p in zip(
            cells.trigger.tolist(), cells.photo.tolist(), aligned.probability.tolist(), strict=True
        ):
            joint[i, j] = joint.get((i, j), 0.0) + weight * p
    _, clock, cells, aligned = fits[0]
    likely = aligned.probability > 0.5
    pairs = [
        Pair(ordered[i], photos[j], min(joint[i, j], 1.0))
        for i, j in zip(cells.trigger[likely].tolist(), cells.photo[likely].tolist(), strict=True)
    ]
    used, taken = {p.trigger.key for p in pairs}, {id(p.shot) for p in pairs}
    shift = times.photo_reference_s - times.reference_s
    offsets = np.array([other.offset_s for _, other, *_ in fits])
    if step_s is not None:
        offsets = np.concatenate([offsets, offsets[:1] + step_s, offsets[:1] - step_s])
        weights = np.concatenate([weights, weights[:1], weights[:1]])
    spread2 = float(weights @ (offsets - clock.offset_s) ** 2)
    return Pairing(
        tuple(pairs),
        tuple(t for t in ordered if t.key not in used),
        tuple(s for s in photos if id(s) not in taken),
        ClockFit(
            clock.offset_s + shift,
            float(np.sqrt(clock.offset_sigma_s**2 + spread2)),
            clock.drift,
            clock.drift_sigma,
            times.reference_s,
            clock.jitter_s,
        ),
        tuple(
            Alternative(float(offset + shift), float(weight))
            for offset, weight in zip(offsets, weights, strict=True)
            if weight > 1e-3
        ),
    )


def update(
    previous: Pairing,
    triggers: Sequence[Trigger] = (),
    shots: Sequence[Shot] = (),
    *,
    known: KnownClock | None = None,
    anchors: Sequence[tuple[int, str]] = (),
) -> Pairing:
    """Pair again with what has come since (photos of a card read late, triggers sent again).

    As :func:`renew`, with everything that was known then.
    """
    all_triggers = [p.trigger for p in previous.pairs] + [*previous.triggers_without_photo, *triggers]
    all_shots = [p.shot for p in previous.pairs] + [*previous.photos_without_trigger, *shots]
    return renew(previous, all_triggers, all_shots, known=known, anchors=anchors)


def renew(
    previous: Pairing,
    all_triggers: Sequence[Trigger],
    all_shots: Sequence[Shot],
    *,
    known: KnownClock | None = None,
    anchors: Sequence[tuple[int, str]] = (),
) -> Pairing:
    """Pair all triggers and photos, given an earlier pairing of some of them.

    The earlier clock, where it was sure, saves the search. Should that move a pair that was sure, or leave
    both triggers and photos alone, everything is paired anew: survey lines are alike, and a clock that is
    one line off explains the triggers of one line by the photos of another until more of both come.
    """
    clock = previous.clock
    if known is None and not anchors and all_triggers and clock is not None and not previous.ambiguous:
        moment = float(np.mean([t.time_s for t in all_triggers]))
        offset_s = clock.camera_s(moment) - moment
        sigma_s = clock.offset_sigma_s + clock.drift_sigma * abs(moment - clock.reference_s) + 0.1
        quick = pair(all_triggers, all_shots, known=KnownClock(offset_s, sigma_s))
        now = {(p.trigger.key, p.shot.name) for p in quick.sure_pairs}
        there = {t.key for t in all_triggers}, {s.name for s in all_shots}
        stays = all(
            (p.trigger.key, p.shot.name) in now
            for p in previous.sure_pairs
            if p.trigger.key in there[0] and p.shot.name in there[1]
        )
        alone = min(len(quick.triggers_without_photo), len(quick.photos_without_trigger))
        if stays and alone < _BOTH_ALONE:
            return quick
    return pair(all_triggers, all_shots, known=known, anchors=anchors)


def _constant_step_s(trigger_s: FloatArray) -> float | None:
    """The interval of an intervalometer, None where the triggers (n,) do not keep to one.

    Then every clock that is a step earlier or later explains the times as well: which photos and
    triggers are missing is chance, and by chance holes in both series fall together under one clock
    more often than under another.
    """
    intervals = np.diff(trigger_s)
    if len(intervals) < 2:
        return None
    step = float(np.median(intervals))
    count = np.concatenate([[0.0], np.cumsum(np.round(intervals / max(step, 1e-3)))])
    slope, start = np.polyfit(count, trigger_s, 1) if count[-1] > 0 else (0.0, 0.0)
    off = np.abs(trigger_s - start - slope * count)
    return float(slope) if float(off.max()) < _ON_TIME_S else None


def _times(triggers: Sequence[Trigger], photos: Sequence[Shot]) -> Times:
    trigger_s = np.array([t.time_s for t in triggers])
    photo_s = np.array([s.time_s for s in photos])
    resolution_s = np.maximum([s.resolution_s for s in photos], 1e-3)
    reference, photo_reference = float(trigger_s.mean()), float(np.floor(photo_s[0]))
    return Times(
        trigger_s - reference,
        np.array([t.sigma_s for t in triggers]),
        photo_s - photo_reference,
        resolution_s,
        log_density_alone(photo_s, resolution_s),
        reference,
        photo_reference,
    )


def _anchored(
    triggers: Sequence[Trigger], photos: Sequence[Shot], anchors: Sequence[tuple[int, str]]
) -> KnownClock | None:
    by_key, by_name = {t.key: t for t in triggers}, {s.name: s for s in photos}
    found = [(by_key[k], by_name[n]) for k, n in anchors if k in by_key and n in by_name]
    if not found:
        return None
    offsets = [shot.time_s + shot.resolution_s / 2 - trigger.time_s for trigger, shot in found]
    return KnownClock(float(np.median(offsets)), 0.1 + found[0][1].resolution_s / 4)


_Fit = tuple[float, Clock, Cells, Aligned]


def _refine(times: Times, clock: Clock, counters: FloatArray, known: KnownClock | None) -> _Fit:
    """EM: align, fit the clock to the pairs' probabilities, align again; then the counters' word."""
    n_t, n_p = len(times.trigger_s), len(times.photo_s)
    for _ in range(_MAX_ROUNDS):
        cells = cells_of(times, clock)
        aligned = align(cells, n_t, n_p)
        moved = fit(times, cells, aligned.probability, clock)
        settled = abs(moved.offset_s - clock.offset_s) < 0.1 * clock.jitter_s
        settled = settled and abs(moved.jitter_s / clock.jitter_s - 1) < 0.1
        clock = moved
        if settled:
            break
    cells = cells_of(times, clock)
    count, order = counters[cells.trigger, 0], counters[cells.photo, 1]
    if np.isfinite(count).any():
        objection = _counter_objection(count, order, align(cells, n_t, n_p))
        cells = replace(cells, log_weight=cells.log_weight + objection)
    # Of photos and triggers that fit each other singly, those that no alignment joins speak against a clock.
    fitting = coincident(cells)
    joined = align(replace(cells, log_weight=cells.log_weight + fitting * _FITS), n_t, n_p)
    evidence = joined.log_evidence - _FITS * float(fitting.sum())
    # How often this flight loses photos and triggers says how likely a lone photo beside a lone trigger
    # is. It moves the pairs only: clocks are compared under one and the same loss.
    more = _loss(cells, joined) + fitting * _NOT_TWICE * _resolvable(times, clock, cells)
    aligned = align(replace(cells, log_weight=cells.log_weight + more), n_t, n_p)
    # The clock had to be found: its posterior width over what was possible before (Occam's factor).
    width = np.sqrt(2 * np.pi) * clock.offset_sigma_s
    if known is None:
        prior = float(np.log(width / (2 * _CLOCK_RANGE_S)))
    else:
        offset_s = known.offset_s + times.reference_s - times.photo_reference_s
        sigma = float(np.hypot(known.sigma_s, clock.offset_sigma_s))
        off = (clock.offset_s - offset_s) / sigma
        prior = float(np.log(width / (np.sqrt(2 * np.pi) * sigma)) - off**2 / 2)
    return evidence + prior, clock, cells, aligned


def _with_neighbours(
    fits: list[_Fit], times: Times, counters: FloatArray, known: KnownClock | None
) -> list[_Fit]:
    """Also the clocks one usual interval beside the best, until the best lies between two that are worse.

    Where the interval is not much longer than what the photos' times are off by, the search by nearest photos
    can settle on a clock that is one photo off and pass the right one over.
    """
    step_s = float(np.median(np.diff(times.trigger_s))) if len(times.trigger_s) > 1 else 0.0
    coarse_s = float(times.resolution_s.max()) + DRIFT_SIGMA * float(np.ptp(times.trigger_s)) + MAX_JITTER_S
    if not 0 < step_s < _COARSE_STEPS * coarse_s:
        return fits
    found, done = list(fits), set[float]()
    while found and len(done) < _MAX_ROUNDS:
        best = max(found, key=lambda one: one[0])[1]
        if best.offset_s in done:
            break
        done.add(best.offset_s)
        for shift_s in (-step_s, step_s):
            start = best.offset_s + shift_s
            if all(abs(start - clock.offset_s) > step_s / 3 for _, clock, *_ in found):
                found.append(_refine(times, Clock(start, best.drift), counters, known))
    return found


def _loss(cells: Cells, aligned: Aligned) -> float:
    """Log of how much likelier a pair is against two lone ones than was assumed beforehand.

    From the shares that are lone between the first and the last pair, with a few observations' worth
    of belief in the loss assumed.
    """
    likely = aligned.probability > 0.5
    if likely.sum() < 2:
        return 0.0
    pairs = float(aligned.probability[likely].sum())
    lone = []
    for index in (cells.trigger, cells.photo):
        spanned = float(np.ptp(index[likely]) + 1)
        lone.append(max((spanned - pairs + _BELIEF * P_GAP) / (spanned + _BELIEF), 0.1 / pairs))
    return float(np.log((1 - max(lone)) / (lone[0] * lone[1]))) - LOG_PAIR


def _resolvable(times: Times, clock: Clock, cells: Cells) -> FloatArray:
    """How clearly (m,), 0 to 1, the times tell one exposure from the next one before or after it.

    No camera exposes twice at one moment: a lone photo where a lone trigger is, is their pair, but
    only where a moment is much shorter than the interval.
    """
    steps = [
        _least_step(series)[index]
        for series, index in ((times.trigger_s, cells.trigger), (times.photo_s, cells.photo))
    ]
    usual = float(np.median(np.diff(times.trigger_s))) if len(times.trigger_s) > 1 else 0.0
    interval = np.minimum(np.minimum(*steps), usual)
    moment = times.resolution_s[cells.photo] + 2 * clock.jitter_s
    clear: FloatArray = np.clip(interval / moment - 1, 0.0, 1.0)
    return clear


def _least_step(series_s: FloatArray) -> FloatArray:
    """Time (n,) from each to the nearer of its neighbours."""
    steps = np.concatenate([[np.inf], np.diff(series_s), [np.inf]])
    least: FloatArray = np.minimum(steps[:-1], steps[1:])
    return least


def _counter_shift(triggers: Sequence[Trigger], photos: Sequence[Shot]) -> FloatArray:
    """Counters (n, 2) of triggers and photos, NaN where there is none; n is the longer sequence."""
    table = np.full((max(len(triggers), len(photos)), 2), np.nan)
    for row, trigger in enumerate(triggers):
        count = trigger.completed_captures or trigger.image_index
        table[row, 0] = np.nan if count is None else count
    table[: len(photos), 1] = [shot.order for shot in photos]
    return table


def _counter_objection(count: FloatArray, order: FloatArray, aligned: Aligned) -> FloatArray:
    """Log factors (m,) against pairs whose counters part from those of their sure neighbours.

    File number minus image index is constant between jumps, so each pair is held against the
    median over its sure neighbours. Agreement proves nothing, because shifted pairs agree as well;
    and counters that disagree with each other all the time are not believed.
    """
    shift = order - count
    none = np.zeros(len(shift))
    sure = np.flatnonzero((aligned.probability > 0.9) & np.isfinite(shift))
    if len(sure) < 5:
        return none
    # The five sure pairs before each cell and the five after it: where a photo was not taken the
    # counters part, and next to such a place either side may be right.
    first = np.searchsorted(sure, np.arange(len(shift)))
    last = np.searchsorted(sure, np.arange(len(shift)), side="right")
    disagrees = np.isfinite(shift)
    for around in (first[:, None] - np.arange(1, 6), last[:, None] + np.arange(5)):
        expected = np.median(shift[sure][np.clip(around, 0, len(sure) - 1)], axis=1)
        disagrees &= np.abs(shift - expected) > 0.5
    if disagrees[sure].mean() > 0.2:
        return none
    return np.where(disagrees, _INDEX_DISAGREES, 0.0)


def _distinct(fits: list[_Fit]) -> list[_Fit]:
    """Best first; of clocks that have come to the same pairs only the best."""
    kept: list[tuple[_Fit, set[tuple[int, int]]]] = []
    for each in sorted(fits, key=lambda one: -one[0]):
        likely = each[3].probability > 0.5
        pairs = set(zip(each[2].trigger[likely].tolist(), each[2].photo[likely].tolist(), strict=True))
        if pairs and not any(2 * len(pairs & other) > min(len(pairs), len(other)) for _, other in kept):
            kept.append((each, pairs))
    return [each for each, _ in kept]


def _cautious(fits: list[_Fit], n_photos: int) -> list[_Fit]:
    """The clocks, best first, their log evidence brought nearer where the difference is mere chance.

    At equal intervals the noise of both clocks fits one shift a little better than another, and the
    likelihood takes that for proof. So over photos that are paired under both clocks a difference
    counts in full only where it is many times its own standard error (the idea of Vuong's test,
    Econometrica 57, 1989). Photos that fit one clock only are evidence, not chance.
    """
    shares = [
        np.bincount(cells.photo, weights=aligned.probability * cells.log_weight, minlength=n_photos)
        for _, _, cells, aligned in fits
    ]
    out: list[_Fit] = []
    for (value, clock, cells, aligned), share in zip(fits, shares, strict=True):
        both = (np.abs(shares[0]) > 1.0) & (np.abs(share) > 1.0)
        gap = (shares[0] - share)[both]
        common = float(gap.sum())
        chance2 = float(len(gap) * np.var(gap)) if len(gap) else 0.0
        believed = common**3 / (common**2 + 4 * chance2) if common else 0.0
        out.append((value + common - believed, clock, cells, aligned))
    best, *others = sorted(out, key=lambda one: -one[0])
    return [best, *sorted((_heeded(other, best) for other in others), key=lambda one: -one[0])]


def _heeded(other: _Fit, best: _Fit) -> _Fit:
    """Another clock, its log evidence raised where it explains as many pairs as well as the best does.

    Survey lines are alike to a hundredth of a second: where photos are missing in one and triggers in the
    next, an odd interval of the one may be the sum of two of the other, which speaks loudly for a clock that
    is a line off. The right clock then is not likelier, but it pairs more.
    """
    value, clock, _, aligned = other
    likely, most = (float((fit[3].probability > 0.5).sum()) for fit in (other, best))
    if value > 0 and likely >= most and clock.jitter_s <= _AS_SHARP * best[1].jitter_s:
        value = max(value, best[0] + _NOT_DISMISSED)
    return value, clock, other[2], aligned

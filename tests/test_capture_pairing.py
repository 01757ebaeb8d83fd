"""Pairing against simulated flights: error rates both ways, and whether probabilities are honest."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from capture_flights import fly, judge
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.pairing_flights import cut, flight
from daemon.capture.alignment import Cells, align, possible_pairs
from daemon.capture.pairing import pair, renew, update, without_repeats
from daemon.capture.paths import LOG_END, log_jump, path_sums
from daemon.capture.records import KnownClock, Shot, Trigger

EQUAL_S = 300 + 2.0 * np.arange(80)


@given(st.integers(1, 6), st.integers(1, 5), st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_sums_equal_the_enumeration_of_all_alignments(n_t: int, n_p: int, seed: int) -> None:
    weight = np.random.default_rng(seed).normal(0, 3, (n_t, n_p))
    total, joint = 0.0, np.zeros((n_t, n_p))
    for size in range(min(n_t, n_p) + 1):
        for rows in combinations(range(n_t), size):
            for columns in combinations(range(n_p), size):
                log_w = sum(weight[i, j] for i, j in zip(rows, columns, strict=True))
                ends = n_t + n_p
                if size:
                    ends = rows[0] + columns[0] + n_t - 1 - rows[-1] + n_p - 1 - columns[-1]
                jumps = zip(np.diff(rows) - 1, np.diff(columns) - 1, strict=True)
                log_w += sum(log_jump(int(h), int(g)) for h, g in jumps)
                value = float(np.exp(log_w + LOG_END * ends))
                total += value
                joint[list(rows), list(columns)] += value
    i, j = (a.ravel() for a in np.indices((n_t, n_p)))
    got = align(Cells(i, j, weight.ravel()), n_t, n_p)
    assert got.probability == pytest.approx((joint / total).ravel(), abs=1e-9)
    assert got.log_evidence == pytest.approx(np.log(total) - LOG_END * (n_t + n_p), abs=1e-9)


def test_sums_over_a_long_band_equal_each_path_added_up() -> None:
    """Weights that grow beyond what a float holds, rows of losses on either side, narrow windows."""
    rng = np.random.default_rng(3)
    trigger_s = np.delete(np.cumsum(rng.uniform(0.5, 2.0, 260)), np.s_[60:75])
    photo_s = np.delete(np.cumsum(rng.uniform(0.5, 2.0, 250)), np.s_[140:170])
    i, j = possible_pairs(trigger_s, photo_s, np.zeros(len(photo_s)), 2.5)
    weight = rng.normal(4, 6, len(i))
    out = np.empty(len(i))
    for k in range(len(i)):
        h, g = i[k] - i[:k] - 1, j[k] - j[:k] - 1
        earlier = np.flatnonzero((h >= 0) & (g >= 0))
        jumps = [log_jump(int(h[n]), int(g[n])) for n in earlier]
        out[k] = weight[k] + np.logaddexp.reduce([LOG_END * (i[k] + j[k]), *(out[earlier] + jumps)])
    assert out.max() > 1000
    assert path_sums(i, j, weight) == pytest.approx(out, abs=1e-8)


@pytest.mark.parametrize("resolution_s", [1.0, 0.01])
def test_probabilities_are_honest_over_many_flights(resolution_s: float) -> None:
    """Of those above 0.99 at most 1 % wrong (here: 0.1 %), and at least 95 % of the right ones there."""
    right = wrong = there = 0
    believed, true = [], []
    for seed in range(16):
        flight = fly(
            seed, 40 + 12 * seed, resolution_s=resolution_s, drop=0.02 if seed % 2 else 0.1, repeats=seed
        )
        result = pair(flight.triggers, flight.shots)
        r, w, n = judge(flight, result)
        right, wrong, there = right + r, wrong + w, there + n
        key_at = {t.time_s: t.key for t in reversed(flight.triggers) if t.key < 100_000}
        for p in result.pairs:
            believed.append(p.probability)
            true.append(flight.truth.get(p.shot.name) == key_at[p.trigger.time_s])
    assert wrong <= 0.001 * (right + wrong)
    assert right >= 0.95 * there
    # All pairs together: as many wrong as the probabilities say, within chance and caution.
    expected_wrong = float(np.sum(1 - np.array(believed)))
    assert sum(not t for t in true) <= 2 * expected_wrong + 3


@given(
    st.integers(0, 2**32 - 1),
    st.integers(20, 120),
    st.sampled_from([1.0, 0.1, 0.001]),
    st.floats(-1e-4, 1e-4),
    st.floats(0, 0.15),
    st.integers(0, 8),
)
@settings(max_examples=12, deadline=None)
def test_any_flight(seed: int, n: int, resolution_s: float, drift: float, drop: float, extra: int) -> None:
    flight = fly(seed, n, resolution_s=resolution_s, drift=drift, drop=drop, extra=extra)
    result = pair(flight.triggers, flight.shots)
    right, wrong, _ = judge(flight, result)
    assert wrong <= 0.01 * (right + wrong)
    # Every trigger and every photo is in exactly one list, and pairs do not cross.
    triggers = [p.trigger.key for p in result.pairs] + [t.key for t in result.triggers_without_photo]
    names = [p.shot.name for p in result.pairs] + [s.name for s in result.photos_without_trigger]
    assert sorted(triggers) == sorted(t.key for t in flight.triggers)
    assert sorted(names) == sorted(s.name for s in flight.shots)
    keys = [p.trigger.time_s for p in result.pairs]
    assert keys == sorted(keys)
    assert [p.shot.order for p in result.pairs] == sorted(p.shot.order for p in result.pairs)
    assert all(0 <= p.probability <= 1 for p in result.pairs)


@pytest.mark.parametrize("resolution_s", [1.0, 0.01])
def test_clock_within_its_sigmas(resolution_s: float) -> None:
    offsets, drifts = [], []
    for seed in range(12):
        flight = fly(seed, 250, resolution_s=resolution_s, late_s=0.0)
        clock = pair(flight.triggers, flight.shots).clock
        assert clock is not None
        middle = clock.reference_s
        truth = flight.offset_s + flight.drift * (middle - flight.reference_s)
        offsets.append((clock.offset_s - truth) / clock.offset_sigma_s)
        drifts.append((clock.drift - flight.drift) / clock.drift_sigma)
        assert abs(clock.offset_s - truth) < 0.1
    for scores in (offsets, drifts):
        assert 0.2 < np.sqrt(np.mean(np.square(scores))) < 2.0


@pytest.mark.parametrize("resolution_s", [1.0, 0.01])
@pytest.mark.parametrize("drop", [0.0, 0.02])
def test_equal_intervals_are_not_called_sure(resolution_s: float, drop: float) -> None:
    """But one photo of the clock, or one known pair, settles them."""
    flight = fly(4, times_s=EQUAL_S, resolution_s=resolution_s, drop=drop, extra=0)
    result = pair(flight.triggers, flight.shots)
    assert not result.sure_pairs
    assert result.ambiguous
    assert "one photo of the vehicle's clock" in result.advice
    assert max(p.probability for p in result.pairs) < 0.95
    known = pair(flight.triggers, flight.shots, known=KnownClock(flight.offset_s, 0.2))
    name, key = next(iter(flight.truth.items()))
    anchored = pair(flight.triggers, flight.shots, anchors=[(key, name)])
    for settled in (known, anchored):
        right, wrong, there = judge(flight, settled)
        assert right >= 0.9 * there
        assert wrong == 0


def test_a_line_whose_odd_steps_are_sums_of_another_lines_is_not_called_sure() -> None:
    """The link is cut in the second of two lines that were flown alike to the hundredth of a second.

    The triggers of the first line fit six photos of the second, odd steps among them, and eight of their own.
    """
    first_line = [24.26, 27.56, 30.02, 32.48, 34.94, 37.40, 39.86, 43.08]
    cut_off = [53.12, 58.88, 61.34, 63.80, 68.72, 71.94, 77.30, 88.08]
    triggers = [Trigger(k, at_s, image_index=k) for k, at_s in enumerate(first_line)]
    triggers.append(Trigger(16, 98.86, image_index=16))
    times_s = [*first_line[1:], *cut_off, 98.86]
    shots = [Shot(f"DSC{18 + k:05d}.JPG", 5e5 + at_s, 0.01, 18 + k) for k, at_s in enumerate(times_s)]
    truth = {shot.name: k + 1 for k, shot in enumerate(shots)}
    blind = pair(triggers, shots)
    assert all(truth[p.shot.name] == p.trigger.key for p in blind.sure_pairs)
    assert blind.sure_pairs or blind.ambiguous
    anchored = pair(triggers, shots, anchors=[(3, shots[2].name)])
    assert 7 <= len(anchored.sure_pairs) <= 8
    assert all(truth[p.shot.name] == p.trigger.key for p in anchored.sure_pairs)


def test_a_clock_that_drifts_as_none_does_is_not_believed() -> None:
    """Steps of 1.01 s and whole seconds: a fit of 480 ppm slips by one photo within the flight."""
    one = flight(1788)
    result = pair(one.triggers, cut(one.shots, 1.0))
    wrong = [p for p in result.sure_pairs if one.truth.get(p.shot.name) != p.trigger.key]
    assert len(wrong) <= 1
    assert result.sure_pairs or result.ambiguous
    sharp = pair(one.triggers, cut(one.shots, 0.01))
    assert len(sharp.sure_pairs) >= 480
    assert all(one.truth.get(p.shot.name) == p.trigger.key for p in sharp.sure_pairs)


def test_late_photos_join_without_disturbing_sure_pairs() -> None:
    for seed in range(4):
        flight = fly(seed, 150)
        rng = np.random.default_rng(seed)
        late = set(rng.choice(len(flight.shots), 30, replace=False).tolist())
        early = [s for k, s in enumerate(flight.shots) if k not in late]
        first = pair(flight.triggers, early)
        second = update(first, shots=[s for k, s in enumerate(flight.shots) if k in late])
        whole = pair(flight.triggers, flight.shots)
        pairs = {(p.trigger.key, p.shot.name) for p in second.sure_pairs}
        assert {(p.trigger.key, p.shot.name) for p in first.sure_pairs} <= pairs
        # At the border of sureness a pair may stand on either side of it.
        assert len(pairs ^ {(p.trigger.key, p.shot.name) for p in whole.sure_pairs}) <= 2
        assert judge(flight, second)[1] == 0


def test_repeated_feedback_is_one_trigger_and_a_stuck_index_is_not_believed() -> None:
    shot = Trigger(0, 10.0, image_index=7)
    again = [replace(shot, key=k) for k in range(1, 100)]
    (only,) = without_repeats([shot, *again])
    assert only.image_index == 7
    stuck = without_repeats([Trigger(k, 10.0 + k, image_index=7) for k in range(5)])
    assert len(stuck) == 5
    assert {t.image_index for t in stuck} == {None}


def test_a_lying_image_index_does_no_harm() -> None:
    flight = fly(11, 150)
    rng = np.random.default_rng(0)
    jumping = [
        replace(t, image_index=(t.image_index or 0) + (40 if t.key > 70 else 0)) for t in flight.triggers
    ]
    nonsense = [replace(t, image_index=int(rng.integers(1, 10**6))) for t in flight.triggers]
    for triggers in (jumping, nonsense):
        right, wrong, there = judge(flight, pair(triggers, flight.shots))
        assert wrong == 0
        assert right >= 0.95 * there


def test_different_flights_are_not_paired_surely() -> None:
    sure = 0
    for seed in range(6):
        ours, other = fly(seed, 60, resolution_s=0.01), fly(seed + 100, 60, resolution_s=0.01)
        sure += len(pair(ours.triggers, other.shots).sure_pairs)
    assert sure == 0


def test_few_or_none() -> None:
    assert pair([], []).pairs == ()
    assert pair([Trigger(0, 1.0)], []).triggers_without_photo == (Trigger(0, 1.0),)
    assert not pair([Trigger(0, 1.0)], [Shot("a", 50.0)]).sure_pairs
    known = pair([Trigger(0, 1.0)], [Shot("a", 50.0, 0.01)], known=KnownClock(49.0, 0.05))
    assert [p.shot.name for p in known.pairs] == ["a"]


def test_a_thousand_photos_in_two_cpu_seconds() -> None:
    flight = fly(3, 1000)
    before = time.process_time()
    result = pair(flight.triggers, flight.shots)
    assert time.process_time() - before < 2.0
    assert judge(flight, result)[0] > 0.95 * len(flight.truth)


@pytest.mark.parametrize(("seed", "resolution_s"), [(608, 1.0), (740, 0.01), (1311, 1.0)])
def test_short_intervals_are_not_paired_one_off(seed: int, resolution_s: float) -> None:
    """Photos every 1.05 s with pauses, or every 1.5 s with many alike lines: wrong clocks nearly fit."""
    one = flight(seed)
    sure = pair(one.triggers, cut(one.shots, resolution_s)).sure_pairs
    assert len(sure) > 100
    assert all(one.truth.get(p.shot.name) == p.trigger.key for p in sure)


def test_a_clock_that_was_one_line_off_is_given_up() -> None:
    """Two equal lines; of the first only photos came, of the second first triggers: then the photos come."""
    line = np.concatenate([[0.0, 2.9], 2.9 + 1.92 * np.arange(1, 10), [22.9]])
    exposed = np.concatenate([20 + line, 53 + line, [90.0, 102.0, 114.0]])
    shots = [Shot(f"{k:03d}.JPG", float(np.floor(t + 2856.7)), 1.0, k) for k, t in enumerate(exposed)]
    triggers = [Trigger(k, t, 0.02, k + 1) for k, t in enumerate(exposed.tolist())][len(line) :]
    early = pair(triggers[: len(line)], shots[: len(line)])
    assert [p.shot.name for p in early.pairs] == [s.name for s in shots[: len(line)]]
    late = renew(early, triggers, shots)
    assert {(p.trigger.key, p.shot.order) for p in late.sure_pairs} == {(t.key, t.key) for t in triggers}


def test_a_cut_link_leaves_the_clock_that_explains_the_triggers_on_both_sides_of_it() -> None:
    """Equal lines; triggers of the first and of the last stops. One line off, more photos would be lone."""
    line = np.concatenate([[0.0, 2.5], 2.5 + 1.28 * np.arange(1, 19), [27.9]])
    exposed = np.concatenate([24.1 + line, 62.9 + line, 96.1 + 12.48 * np.arange(4)])
    shots = [Shot(f"{k:03d}.JPG", float(np.round(t - 3469.036, 2)), 0.01, k) for k, t in enumerate(exposed)]
    del shots[28], shots[26]
    triggers = [Trigger(k, t, 0.02, k + 1) for k, t in enumerate(exposed.tolist())]
    heard = [*triggers[:13], *triggers[-4:]]
    assert {(p.trigger.key, p.shot.order) for p in pair(heard, shots).sure_pairs} == {
        (t.key, t.key) for t in heard
    }

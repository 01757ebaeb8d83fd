"""Simulated flights with known truth for the pairing tests."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from daemon.capture.records import Pairing, Shot, Trigger


@dataclass(frozen=True)
class Flight:
    """Triggers, photos, and the truth: photo name -> trigger key (photos of lone shots missing)."""

    triggers: list[Trigger]
    shots: list[Shot]
    truth: dict[str, int]
    offset_s: float
    drift: float
    reference_s: float


def exposures(rng: np.random.Generator, n: int, interval_s: float, wind: float = 0.06) -> np.ndarray:
    """Exposure times (n,) of survey lines: near-equal steps with wind, and turns of unequal length."""
    steps = interval_s * (1 + wind * rng.standard_normal(n))
    per_line = int(rng.integers(8, 25))
    turn = rng.uniform(6, 12) * (1 + 0.1 * rng.standard_normal(n))
    steps[per_line::per_line] = turn[per_line::per_line]
    return 300.0 + np.cumsum(np.maximum(steps, 0.3 * interval_s))


def fly(
    seed: int,
    n: int = 150,
    *,
    interval_s: float = 2.2,
    resolution_s: float = 1.0,
    drift: float = 80e-6,
    offset_s: float | None = None,
    drop: float = 0.02,
    extra: int = 5,
    late_s: float = 0.03,
    repeats: int = 0,
    times_s: np.ndarray | None = None,
) -> Flight:
    """One flight; ``drop`` is the share lost on either side, ``extra`` the test shots before it."""
    rng = np.random.default_rng(seed)
    moments = exposures(rng, n, interval_s) if times_s is None else times_s
    n = len(moments)
    offset = float(rng.uniform(-12, 12) * 3600 + 18) if offset_s is None else offset_s
    tests = moments[0] - 20 - np.sort(rng.uniform(0, 60, extra))[::-1]
    everything = np.concatenate([tests, moments])
    late = np.abs(late_s * rng.standard_normal(len(everything)))
    reference = float(moments[0])
    camera = everything + late + offset + drift * (everything - reference)
    reading = np.floor(camera / resolution_s) * resolution_s
    shots, truth = [], {}
    for k, moment in enumerate(reading):
        if k >= extra and rng.random() < drop:
            continue
        name = f"DSC{k + 1:05d}.JPG"
        shots.append(Shot(name, float(moment), resolution_s, k + 1))
        if k >= extra:
            truth[name] = k - extra
    triggers = []
    for k, moment in enumerate(moments):
        if rng.random() < drop:
            truth.pop(f"DSC{k + extra + 1:05d}.JPG", None)
            continue
        measured = float(moment + 0.01 * rng.standard_normal())
        triggers.append(Trigger(k, measured, 0.02, k + 1))
    for _ in range(repeats):
        again = triggers[int(rng.integers(len(triggers)))]
        triggers.append(replace(again, key=100_000 + len(triggers)))
    return Flight(triggers, shots, truth, offset, drift, reference)


def judge(flight: Flight, pairing: Pairing) -> tuple[int, int, int]:
    """Number of sure pairs that are right, of sure pairs that are wrong, and of pairs there are."""
    # A repeat that came first in the list has its own key but its original's time.
    key_at = {t.time_s: t.key for t in reversed(flight.triggers) if t.key < 100_000}
    right = sum(flight.truth.get(p.shot.name) == key_at[p.trigger.time_s] for p in pairing.sure_pairs)
    return right, len(pairing.sure_pairs) - right, len(flight.truth)

"""Random flights for the pairing campaign: triggers, photos, and which belongs to which.

Everything that disturbs a real flight is drawn for each flight anew: its length, how it is flown
(lines with turns, orbits with pauses, bursts, an intervalometer), wind, late exposures, losses on
either side one by one or in a row, test shots, offset and drift of the camera's clock.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.camera import FloatArray
from daemon.capture.records import Shot, Trigger

LONGEST, MOST_LOST, MOST_LATE_S = 600, 0.15, 0.2
OFFSET_S, DRIFT = 3600.0, 200e-6
#: An interval this many times the usual one is a turn or a pause.
PAUSE = 1.5
KINDS = ("lines", "orbits", "bursts", "constant")
_SHARES = (0.55, 0.2, 0.15, 0.1)


@dataclass(frozen=True)
class Flight:
    """``exposed_s`` (n,): true exposures on the vehicle's clock; ``truth``: file name -> trigger key,
    where both are there. ``shots`` have times to the millisecond: :func:`cut` rounds them off."""

    kind: str
    exposed_s: FloatArray
    triggers: tuple[Trigger, ...]
    shots: tuple[Shot, ...]
    truth: dict[str, int]
    offset_s: float

    @property
    def has_pause(self) -> bool:
        """Whether any interval between triggers stands out: only then can the times settle a clock."""
        steps = np.diff([t.time_s for t in self.triggers])
        return len(steps) > 1 and bool(steps.max() > PAUSE * np.median(steps))


def cut(shots: tuple[Shot, ...], resolution_s: float) -> list[Shot]:
    """The photos with their times cut off as EXIF does."""
    return [
        replace(s, time_s=float(np.floor(s.time_s / resolution_s) * resolution_s), resolution_s=resolution_s)
        for s in shots
    ]


def flight(seed: int) -> Flight:
    """The flight of a seed, always the same."""
    rng = np.random.default_rng([20, seed])
    n = int(rng.integers(1, LONGEST + 1))
    kind = str(rng.choice(KINDS, p=_SHARES))
    moments = 300.0 + _moments(rng, kind, n)
    late = rng.uniform(0, rng.uniform(0, MOST_LATE_S), n)
    exposed = moments + late
    # Test shots on the ground that no trigger knows.
    tests = moments[0] - 15 - np.sort(rng.uniform(0, 90, int(rng.integers(0, 6))))[::-1]
    everything = np.concatenate([tests, exposed])
    offset, drift = float(rng.uniform(-OFFSET_S, OFFSET_S)), float(rng.uniform(-DRIFT, DRIFT))
    camera = 1.6e9 + everything + offset + drift * (everything - moments[0])
    lost_photo, lost_trigger = _lost(rng, n), _lost(rng, n)
    # A lost photo was either not taken (files are numbered on) or its file is gone (a number is missing).
    untaken = bool(rng.random() < 0.5)
    indexed = bool(rng.random() < 0.7)
    shots, number = [], int(rng.integers(1, 9000))
    for k, moment in enumerate(camera.tolist()):
        place = k - len(tests)
        missing = place >= 0 and lost_photo[place]
        if not missing:
            shots.append(Shot(f"DSC{number:05d}.JPG", round(moment, 3), 1e-3, number))
        number += 0 if missing and untaken else 1
    names = iter(shots[len(tests) :])
    name_of = {k: next(names).name for k in range(n) if not lost_photo[k]}
    triggers = [
        Trigger(k, float(moment + 0.01 * rng.standard_normal()), 0.02, k + 1 if indexed else None)
        for k, moment in enumerate(moments.tolist())
        if not lost_trigger[k]
    ]
    truth = {name: k for k, name in name_of.items() if not lost_trigger[k]}
    return Flight(kind, exposed, tuple(triggers), tuple(shots), truth, 1.6e9 + offset)


def _moments(rng: np.random.Generator, kind: str, n: int) -> FloatArray:
    """Trigger times (n,) from 0 on."""
    interval = float(rng.uniform(0.8, 5.0))
    if kind == "constant":
        # An intervalometer: to the millisecond, without a turn.
        steps = np.full(n, round(interval, 1)) + 0.001 * rng.standard_normal(n)
        return np.cumsum(steps)
    wind = rng.uniform(0.01, 0.15)
    if kind == "orbits":
        # Steps change slowly round the circle with head and tail wind, and there is a pause between circles.
        per_circle = int(rng.integers(12, 60))
        phase = 2 * np.pi * np.arange(n) / per_circle
        steps = interval * (1 + wind * np.sin(phase) + 0.02 * rng.standard_normal(n))
        pause = np.arange(n) % per_circle == per_circle - 1
        steps[pause] += rng.uniform(3, 20, n)[pause]
        return np.cumsum(np.maximum(steps, 0.3 * interval))
    # Survey lines: against the wind slower than with it, gusts, turns of unequal length.
    per_line = int(rng.integers(5, 30))
    line = np.arange(n) // per_line
    steps = interval * (1 + wind * (-1.0) ** line + 0.04 * rng.standard_normal(n))
    turn = np.arange(n) % per_line == per_line - 1
    steps[turn] = (rng.uniform(4, 15) * (1 + 0.1 * rng.standard_normal(n)))[turn]
    if rng.random() < 0.3:  # a battery swap, a wait for a gust, a pause of the pilot's
        steps[int(rng.integers(n))] += rng.uniform(10, 900)
    if kind == "bursts":
        for start in rng.integers(0, n, max(1, n // 40)).tolist():
            steps[start : start + int(rng.integers(2, 6))] = rng.uniform(0.4, 1.0)
    return np.cumsum(np.maximum(steps, 0.3))


def _lost(rng: np.random.Generator, n: int) -> np.ndarray:
    """Which of (n,) are lost: up to 15 %, singly, in a row, or at an end."""
    lost = np.zeros(n, dtype=bool)
    count = round(rng.uniform(0, MOST_LOST) * n)
    how = rng.random()
    if how < 0.6:
        lost[rng.choice(n, count, replace=False)] = True
    else:
        start = int(rng.integers(0, n - count + 1)) if how < 0.8 else (0 if how < 0.9 else n - count)
        lost[start : start + count] = True
    return lost

"""What the vehicle believes of its place: the truth, and the errors of a GNSS receiver."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field

#: A receiver works its place out so often (s).
FIX_S = 0.2
#: Heights are worse than places on the ground.
VERTICAL = 1.6
#: A slow error is forgotten over this time.
DRIFT_S = 200.0
#: Sizes (m, on the ground) and lengths (s) of jumps.
JUMP_M, JUMP_S = (3.0, 8.0), (4.0, 25.0)
#: At full health a receiver states this much, if nobody says otherwise.
_USUAL_M = (1.5, 2.5)

Place = tuple[float, float, float]


def plus(one: tuple[float, ...], other: tuple[float, ...]) -> Place:
    """One place or way and another."""
    return (one[0] + other[0], one[1] + other[1], one[2] + other[2])


@dataclass(frozen=True)
class Gnss:
    """Errors in m on each horizontal axis, :data:`VERTICAL` times that in height.

    ``noise_m``: white, fix by fix. ``drift_m``: a bias that wanders (first-order Gauss-Markov,
    :data:`DRIFT_S`), there from the start. ``jump_every_s``: so often on average (Poisson) the place jumps
    away by :data:`JUMP_M` for :data:`JUMP_S` and back; velocity and stated accuracy do not show it.
    ``stated_share``: accuracies told, as a share of the true standard deviation of noise and drift.
    ``accuracies``: False: a receiver that tells dilutions (HDOP) and no accuracies.
    """

    noise_m: float = 0.0
    drift_m: float = 0.0
    jump_every_s: float | None = None
    stated_share: float = 1.0
    accuracies: bool = True

    @property
    def stated_m(self) -> tuple[float, float]:
        """Horizontal and vertical accuracy as told; without errors what good receivers say."""
        sigma_m = math.hypot(self.noise_m, self.drift_m)
        if sigma_m == 0:
            return _USUAL_M
        return self.stated_share * sigma_m, self.stated_share * VERTICAL * sigma_m


@dataclass
class Receiver:
    """``error_m``: what the autopilot's estimate of its place is off by now, noise included; ``bias_m``:
    without noise, which is what the autopilot flies and triggers by."""

    gnss: Gnss
    rng: random.Random
    bias_m: Place = (0.0, 0.0, 0.0)
    error_m: Place = (0.0, 0.0, 0.0)
    jumps: int = 0
    _drift_m: Place = field(default=(0.0, 0.0, 0.0))
    _jump_m: Place = field(default=(0.0, 0.0, 0.0))
    _jump_until_s: float = -1.0
    _next_fix_s: float = -1.0
    _now_s: float = 0.0

    def __post_init__(self) -> None:
        self._drift_m = self._normal(self.gnss.drift_m)
        self.bias_m = self.error_m = self._drift_m

    @property
    def jumped(self) -> bool:
        """Whether its place is away now."""
        return any(self._jump_m)

    def told_m(self, at_m: Place) -> Place:
        """Where a vehicle that is at ``at_m`` says that it is."""
        return plus(at_m, self.error_m)

    def step(self, dt_s: float) -> None:
        gnss = self.gnss
        self._now_s += dt_s
        if gnss.drift_m == 0 and gnss.noise_m == 0 and gnss.jump_every_s is None:
            return
        if self._now_s < self._next_fix_s:
            return
        self._next_fix_s = self._now_s + FIX_S - 1e-9
        kept = math.exp(-FIX_S / DRIFT_S)
        fresh = self._normal(gnss.drift_m * math.sqrt(1 - kept * kept))
        self._drift_m = plus(tuple(kept * one for one in self._drift_m), fresh)
        self._jump()
        self.bias_m = plus(self._drift_m, self._jump_m)
        self.error_m = plus(self.bias_m, self._normal(gnss.noise_m))

    def _jump(self) -> None:
        if self._now_s < self._jump_until_s:
            return
        self._jump_m = (0.0, 0.0, 0.0)
        every_s = self.gnss.jump_every_s
        if every_s is not None and self.rng.random() < FIX_S / every_s:
            size, course = self.rng.uniform(*JUMP_M), self.rng.uniform(0, 2 * math.pi)
            up = self.rng.uniform(-0.5, 0.5) * size
            self._jump_m = (size * math.sin(course), size * math.cos(course), up)
            self._jump_until_s = self._now_s + self.rng.uniform(*JUMP_S)
            self.jumps += 1

    def _normal(self, sigma_m: float) -> Place:
        if sigma_m == 0:
            return (0.0, 0.0, 0.0)
        gauss = self.rng.gauss
        return (gauss(0, sigma_m), gauss(0, sigma_m), gauss(0, VERTICAL * sigma_m))

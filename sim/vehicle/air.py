"""Wind, as a multirotor that holds its track feels it: it leans into the air and sways with the gusts."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field

#: Lean into the air's drag, degrees per m/s.
LEAN_DEG_S_M = 0.8
GRAVITY_M_S2 = 9.81
#: The fastest through the air; against the wind so much less over ground.
MOST_AIRSPEED_M_S = 16.0
LEAST_GROUND_SPEED_M_S = 0.5
#: How long a gust lasts (Dryden's low-altitude lengths, 50-100 m, carried past at 5-10 m/s, are longer; those
#: are followed, the shorter part is what displaces).
_GUST_S = 3.0
#: Vertical gusts are weaker near the ground.
_VERTICAL_SHARE = 0.35
#: Position control against what the gusts push: natural frequency (rad/s) and damping.
_CONTROL_RAD_S, _DAMPING = 1.2, 0.7
#: Below this height over the launch the sway fades out: on the ground nothing moves.
_FREE_HEIGHT_M = 3.0

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Wind:
    """``mean_m_s`` blowing from ``from_deg`` (clockwise from north); ``gust_m_s``: standard deviation of the
    gusts on each horizontal axis, a first-order Gauss-Markov process."""

    mean_m_s: float = 0.0
    from_deg: float = 270.0
    gust_m_s: float = 0.0

    @property
    def calm(self) -> bool:
        return self.mean_m_s == 0 and self.gust_m_s == 0


@dataclass
class Air:
    """The wind now, and what it does to the vehicle: ``sway_m`` off its track, ``sway_m_s`` the speed of that
    (east, north, up). The mean wind displaces nothing: control takes it out."""

    wind: Wind
    rng: random.Random
    gust_m_s: Vector = (0.0, 0.0, 0.0)
    sway_m: Vector = (0.0, 0.0, 0.0)
    sway_m_s: Vector = (0.0, 0.0, 0.0)
    _started: bool = field(default=False)

    @property
    def wind_m_s(self) -> Vector:
        """Velocity of the air, east, north, up."""
        towards = math.radians(self.wind.from_deg + 180)
        mean = self.wind.mean_m_s
        east, north, up = self.gust_m_s
        return (mean * math.sin(towards) + east, mean * math.cos(towards) + north, up)

    def step(self, dt_s: float, height_m: float) -> None:
        """Let time pass for a vehicle so high over its launch."""
        if self.wind.calm:
            return
        size = self.wind.gust_m_s
        sizes = (size, size, _VERTICAL_SHARE * size)
        kept = math.exp(-dt_s / _GUST_S) if self._started else 0.0
        fresh, self._started = math.sqrt(1 - kept * kept), True
        gust = [
            kept * g + fresh * s * self.rng.gauss(0, 1) for g, s in zip(self.gust_m_s, sizes, strict=True)
        ]
        self.gust_m_s = (gust[0], gust[1], gust[2])
        if height_m <= 0.05:
            self.sway_m = self.sway_m_s = (0.0, 0.0, 0.0)
            return
        push = GRAVITY_M_S2 * math.tan(math.radians(LEAN_DEG_S_M))  # m/s2 for each m/s of air
        free = min(1.0, height_m / _FREE_HEIGHT_M)
        speeds = [
            v + dt_s * (free * push * g - 2 * _DAMPING * _CONTROL_RAD_S * v - _CONTROL_RAD_S**2 * x)
            for g, v, x in zip(self.gust_m_s, self.sway_m_s, self.sway_m, strict=True)
        ]
        places = [x + dt_s * v for x, v in zip(self.sway_m, speeds, strict=True)]
        self.sway_m_s, self.sway_m = (speeds[0], speeds[1], speeds[2]), (places[0], places[1], places[2])

    def lean_deg(self, yaw_deg: float) -> tuple[float, float]:
        """What the wind adds to (pitch, roll) of a vehicle with this heading: it leans against it."""
        east, north, _ = self.wind_m_s
        nose = math.radians(yaw_deg)
        ahead = east * math.sin(nose) + north * math.cos(nose)
        right = east * math.cos(nose) - north * math.sin(nose)
        return LEAN_DEG_S_M * ahead, -LEAN_DEG_S_M * right

    def ground_speed_m_s(self, wanted_m_s: float, way: Vector) -> float:
        """As far as the vehicle can fly so fast along ``way`` through this air."""
        east, north, _ = self.wind_m_s
        along = east * way[0] + north * way[1]
        return min(wanted_m_s, max(MOST_AIRSPEED_M_S + along, LEAST_GROUND_SPEED_M_S))

"""Where the vehicle is and where it looks: kinematics with limits, no forces."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field

from sim.vehicle.air import GRAVITY_M_S2, LEAN_DEG_S_M, Air
from sim.vehicle.options import VehicleOptions
from sim.vehicle.receiver import Place, plus


@dataclass
class Body:
    """East, north, up of home in m. ``track_m``: where it would be without gusts; ``at_m``: where it is.
    ``goal_m``: flown to on a straight line, passed at ``end_m_s``. ``error_m``: what it believes of its
    place, off the truth.

    Yaw and gimbal turn at limited rates towards their goals; ``look_at_m`` (a point of interest)
    goes before both. ``gimbal_yaw_deg`` is relative to the nose.
    """

    options: VehicleOptions
    rng: random.Random = field(default_factory=lambda: random.Random(0))
    track_m: Place = (0.0, 0.0, 0.0)
    speed_m_s: float = 0.0
    way: Place = (0.0, 0.0, 0.0)
    goal_m: Place | None = None
    end_m_s: float = 0.0
    cruise_m_s: float = 0.0
    yaw_deg: float = 0.0
    yaw_goal_deg: float = 0.0
    gimbal_pitch_deg: float = 0.0
    gimbal_pitch_goal_deg: float = 0.0
    look_at_m: Place | None = None
    lean_deg: float = 0.0
    roll_deg: float = 0.0
    error_m: Place = (0.0, 0.0, 0.0)
    flown_m: float = field(default=0.0)

    def __post_init__(self) -> None:
        self.cruise_m_s = self.cruise_m_s or self.options.cruise_m_s
        self.air = Air(self.options.wind, self.rng)
        self._lean_flight_deg = 0.0

    @property
    def at_m(self) -> Place:
        return plus(self.track_m, self.air.sway_m)

    @property
    def believed_m(self) -> Place:
        return plus(self.at_m, self.error_m)

    @property
    def velocity_m_s(self) -> Place:
        along = (self.way[0] * self.speed_m_s, self.way[1] * self.speed_m_s, self.way[2] * self.speed_m_s)
        return plus(along, self.air.sway_m_s)

    @property
    def arrived(self) -> bool:
        return self.goal_m is None or math.dist(self.track_m, self.goal_m) < 1e-6

    @property
    def turned(self) -> bool:
        return abs(turn_deg(self.yaw_deg, self.yaw_goal_deg)) < 2.0

    def fly_to(self, goal_m: Place, end_m_s: float = 0.0) -> None:
        self.goal_m, self.end_m_s = goal_m, end_m_s

    def hold(self) -> None:
        """Stand still at once (the braking distance is not modelled)."""
        self.goal_m, self.speed_m_s = None, 0.0

    def course_deg(self, goal_m: Place) -> float | None:
        """Direction of flight to a goal; None straight up or down."""
        east, north = goal_m[0] - self.at_m[0], goal_m[1] - self.at_m[1]
        return math.degrees(math.atan2(east, north)) % 360 if math.hypot(east, north) > 0.5 else None

    def step(self, dt_s: float) -> None:
        before = self.speed_m_s
        self.air.step(dt_s, self.track_m[2])
        self._move(dt_s)
        lean = LEAN_DEG_S_M * self.speed_m_s * math.hypot(self.way[0], self.way[1])
        lean += math.degrees(math.atan2((self.speed_m_s - before) / dt_s, GRAVITY_M_S2))
        self._lean_flight_deg += max(-1.0, min(1.0, dt_s / 0.2)) * (lean - self._lean_flight_deg)
        wind_pitch_deg, wind_roll_deg = self.air.lean_deg(self.yaw_deg) if self.track_m[2] > 0 else (0.0, 0.0)
        self.lean_deg = self._lean_flight_deg - wind_pitch_deg
        self.roll_deg = wind_roll_deg
        self._look()
        yaw_step = self.options.yaw_rate_deg_s * dt_s
        turn = turn_deg(self.yaw_deg, self.yaw_goal_deg)
        self.yaw_deg = (self.yaw_deg + max(-yaw_step, min(yaw_step, turn))) % 360
        lowest, highest = self.options.gimbal_lowest_deg, self.options.gimbal_highest_deg
        tilt_step = self.options.gimbal_rate_deg_s * dt_s
        tilt = max(lowest, min(highest, self.gimbal_pitch_goal_deg)) - self.gimbal_pitch_deg
        self.gimbal_pitch_deg += max(-tilt_step, min(tilt_step, tilt))

    def _move(self, dt_s: float) -> None:
        if self.goal_m is None:
            self.speed_m_s = 0.0
            return
        distance = math.dist(self.track_m, self.goal_m)
        if distance < 1e-9:
            self.speed_m_s = min(self.speed_m_s, self.end_m_s)
            return
        east, north, up = ((goal - at) / distance for goal, at in zip(self.goal_m, self.track_m, strict=True))
        self.way = (east, north, up)
        limit = self.cruise_m_s
        vertical = self.options.climb_m_s if up > 0 else self.options.descent_m_s
        if abs(up) > 1e-6:
            limit = min(limit, vertical / abs(up))
        limit = self.air.ground_speed_m_s(limit, self.way)
        rate = self.options.acceleration_m_s2
        braking = math.sqrt(self.end_m_s**2 + 2 * rate * distance)
        self.speed_m_s = min(self.speed_m_s + rate * dt_s, limit, max(braking, 0.05))
        moved = min(self.speed_m_s * dt_s, distance)
        self.flown_m += moved
        self.track_m = (
            (self.track_m[0] + east * moved, self.track_m[1] + north * moved, self.track_m[2] + up * moved)
            if moved < distance
            else self.goal_m
        )

    def _look(self) -> None:
        if self.look_at_m is None:
            return
        east, north, up = (to - at for to, at in zip(self.look_at_m, self.at_m, strict=True))
        if math.hypot(east, north) > 0.01:
            self.yaw_goal_deg = math.degrees(math.atan2(east, north)) % 360
        self.gimbal_pitch_goal_deg = math.degrees(math.atan2(up, math.hypot(east, north)))


def turn_deg(from_deg: float, to_deg: float) -> float:
    """The shorter way round, -180 to 180."""
    return (to_deg - from_deg + 180) % 360 - 180

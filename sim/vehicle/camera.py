"""The camera: photos by command and by distance, as the autopilots trigger them."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field

from sim.vehicle.motion import Body, Place
from sim.vehicle.options import VehicleOptions


@dataclass(frozen=True)
class PhotoTaken:
    """Truth about one photo. ``index``: from 1 on ArduPilot, from 0 on PX4. East, north, up of home."""

    index: int
    boot_s: float
    at_m: Place
    yaw_deg: float
    pitch_deg: float
    vehicle_pitch_deg: float


@dataclass
class Camera:
    options: VehicleOptions
    rng: random.Random
    miss_share: float = 0.0
    spacing_m: float = 0.0
    photos: list[PhotoTaken] = field(default_factory=list)
    triggered: int = 0
    _last_s: float = -math.inf
    _last_m: Place | None = None

    def trigger(self, body: Body, now_s: float) -> PhotoTaken | None:
        """A photo, unless the last one is too recent or the shutter fails."""
        if now_s - self._last_s < self.options.camera_interval_s - 1e-9:
            return None
        self._last_s, self._last_m = now_s, body.at_m
        self.triggered += 1
        if self.rng.random() < self.miss_share:
            return None
        first = 1 if self.options.flavour == "ardupilot" else 0
        photo = PhotoTaken(
            *(len(self.photos) + first, now_s, body.at_m, body.yaw_deg, body.gimbal_pitch_deg),
            -body.lean_deg,
        )
        self.photos.append(photo)
        return photo

    def by_distance(self, spacing_m: float) -> None:
        """From here on a photo each ``spacing_m``; 0 or less: no more."""
        self.spacing_m = max(spacing_m, 0.0)

    def start_here(self, body: Body) -> None:
        """The distance counts from here."""
        self._last_m = body.at_m

    def step(self, body: Body, now_s: float) -> PhotoTaken | None:
        if self.spacing_m <= 0:
            return None
        if self._last_m is None:
            self._last_m = body.at_m
        if math.dist(body.at_m, self._last_m) < self.spacing_m:
            return None
        return self.trigger(body, now_s)

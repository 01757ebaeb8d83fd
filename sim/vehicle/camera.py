"""The camera: photos by command and by distance, as the autopilots trigger them."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field

from sim.vehicle.motion import Body
from sim.vehicle.options import VehicleOptions
from sim.vehicle.receiver import Place, Receiver


@dataclass(frozen=True)
class PhotoTaken:
    """Truth about one photo. ``index``: from 1 on ArduPilot, from 0 on PX4. East, north, up of home.
    ``boot_s``: since the vehicle was switched on last. ``believed_m``: where the vehicle says that it was;
    ``jumped``: while its receiver's place was away."""

    index: int
    boot_s: float
    utc_s: float
    at_m: Place
    believed_m: Place
    yaw_deg: float
    pitch_deg: float
    vehicle_pitch_deg: float
    vehicle_roll_deg: float
    jumped: bool = False


@dataclass
class Camera:
    """``photos``: the truth, whatever was switched off in between. ``counted``: since the vehicle was
    switched on last."""

    options: VehicleOptions
    rng: random.Random
    miss_share: float = 0.0
    spacing_m: float = 0.0
    photos: list[PhotoTaken] = field(default_factory=list)
    counted: int = 0
    triggered: int = 0
    _last_s: float = -math.inf
    _last_m: Place | None = None

    def trigger(self, body: Body, now_s: float, utc_s: float, receiver: Receiver) -> PhotoTaken | None:
        """A photo, unless the last one is too recent or the shutter fails."""
        if now_s - self._last_s < self.options.camera_interval_s - 1e-9:
            return None
        self._last_s, self._last_m = now_s, body.believed_m
        self.triggered += 1
        if self.rng.random() < self.miss_share:
            return None
        first = 1 if self.options.flavour == "ardupilot" else 0
        photo = PhotoTaken(
            *(self.counted + first, now_s, utc_s, body.at_m, receiver.told_m(body.at_m)),
            *(body.yaw_deg, body.gimbal_pitch_deg, -body.lean_deg, body.roll_deg),
            receiver.jumped,
        )
        self.counted += 1
        self.photos.append(photo)
        return photo

    def by_distance(self, spacing_m: float) -> None:
        """From here on a photo each ``spacing_m``; 0 or less: no more."""
        self.spacing_m = max(spacing_m, 0.0)

    def start_here(self, body: Body) -> None:
        """The distance counts from here."""
        self._last_m = body.believed_m

    def due(self, body: Body) -> bool:
        """Whether a photo by distance is due, as far as the vehicle knows where it is."""
        if self.spacing_m <= 0:
            return False
        if self._last_m is None:
            self._last_m = body.believed_m
        return math.dist(body.believed_m, self._last_m) >= self.spacing_m

    def switched_off(self) -> None:
        """What was set by command is forgotten, and numbers begin anew."""
        self.spacing_m, self.counted, self._last_s, self._last_m = 0.0, 0, -math.inf, None

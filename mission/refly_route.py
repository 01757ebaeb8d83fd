"""The way of an extra pass: from the ground at the launch point through its stations and back."""

from __future__ import annotations

import numpy as np

from calib.camera import FloatArray
from mission.plan import Vehicle
from mission.route import Detours, Gap, legs_s


class PassDetours(Detours):
    """Cheapest ways through stations with climb, way home and landing; nothing is flown without any.

    Legs to and from the launch point are flown as autopilots do: straight up to the first height, the
    way home at ``return_height_m`` or higher, then straight down.
    """

    def __init__(self, vehicle: Vehicle, return_height_m: float) -> None:
        self._return_m = return_height_m
        ground = np.zeros(3)
        super().__init__(vehicle, [Gap(ground, ground, 0)], np.zeros((0, 3)))

    def add(self, stations_m: FloatArray) -> None:
        """More stations (n, 3), numbered on."""
        super().add(stations_m)
        here = self._stations
        ground = np.zeros((len(here), 3))
        above = np.column_stack([np.zeros((len(here), 2)), here[:, 2]])
        level = np.maximum(here[:, 2], self._return_m)
        raised, home = here.copy(), above.copy()
        raised[:, 2] = home[:, 2] = level
        out = legs_s(self.vehicle, ground, above) + legs_s(self.vehicle, above, here)
        back = legs_s(self.vehicle, here, raised) + legs_s(self.vehicle, raised, home)
        self._from = out[None]
        self._to = (back + legs_s(self.vehicle, home, ground))[None]

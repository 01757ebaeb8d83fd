"""Terrain as the prediction needs it: ground heights above the launch point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from calib.camera import FloatArray


class Terrain(Protocol):
    """Ground heights above the launch point, m."""

    def height_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """Heights (n,) at east (n,), north (n,), metres from the launch point.

        Raises:
            InputError: the model does not cover a place.
        """
        ...


@dataclass(frozen=True)
class LevelGround:
    """The same height everywhere, by default the launch point's."""

    at_m: float = 0.0

    def height_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """(n,), (n,) -> (n,)."""
        return np.full(np.broadcast(east_m, north_m).shape, self.at_m)

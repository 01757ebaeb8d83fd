"""Ground height as a smooth function with a known gradient."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.camera import FloatArray


@dataclass(frozen=True)
class Relief:
    """Height above z = 0 as a sum of plane waves; not periodic over any surveyed area.

    waves: (w, 4) rows of angular wave number east and north (rad/m), phase (rad), amplitude (m).
    """

    waves: FloatArray

    @classmethod
    def random(
        cls, seed: int, amplitude_m: float, wavelengths_m: tuple[float, float] = (35.0, 160.0)
    ) -> Relief:
        """Rolling ground whose height stays within ``amplitude_m`` of zero, mostly within half of that."""
        rng = np.random.default_rng([seed, 1])
        count = 7
        length = np.exp(rng.uniform(math.log(wavelengths_m[0]), math.log(wavelengths_m[1]), count))
        azimuth = rng.uniform(0, 2 * np.pi, count)
        # Longer waves are higher, as on real ground.
        weight = length / length.sum()
        waves = np.stack(
            [
                2 * np.pi / length * np.cos(azimuth),
                2 * np.pi / length * np.sin(azimuth),
                rng.uniform(0, 2 * np.pi, count),
                amplitude_m * weight,
            ],
            axis=-1,
        )
        return cls(waves)

    @property
    def bound_m(self) -> float:
        """No height is farther from zero than this."""
        return float(np.abs(self.waves[:, 3]).sum())

    def height_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """Height at positions of any (equal) shape."""
        total = np.zeros(np.shape(east_m))
        for east, north, phase, amplitude in self.waves:
            total += amplitude * np.sin(east * east_m + north * north_m + phase)
        return total

    def height_and_gradient(
        self, east_m: FloatArray, north_m: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Height, d height / d east and d height / d north (m, m/m, m/m)."""
        height, by_east, by_north = (np.zeros(np.shape(east_m)) for _ in range(3))
        for east, north, phase, amplitude in self.waves:
            angle = east * east_m + north * north_m + phase
            height += amplitude * np.sin(angle)
            slope = np.cos(angle)
            by_east += (amplitude * east) * slope
            by_north += (amplitude * north) * slope
        return height, by_east, by_north

"""Ground height as a smooth function with a known gradient."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from calib.camera import FloatArray


class HeightField(Protocol):
    """What a ground must be able to say; positions are in m, arrays of any (equal) shape."""

    @property
    def lowest_m(self) -> float:
        """No height is below this."""

    @property
    def highest_m(self) -> float:
        """No height is above this."""

    @property
    def steepest(self) -> float:
        """No slope (m/m) is steeper than this."""

    def height_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """Height at positions."""

    def height_and_gradient(
        self, east_m: FloatArray, north_m: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Height, d height / d east and d height / d north (m, m/m, m/m)."""


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

    @classmethod
    def rough(cls, seed: int, rms_slope: float, wavelengths_m: tuple[float, float] = (3.0, 25.0)) -> Relief:
        """Small bumps in all directions, alike in slope at all lengths; ``rms_slope`` in m/m."""
        if rms_slope <= 0:
            return cls(np.zeros((0, 4)))
        rng = np.random.default_rng([seed, 11])
        count = 10
        length = np.geomspace(*wavelengths_m, count) * rng.uniform(0.9, 1.1, count)
        # Directions by the golden angle: no two neighbouring lengths run alike.
        azimuth = rng.uniform(0, 2 * np.pi) + 2.39996 * np.arange(count)
        number = 2 * np.pi / length
        # A wave's slope has the rms number * amplitude / sqrt(2); those of different waves add squared.
        amplitude = rms_slope * math.sqrt(2 / count) / number
        phase = rng.uniform(0, 2 * np.pi, count)
        return cls(np.stack([number * np.cos(azimuth), number * np.sin(azimuth), phase, amplitude], axis=-1))

    @property
    def bound_m(self) -> float:
        """No height is farther from zero than this."""
        return float(np.abs(self.waves[:, 3]).sum())

    @property
    def lowest_m(self) -> float:
        return -self.bound_m

    @property
    def highest_m(self) -> float:
        return self.bound_m

    @property
    def steepest(self) -> float:
        return float((np.hypot(self.waves[:, 0], self.waves[:, 1]) * np.abs(self.waves[:, 3])).sum())

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

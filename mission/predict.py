"""What a planned mission will tell about its camera, before take-off, and the photos that cure it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from shapely import Polygon

from calib.camera import FloatArray
from calib.findings import Verdict
from mission.plan import Plan, Station


class Terrain(Protocol):
    """Ground heights above the launch point, m."""

    def height_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """Heights (n,) at east (n,), north (n,), metres from the launch point."""
        ...


@dataclass(frozen=True)
class FlatTerrain:
    """Level ground, by default at the launch point's height."""

    at_m: float = 0.0

    def height_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """(n,), (n,) -> (n,)."""
        return np.full(np.broadcast(east_m, north_m).shape, self.at_m)


@dataclass(frozen=True)
class Prediction:
    """What the calibration of a planned mission is expected to be worth.

    Sigmas contain the measured model error. ``sigma_k_px`` are those of K1-K3 in pixel units
    (px^-2, px^-4, px^-6). ``dome_*``: sigma of the dome at the site's edge, and in percent of the
    flying height. ``gsd_*``: ground resolution, over the area, of the sharpest photo of each place.
    ``least_views``: photos that see the worst place of the area, ``least_views_at_m`` (east, north).
    ``verdict``: what the check will say at best, given a good reference; ``reason`` in one sentence.
    """

    sigma_f_percent: float
    sigma_k_px: tuple[float, float, float]
    k1_k2_correlation: float
    dome_sigma_m: float
    dome_percent: float
    convergent_share: float
    photos: int
    height_agl_m: float
    gsd_worst_m: float
    gsd_mean_m: float
    least_views: int
    least_views_at_m: tuple[float, float]
    verdict: Verdict
    reason: str


@dataclass(frozen=True)
class Fix:
    """Photos added to a plan so that it calibrates, robustly.

    ``plan`` has the additions in its path; ``added`` is empty where none are needed or none help.
    ``seconds``: what they cost in the air. ``binding_limit``: None where the criterion is met,
    otherwise what stands against it, in words. ``after`` is with all additions taken.
    """

    plan: Plan
    added: tuple[Station, ...]
    seconds: float
    before: Prediction
    after: Prediction
    reason: str
    binding_limit: str | None


def predict(plan: Plan, terrain: Terrain | None = None, area: Polygon | None = None) -> Prediction:
    """Predict the calibration of ``plan`` (not there yet)."""
    raise NotImplementedError


def fix(
    plan: Plan,
    terrain: Terrain | None = None,
    area: Polygon | None = None,
    feasible: Callable[[Station], bool] | None = None,
) -> Fix:
    """The cheapest additions that make ``plan`` calibrate (not there yet)."""
    raise NotImplementedError

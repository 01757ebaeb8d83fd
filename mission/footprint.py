"""What a photo sees of level ground: sizes, spacings for an overlap, outlines."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.camera import BrownCamera, FloatArray
from calib.errors import InputError
from mission.plan import Station

#: Spacings are this much closer than the overlap asks, so that rounding never costs a photo.
SLACK = 0.99


@dataclass(frozen=True)
class Footprint:
    """The rectangle that a photo sees for certain, per metre of height above level ground.

    ``half_across``: to either side; ``behind, ahead``: along the direction of view, from under the
    camera (behind is negative for a photo straight down).
    """

    half_across: float
    behind: float
    ahead: float

    @property
    def along(self) -> float:
        return self.ahead - self.behind

    @property
    def reach(self) -> float:
        """To the farthest corner."""
        return math.hypot(self.half_across, max(self.ahead, -self.behind))


@dataclass(frozen=True)
class Spacing:
    """Distances that give an overlap: every place is in ``views`` photos of a row, of width ``window``."""

    step: float
    views: int

    @property
    def window(self) -> float:
        """A stretch of this length around any place holds ``views`` photos, all of which see it."""
        return self.views * self.step

    @property
    def margin(self) -> float:
        """How far a row must go on beyond the outermost place."""
        return max(0.5 * self.views - 1, 0.0) * self.step


def footprint(camera: BrownCamera, off_nadir_deg: float = 0.0) -> Footprint:
    """Footprint of a camera tilted forward by ``off_nadir_deg``, lens distortion included.

    Raises:
        InputError: the image reaches the horizon.
    """
    right, ahead = _on_ground(_edges(camera), off_nadir_deg)
    per_side = len(right) // 4
    top, side_r, bottom, side_l = (slice(i * per_side, (i + 1) * per_side) for i in range(4))
    return Footprint(
        float(min(right[side_r].min(), -right[side_l].max())),
        float(ahead[bottom].max()),
        float(ahead[top].min()),
    )


def spacing(size: float, overlap: float) -> Spacing:
    """Distance between photos that see ``size`` and overlap by the share ``overlap`` [0, 1)."""
    return Spacing(SLACK * size * (1 - overlap), max(math.floor(1 / (1 - overlap) + 1e-6), 1))


def outline_m(camera: BrownCamera, station: Station, ground_m: float, most_m: float) -> FloatArray:
    """Outline (n, 2) in m east, north of what a photo sees of level ground at height ``ground_m``.

    What looks at or near the horizon is cut off ``most_m`` away.
    """
    rays = _edges(camera)
    tilt, yaw = math.radians(90 + station.pitch_deg), math.radians(station.yaw_deg)
    height = max(station.height_m - ground_m, 0.1)
    down = math.cos(tilt) + rays[:, 1] * math.sin(tilt)
    out = np.stack([rays[:, 0], math.sin(tilt) - rays[:, 1] * math.cos(tilt)], axis=-1)
    reach = height * np.hypot(*out.T) / np.maximum(down, 1e-9)
    out *= (np.minimum(reach, most_m) / np.maximum(np.hypot(*out.T), 1e-12))[:, None]
    east = out[:, 0] * math.cos(yaw) + out[:, 1] * math.sin(yaw)
    north = -out[:, 0] * math.sin(yaw) + out[:, 1] * math.cos(yaw)
    return np.stack([station.east_m + east, station.north_m + north], axis=-1)


def _edges(camera: BrownCamera, per_side: int = 8) -> FloatArray:
    """Rays (4 n, 2) along the image's edges: top, right, bottom, left, corner to corner."""
    share = np.linspace(0, 1, per_side)
    w, h, one = float(camera.width), float(camera.height), np.ones(per_side)
    pixels = np.concatenate(
        [
            np.stack([share * w, 0 * one], axis=-1),
            np.stack([w * one, share * h], axis=-1),
            np.stack([(1 - share) * w, h * one], axis=-1),
            np.stack([0 * one, (1 - share) * h], axis=-1),
        ]
    )
    rays = camera.unproject(pixels)
    # Where the lens model does not reach the corner the ideal lens will do.
    plain = np.stack(
        [(pixels[:, 0] - camera.cx_px) / camera.f_px, (pixels[:, 1] - camera.cy_px) / camera.fy_px], axis=-1
    )
    return np.where(np.isfinite(rays), rays, plain)


def _on_ground(rays: FloatArray, off_nadir_deg: float) -> tuple[FloatArray, FloatArray]:
    """Where rays meet the ground one metre below: to the right and ahead, (n,) each."""
    tilt = math.radians(off_nadir_deg)
    down = math.cos(tilt) + rays[:, 1] * math.sin(tilt)
    if down.min() < 0.05:
        raise InputError(
            f"Tilted {off_nadir_deg:g} degrees off nadir the photos reach the horizon; a grid needs "
            "less tilt."
        )
    return rays[:, 0] / down, (math.sin(tilt) - rays[:, 1] * math.cos(tilt)) / down

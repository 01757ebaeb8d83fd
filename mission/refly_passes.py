"""Passes that may cure a calibration: orbits, fans, arcs, higher circles, strips, and single photos."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.camera import FloatArray
from calib.evidence import CONVERGENT_DEG
from mission.plan import Station, Vehicle, looking_inwards

PATTERN = "refly"
#: A gimbal and an aircraft in the wind are off by this much; a photo has to count as convergent all the same.
AIM_DEG = 2.5
#: Tilts off nadir, heights over the survey's, and numbers of photos of the circles tried.
TILTS_DEG = (25.0, 32.0, 40.0)
HEIGHTS = (0.8, 1.0, 1.3, 1.6)
#: From much nearer than the survey its photos match badly (and climbing would be all that counts); flatter
#: views do, too.
LEAST_HEIGHT, MOST_TILT_DEG = 0.8, 42.5
LOWEST, _BELOW_CEILING_M = 0.3, 0.2
#: Single photos are tried at so many of the lowest heights: climbing takes time.
SINGLE_HEIGHTS = 3
CIRCLE_PHOTOS = (4, 6, 8, 12)
#: [C&D]'s eight convergent photos: as high as the survey, here 40 degrees off nadir.
PAPER_PHOTOS, PAPER_TILT_DEG = 8, 40.0
ARC_DEG, ARC_PHOTOS = 150.0, (5,)


@dataclass(frozen=True)
class Shape:
    """A regular pass around ``middle_m`` (2,), ``ground_m`` high: what it is called, and its photos.

    ``kind``: "orbit", "arc", "strip" (straight lines) or "single". Heights above launch, angles off nadir.
    """

    kind: str
    stations: tuple[Station, ...]
    radius_m: float = 0.0
    height_m: float = 0.0
    tilt_deg: float = 0.0


def tilts_for(vehicle: Vehicle) -> tuple[float, ...]:
    """Tilts off nadir that gimbal and check allow; empty where the camera cannot look far enough aside."""
    most = 90.0 + vehicle.gimbal_highest_deg
    least = max(CONVERGENT_DEG + AIM_DEG, 90.0 + vehicle.gimbal_lowest_deg)
    found = [tilt for tilt in TILTS_DEG if least <= tilt <= most]
    # The best of a short gimbal is its end.
    if least <= most < TILTS_DEG[-1] and all(abs(most - tilt) > 2.0 for tilt in found):
        found.append(most)
    return tuple(found)


def heights_for(height_m: float, highest_agl_m: float) -> tuple[float, ...]:
    """Heights over the survey's ``height_m``; under a low ceiling also the highest that it allows."""
    highest = (highest_agl_m - _BELOW_CEILING_M) / height_m
    found = [h for h in HEIGHTS if h <= highest]
    if LOWEST <= highest < HEIGHTS[-1] and all(abs(h - highest) > 0.1 for h in found):
        found.append(highest)
    return tuple(found)


@dataclass(frozen=True)
class Over:
    """The place that passes are made over, and what they may be made of.

    middle_m (2,), ``ground_m`` there, ``height_m`` of the survey above it. ``tilts_deg`` off nadir, rising;
    ``heights`` as factors of the survey's.
    """

    middle_m: FloatArray
    ground_m: float
    height_m: float
    tilts_deg: tuple[float, ...]
    heights: tuple[float, ...]

    @property
    def towards_launch_deg(self) -> float:
        """Azimuth of the launch point (the frame's origin) from the middle."""
        return math.degrees(math.atan2(-self.middle_m[0], -self.middle_m[1]))


def circle(
    middle_m: FloatArray,
    ground_m: float,
    height_agl_m: float,
    tilt_deg: float,
    photos: int,
    first_deg: float = 0.0,
    arc_deg: float = 360.0,
) -> Shape:
    """Photos on a circle that look inwards; of an arc, ``first_deg`` is the azimuth of its middle."""
    radius = height_agl_m * math.tan(math.radians(tilt_deg))
    whole = arc_deg >= 360.0
    steps = np.arange(photos) / photos * 360.0 if whole else np.linspace(-0.5, 0.5, photos) * arc_deg
    up_m = ground_m + height_agl_m
    stations = looking_inwards(middle_m, up_m, radius, first_deg + steps, tilt_deg, PATTERN)
    return Shape("orbit" if whole else "arc", stations, radius, up_m, tilt_deg)


def orbits(over: Over) -> list[Shape]:
    """Circles of all heights, the larger tilts, all numbers; the first station is the launch point's side."""
    return [
        circle(over.middle_m, over.ground_m, factor * over.height_m, tilt, count, over.towards_launch_deg)
        for factor in over.heights
        for tilt in over.tilts_deg[-2:]
        for count in CIRCLE_PHOTOS
    ]


def paper_fan(middle_m: FloatArray, ground_m: float, height_m: float) -> Shape:
    """[C&D]'s eight photos (flights 3 and 4)."""
    return circle(middle_m, ground_m, height_m, PAPER_TILT_DEG, PAPER_PHOTOS)


def arcs(over: Over) -> list[Shape]:
    """Parts of circles on the launch point's side, and on the other three."""
    towards = over.towards_launch_deg
    return [
        circle(over.middle_m, over.ground_m, factor * over.height_m, tilt, count, towards + side, ARC_DEG)
        for side in (0.0, 90.0, -90.0, 180.0)
        for factor in _middle(over.heights)
        for tilt in over.tilts_deg[-2:]
        for count in ARC_PHOTOS
    ]


def strips(middle_m: FloatArray, ground_m: float, height_m: float, along_deg: float) -> list[Shape]:
    """Straight lines with the camera straight down, for cameras that cannot look aside.

    Across the survey's lines (``along_deg``) at its own and at a greater height, and a second height.
    """
    found = []
    for factor in (1.0, 1.3, 1.6):
        for turn in (90.0, 0.0):
            for count in (4, 6, 8):
                heading = math.radians(along_deg + turn)
                offsets = np.linspace(-0.9, 0.9, count) * height_m
                stations = tuple(
                    Station(
                        float(middle_m[0] + s * math.sin(heading)),
                        float(middle_m[1] + s * math.cos(heading)),
                        ground_m + factor * height_m,
                        math.degrees(heading) % 360.0,
                        -90.0,
                        PATTERN,
                    )
                    for s in offsets
                )
                if factor > 1.0 or turn > 0:
                    found.append(Shape("strip", stations, 0.0, ground_m + factor * height_m))
    return found


def singles(over: Over) -> list[Station]:
    """Photos on a grid of places, heights, directions and tilts that look at the ground around the middle."""
    found = []
    steps = np.arange(-2, 3) * 0.6
    for factor in over.heights[:SINGLE_HEIGHTS]:
        for x in steps:
            for y in steps:
                for tilt in over.tilts_deg:
                    reach = factor * math.tan(math.radians(tilt))
                    for yaw in range(0, 360, 45):
                        turn = math.radians(yaw)
                        aim = math.hypot(x + reach * math.sin(turn), y + reach * math.cos(turn))
                        if aim <= 0.5:
                            east, north = over.middle_m + over.height_m * np.array([x, y])
                            up = over.ground_m + factor * over.height_m
                            found.append(
                                Station(float(east), float(north), up, float(yaw), tilt - 90.0, PATTERN)
                            )
    return found


def _middle(heights: tuple[float, ...]) -> tuple[float, ...]:
    """The two heights around the survey's own, or what there is."""
    return tuple(sorted(heights, key=lambda h: abs(math.log(h / 1.15)))[:2])

"""The convergent pass in words and numbers: [C&D]'s eight photos for this site and height."""

from __future__ import annotations

import math
from dataclasses import dataclass

#: Eight photos on a circle ([C&D] Table 2, flights 3 and 4), looking 20-45 degrees off nadir.
PHOTOS = 8
TILT_DEG = 35.0


@dataclass(frozen=True)
class Station:
    """One photo: east and north of the site's middle and height above ground in m, and where to look.

    ``yaw_deg`` clockwise from north, ``pitch_deg`` -90 straight down.
    """

    east_m: float
    north_m: float
    height_agl_m: float
    yaw_deg: float
    pitch_deg: float


def convergent_circle(height_agl_m: float, photos: int = PHOTOS, tilt_deg: float = TILT_DEG) -> list[Station]:
    """Stations on a circle around the middle of the site, all looking at it."""
    radius = height_agl_m * math.tan(math.radians(tilt_deg))
    stations = []
    for index in range(photos):
        azimuth = 2 * math.pi * index / photos
        stations.append(
            Station(
                east_m=radius * math.sin(azimuth),
                north_m=radius * math.cos(azimuth),
                height_agl_m=height_agl_m,
                yaw_deg=(math.degrees(azimuth) + 180) % 360,
                pitch_deg=tilt_deg - 90,
            )
        )
    return stations


def describe_circle(height_agl_m: float | None, middle_wgs84: tuple[float, float] | None = None) -> str:
    """The pass as a paragraph for the pilot; in proportions where the height is not known in metres."""
    pitch = round(TILT_DEG - 90)
    look = f"Tilt the camera to {pitch} degrees (about {TILT_DEG:.0f} degrees off straight down)"
    if height_agl_m is None:
        return (
            f"Take {PHOTOS} more photos on a circle around the middle of the site, as high as the survey "
            f"and with a radius of {math.tan(math.radians(TILT_DEG)):.1f} times that height. {look} and aim "
            "at the middle from every side, one photo every 45 degrees, then check the old and new photos "
            "together."
        )
    radius = height_agl_m * math.tan(math.radians(TILT_DEG))
    where = "the middle of the site"
    if middle_wgs84 is not None:
        where += f" ({middle_wgs84[0]:.6f}, {middle_wgs84[1]:.6f})"
    return (
        f"Fly one circle of {radius:.0f} m radius around {where}, {height_agl_m:.0f} m above the ground or "
        f"higher. "
        f"{look} and aim at the middle: {PHOTOS} photos, one every 45 degrees (an orbit or point-of-interest "
        "flight does it). Keep zoom and focus as they are, then check the old and new photos together."
    )

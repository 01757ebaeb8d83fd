"""A mission as every other module of this package sees it: launch, camera, vehicle, waypoints.

Frame: east, north, up in metres around the launch point on the ground (:class:`LocalFrame`);
``height_m`` is above the launch point, ``yaw_deg`` clockwise from true north, ``pitch_deg`` the
camera's, -90 straight down, 0 at the horizon.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from calib.camera import BrownCamera, FloatArray
from calib.frames import LocalFrame


class Shot(StrEnum):
    """What the camera does at, or from, a waypoint."""

    NONE = "none"  # only flown to
    STOP = "stop"  # one photo, when vehicle and gimbal have settled
    LINE = "line"  # photos by distance from here to the next waypoint, both ends included


@dataclass(frozen=True)
class Waypoint:
    """One place of the path. ``spacing_m``: distance between photos of a LINE.

    ``pattern``: which part of the mission it belongs to ("nadir", "orbit", ...).
    """

    east_m: float
    north_m: float
    height_m: float
    yaw_deg: float = 0.0
    pitch_deg: float = -90.0
    shot: Shot = Shot.NONE
    spacing_m: float = 0.0
    pattern: str = ""

    @property
    def enu_m(self) -> FloatArray:
        """(3,)."""
        return np.array([self.east_m, self.north_m, self.height_m])


@dataclass(frozen=True)
class Station:
    """One photo to be taken."""

    east_m: float
    north_m: float
    height_m: float
    yaw_deg: float
    pitch_deg: float
    pattern: str = ""


@dataclass(frozen=True)
class Vehicle:
    """What the aircraft can do. Defaults: an ordinary camera quadcopter.

    ``endurance_s``: usable time in the air of one battery; ``reserve_share`` of it is kept for
    extra passes and landing. ``settle_s``: from arriving at a STOP to the photo, gimbal included.
    """

    speed_m_s: float = 8.0
    climb_m_s: float = 3.0
    descent_m_s: float = 2.0
    acceleration_m_s2: float = 2.0
    endurance_s: float = 1200.0
    reserve_share: float = 0.25
    settle_s: float = 2.0
    gimbal_lowest_deg: float = -90.0
    gimbal_highest_deg: float = 0.0
    camera_interval_s: float = 2.0
    most_items: int = 650


@dataclass(frozen=True)
class Plan:
    """A whole mission: take-off at the launch point, ``waypoints`` in order, return and landing.

    ``return_height_m``: above the launch point, flown on the way home.
    """

    name: str
    launch: LocalFrame
    camera: BrownCamera
    camera_name: str
    vehicle: Vehicle
    waypoints: tuple[Waypoint, ...]
    return_height_m: float

    @property
    def path_m(self) -> FloatArray:
        """Launch point at the first height, waypoints, way home: corners of the path, (n + 2, 3)."""
        corners = [w.enu_m for w in self.waypoints]
        first = corners[0][2] if corners else self.return_height_m
        home = np.array([0.0, 0.0, self.return_height_m])
        return np.array([[0.0, 0.0, first], *corners, home])


def stations(plan: Plan) -> tuple[Station, ...]:
    """Every photo of the plan in the order in which it is taken.

    The photos of a LINE look where the line's first waypoint looks.
    """
    found: list[Station] = []
    for index, here in enumerate(plan.waypoints):
        if here.shot is Shot.STOP:
            found.append(_station(here, here.enu_m))
        elif here.shot is Shot.LINE:
            if index + 1 == len(plan.waypoints):
                raise ValueError("a LINE needs a waypoint to end at")
            found += [_station(here, at) for at in line_photos_m(here, plan.waypoints[index + 1])]
    return tuple(found)


def looking_inwards(
    middle_m: FloatArray, up_m: float, radius_m: float, azimuth_deg: FloatArray, tilt_deg: float, pattern: str
) -> tuple[Station, ...]:
    """Stations at azimuths (n,) from ``middle_m`` (2,), all at ``up_m``, looking back at it."""
    return tuple(
        Station(
            float(middle_m[0] + radius_m * math.sin(math.radians(azimuth))),
            float(middle_m[1] + radius_m * math.cos(math.radians(azimuth))),
            up_m,
            float((azimuth + 180.0) % 360.0),
            tilt_deg - 90.0,
            pattern,
        )
        for azimuth in azimuth_deg
    )


def stop(station: Station) -> Waypoint:
    """One photo from a standing aircraft."""
    return Waypoint(
        station.east_m,
        station.north_m,
        station.height_m,
        station.yaw_deg,
        station.pitch_deg,
        Shot.STOP,
        pattern=station.pattern,
    )


def line_photos_m(start: Waypoint, end: Waypoint) -> FloatArray:
    """Where the photos of a LINE are taken, (n, 3): at both ends and at most ``spacing_m`` apart."""
    if not start.spacing_m > 0:
        raise ValueError("a LINE needs a spacing")
    way = end.enu_m - start.enu_m
    length = float(np.linalg.norm(way))
    # A rounding error must not cost another photo.
    gaps = max(math.ceil(length / start.spacing_m - 1e-9), 1)
    along: FloatArray = start.enu_m + np.linspace(0, 1, gaps + 1)[:, None] * way
    return along


def _station(waypoint: Waypoint, at: FloatArray) -> Station:
    return Station(
        float(at[0]), float(at[1]), float(at[2]), waypoint.yaw_deg, waypoint.pitch_deg, waypoint.pattern
    )

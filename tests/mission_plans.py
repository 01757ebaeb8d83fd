"""Random plans for the tests of mission files, and the comparison of photos."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from hypothesis import strategies as st

from calib.camera import BrownCamera
from calib.frames import LocalFrame
from mission import encode
from mission.plan import Plan, Shot, Station, Vehicle, Waypoint, line_photos_m, stations

CAMERA = BrownCamera(4000, 3000, 3000.0, 2000.0, 1500.0)
LAUNCH = LocalFrame(47.0, 8.5, 430.0)


def plan_of(*waypoints: Waypoint, launch: LocalFrame = LAUNCH, **vehicle: float) -> Plan:
    fleet = Vehicle(**vehicle)  # type: ignore[arg-type]
    return Plan("test", launch, CAMERA, "M3E", fleet, waypoints, 40.0)


def orbit(stops: int = 8, radius: float = 40.0, height: float = 50.0) -> tuple[Waypoint, ...]:
    """Stops around the launch point, all looking at it."""
    pitch = -math.degrees(math.atan2(height, radius))
    found = []
    for index in range(stops):
        azimuth = 2 * math.pi * index / stops
        east, north = radius * math.sin(azimuth), radius * math.cos(azimuth)
        yaw = (math.degrees(azimuth) + 180) % 360
        found.append(Waypoint(east, north, height, yaw, pitch, Shot.STOP, pattern="orbit"))
    return tuple(found)


def line(length: float = 100.0, spacing: float = 10.0, height: float = 60.0) -> tuple[Waypoint, ...]:
    return (
        Waypoint(0, 0, height, 90.0, -90.0, Shot.LINE, spacing, "nadir"),
        Waypoint(length, 0, height, 90.0, -90.0),
    )


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, width=64)


#: Ordinary places and the awkward ones: dateline, equator and prime meridian, far north and south.
launches = st.builds(
    LocalFrame,
    st.one_of(numbers(-84, 84), st.sampled_from([0.0, -33.0, 79.9])),
    st.one_of(numbers(-180, 180), st.sampled_from([0.0, 179.99999, -179.99999, 180.0])),
    numbers(-100, 4000),
)


@st.composite
def plans(draw: st.DrawFn) -> Plan:
    count = draw(st.integers(1, 7))
    found = []
    for index in range(count):
        kinds = list(Shot) if index + 1 < count else [Shot.NONE, Shot.STOP]
        found.append(
            Waypoint(
                draw(numbers(-2500, 2500)),
                draw(numbers(-2500, 2500)),
                draw(numbers(-60, 400)),
                draw(numbers(-360, 720)),
                draw(numbers(-90, 20)),
                draw(st.sampled_from(kinds)),
                draw(numbers(20, 300)),
                draw(st.sampled_from(["nadir", "orbit"])),
            )
        )
    if count > 2 and draw(st.booleans()):  # a leg of no length
        found[1] = found[0].__class__(**{**found[1].__dict__, **_place(found[0])})
    return plan_of(*found, launch=draw(launches), settle_s=draw(numbers(0, 5)))


def _place(waypoint: Waypoint) -> dict[str, float]:
    return {"east_m": waypoint.east_m, "north_m": waypoint.north_m, "height_m": waypoint.height_m}


def same_photos(
    want: Sequence[Station], have: Sequence[Station], place_m: float, yaw_deg: float, pitch_deg: float
) -> None:
    """As many photos, each within the given losses."""
    assert len(want) == len(have)
    for ours, theirs in zip(want, have, strict=True):
        assert distance_m(ours, theirs) <= place_m
        assert angle_deg(ours.yaw_deg, theirs.yaw_deg) <= yaw_deg + 1e-9
        assert abs(ours.pitch_deg - theirs.pitch_deg) <= pitch_deg + 1e-9


def triggered(plan: Plan) -> tuple[Station, ...]:
    """Photos of the plan where an autopilot takes them: by distance on a line, which is set so much longer
    that none is due at the line's end, where the last is taken by command."""
    found = list(stations(plan))
    first = 0
    for here, end in zip(plan.waypoints, [*plan.waypoints[1:], None], strict=True):
        if here.shot is Shot.LINE and end is not None:
            gaps = len(line_photos_m(here, end)) - 1
            gap = math.dist(here.enu_m, end.enu_m) / gaps
            longer = min(1.0, gap / 4) / gaps / gap if gap > 0 else 0.0
            for k in range(1, gaps):
                at = here.enu_m + (end.enu_m - here.enu_m) * k * (1 + longer) / gaps
                east, north, up = (float(value) for value in at)
                found[first + k] = replace(found[first + k], east_m=east, north_m=north, height_m=up)
            first += gaps + 1
        elif here.shot is Shot.STOP:
            first += 1
    return tuple(found)


def distance_m(one: Station, other: Station) -> float:
    return math.dist((one.east_m, one.north_m, one.height_m), (other.east_m, other.north_m, other.height_m))


def angle_deg(one: float, other: float) -> float:
    return abs((one - other + 180) % 360 - 180)


def place_loss_m(plan: Plan) -> float:
    """1 cm, and 1.2 more where ArduPilot's readings of 0 have to be evaded."""
    placed = [item for item in encode.items(plan, "ardupilot")[2:] if item.has_place]
    return 0.022 if any(i.z == 0.01 or (i.x, i.y) == (0, 1) for i in placed) else 0.01

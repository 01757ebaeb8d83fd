"""Patterns around a place: the orbit and the convergent fan."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import shapely

from calib.camera import FloatArray
from calib.errors import InputError
from mission.patterns.piece import Part, Piece
from mission.plan import Station, looking_inwards, stop
from mission.site import FAN_TILT_DEG, ORBIT_TILT_DEG, Site

ORBIT_PHOTOS = 24
#: [C&D] Table 2, flights 3 and 4.
FAN_PHOTOS = 8
#: Phases of the fan that are tried, between one station and the next.
_PHASES = 12


def orbit_part(site: Site) -> Part:
    """Photos on a circle or an arc around the point of interest, all looking at it.

    Of tilt, radius and height two decide: the height is the site's, the radius follows from the tilt
    unless it is given; given both, the camera is tilted as asked.

    Raises:
        InputError: tilt, radius or number of photos that make no sense, no station allowed.
    """
    options = site.options
    tilt = _tilt(options.tilt_deg, options.radius_m, site.height_m, ORBIT_TILT_DEG)
    radius = options.radius_m or site.height_m * math.tan(math.radians(tilt))
    count = options.photos or ORBIT_PHOTOS
    if not 1 <= count <= 400:
        raise InputError(f"An orbit has 1 to 400 photos, not {count}.")
    azimuth, closed = _azimuths(count, options.arc_deg)
    if (options.clockwise is False and closed) or (
        options.clockwise is not None and not closed and (azimuth[-1] > azimuth[0]) != options.clockwise
    ):
        azimuth = azimuth[::-1]
    stations = ring_stations(site, site.middle_m, radius, azimuth, tilt, "orbit")
    kept = allowed(site, stations)
    _some_left(kept, stations, "orbit", radius)
    whole = closed and len(kept) == len(stations)
    piece = Piece(tuple(stop(s) for s in kept), reversible=options.clockwise is None, loop=whole)
    return Part("orbit", (piece,), _left_out("orbit", stations, kept))


def fan_part(site: Site) -> Part:
    """[C&D]'s convergent photos: stations on a circle, all looking at the middle of the site.

    The circle is turned so that as many stations as possible are allowed.

    Raises:
        InputError: a tilt that makes no sense, no station allowed.
    """
    options = site.options
    tilt = _tilt(options.tilt_deg, None, site.height_m, FAN_TILT_DEG)
    radius = site.height_m * math.tan(math.radians(tilt))
    count = options.photos or FAN_PHOTOS
    best: list[Station] = []
    stations: list[Station] = []
    for phase in range(_PHASES):
        azimuth = (np.arange(count) + phase / _PHASES) * 360.0 / count
        stations = ring_stations(site, site.middle_m, radius, azimuth, tilt, "fan")
        kept = allowed(site, stations)
        if len(kept) > len(best):
            best = kept
        if len(best) == count:
            break
    _some_left(best, stations, "fan", radius)
    pieces = tuple(Piece((stop(s),)) for s in best)
    return Part("fan", pieces, _left_out("fan", stations, best))


def ring_stations(
    site: Site,
    middle_m: tuple[float, float],
    radius_m: float,
    azimuth_deg: FloatArray,
    tilt_deg: float,
    pattern: str,
    height_m: float | None = None,
) -> list[Station]:
    """Stations ``azimuth_deg`` (n,) from the middle, looking back at it, ``tilt_deg`` off nadir.

    They stand at one level, ``height_m`` (default: the site's) above the ground at the middle, or
    where the ground under them is higher, above that.
    """
    above = site.height_m if height_m is None else height_m
    level = site.ground_m(*middle_m) + above
    ring = looking_inwards(np.array(middle_m), level, radius_m, azimuth_deg, tilt_deg, pattern)
    east, north = np.array([s.east_m for s in ring]), np.array([s.north_m for s in ring])
    heights = np.maximum(level, site.terrain.height_m(east, north) + min(site.clearance_m * 1.5, above))
    return [replace(s, height_m=float(h)) for s, h in zip(ring, heights, strict=True)]


def allowed(site: Site, stations: list[Station]) -> list[Station]:
    """The stations that fence and structures allow, in order."""
    return [s for s in stations if shapely.contains_xy(site.space.free(s.height_m), s.east_m, s.north_m)]


def _tilt(tilt_deg: float | None, radius_m: float | None, height_m: float, default: float) -> float:
    if radius_m is not None and not 0 < radius_m < 10_000:
        raise InputError(f"A radius of {radius_m:g} m cannot be flown.")
    if tilt_deg is None:
        return default if radius_m is None else math.degrees(math.atan2(radius_m, height_m))
    if not 1 <= tilt_deg <= 80:
        raise InputError(
            f"A tilt of {tilt_deg:g} degrees off nadir is not possible here; 20 to 45 calibrate best."
        )
    return tilt_deg


def _azimuths(count: int, arc_deg: tuple[float, float] | None) -> tuple[FloatArray, bool]:
    """Azimuths (n,), clockwise, and whether they go all the way round."""
    if arc_deg is None or abs(arc_deg[1] - arc_deg[0]) >= 360:
        return np.arange(count) * 360.0 / count, True
    span = (arc_deg[1] - arc_deg[0]) % 360
    return arc_deg[0] + np.linspace(0, span, count), False


def _some_left(kept: list[Station], all_of_them: list[Station], pattern: str, radius_m: float) -> None:
    if not kept:
        raise InputError(
            f"None of the {len(all_of_them)} stations of the {pattern} ({radius_m:.0f} m around its "
            "middle) is "
            "allowed by fence and structures; choose another point of interest, tilt or height."
        )


def _left_out(pattern: str, stations: list[Station], kept: list[Station]) -> tuple[str, ...]:
    lost = len(stations) - len(kept)
    if not lost:
        return ()
    return (f"{lost} of the {len(stations)} photos of the {pattern} are left out for fence or structures.",)

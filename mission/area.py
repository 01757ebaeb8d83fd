"""The area to survey: from whatever file or text the user has to a checked polygon.

Two frames: :class:`GeoArea` in WGS84 degrees (x longitude, y latitude; longitudes run on past
180 where the area crosses the date line), and shapely polygons in metres east and north of a
:class:`LocalFrame`, which the rest of ``mission`` works with. Ground is meant, so the height in
the local frame is 0.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely import Polygon
from shapely.geometry.base import BaseGeometry

from calib.camera import FloatArray
from calib.errors import InputError
from calib.frames import LocalFrame
from mission.area_files import FILE_READERS, read_wkt

#: One flight covers some kilometres; anything larger is a slip (degrees for metres, x for y).
MOST_ACROSS_M = 20_000.0
LEAST_ACROSS_M = 1.0
#: Nearer to a pole longitudes mean nothing.
MOST_LATITUDE_DEG = 89.0
#: Corners of a circle given by its radius; the polygon lies around the circle.
CIRCLE_CORNERS = 64
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_CIRCLE = re.compile(rf"\s*({_NUMBER})\s*,\s*({_NUMBER})\s*,\s*({_NUMBER})\s*(?:m)?\s*")


@dataclass(frozen=True)
class GeoArea:
    """One polygon in degrees, holes allowed. ``source``: where it came from, for messages.

    ``circle``: latitude, longitude (degrees) and radius (m) where it was given as a circle.
    """

    polygon: Polygon
    source: str
    circle: tuple[float, float, float] | None = None

    @property
    def middle(self) -> tuple[float, float]:
        """Latitude and longitude of the centroid, longitude in [-180, 180)."""
        at = self.polygon.centroid
        return float(at.y), float((at.x + 180) % 360 - 180)

    def local(self, frame: LocalFrame) -> Polygon:
        """The polygon in metres east and north of ``frame``'s origin.

        Raises:
            InputError: too large, too small or too far away from the origin.
        """
        return to_local(self, frame)


def load_area(given: str, what: str = "area") -> GeoArea:
    """An area from ``LAT,LON,RADIUS`` (degrees, m), WKT text, or a file.

    Files: KML, KMZ, GeoJSON, GeoPackage, shapefile, WKT; other projections than WGS84 are
    converted.

    Raises:
        InputError: one sentence saying what is wrong with it.
    """
    circle = _CIRCLE.fullmatch(given)
    if circle is not None:
        latitude, longitude, radius = (float(number) for number in circle.groups())
        return circle_area(latitude, longitude, radius, what)
    if re.match(r"\s*(SRID=\d+\s*;)?\s*(MULTI)?POLYGON\b", given, re.IGNORECASE):
        return area_from_parts(read_wkt(given, f"the {what}"), f"the {what}")
    path = Path(given).expanduser()
    reader = FILE_READERS.get(path.suffix.lower())
    if reader is None:
        known = ", ".join(sorted(FILE_READERS))
        raise InputError(
            f"The {what} {given} is neither LAT,LON,RADIUS nor WKT nor a file of a known kind ({known})."
        )
    if not path.is_file():
        raise InputError(f"There is no file {path} for the {what}.")
    return area_from_parts(reader(path), str(path))


def circle_area(latitude: float, longitude: float, radius_m: float, what: str = "area") -> GeoArea:
    """A circle around a point (degrees, m) as a polygon that contains it.

    Raises:
        InputError: no such place, or a radius that makes no sense.
    """
    source = f"the {what} {latitude:g},{longitude:g},{radius_m:g}"
    _check_degrees(np.array([[longitude, latitude]]), source)
    if not LEAST_ACROSS_M / 2 <= radius_m <= MOST_ACROSS_M / 2:
        raise InputError(
            f"The radius of {source} must be between {LEAST_ACROSS_M / 2:g} and {MOST_ACROSS_M / 2:g} m."
        )
    angle = 2 * np.pi * np.arange(CIRCLE_CORNERS) / CIRCLE_CORNERS
    corner = radius_m / math.cos(math.pi / CIRCLE_CORNERS)
    enu = np.stack([corner * np.sin(angle), corner * np.cos(angle), np.zeros_like(angle)], axis=-1)
    geodetic = LocalFrame(latitude, longitude).geodetic(enu)
    ring = np.stack([_near(geodetic[:, 1], longitude), geodetic[:, 0]], axis=-1)
    return GeoArea(Polygon(ring), source, (latitude, longitude, radius_m))


def area_from_corners(corners: Sequence[Sequence[float]], source: str) -> GeoArea:
    """An area from (latitude, longitude) pairs in degrees.

    Raises:
        InputError: fewer than three corners, no such place, self-crossing.
    """
    if len(corners) < 3:
        raise InputError(f"{_capital(source)} has {len(corners)} corners; a polygon needs three.")
    return area_from_parts([Polygon([(c[1], c[0]) for c in corners])], source)


def area_from_parts(parts: Sequence[BaseGeometry], source: str) -> GeoArea:
    """One checked polygon from the polygons (degrees) of a file; touching parts are joined.

    Raises:
        InputError: none, several, empty, self-crossing, or not on this planet.
    """
    polygons = [p for part in parts for p in shapely.get_parts(part) if isinstance(p, Polygon)]
    polygons = [p for p in polygons if not p.is_empty]
    if not polygons:
        raise InputError(f"There is no polygon in {source}.")
    start = float(shapely.get_coordinates(polygons[0])[0, 0])
    unwrapped = [_unwrapped(polygon, start, source) for polygon in polygons]
    for polygon in unwrapped:
        _check_valid(polygon, source)
    joined = shapely.union_all(unwrapped) if len(unwrapped) > 1 else unwrapped[0]
    if not isinstance(joined, Polygon):
        raise InputError(
            f"There are {len(shapely.get_parts(joined))} separate polygons in {source}; one mission has one "
            "area, so leave one of them or plan each on its own."
        )
    return GeoArea(shapely.remove_repeated_points(shapely.force_2d(joined)), source)


def to_local(area: GeoArea, frame: LocalFrame) -> Polygon:
    """See :meth:`GeoArea.local`."""
    polygon: Polygon = shapely.transform(area.polygon, lambda xy: local_points_m(frame, xy[:, 1], xy[:, 0]))
    west, south, east, north = polygon.bounds
    across = max(east - west, north - south)
    if not math.isfinite(across) or across > MOST_ACROSS_M:
        raise InputError(
            f"{_capital(area.source)} is {across / 1000:.0f} km across and one mission covers at most "
            f"{MOST_ACROSS_M / 1000:g} km; are longitude and latitude where they should be?"
        )
    if across < LEAST_ACROSS_M or polygon.area < LEAST_ACROSS_M**2:
        raise InputError(f"{_capital(area.source)} is smaller than a square metre.")
    if shapely.hausdorff_distance(shapely.Point(0, 0), polygon) > 2 * MOST_ACROSS_M:
        away = polygon.distance(shapely.Point(0, 0))
        raise InputError(f"{_capital(area.source)} is {away / 1000:.0f} km away from the launch point.")
    if not polygon.is_valid:  # Crossing by less than the degrees could show.
        polygon = _check_valid(polygon, area.source)
    return shapely.orient_polygons(polygon)


def local_points_m(frame: LocalFrame, latitude_deg: FloatArray, longitude_deg: FloatArray) -> FloatArray:
    """Ground points (n,), (n,) in degrees -> east, north (n, 2) in m."""
    altitude = np.full(np.shape(latitude_deg), frame.altitude_m)
    return frame.enu(latitude_deg, longitude_deg, altitude)[..., :2]


def _unwrapped(polygon: Polygon, start: float, source: str) -> Polygon:
    """The polygon with longitudes that do not jump at the date line, near ``start``."""
    _check_degrees(shapely.get_coordinates(polygon), source)

    def ring(coordinates: Any) -> FloatArray:
        xy = np.array(coordinates)[:, :2]
        xy[:, 0] = np.unwrap(np.concatenate([[start], xy[:, 0]]), period=360)[1:]
        return xy

    return Polygon(ring(polygon.exterior.coords), [ring(hole.coords) for hole in polygon.interiors])


def _near(longitude: FloatArray, reference: float) -> FloatArray:
    return reference + (longitude - reference + 180) % 360 - 180


def _check_degrees(lon_lat: FloatArray, source: str) -> None:
    if not np.isfinite(lon_lat[:, :2]).all():
        raise InputError(f"{_capital(source)} has a corner without numbers.")
    longitude, latitude = np.abs(lon_lat[:, 0]).max(), np.abs(lon_lat[:, 1]).max()
    if latitude > 90 or longitude > 360:
        kind, value = ("latitude", latitude) if latitude > 90 else ("longitude", longitude)
        raise InputError(
            f"{_capital(source)} has a {kind} of {value:g} degrees; are longitude and latitude swapped, or "
            "are these metres of a projection?"
        )
    if latitude > MOST_LATITUDE_DEG:
        raise InputError(
            f"{_capital(source)} lies within a degree of a pole, where no mission can be planned."
        )


def _check_valid(polygon: Polygon, source: str) -> Polygon:
    if polygon.is_valid:
        return polygon
    reason = shapely.is_valid_reason(polygon)
    place = re.search(r"\[([^ \]]+) ([^ \]]+)", reason)
    where = f" at {float(place[2]):.6f}, {float(place[1]):.6f}" if place is not None else ""
    fault = (
        "crosses itself"
        if "intersect" in reason.lower()
        else f"is not a proper polygon ({reason.split('[')[0]})"
    )
    raise InputError(f"The outline of {source} {fault}{where}; draw it again there.")


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]

"""Where the aircraft may and may not fly: polygons and circles in WGS84, and a ceiling.

The shape of QGroundControl's geofence (GeoFenceController, version 2), so that a fence goes into a
``.plan`` file and out again unchanged. Geometry over legs and arcs is :mod:`mission.limits`'.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

#: Corners as (latitude, longitude) in degrees, in order, the first one not repeated at the end.
Polygon = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Circle:
    """A round zone. Centre in degrees, radius in metres.

    ``inside``: the aircraft must stay in it (keep-in); otherwise out of it.
    """

    latitude_deg: float
    longitude_deg: float
    radius_m: float
    inside: bool = True

    def __post_init__(self) -> None:
        _check_point(self.latitude_deg, self.longitude_deg)
        if not (self.radius_m > 0 and math.isfinite(self.radius_m)):
            raise ValueError(f"a circle's radius must be more than 0 m, not {self.radius_m:g}")


@dataclass(frozen=True)
class Fence:
    """All zones together: inside every keep-in zone, outside every keep-out zone, below the ceiling.

    ``ceiling_m``: above the launch point; None where there is none.
    """

    keep_in: tuple[Polygon, ...] = ()
    keep_out: tuple[Polygon, ...] = ()
    circles: tuple[Circle, ...] = ()
    ceiling_m: float | None = None

    def __post_init__(self) -> None:
        for polygon in (*self.keep_in, *self.keep_out):
            if len(polygon) < 3:
                raise ValueError(f"a fence polygon needs three corners, not {len(polygon)}")
            for latitude, longitude in polygon:
                _check_point(latitude, longitude)
        if self.ceiling_m is not None and not (self.ceiling_m > 0 and math.isfinite(self.ceiling_m)):
            raise ValueError(f"a ceiling must be above 0 m, not {self.ceiling_m:g}")

    @property
    def is_empty(self) -> bool:
        """Nothing forbidden at all."""
        return not (self.keep_in or self.keep_out or self.circles) and self.ceiling_m is None


def _check_point(latitude_deg: float, longitude_deg: float) -> None:
    if not (-90 <= latitude_deg <= 90 and -180 <= longitude_deg <= 180):
        raise ValueError(f"{latitude_deg:g}, {longitude_deg:g} is no latitude and longitude in degrees")

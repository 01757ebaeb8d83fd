"""A plan with photos added by somebody else: ways that are not allowed are replaced by ways that are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import shapely

from mission.compose import return_height_m
from mission.connect import connection, lack_of_clearance_m
from mission.plan import Plan, Shot, Station, Waypoint
from mission.site import Site


def rerouted(plan: Plan, site: Site) -> Plan:
    """The same photos; legs without photos that cross the fence, a structure or the ground go round."""
    found: list[Waypoint] = []
    here = plan.path_m[0]
    on_line = False
    for waypoint in plan.waypoints:
        leg = np.array([here, waypoint.enu_m])
        if not on_line and not (site.space.clear(*leg) and lack_of_clearance_m(site, leg) <= 0):
            found += connection(site, here, waypoint.enu_m, waypoint) or []
        found.append(waypoint)
        here, on_line = waypoint.enu_m, waypoint.shot is Shot.LINE
    height = max(plan.return_height_m, return_height_m(site, found))
    return replace(plan, waypoints=tuple(found), return_height_m=height)


def allowed_station(site: Site) -> Callable[[Station], bool]:
    """Whether a photo may be taken somewhere: fence, structures, ceiling, ground, gimbal, reachable."""
    reachable = [
        part
        for part in shapely.get_parts(site.space.free(site.height_m))
        if part.distance(shapely.Point(0, 0)) <= site.space.margin_m + 0.01
    ] or list(shapely.get_parts(site.space.free(site.height_m)))

    def allowed(station: Station) -> bool:
        at = shapely.Point(station.east_m, station.north_m)
        vehicle, ceiling = site.vehicle, site.space.ceiling_m
        return (
            bool(site.space.free(station.height_m).covers(at))
            and any(part.covers(at) for part in reachable)
            and (ceiling is None or station.height_m <= ceiling - 0.1)
            and station.height_m - site.ground_m(station.east_m, station.north_m) >= site.clearance_m
            and vehicle.gimbal_lowest_deg <= station.pitch_deg <= vehicle.gimbal_highest_deg
        )

    return allowed

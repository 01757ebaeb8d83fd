"""Where the extra pass is flown: a check's network in the frame around the launch point, and its site."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import shapely
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from shapely import Polygon

from calib.align.adjust import Priors
from calib.align.georeference import DEFAULT_SIGMA_M
from calib.align.readout import way_information
from calib.align.selfcal import BASIC, mask
from calib.align.uncertainty import beyond_field
from calib.brownfit import fit_brown
from calib.camera import BROWN_NAMES, FloatArray
from calib.errors import InputError
from calib.field import Lens
from calib.flown import FlownNetwork
from calib.flown_file import FlownCheck
from calib.frames import LocalFrame
from calib.limits import Z95
from calib.network_design import dome_functional, lens_information
from calib.network_views import SIMULATED, nearest_view_deg
from calib.shutter import shows_no_readout
from mission.planned_network import Assumptions, PlannedNetwork
from mission.site import Site
from mission.site_build import site_of, terrain_of
from mission.site_file import SiteFile

#: Farther away, a launch point belongs to another place.
_FARTHEST_LAUNCH_M = 5000.0
#: Side of the cells of ground whose tie points' median is one height of the terrain.
_CELL_M = 8.0
#: Attitudes without a measurement are known to this much from the plan itself.
_ATTITUDE_SIGMA_DEG = 5.0
#: How much larger than formal sigmas the check's are after a pass. Correlated noise, most of what a plan
#: before take-off has to expect (2.7 of the rows in ``mission.planned_network``), is in the flight's own
#: noise already; left are the rows none, aspect, pattern (1.0) and rolling shutter (1.1).
MODEL_ERROR_FACTOR = 1.1
#: Pixels of real cameras are square to better than this share; five metres a second in 30 ms at 120 m are
#: more.
OUT_OF_SQUARE = 4e-4
#: A block whose own sigma exceeds that of its network by more than this had other trouble than geometry.
_MOST_LOST = 2.0


@dataclass(frozen=True, eq=False)
class TiePointTerrain:
    """The ground as the tie points have it; beyond them the nearest one's height."""

    inside: LinearNDInterpolator
    nearest: NearestNDInterpolator
    name: str = "the survey's tie points"
    resolution_m: float = _CELL_M

    def height_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """Heights (...) above the launch point at east (...), north (...), m."""
        found = np.asarray(self.inside(east_m, north_m), dtype=float)
        height: FloatArray = np.where(np.isfinite(found), found, self.nearest(east_m, north_m))
        return height


def tie_point_terrain(points_m: FloatArray) -> TiePointTerrain:
    """Terrain from points (m, 3)."""
    cell = np.floor(points_m[:, :2] / _CELL_M).astype(int)
    _, group = np.unique(cell, axis=0, return_inverse=True)
    order = np.argsort(group, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(group[order])) + 1)
    nodes = np.array([np.median(points_m[part], axis=0) for part in parts])
    if len(nodes) < 4 or np.linalg.matrix_rank(nodes[:, :2] - nodes[:, :2].mean(axis=0), tol=1.0) < 2:
        corners = 1000.0 * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
        nodes = np.column_stack([corners, np.full(4, np.median(points_m[:, 2]))])
    return TiePointTerrain(
        LinearNDInterpolator(nodes[:, :2], nodes[:, 2]), NearestNDInterpolator(nodes[:, :2], nodes[:, 2])
    )


@dataclass(frozen=True)
class FlownSite:
    """A flown block around its launch point.

    ``planned``: its network as the search takes it, camera heights above the launch point's ground.
    ``notes``: what was assumed, for the operator.
    """

    check: FlownCheck
    site: Site
    planned: PlannedNetwork
    notes: tuple[str, ...]

    @property
    def centres_m(self) -> FloatArray:
        """Where photos were taken, (k, 3)."""
        return self.planned.network.centres_m


def flown_site(check: FlownCheck, keys: SiteFile, name: str = "refly") -> FlownSite:
    """The block of ``check`` and the limits of ``keys`` (area, camera and height come from the block).

    Raises:
        InputError: no believed geotags place the block, or a key is unusable.
    """
    if check.origin_wgs84 is None:
        why = f" {check.geotag_fault}" if check.geotag_fault else ""
        raise InputError(
            "The photos' positions do not say where this block lies, so no stations can be given for "
            f"it.{why} Fly  a circle by hand as the report says under What to fly."
        )
    own = LocalFrame(*check.origin_wgs84)
    net = check.flown.network
    notes = []
    if keys.launch is None:
        place = own.geodetic(net.centres_m[:1])[0]
        latitude, longitude = float(place[0]), float(place[1])
        notes.append("No launch point is given: the place below the first photo is taken.")
    else:
        latitude, longitude = keys.launch
    at = own.enu(np.array([latitude]), np.array([longitude]), np.array([own.altitude_m]))[0]
    away = float(np.linalg.norm(net.centres_m[:, :2] - at[:2], axis=1).min())
    if not away < _FARTHEST_LAUNCH_M:
        raise InputError(
            f"The launch point {latitude:.6f}, {longitude:.6f} is {away / 1000:.1f} km from the nearest "
            "photo; is it right?"
        )
    up = _launch_up_m(check, at, notes, keys.launch is not None)
    launch = LocalFrame(latitude, longitude, own.altitude_m + up)
    points, centres = (launch.enu(*own.geodetic(given).T) for given in (net.points_m, net.centres_m))
    moved = replace(net, points_m=points, centres_m=centres)
    hull = shapely.MultiPoint(centres[:, :2]).convex_hull
    area = hull if isinstance(hull, Polygon) else hull.buffer(0.3 * check.height_agl_m)
    hidden = hidden_shutter(check, keys.mechanical_shutter)
    if hidden:
        notes.append(
            "These photos do not show whether the camera reads its rows one after the other while it moves "
            "(a rolling shutter). The pass allows for that; with --mechanical-shutter it does not."
        )
    frame = LocalFrame(latitude, longitude)
    terrain = (
        tie_point_terrain(points)
        if keys.dem is None
        else terrain_of(keys.dem, frame, area, check.height_agl_m)
    )
    height = round(check.height_agl_m, 1)
    site = site_of(keys, name, frame, area, check.brown, check.camera_name, height, terrain)
    planned = _planned(replace(check.flown, network=moved), check, hidden)
    return FlownSite(check, site, planned, tuple(notes))


def _launch_up_m(check: FlownCheck, at_m: FloatArray, notes: list[str], given: bool) -> float:
    """Height of the launch point in the network's frame; ``at_m`` (3,) its place there."""
    terrain = tie_point_terrain(check.flown.network.points_m)
    ground = float(terrain.height_m(at_m[:1], at_m[1:2])[0])
    if check.launch_up_m is None:
        notes.append("The photos do not say how high above the launch point they are: ground heights count.")
        return ground
    if given and abs(ground - check.launch_up_m) > 0.3 * check.height_agl_m:
        notes.append(
            f"The ground at the launch point lies {abs(ground - check.launch_up_m):.0f} m "
            f"{'above' if ground > check.launch_up_m else 'below'} where the flight began: "
            "heights count from the ground there."
        )
        return ground
    return check.launch_up_m


def hidden_shutter(check: FlownCheck, mechanical: bool | None = None) -> bool:
    """Whether a rolling shutter may hide in the affinity: it is not shown that the pixels are square.

    Where all lines are flown the same way in the image, the way during the readout stretches every photo
    alike. Photos from aside tell the two apart, and the check then asks for the way of every single photo.
    Cameras that are known to have none are believed, and who says it: ``mechanical``.
    """
    if mechanical is None:
        mechanical = shows_no_readout(check.camera_name)
    if check.flown.known.way_information is not None or mechanical:
        return False
    at = [BROWN_NAMES.index(name) for name in ("b1", "b2")]
    affinity = float(np.linalg.norm(check.brown.vector[at]))
    sigma = math.sqrt(float(np.linalg.eigvalsh(check.brown_covariance[np.ix_(at, at)])[-1]))
    return affinity + Z95 * sigma > OUT_OF_SQUARE * check.brown.f_px


def _with_its_pattern(lens: Lens, check: FlownCheck) -> Lens:
    """The lens with as much of a pattern as it has: a weak flight shows less of it than the reference."""
    known = check.reference_field_px
    if known is None or float(np.sum(known**2)) <= float(np.sum(lens.field_px**2)):
        return lens
    return replace(lens, field_px=known)


def _planned(flown: FlownNetwork, check: FlownCheck, hidden: bool) -> PlannedNetwork:
    """The network as the search takes it, with the block's own noise, tie points and priors.

    ``hidden``: a rolling shutter is to be allowed for.
    """
    lens = flown.network.lens
    # With more photos more parameters are significant: the pass has to serve all of them.
    free = mask((*BASIC, "k3", "p1", "p2", "b1", "b2"), field=True)
    ways = flown.known.way_information
    if hidden:
        ways = way_information(flown.network.centres_m, check.height_agl_m)
    # Precise positions that contradict the images are dropped, perhaps only when the pass is there to show
    # it: the images have to do without them.
    known = replace(
        flown.known,
        free=free,
        centre_sigma_m=np.maximum(flown.known.centre_sigma_m, DEFAULT_SIGMA_M),
        way_information=ways,
    )
    functionals = dome_functional(flown.network.points_m)[None]
    gradient = fit_brown(lens)[1][0]
    same = lens_information(flown.network, flown.known).covariance
    formal_px = math.sqrt(float(gradient @ same @ gradient))
    # What thinning and a rolling shutter's unknowns take away; it never adds.
    lost = max(check.sigma_f_formal_px / formal_px, 1.0)
    rotation = flown.known.rotation_sigma_rad[np.isfinite(flown.known.rotation_sigma_rad)]
    position = known.centre_sigma_m[np.isfinite(known.centre_sigma_m)]
    assumptions = Assumptions(
        noise_px=flown.noise_px,
        tie_points_per_photo=flown.tie_points_per_photo,
        points_per_photo=max(round(flown.points_per_photo), 1),
        matching=SIMULATED,
        position_sigma_m=float(np.median(position)) if len(position) else 100.0,
        attitude_sigma_deg=math.degrees(np.median(rotation)) if len(rotation) else _ATTITUDE_SIGMA_DEG,
        model_error_factor=MODEL_ERROR_FACTOR * min(lost, _MOST_LOST),
    )
    net = flown.network
    priors = Priors(
        net.centres_m, known.centre_sigma_m, net.rotations, known.rotation_sigma_rad, lens.vector,
        known.lens_sigma,
    )  # fmt: skip
    beyond = beyond_field(_with_its_pattern(lens, check), free, priors)[np.ix_(free, free)]
    # The flight's own tie points are those matched at its own angles already.
    angles = nearest_view_deg(net.photo, net.point, net.centres_m, net.points_m)
    own_share = max(float(np.mean(SIMULATED.share(angles))), flown.matched_share)
    given = check.reference_covariance
    reference = None if given is None else given[np.ix_(free, free)]
    return PlannedNetwork(
        net, known, functionals, gradient[free], check.height_agl_m, assumptions, beyond, own_share, reference
    )

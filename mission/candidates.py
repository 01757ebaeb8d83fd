"""Photos that might be added: single stations, rings, and what each would measure."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib.camera import FloatArray
from calib.network_design import Reduced, reduce_network
from calib.network_extension import (
    Joint,
    PhotoPool,
    PhotoRows,
    joint_covariance,
    photos_of,
    rows_of_photos,
)
from calib.network_views import angle_to_views_deg, nearest_view_deg, seen_points, view_table
from calib.solution import IntArray
from mission.plan import Station, Vehicle, looking_inwards
from mission.planned_network import PlannedNetwork, poses
from mission.route import Detours, Gap

#: Ground points of one candidate photo: used in the search, used in its check, fewest to count.
MOST_POINTS, CHECK_POINTS, LEAST_POINTS = 16, 36, 8
#: Points of the network around the place of the extra photos, at most.
WINDOW_POINTS = 260
#: Around each of several places.
WINDOW_POINTS_EACH = 140
#: Oblique photos reach that far, in flying heights, and tie the site together.
REACH = 2.5
#: Of all points there an even part is used: so many in a photo that looks straight down (in the search, in
#: its check), and altogether at most.
IN_VIEW, CHECK_IN_VIEW = 16, 32
MOST_EVEN, CHECK_MOST_EVEN = 160, 320
#: Of these a photo has to see at least so many.
LEAST_EVEN = 5
#: More photos than this are checked with the search's points: their share of the work grows with the third
#: power, and thinned points tell almost the same.
FEW_PHOTOS = 14
#: Tilts off nadir, heights over the survey's, and numbers of photos of the rings tried.
TILTS_DEG = (20.0, 30.0, 40.0)
HEIGHT_FACTORS = (1.0, 1.3)
RING_PHOTOS = (4, 6, 8, 12, 16)
PATTERN = "fix"


@dataclass(frozen=True)
class _Ground:
    """Points of the network that photos are tied to: each stands for ``stands_for`` of the network's."""

    joint: Joint
    views: FloatArray
    stands_for: float


def _part(points: IntArray, stands_for: float) -> IntArray:
    """Every ``stands_for``-th of ``points``."""
    count = max(round(len(points) / stands_for), 1)
    found: IntArray = points[np.linspace(0, len(points) - 1, count).astype(int)]
    return found


def _ground(
    planned: PlannedNetwork, points: IntArray, stands_for: float = 1.0, reduced: Reduced | None = None
) -> _Ground:
    """Every ``stands_for``-th of the network's ``points``, and the views of them that there are."""
    net = planned.network
    part = _part(points, stands_for)
    place = np.full(len(net.points_m), -1)
    place[part] = np.arange(len(part))
    views = place[net.point] >= 0
    ray = net.centres_m[net.photo[views]] - net.points_m[net.point[views]]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    table = view_table(ray, place[net.point[views]], len(part))
    return _Ground(
        joint_covariance(net, planned.known, planned.functionals, part, stands_for, reduced),
        table,
        stands_for,
    )


class Candidates:
    """A pool of photos over one network around ``middles_m`` (k, 2), growing while it is searched."""

    def __init__(
        self,
        planned: PlannedNetwork,
        middles_m: FloatArray,
        vehicle: Vehicle,
        gaps: Sequence[Gap],
        feasible: Callable[[Station], bool] | None,
        most_points: int = MOST_POINTS,
        even: bool = False,
    ) -> None:
        """``even``: an even part of all points within reach, instead of the nearest ones."""
        self.planned, self.vehicle, self.most_points, self._even = planned, vehicle, most_points, even
        self.feasible = feasible or (lambda _: True)
        away = np.linalg.norm(planned.network.points_m[:, None, :2] - middles_m, axis=2)
        each = WINDOW_POINTS if len(middles_m) == 1 else WINDOW_POINTS_EACH
        nearest = np.argsort(away, axis=0, kind="stable")[: len(away) if even else each].ravel()
        self._near = np.unique(nearest[away[nearest].min(axis=1) < REACH * planned.height_agl_m])
        self._ground = self._even_ground(IN_VIEW, MOST_EVEN) if even else _ground(planned, self._near)
        self.stations: list[Station] = []
        self.pool = PhotoPool(self.joint, [])
        self.detours = Detours(vehicle, gaps, np.zeros((0, 3)))
        self._index: dict[Station, int] = {}
        self._useless: set[Station] = set()

    @property
    def joint(self) -> Joint:
        """Of the network and the points that the search uses."""
        return self._ground.joint

    def _even_ground(self, in_view: int, most: int) -> _Ground:
        return _ground(self.planned, self._near, self._thinning(in_view, most), self._reduced)

    def _thinning(self, in_view: int, most: int) -> float:
        per_photo = self.planned.assumptions.points_per_photo
        return max(per_photo / in_view, len(self._near) / most, 1.0)

    @cached_property
    def _reduced(self) -> Reduced:
        """The network reduced to the photos of all points that search or check use: most of the work."""
        planned = self.planned
        parts = [
            _part(self._near, self._thinning(*given))
            for given in ((IN_VIEW, MOST_EVEN), (CHECK_IN_VIEW, CHECK_MOST_EVEN))
        ]
        kept = photos_of(planned.network, np.concatenate(parts))
        return reduce_network(planned.network, planned.known, planned.functionals, kept)

    @cached_property
    def _check_ground(self) -> _Ground:
        return self._even_ground(CHECK_IN_VIEW, CHECK_MOST_EVEN) if self._even else self._ground

    def add(self, stations: Sequence[Station]) -> list[int | None]:
        """Their numbers in the pool; None where a photo is not allowed or sees too little."""
        new = [
            s
            for s in dict.fromkeys(stations)
            if s not in self._index
            and s not in self._useless
            and self.vehicle.gimbal_lowest_deg <= s.pitch_deg <= self.vehicle.gimbal_highest_deg
            and self.feasible(s)
        ]
        kept = []
        for station, rows in zip(new, self._rows(self._ground, new, self.most_points), strict=True):
            if rows is None:
                self._useless.add(station)
            else:
                self._index[station] = len(self.stations)
                self.stations.append(station)
                self.pool.rows.append(rows)
                kept.append([station.east_m, station.north_m, station.height_m])
        if kept:
            self.detours.add(np.array(kept))
        return [self._index.get(s) for s in stations]

    def dense_pool(self, photos: Sequence[int]) -> PhotoPool:
        """The same photos with more of the points that they see: what the search is checked with.

        They are matched among each other, too.
        """
        ground = self._check_ground if len(photos) <= FEW_PHOTOS else self._ground
        rows = self._rows(ground, [self.stations[i] for i in photos], CHECK_POINTS, together=True)
        return PhotoPool(ground.joint, [r for r in rows if r is not None])

    def _rows(
        self, ground: _Ground, stations: Sequence[Station], most: int, together: bool = False
    ) -> list[PhotoRows | None]:
        """What each photo measures; of more than ``most`` points (any number, of an even ground) a part."""
        if not stations:
            return []
        planned, joint = self.planned, ground.joint
        camera, given = planned.network.lens.brown, planned.assumptions
        rotations, centres = poses(stations, given.attitude_scatter_deg)
        photo, point = seen_points(
            camera, rotations, centres, joint.points_m, given.matching.max_incidence_deg
        )
        ray = centres[photo] - joint.points_m[point]
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        angle = angle_to_views_deg(ray, point, ground.views)
        if together:
            angle = np.minimum(angle, nearest_view_deg(photo, point, centres, joint.points_m))
        share = given.matching.share(angle) / planned.own_share
        used = share > 0.02
        photo, point, share = photo[used], point[used], share[used]
        pose_sigma = (math.radians(given.attitude_sigma_deg), given.position_sigma_m)
        views, weights = [], []
        for i in range(len(stations)):
            mine: IntArray = np.flatnonzero(photo == i)
            if len(mine) < (LEAST_EVEN if self._even else LEAST_POINTS):
                continue
            weight = 1.0
            if len(mine) > most and not self._even:
                # Every n-th of an even sequence is even again.
                part = mine[np.linspace(0, len(mine) - 1, most).astype(int)]
                weight, mine = float(share[mine].sum() / share[part].sum()), part
            views.append(mine)
            weights.append(weight * share[mine])
        found: list[PhotoRows | None] = [None] * len(stations)
        if not views:
            return found
        rows = np.concatenate(views)
        sigma = given.sigma_px / np.sqrt(ground.stands_for * np.concatenate(weights))
        made = rows_of_photos(
            joint, planned.network.lens, planned.known, rotations, centres, photo[rows], point[rows], sigma,
            pose_sigma, planned.new_way_information,
        )  # fmt: skip
        for mine in views:
            i = int(photo[mine[0]])
            found[i] = made[i]
        return found


def single_stations(middle_m: FloatArray, ground_m: float, height_m: float) -> list[Station]:
    """Photos on a grid of places, heights, directions and tilts that look at the ground around ``middle_m``.

    ``middle_m`` (2,), ``ground_m``: ground height there, ``height_m``: of the survey above ground.
    """
    found = []
    steps = np.arange(-3, 4) * 0.5
    for factor in HEIGHT_FACTORS:
        h = factor * height_m
        for x in steps:
            for y in steps:
                for tilt in TILTS_DEG:
                    for yaw in range(0, 360, 45):
                        reach = factor * math.tan(math.radians(tilt))
                        aim = np.array([x, y]) + reach * np.array(
                            [math.sin(math.radians(yaw)), math.cos(math.radians(yaw))]
                        )
                        if np.hypot(*aim) <= 0.55:
                            found.append(
                                Station(
                                    float(middle_m[0] + x * height_m),
                                    float(middle_m[1] + y * height_m),
                                    ground_m + h,
                                    float(yaw),
                                    tilt - 90.0,
                                    PATTERN,
                                )
                            )
    return found


def rings(middle_m: FloatArray, ground_m: float, height_m: float) -> list[list[Station]]:
    """Orbits and fans around ``middle_m``: circles of photos that look at it."""
    found = []
    for factor in HEIGHT_FACTORS:
        for tilt in (30.0, 40.0):
            radius = factor * height_m * math.tan(math.radians(tilt))
            for count in RING_PHOTOS:
                azimuth = 360.0 * np.arange(count) / count
                up_m = ground_m + factor * height_m
                found.append(list(looking_inwards(middle_m, up_m, radius, azimuth, tilt, PATTERN)))
    return found

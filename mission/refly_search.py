"""The shortest pass that cures a flown network, within what site and battery allow."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import shapely
import shapely.ops

from calib.camera import FloatArray
from calib.evidence import CONVERGENT_DEG
from calib.limits import CONVERGENT_LIMIT_PERCENT, LEAST_CONVERGENT
from mission.candidates import Candidates
from mission.fixing import polish
from mission.optimise import Choice, Criterion, Search
from mission.plan import Station
from mission.planned_network import PlannedNetwork
from mission.refly_passes import Shape, arcs, orbits, paper_fan, singles, strips, tilts_for
from mission.refly_route import PassDetours
from mission.reroute import allowed_station
from mission.route import Gap
from mission.site import Site

#: The search thins each photo's points; a pass that fails with all of them is searched again, stricter.
_ROUNDS = 4


@dataclass(frozen=True)
class Worth:
    """What is known with a pass taken: f, dome in percent (model error included), and the lens's covariance.

    ``lens`` (q, q) over the network's free parameters, model error included.
    """

    sigma_f_percent: float
    dome_percent: float
    lens: FloatArray


@dataclass(frozen=True)
class Found:
    """A pass: photos in the order in which they are flown, what it costs and what it is worth.

    ``good``: the criterion holds with any one photo missing; ``ratio`` against its limits (1: just).
    ``shape``: the regular pass that it is, None for single photos.
    """

    stations: tuple[Station, ...]
    seconds: float
    ratio: float
    worth: Worth
    shape: Shape | None

    @property
    def good(self) -> bool:
        """Whether it cures."""
        return self.ratio <= 1.0


def criterion_for(planned: PlannedNetwork) -> Criterion:
    """Limits of f and dome, and as many photos that the check counts enough oblique ones with one missing."""
    axis = planned.network.rotations[:, 2, :]
    tilt = np.degrees(np.arccos(np.clip(-axis[:, 2], -1, 1)))
    oblique = int((tilt >= CONVERGENT_DEG).sum())
    if 100 * oblique >= CONVERGENT_LIMIT_PERCENT * (len(tilt) + LEAST_CONVERGENT):
        return Criterion()
    return Criterion(least_photos=max(LEAST_CONVERGENT - oblique, 0) + 1)


def place_of_pass(planned: PlannedNetwork) -> FloatArray:
    """Middle (2,) of the ground that the pass looks at: well inside the block, near the launch point."""
    hull = shapely.MultiPoint(planned.network.centres_m[:, :2]).convex_hull
    for share in (1.0, 0.7, 0.4):
        inner = hull.buffer(-share * planned.height_agl_m)
        if not inner.is_empty:
            nearest = shapely.ops.nearest_points(inner, shapely.Point(0, 0))[0]
            return np.array([nearest.x, nearest.y])
    return np.array([hull.centroid.x, hull.centroid.y])


def line_direction_deg(planned: PlannedNetwork) -> float:
    """Compass direction of the survey's lines: the commonest way from one photo to the next."""
    steps = np.diff(planned.network.centres_m[:, :2], axis=0)
    twice = 2 * np.arctan2(steps[:, 0], steps[:, 1])
    weight = np.linalg.norm(steps, axis=1)
    mean = math.atan2(float(weight @ np.sin(twice)), float(weight @ np.cos(twice)))
    return math.degrees(mean / 2) % 180.0


class PassSearch:
    """Candidates of one site around one place, searched under one criterion.

    ``most_s``: longest flight, from the ground and back.
    """

    def __init__(
        self,
        planned: PlannedNetwork,
        site: Site,
        return_height_m: float,
        most_s: float = math.inf,
        criterion: Criterion | None = None,
        feasible: Callable[[Station], bool] | None = None,
    ) -> None:
        self.planned, self.site, self.most_s = planned, site, most_s
        self.criterion = criterion or criterion_for(planned)
        self.middle_m = place_of_pass(planned)
        self.ground_m = site.ground_m(float(self.middle_m[0]), float(self.middle_m[1]))
        ground = np.zeros(3)
        allowed = feasible or allowed_station(site)
        gaps = [Gap(ground, ground, 0)]
        self.candidates = Candidates(planned, self.middle_m, site.vehicle, gaps, allowed)
        self.candidates.detours = PassDetours(site.vehicle, return_height_m)
        self.shapes: list[tuple[tuple[int, ...], Shape]] = []
        self._worths: dict[tuple[int, ...], tuple[float, Worth]] = {}

    def fill(self) -> None:
        """Put every candidate that is allowed into the pool."""
        middle, ground, height = self.middle_m, self.ground_m, self.planned.height_agl_m
        tilts = tilts_for(self.site.vehicle)
        if tilts:
            self._add_shapes([*orbits(middle, ground, height, tilts), paper_fan(middle, ground, height)])
            self._add_shapes(arcs(middle, ground, height, tilts))
            self.candidates.add(singles(middle, ground, height, tilts))
        else:
            along = line_direction_deg(self.planned)
            self._add_shapes(strips(middle, ground, height, along))

    def _add_shapes(self, shapes: list[Shape]) -> None:
        for shape in shapes:
            kept = [i for i in self.candidates.add(shape.stations) if i is not None]
            # What the fence leaves of a circle is a pass, too, but not that circle.
            if kept and (len(kept) == len(shape.stations) or shape.kind == "orbit"):
                self.shapes.append((tuple(sorted(set(kept))), shape))

    def search(self, criterion: Criterion) -> Search:
        """A search over the pool under another criterion."""
        return Search(
            self.candidates.pool, self.planned.worth, self.candidates.detours, criterion
        )

    def best(self) -> Found | None:
        """The shortest pass that cures, or what comes nearest; None where no photo is allowed."""
        if not self.candidates.stations:
            return None
        wanted = self.criterion
        found: Found | None = None
        for _ in range(_ROUNDS):
            hunt = self.search(wanted)
            choice = hunt.best([photos for photos, _ in self.shapes if len(photos) > 2])
            choice = polish(self.candidates, hunt, choice, self.ground_m)
            found = self.found(choice.photos)
            if found.good or not choice.good:
                break
            tighter = (wanted.sigma_f_percent / self.criterion.sigma_f_percent) / (1.02 * found.ratio)
            wanted = Criterion(
                self.criterion.sigma_f_percent * tighter,
                self.criterion.dome_percent * tighter,
                self.criterion.least_photos,
            )
        regular = self.regular("orbit", "arc", "strip")
        if found is not None and regular is not None and regular.good:
            if not found.good or regular.seconds < found.seconds - 0.05:
                found = regular
        if found is not None and found.seconds > self.most_s:
            return self.within_time()
        return found

    def within_time(self) -> Found | None:
        """The pass worth most among those that the battery allows."""
        hunt = self.search(self.criterion)
        best: Found | None = None
        for by_time in (True, False):
            choice = hunt.greedy((), by_time, self.most_s)
            photos = choice.photos
            while photos and self.candidates.detours.seconds(photos) > self.most_s:
                photos = self._without_dearest(photos)
            if photos:
                found = self.found(photos)
                if best is None or found.ratio < best.ratio:
                    best = found
        return best

    def _without_dearest(self, photos: tuple[int, ...]) -> tuple[int, ...]:
        rests = [tuple(p for p in photos if p != one) for one in photos]
        return min(rests, key=lambda rest: (self.candidates.detours.seconds(rest), rest))

    def regular(self, *kinds: str, whole: bool = False) -> Found | None:
        """The shortest regular pass of these kinds that cures; where none does, the best one.

        ``whole``: only if all of its photos are allowed.
        """
        options = [
            (self.candidates.detours.seconds(photos), photos, shape)
            for photos, shape in self.shapes
            if shape.kind in kinds and (not whole or len(photos) == len(shape.stations))
        ]
        hunt = self.search(self.criterion)
        nearest: tuple[float, tuple[int, ...]] | None = None
        for seconds, photos, _ in sorted(options, key=lambda o: (o[0], o[1])):
            if seconds > self.most_s:
                break
            ratio = hunt.ratio(photos)
            if ratio <= 1.05:
                found = self.found(photos)
                if found.good:
                    return found
                ratio = found.ratio
            if nearest is None or ratio < nearest[0]:
                nearest = (ratio, photos)
        return None if nearest is None else self.found(nearest[1])

    def found(self, photos: tuple[int, ...]) -> Found:
        """Photos of the pool as a pass, valued with all the points that they see."""
        photos = tuple(sorted(photos))
        if photos not in self._worths:
            dense = self.candidates.dense_pool(photos)
            check = Search(dense, self.planned.worth, self.candidates.detours, self.criterion)
            with_all = dense.combined(tuple(range(len(dense)))).head
            q = len(self.planned.f_gradient)
            factor = self.planned.assumptions.model_error_factor
            worth = Worth(*self.planned.worth(with_all), factor**2 * with_all[:q, :q])
            self._worths[photos] = (check.ratio(range(len(dense))), worth)
        ratio, worth = self._worths[photos]
        order = self.candidates.detours.order(photos)[0]
        shape = next((shape for known, shape in self.shapes if known == photos), None)
        return Found(
            tuple(self.candidates.stations[i] for i in order),
            self.candidates.detours.seconds(photos),
            ratio,
            worth,
            shape,
        )

    def nothing_added(self) -> Choice:
        """The network as it is."""
        return self.search(Criterion()).choice(())

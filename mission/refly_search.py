"""The shortest pass that cures a flown network, within what site and battery allow."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
import shapely
import shapely.ops

from calib.camera import FloatArray
from calib.evidence import CONVERGENT_DEG
from calib.limits import CONVERGENT_LIMIT_PERCENT, FOCAL_LIMIT_PERCENT, LEAST_CONVERGENT, Z95
from mission.candidates import Candidates
from mission.fixing import polish
from mission.optimise import Choice, Criterion, Search, Worths
from mission.plan import Station
from mission.planned_network import PlannedNetwork
from mission.refly_passes import (
    AIM_DEG,
    LEAST_HEIGHT,
    MOST_TILT_DEG,
    Over,
    Shape,
    arcs,
    heights_for,
    orbits,
    paper_fan,
    singles,
    strips,
    tilts_for,
)
from mission.refly_route import PassDetours
from mission.reroute import allowed_station
from mission.route import Gap
from mission.site import Site

#: The search thins each photo's points; a pass that fails with all of them is searched again, stricter.
_ROUNDS = 3
#: What the thinned search lacks, mostly; a pass so near to what is asked for is not searched again; photos
#: that are left out on trial at the end.
_FIRST_SHARE, _CLOSE, _TRIMS = 1.15, 0.9, 3
#: Sigma of f against the reference with which the check trusts a camera that has not changed: an error as
#: large as it has five times in a thousand flights (2.8 sigma) is still within the limit at 95 %.
CURED_SIGMA_F_PERCENT = FOCAL_LIMIT_PERCENT / (Z95 + 2.8)
#: However little of that the reference leaves: less is not asked of f.
LEAST_SIGMA_F_PERCENT = 0.6 * CURED_SIGMA_F_PERCENT
#: The dome's sigma is mostly a bound on what the lens model cannot follow: errors are about half of it, and
#: 1.96 of it and 1.6 such errors are within [C&D]'s 0.1 % of the height.
CURED_DOME_PERCENT = 0.035
#: Of the fewest convergent photos that the check asks for, so many may fail: at 5 % each, two of four do so
#: once in seventy flights, three of five once in eight hundred.
SPARE_PHOTOS = 2
#: Passes of more photos are not polished: one photo more or less hardly shows in them.
MANY_PHOTOS = 14
#: Least distance, in flying heights, between photos whose axes differ by less than this.
APART, APART_DEG = 0.18, 15.0


@dataclass(frozen=True)
class Worth:
    """What is known with a pass taken: f, dome in percent (model error included), and the lens's covariance.

    ``lens`` (q, q) over the network's free parameters, model error included. ``dome_beyond_percent``: the
    part of the dome that the lens model cannot follow; ``dome_reference_percent``: the reference's own part.
    """

    sigma_f_percent: float
    dome_percent: float
    lens: FloatArray
    dome_beyond_percent: float = 0.0
    dome_reference_percent: float = 0.0


@dataclass(frozen=True)
class Found:
    """A pass: photos in the order in which they are flown, what it costs and what it is worth.

    ``ratio``: f and dome against their limits with the worst photo missing (1: just good).
    ``counted``: enough of its photos are oblique enough for the check, with one missing. ``shape``: the
    regular pass that it is, None for single photos.
    """

    stations: tuple[Station, ...]
    seconds: float
    ratio: float
    counted: bool
    worth: Worth
    shape: Shape | None

    @property
    def good(self) -> bool:
        """Whether it cures."""
        return self.counted and self.ratio <= 1.0

    @property
    def rank(self) -> tuple[bool, float, float]:
        """Smaller is nearer to a cure, then shorter."""
        return (not self.counted, max(self.ratio, 1.0), self.seconds)


def criterion_for(planned: PlannedNetwork) -> Criterion:
    """Limits of f and dome, and so many photos that the check counts enough oblique ones with two missing."""
    axis = planned.network.rotations[:, 2, :]
    tilt = np.degrees(np.arccos(np.clip(-axis[:, 2], -1, 1)))
    oblique = int((tilt >= CONVERGENT_DEG).sum())
    enough = 100 * oblique >= CONVERGENT_LIMIT_PERCENT * (len(tilt) + LEAST_CONVERGENT)
    return Criterion(
        cured_sigma_f_percent(planned.reference_sigma_f_percent),
        CURED_DOME_PERCENT,
        0 if enough else max(LEAST_CONVERGENT - oblique, 0) + SPARE_PHOTOS,
    )


def cured_sigma_f_percent(reference_percent: float) -> float:
    """Sigma of f that a pass has to reach, beside a reference whose own is ``reference_percent``."""
    left = CURED_SIGMA_F_PERCENT**2 - reference_percent**2
    return max(math.sqrt(max(left, 0.0)), LEAST_SIGMA_F_PERCENT)


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
        self.tilts_deg = tilts_for(site.vehicle)
        allowed = feasible or allowed_station(site)

        ceiling = site.space.ceiling_m
        self.heights = heights_for(
            planned.height_agl_m, math.inf if ceiling is None else ceiling - self.ground_m
        )
        lowest_m = 0.97 * min((*self.heights, LEAST_HEIGHT)) * planned.height_agl_m

        def counts(station: Station) -> bool:
            """Whether the check counts it as convergent (where the camera can look aside), and the survey's
            photos will match it: not from much nearer, not too flatly."""
            tilt = 90.0 + station.pitch_deg
            if not self.tilts_deg:
                return True
            return (
                CONVERGENT_DEG + AIM_DEG - 0.01 <= tilt <= MOST_TILT_DEG
                and station.height_m - self.ground_m >= lowest_m
            )

        gaps = [Gap(np.zeros(3), np.zeros(3), 0)]
        self.candidates = Candidates(
            planned, self.middle_m[None], site.vehicle, gaps, lambda s: counts(s) and allowed(s), even=True
        )
        self.candidates.detours = PassDetours(site.vehicle, return_height_m)
        #: Seconds of the shortest cure that :meth:`best` found, however long; None: none.
        self.cure_s: float | None = None
        self.shapes: list[tuple[tuple[int, ...], Shape]] = []
        self._found: dict[tuple[int, ...], Found] = {}
        self._worths = Worths(self.candidates.pool, planned.worth)

    def fill(self) -> None:
        """Put every candidate that is allowed into the pool."""
        over = self.over
        place = (over.middle_m, over.ground_m, over.height_m)
        if over.tilts_deg:
            self._add_shapes([*orbits(over), paper_fan(*place)])
            self._add_shapes(arcs(over))
            self.candidates.add(singles(over))
        else:
            self._add_shapes(strips(*place, line_direction_deg(self.planned)))

    @property
    def over(self) -> Over:
        """The place, and what passes over it may be made of."""
        return Over(self.middle_m, self.ground_m, self.planned.height_agl_m, self.tilts_deg, self.heights)

    def alike(self, one: int, other: int) -> bool:
        """Whether two candidates look the same way from nearly the same place: one fault would spoil both."""
        a, b = self.candidates.stations[one], self.candidates.stations[other]
        here, there = (a.east_m, a.north_m, a.height_m), (b.east_m, b.north_m, b.height_m)
        if math.dist(here, there) >= APART * self.planned.height_agl_m:
            return False
        lean, other_lean = math.radians(90.0 + a.pitch_deg), math.radians(90.0 + b.pitch_deg)
        turn = math.cos(math.radians(a.yaw_deg - b.yaw_deg))
        cosine = math.sin(lean) * math.sin(other_lean) * turn + math.cos(lean) * math.cos(other_lean)
        return cosine > math.cos(math.radians(APART_DEG))

    def _add_shapes(self, shapes: list[Shape]) -> None:
        for shape in shapes:
            kept = [i for i in self.candidates.add(shape.stations) if i is not None]
            # What the fence leaves of a circle is a pass, too, but not that circle.
            if kept and (len(kept) == len(shape.stations) or shape.kind == "orbit"):
                self.shapes.append((tuple(sorted(set(kept))), shape))

    def search(self, criterion: Criterion) -> Search:
        """A search over the pool under another criterion."""
        return Search(self._worths, self.candidates.detours, criterion, self.alike)

    def best(self) -> Found | None:
        """The shortest pass that cures, or what comes nearest; None where no photo is allowed."""
        if not self.candidates.stations:
            return None
        regular = self.regular("orbit", "arc", "strip")
        if not self.tilts_deg:
            return regular
        found = self._cheapest()
        if regular is not None and regular.rank < found.rank:
            found = regular
        self.cure_s = found.seconds if found.good else None
        return self.within_time() if found.seconds > self.most_s else found

    def _cheapest(self) -> Found:
        """The shortest of a few searches: each under limits that make up for what the last one left out.

        The search thins points and lets no photo of the pass be matched with another one of it, so that a
        pass does more than it says, or at times less.
        """
        share = _FIRST_SHARE
        found: Found | None = None
        for _ in range(_ROUNDS):
            hunt = self._eased(share)
            choice = hunt.greedy((), by_time=False)
            many = len(choice.photos) > MANY_PHOTOS
            if not many:
                choice = hunt.best([photos for photos, _ in self.shapes if len(photos) > 2], self._parts())
                choice = self._improved(hunt, choice)
            first = self.found(choice.photos)
            now = self._trimmed(choice.photos) if first.good and not many else first
            if found is None or now.rank < found.rank:
                found = now
            if _CLOSE <= first.ratio <= 1.0 or (first.ratio > 1 and not choice.good):
                break
            share /= 1.02 * first.ratio
        if found is None:
            raise ValueError("a search needs rounds")
        return found

    def _parts(self) -> list[list[int]]:
        """The pool without the photos that are lower than the survey's."""
        least_m = self.ground_m + 0.95 * self.planned.height_agl_m
        return [[i for i, s in enumerate(self.candidates.stations) if s.height_m > least_m]]

    def _eased(self, share: float) -> Search:
        """A search under limits ``share`` times those asked for."""
        wanted = self.criterion
        return self.search(
            replace(
                wanted,
                sigma_f_percent=share * wanted.sigma_f_percent,
                dome_percent=share * wanted.dome_percent,
            )
        )

    def _trimmed(self, photos: tuple[int, ...]) -> Found:
        """A pass that cures without the photos that it does not need, the dearest first."""
        found, rest = self.found(photos), tuple(sorted(photos))
        while len(rest) > max(self.criterion.least_photos, 2):
            pool = self.candidates.dense_pool(rest)
            if len(pool) < len(rest):
                break
            hunt = Search(Worths(pool, self.planned.worth), self.candidates.detours, self.criterion)
            fewer = [tuple(p for p in rest if p != one) for one in rest]
            cost = [self.candidates.detours.seconds(r) for r in fewer]
            order = sorted(range(len(rest)), key=lambda a: (cost[a], fewer[a]))
            tried = [fewer[a] for a in islice(hunt.dispensable(range(len(pool)), order), _TRIMS)]
            better = next((one for one in map(self.found, tried) if one.good), None)
            if better is None:
                break
            found, rest = better, next(r for r in tried if self.found(r) is better)
        return found

    def _improved(self, hunt: Search, choice: Choice) -> Choice:
        """Stations shifted, then exchanged for each other again, as long as that saves time."""
        for _ in range(_ROUNDS):
            before = choice.seconds
            choice = hunt.exchange(polish(self.candidates, hunt, choice, self.ground_m))
            if not choice.good or choice.seconds > 0.98 * before:
                break
        return choice

    def within_time(self) -> Found | None:
        """The pass worth most among those that the battery allows."""
        hunt = self.search(self.criterion)
        best = self.regular("orbit", "arc")
        for by_time in (True, False):
            choice = hunt.greedy((), by_time, self.most_s)
            photos = choice.photos
            while photos and self.candidates.detours.seconds(photos) > self.most_s:
                photos = self._without_dearest(photos)
            if photos:
                found = self.found(photos)
                if best is None or found.rank < best.rank:
                    best = found
        return best

    def _without_dearest(self, photos: tuple[int, ...]) -> tuple[int, ...]:
        rests = [tuple(p for p in photos if p != one) for one in photos]
        return min(rests, key=lambda rest: (self.candidates.detours.seconds(rest), rest))

    def regular(self, *kinds: str, whole: bool = False, highest_m: float = math.inf) -> Found | None:
        """The shortest regular pass of these kinds that cures; where none does, the best one.

        ``whole``: only if all of its photos are allowed. ``highest_m``: above launch.
        """
        options = [
            (self.candidates.detours.seconds(photos), photos, shape)
            for photos, shape in self.shapes
            if shape.kind in kinds
            and shape.height_m <= highest_m
            and (not whole or len(photos) == len(shape.stations))
        ]
        hunt = self.search(replace(self.criterion, least_photos=0))
        nearest: tuple[float, tuple[int, ...]] | None = None
        for seconds, photos, _ in sorted(options, key=lambda o: (o[0], o[1])):
            if seconds > self.most_s:
                break
            if nearest is not None and hunt.none_missing(photos) > max(nearest[0], 1.05):
                continue
            ratio = hunt.ratio(photos)
            if ratio <= 1.05 and self.found(photos).good:
                return self.found(photos)
            if nearest is None or ratio < nearest[0]:
                nearest = (ratio, photos)
        return None if nearest is None else self.found(nearest[1])

    def found(self, photos: tuple[int, ...]) -> Found:
        """Photos of the pool as a pass, valued with all the points that they see."""
        photos = tuple(sorted(photos))
        if photos not in self._found:
            self._found[photos] = self._valued(photos)
        return self._found[photos]

    def _valued(self, photos: tuple[int, ...]) -> Found:
        candidates, planned = self.candidates, self.planned
        dense = candidates.dense_pool(photos)
        without_count = replace(self.criterion, least_photos=0)
        check = Search(Worths(dense, planned.worth), candidates.detours, without_count)
        with_all = check.worths.joint(range(len(dense))).head
        q, factor = len(planned.f_gradient), planned.assumptions.model_error_factor
        order = candidates.detours.order(photos)[0]
        oblique = sum(
            90.0 + candidates.stations[i].pitch_deg >= CONVERGENT_DEG + AIM_DEG - 0.01 for i in photos
        )
        return Found(
            tuple(candidates.stations[i] for i in order),
            candidates.detours.seconds(photos),
            check.ratio(range(len(dense))),
            oblique >= self.criterion.least_photos,
            Worth(
                *planned.worth(with_all),
                factor**2 * with_all[:q, :q],
                planned.dome_beyond_percent(with_all),
                planned.dome_reference_percent(with_all),
            ),
            next((shape for known, shape in self.shapes if known == photos), None),
        )

"""``plan --fix``: the cheapest extra photos that make a planned mission calibrate, safely."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from shapely import Polygon

from calib.camera import FloatArray
from calib.limits import percent
from mission.candidates import Candidates, rings, single_stations
from mission.optimise import MOST_ADDED, Choice, Criterion, Search, Worths
from mission.places import places_of_pass
from mission.plan import Plan, Station, stations, stop
from mission.planned_network import Assumptions, PlannedNetwork, ground_heights_m, planned_network
from mission.prediction import Prediction, predict_stations
from mission.route import Gap, plan_gaps, with_stops
from mission.terrain_height import LevelGround, Terrain
from mission.timing import minutes, timing

#: Gaps of the path that are looked at, the nearest to the place of the extra photos.
MOST_GAPS = 6


@dataclass(frozen=True)
class Fix:
    """Photos added to a plan so that it calibrates, robustly.

    ``plan`` has the additions in its path; ``added`` is empty where none are needed or none help.
    ``seconds``: what they cost in the air. ``binding_limit``: None where the criterion is met,
    otherwise what stands against it, in words. ``after`` is with all additions taken.
    """

    plan: Plan
    added: tuple[Station, ...]
    seconds: float
    before: Prediction
    after: Prediction
    reason: str
    binding_limit: str | None


def fix(
    plan: Plan,
    terrain: Terrain | None = None,
    area: Polygon | None = None,
    feasible: Callable[[Station], bool] | None = None,
    assumptions: Assumptions | None = None,
    criterion: Criterion | None = None,
) -> Fix:
    """Add the cheapest photos that bring the plan inside ``criterion`` with any one of them missing.

    Args:
        terrain, area: as for :func:`mission.prediction.predict`.
        feasible: whether a photo may be taken from a station; None: everywhere.

    Raises:
        InputError: fewer than two photos, or no two that overlap.
    """
    given, wanted = assumptions or Assumptions(), criterion or Criterion()
    ground = LevelGround() if terrain is None else terrain
    photos = stations(plan)
    planned = planned_network(photos, plan.camera, ground, given)
    before = predict_stations(photos, plan.camera, ground, area, given, planned)
    if wanted.ratio((before.sigma_f_percent, before.dome_percent)) <= 1 and not wanted.least_photos:
        return Fix(plan, (), 0.0, before, before, f"No photos need to be added. {_known(before)}", None)
    places = places_of_pass(plan, planned, area)
    candidates, choice = _at_places(plan, planned, ground, places[:1], feasible, wanted)
    if not choice.good and len(places) > 1:
        # Photos at one place soon say the same again; large blocks need them at several.
        several = _at_places(plan, planned, ground, places, feasible, wanted)
        if several[1].good or several[1].ratio < choice.ratio:
            candidates, choice = several
    if not choice.photos:
        return Fix(
            plan, (), 0.0, before, before, f"Nothing can be added. {_known(before)}", _nothing(candidates)
        )
    gaps = candidates.detours.gaps
    order = candidates.detours.order(choice.photos)
    stops = [[stop(candidates.stations[i]) for i in way] for way in order]
    fixed = with_stops(plan, gaps, stops)
    added = tuple(candidates.stations[i] for way in order for i in way)
    after = predict_stations(stations(fixed), plan.camera, ground, area, given)
    return Fix(
        fixed,
        added,
        choice.seconds,
        before,
        after,
        _reason(added, choice, before, after),
        None if choice.good else _short_of(choice, candidates, wanted, plan),
    )


def _at_places(
    plan: Plan,
    planned: PlannedNetwork,
    ground: Terrain,
    places_m: FloatArray,
    feasible: Callable[[Station], bool] | None,
    criterion: Criterion,
) -> tuple[Candidates, Choice]:
    """Photos around places (k, 2) to choose from, and the best choice."""
    gaps = plan_gaps(plan)
    each = max(MOST_GAPS // len(places_m), 2)
    chosen = {gap.index: gap for place in places_m for gap in _nearest(gaps, place, each)}
    near = tuple(chosen[index] for index in sorted(chosen))
    candidates = Candidates(planned, places_m, plan.vehicle, near, feasible)
    grounds = ground_heights_m(ground, np.column_stack([places_m, np.zeros(len(places_m))]))
    return candidates, search(candidates, places_m, grounds, criterion)


def search(
    candidates: Candidates, places_m: FloatArray, grounds_m: FloatArray, criterion: Criterion
) -> Choice:
    """The best choice among single stations and rings around places (k, 2), polished.

    ``grounds_m`` (k,): ground heights there. Single stations are offered at one place only: at several
    the rings' are enough.
    """
    height = candidates.planned.height_agl_m
    ground_m = float(grounds_m[0])
    if len(places_m) == 1:
        candidates.add(single_stations(places_m[0], ground_m, height))
    sets = []
    around = [rings(place, float(at), height) for place, at in zip(places_m, grounds_m, strict=True)]
    for alike in zip(*around, strict=True):
        found = [i for i in candidates.add([s for ring in alike for s in ring]) if i is not None]
        if found and len(found) <= MOST_ADDED:
            sets.append(found)
    if not candidates.stations:
        return Choice((), 0.0, math.inf)
    wanted = criterion
    worths = Worths(candidates.pool, candidates.planned.worth)
    for _ in range(4):
        hunt = Search(worths, candidates.detours, wanted)
        choice = hunt.best(sets)
        if len(places_m) == 1:
            choice = polish(candidates, hunt, choice, ground_m)
        # The search thins the points of a photo; the answer is checked with all of them.
        dense = _dense_ratio(candidates, choice, criterion)
        if not choice.good or dense <= 1:
            break
        tighter = (wanted.sigma_f_percent / criterion.sigma_f_percent) / (1.02 * dense)
        wanted = Criterion(
            criterion.sigma_f_percent * tighter, criterion.dome_percent * tighter, criterion.least_photos
        )
    return Choice(choice.photos, choice.seconds, dense)


def _dense_ratio(candidates: Candidates, choice: Choice, criterion: Criterion) -> float:
    """The criterion's ratio of a choice with all points that its photos see."""
    dense = candidates.dense_pool(choice.photos)
    check = Search(Worths(dense, candidates.planned.worth), candidates.detours, criterion)
    return check.ratio(range(len(dense)))


def polish(candidates: Candidates, hunt: Search, choice: Choice, ground_m: float) -> Choice:
    """Shift stations by ever smaller steps, still looking at the same places, where that saves time."""
    height = candidates.planned.height_agl_m
    step = 0.2 * height
    while choice.good and step > 0.04 * height:
        improved = False
        for one in choice.photos:
            rest = tuple(p for p in choice.photos if p != one)
            moved = candidates.add(_moved(candidates.stations[one], step, ground_m))
            cost = candidates.detours.seconds(rest) + candidates.detours.insertion_s(rest)
            options = sorted((float(cost[i]), i) for i in moved if i is not None and i not in rest)
            for seconds, i in options[:3]:
                if seconds > choice.seconds - 0.1:
                    break
                if hunt.hopeless(choice.photos, one, i):
                    continue
                cost_s = candidates.detours.seconds((*rest, i))
                if cost_s < choice.seconds - 0.1 and hunt.holds((*rest, i)):
                    choice, improved = hunt.choice((*rest, i)), True
                    break
            if improved:
                break
        if not improved:
            step /= 2
    return choice


def _moved(station: Station, step_m: float, ground_m: float) -> list[Station]:
    """The station shifted to eight sides and down or up, aiming at the same place on the ground."""
    tilt, yaw = math.radians(90.0 + station.pitch_deg), math.radians(station.yaw_deg)
    agl = station.height_m - ground_m
    aim_east = station.east_m + agl * math.tan(tilt) * math.sin(yaw)
    aim_north = station.north_m + agl * math.tan(tilt) * math.cos(yaw)
    found = []
    for east, north, up in (
        *((math.sin(a), math.cos(a), 0.0) for a in np.arange(8) * math.pi / 4),
        (0.0, 0.0, 1.0),
        (0.0, 0.0, -1.0),
    ):
        e, n, h = station.east_m + step_m * east, station.north_m + step_m * north, agl + step_m * up
        way = math.hypot(aim_east - e, aim_north - n)
        off_nadir = math.degrees(math.atan2(way, h))
        if h > 0.5 * agl and off_nadir <= 45.0:
            heading = math.degrees(math.atan2(aim_east - e, aim_north - n)) % 360.0
            found.append(Station(e, n, ground_m + h, heading, off_nadir - 90.0, station.pattern))
    return found


def _nearest(gaps: Sequence[Gap], middle_m: FloatArray, count: int) -> tuple[Gap, ...]:
    def away(gap: Gap) -> float:
        ends = np.array([gap.start_m[:2], gap.end_m[:2]])
        return float(np.linalg.norm(ends - middle_m, axis=1).sum() - np.linalg.norm(ends[1] - ends[0]))

    return tuple(sorted(gaps, key=away)[:count])


def _known(prediction: Prediction) -> str:
    return (
        f"The focal length will be known to {percent(prediction.sigma_f_percent)} and the site's bending to "
        f"{percent(prediction.dome_percent)} of the flying height ({_metres(prediction.dome_sigma_m)})."
    )


def _reason(added: Sequence[Station], choice: Choice, before: Prediction, after: Prediction) -> str:
    tilts = sorted(90.0 + s.pitch_deg for s in added)
    heights = sorted(s.height_m for s in added)
    return (
        f"{len(added)} photos, {choice.seconds:.0f} s: {_span(tilts, 'degrees off nadir')} from "
        f"{_span(heights, 'm above launch')}. Now: focal length known to {percent(before.sigma_f_percent)}, "
        f"possible dome {_metres(before.dome_sigma_m)}. After: {percent(after.sigma_f_percent)}, "
        f"{_metres(after.dome_sigma_m)}."
    )


def _span(values: Sequence[float], unit: str) -> str:
    low, high = f"{values[0]:.0f}", f"{values[-1]:.0f}"
    return f"{low} {unit}" if low == high else f"{low}-{high} {unit}"


def _metres(value: float) -> str:
    return f"{value:.1f} m" if value >= 1 else f"{100 * value:.2g} cm"


def _nothing(candidates: Candidates) -> str:
    low = candidates.vehicle.gimbal_lowest_deg
    high = candidates.vehicle.gimbal_highest_deg
    return (
        "No oblique photo may be taken around the place where it would help: fence, ceiling, terrain or the "
        f"gimbal's range ({low:.0f} to {high:.0f} degrees) forbid all of them."
    )


def _short_of(choice: Choice, candidates: Candidates, criterion: Criterion, plan: Plan) -> str:
    """What stands against the criterion: which of its two limits, and what it would take."""
    pool = candidates.dense_pool(choice.photos)
    sigma_f, dome = Worths(pool, candidates.planned.worth).worst(tuple(range(len(pool))))
    f_short, dome_short = sigma_f > criterion.sigma_f_percent, dome > criterion.dome_percent
    lacks = []
    if f_short:
        lacks.append(
            f"the focal length to {percent(sigma_f)} where {percent(criterion.sigma_f_percent)} is asked"
        )
    if dome_short:
        lacks.append(
            f"the site's bending to {percent(dome)} of the flying height where "
            f"{percent(criterion.dome_percent)} is asked"
        )
    text = (
        f"Even the best {len(choice.photos)} of {len(candidates.stations)} allowed photos, with one of them "
        f"failing, would tell {' and '.join(lacks) or 'too little'}."
    )
    if not math.isfinite(choice.ratio):
        return text
    # Information adds up, so what is left open falls with the root of their number.
    times = choice.ratio**2
    vehicle = plan.vehicle
    spare_s = (1 - vehicle.reserve_share) * vehicle.endurance_s - timing(plan).duration_s
    text += (
        f" About {times * len(choice.photos):.0f} photos and {minutes(times * choice.seconds)} would do it"
    )
    text += (
        ", and the battery has nothing to spare"
        if spare_s <= 0
        else f", and the battery has {minutes(spare_s)} to spare"
    )
    if dome_short and not f_short:
        return (
            text
            + ". It is the size of the area against the height that binds: fly higher, or plan it in parts."
        )
    return text + "."

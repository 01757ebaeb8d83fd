"""The extra pass that cures a flown survey's calibration, why, and what else would do."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import shapely

from calib.brownfit import fit_brown
from calib.camera import FloatArray
from calib.errors import InputError
from calib.flown_file import FlownCheck
from calib.propagation import radial_px_covariance
from mission.compose import return_height_m, way_home
from mission.limits import check_limits, hard_violations
from mission.optimise import Criterion
from mission.plan import Plan, stop
from mission.refly_passes import circle
from mission.refly_search import Found, PassSearch, criterion_for, place_of_pass
from mission.refly_site import FlownSite
from mission.refly_words import (
    WALL,
    cautions,
    described,
    ratio_words,
    reason,
    short_of,
    time_words,
    why_no_pass,
)
from mission.reroute import rerouted
from mission.rule import Finding
from mission.site import Site
from mission.timing import timing

#: Wind and climbing take more of a battery than hovering; the pass is searched again that often.
_BATTERY_ROUNDS = 3
_EVERYWHERE = shapely.MultiPolygon([shapely.box(-1e5, -1e5, 1e5, 1e5)])


@dataclass(frozen=True)
class Alternative:
    """Another pass: what speaks for it, in words, and the pass itself (None: not flown)."""

    text: str
    found: Found | None


@dataclass(frozen=True)
class Refly:
    """What to fly, and why.

    ``plan``, ``found`` are None where nothing is to be flown (``reason`` says why) or nothing may be.
    ``binding_limit``: None where the pass cures; otherwise what stands against a better one.
    ``findings``: the plan held against every limit.
    """

    flown: FlownSite
    plan: Plan | None
    found: Found | None
    reason: str
    binding_limit: str | None
    alternatives: tuple[Alternative, ...]
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    helps: bool

    @property
    def check(self) -> FlownCheck:
        """The check that the pass is for."""
        return self.flown.check

    @property
    def cures(self) -> bool:
        """Whether the pass brings the calibration inside its limits and may be flown."""
        return self.found is not None and self.found.good and not hard_violations(self.findings)

    @property
    def duration_s(self) -> float:
        """Time in the air, from the ground and back."""
        return 0.0 if self.plan is None else timing(self.plan, self.flown.site.wind).duration_s

    def radial_covariance_px(self) -> FloatArray | None:
        """Expected covariance (2, 2) of K1 and K2 in pixel units after the pass; None without one."""
        if self.found is None:
            return None
        planned = self.flown.planned
        jacobian = fit_brown(planned.network.lens)[1][:, planned.known.free]
        brown = jacobian @ self.found.worth.lens @ jacobian.T
        return radial_px_covariance(self.check.brown, brown)[:2, :2]


def refly(flown: FlownSite) -> Refly:
    """The shortest pass that cures the block of ``flown`` inside its site's limits.

    Raises:
        InputError: the block is too weak to be computed with.
    """
    try:
        return _refly(flown)
    except np.linalg.LinAlgError as error:
        raise InputError(
            "The block of these photos is too weak for a pass to be computed: fly the circle that the "
            "check's report describes."
        ) from error


def _refly(flown: FlownSite) -> Refly:
    check, site, planned = flown.check, flown.site, flown.planned
    criterion = criterion_for(planned)
    return_m = return_height_of(flown)
    search = PassSearch(planned, site, return_m, _most_s(site), criterion)
    strong = is_strong(search, criterion)
    why = why_no_pass(check, strong)
    if why is not None:
        return Refly(flown, None, None, why, None, (), (), flown.notes, helps=False)
    search.fill()
    found = search.best()
    plan = None
    findings: tuple[Finding, ...] = ()
    for _ in range(_BATTERY_ROUNDS):
        if found is None:
            break
        plan = pass_plan(found, site, return_m)
        findings = tuple(f for f in check_limits(plan, site) if f.rule != "overlap")
        over = timing(plan, site.wind).battery_share / max(1 - site.vehicle.reserve_share, 1e-9)
        if over <= 1.0:
            break
        search.most_s = min(search.most_s, found.seconds) / (1.01 * over)
        found = search.best()
    if found is None:
        none = binding_limit(flown, search, return_m) or "No photo is allowed where it would help."
        text = f"There is no pass that may be flown here. {none}"
        return Refly(flown, None, None, text, none, (Alternative(WALL, None),), (), flown.notes, helps=True)
    seconds = found.seconds if plan is None else timing(plan, site.wind).duration_s
    text = reason(check, found, seconds)
    limit: str | None = None
    if not found.good:
        limit = binding_limit(flown, search, return_m) or short_of(
            found, check.flown.tie_points_per_photo, check.flown.noise_px
        )
        text += f" This is the best that can be had here, and not enough ({ratio_words(found)}). {limit}"
    elif hard_violations(findings):
        limit = hard_violations(findings)[0].message
    return Refly(
        flown, plan, found, text, limit, _alternatives(search, found), findings,
        (*flown.notes, *cautions(check)), helps=True,
    )  # fmt: skip


def is_strong(search: PassSearch, criterion: Criterion) -> bool:
    """Whether the network holds what the pass would be flown for, without it."""
    if criterion.least_photos > 1:
        return False
    worth = search.planned.worth(search.candidates.pool.joint.head)
    return criterion.ratio(worth) <= 1.0


def pass_plan(found: Found, site: Site, return_m: float) -> Plan:
    """The mission: climb, stations, way home, round what is forbidden."""
    waypoints = tuple(stop(s) for s in found.stations)
    plan = Plan(site.name, site.frame, site.camera, site.camera_name, site.vehicle, waypoints, return_m)
    plan = rerouted(plan, site)
    return replace(plan, waypoints=(*plan.waypoints, *way_home(site, plan.waypoints[-1])))


def return_height_of(flown: FlownSite) -> float:
    """Height above launch at which a pass comes home."""
    middle = place_of_pass(flown.planned)
    ground = flown.site.ground_m(float(middle[0]), float(middle[1]))
    round_it = circle(middle, ground, flown.check.height_agl_m, 40.0, 8).stations
    return return_height_m(flown.site, [stop(s) for s in round_it])


def _most_s(site: Site) -> float:
    return (1 - site.vehicle.reserve_share) * site.vehicle.endurance_s


def _alternatives(search: PassSearch, found: Found) -> tuple[Alternative, ...]:
    """Up to two other ways."""
    made: list[Alternative] = []

    def offer(other: Found | None, why: str) -> None:
        if other is None or not other.good or other.stations == found.stations:
            return
        if any(a.found is not None and a.found.stations == other.stations for a in made):
            return
        more = other.seconds - found.seconds
        when = f"{time_words(more)} longer" if more >= 0.5 else "as short"
        made.append(Alternative(f"{len(other.stations)} photos, {described(other)}: {when}, {why}.", other))

    if not found.good:
        return (Alternative(WALL, None),)
    offer(search.regular("orbit", whole=True), "and simple to fly by hand or with a point-of-interest mode")
    offer(search.regular("arc", whole=True), "from one side only")
    survey_m = search.ground_m + search.planned.height_agl_m
    if len(made) < 2 and max(s.height_m for s in found.stations) > survey_m + 1.0:
        offer(search.regular("orbit", highest_m=survey_m + 0.5), "no higher than the survey")
    return tuple(made[:2])


def binding_limit(flown: FlownSite, search: PassSearch, return_m: float) -> str | None:
    """Which one limit, were it not there, would let a pass cure; None where none of them does."""
    site = flown.site
    if search.cure_s is not None:
        return (
            f"The battery binds: the shortest cure takes about {time_words(search.cure_s)}, and "
            f"{time_words(_most_s(site))} may be flown "
            f"({100 * site.vehicle.reserve_share:.0f} % are kept)."
        )
    for words, freed in _freed(site):
        other = PassSearch(flown.planned, freed, return_m, math.inf, search.criterion)
        other.fill()
        if _curable(other):
            return words
    return None


def _curable(search: PassSearch) -> bool:
    """Whether any pass cures; a regular one answers soonest."""
    regular = search.regular("orbit")
    if regular is not None and regular.good:
        return True
    found = search.best()
    return found is not None and found.good


def _freed(site: Site) -> Iterator[tuple[str, Site]]:
    """The site with one limit lifted at a time, where there is one, and how that limit is said."""
    vehicle, space = site.vehicle, site.space
    low, high = vehicle.gimbal_lowest_deg, vehicle.gimbal_highest_deg
    if high < -50.0 or low > -65.0:
        yield (
            f"The gimbal binds: it reaches {low:g} to {high:g} degrees, and photos 20 to 45 degrees off "
            "nadir are what is missing.",
            replace(site, vehicle=replace(vehicle, gimbal_lowest_deg=-90.0, gimbal_highest_deg=0.0)),
        )
    if space.ceiling_m is not None:
        yield (
            f"The ceiling of {space.ceiling_m:g} m binds: a pass from higher up would do.",
            replace(site, space=replace(space, ceiling_m=None)),
        )
    if space.has_zones:
        yield (
            "The fence binds: it forbids the places from which photos would do.",
            replace(site, space=replace(space, fence_area=_EVERYWHERE, has_zones=False)),
        )
    if space.structures:
        yield (
            f"Structures bind: the stand-off of {space.standoff_m:g} m forbids the places that would do.",
            replace(site, space=replace(space, structures=())),
        )
    if np.isfinite(site.terrain.resolution_m):
        yield (
            f"The ground binds: the clearance of {site.clearance_m:g} m forbids the places that would do.",
            replace(site, clearance_m=0.0),
        )

"""A mission too long for one battery as several, each complete: its own take-off, photos and way home.

Lines stay in their order and whole. Photos that belong together (an orbit, a fan, rings) stay together
and go to the part whose lines pass nearest to what they look at, so that every part's oblique photos
overlap with its own straight ones. The part with most of them is flown first: a check after the first
battery then tells whether the camera is known, while there are batteries left to do something about it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby

import numpy as np

from calib.camera import FloatArray
from calib.errors import InputError
from calib.evidence import CONVERGENT_DEG, STEEP_DEG
from mission.compose import joined, return_height_m, way_home
from mission.limits import check_limits, item_count
from mission.patterns.piece import Piece
from mission.plan import Plan, Shot, Waypoint, stations
from mission.planned import Planned
from mission.rule import Finding
from mission.site import Site
from mission.timing import timing

#: More batteries than this are another day.
MOST_PARTS = 40
#: Single photos from standing of these patterns are flown where they are, between lines.
_BETWEEN_LINES = ("fix",)


def split(planned: Planned) -> tuple[Planned, ...]:
    """The mission in as few parts as battery and mission items need, in the order to fly them.

    One part, ``planned`` itself, where nothing needs to be split. The prediction of every part is that
    of the whole: the photos of all parts are aligned together.

    Raises:
        InputError: one line or one ring alone is too long, or there would be too many parts.
    """
    plan, site = planned.plan, planned.site
    if _fits(plan, site):
        return (planned,)
    sequence, groups = _pieces(plan)
    if not sequence:
        sequence, groups = groups, []
    plans: list[Plan] = []
    left = list(sequence)
    home = _nearest_pieces(sequence, groups)
    while left:
        count = _most_that_fit(plan, site, left, groups, home, len(sequence) - len(left))
        first = len(sequence) - len(left)
        own = [group for group, at in zip(groups, home, strict=True) if first <= at < first + count]
        together = _built(plan, site, [*left[:count], *own])
        if not own or _fits(together, site):
            plans.append(_checked(together, site))
        else:  # A ring too long for anything beside it.
            plans += [
                _checked(_built(plan, site, part), site) for part in (left[:count], *([o] for o in own))
            ]
        left = left[count:]
        if len(plans) > MOST_PARTS:
            raise InputError(
                f"The mission would need more than {MOST_PARTS} batteries: fly higher, ask for less overlap, "
                "or plan a part of the area."
            )
    plans.sort(key=lambda part: -_convergent(part))
    return tuple(
        replace(
            planned,
            plan=(named := replace(part, name=f"{plan.name}-{number}")),
            findings=check_limits(named, site),
            notes=(*planned.notes, _note(number, len(plans), part)),
        )
        for number, part in enumerate(plans, 1)
    )


def worst_findings(parts: Sequence[Planned]) -> tuple[Finding, ...]:
    """Of every rule the finding of the part that keeps it least."""
    rules = [
        sorted(same, key=lambda f: (f.ok, not f.hard))
        for same in zip(*(p.findings for p in parts), strict=True)
    ]
    return tuple(rule[0] for rule in rules)


def _note(number: int, count: int, part: Plan) -> str:
    text = f"Part {number} of {count}: {len(stations(part))} photos, {_convergent(part)} of them convergent"
    if number == 1:
        text += "; fly it first and check its photos before the others"
    return text + ". Keep focus and zoom as they are between the parts, and check all photos together."


def _convergent(plan: Plan) -> int:
    return sum(CONVERGENT_DEG <= 90 + s.pitch_deg <= STEEP_DEG for s in stations(plan))


def _pieces(plan: Plan) -> tuple[list[Piece], list[Piece]]:
    """Lines and single photos between them in their order; groups of photos from standing."""
    single: list[Piece] = []
    chain: list[Waypoint] = []
    for before, here in zip([None, *plan.waypoints[:-1]], plan.waypoints, strict=True):
        on_line = before is not None and before.shot is Shot.LINE
        if on_line or here.shot is Shot.LINE:
            chain.append(here)
            if here.shot is not Shot.LINE:
                if single and _goes_on(single[-1], chain):
                    chain = [*single.pop().waypoints, *chain]
                single.append(Piece(tuple(chain), reversible=False))
                chain = []
        elif here.shot is Shot.STOP:
            single.append(Piece((here,), reversible=False))
    sequence: list[Piece] = []
    groups: list[Piece] = []

    def kind(piece: Piece) -> str:
        first = piece.waypoints[0]
        return "" if first.shot is Shot.LINE or first.pattern in _BETWEEN_LINES else first.pattern

    for pattern, pieces in groupby(single, key=kind):
        if pattern:
            groups.append(Piece(tuple(w for piece in pieces for w in piece.waypoints), reversible=False))
        else:
            sequence += pieces
    if not sequence:  # Nothing but rings and the like: photo by photo.
        return [Piece((w,), reversible=False) for group in groups for w in group.waypoints], []
    return sequence, groups


def _goes_on(piece: Piece, chain: Sequence[Waypoint]) -> bool:
    """Whether a line is the next stretch of the line before it: cut by nothing but a change of slope."""
    if piece.waypoints[0].shot is not Shot.LINE:
        return False
    ahead = chain[-1].enu_m - chain[0].enu_m
    between, before = chain[0].enu_m - piece.ends_m[1], piece.ends_m[1] - piece.ends_m[0]

    def along(way: FloatArray) -> bool:
        return float(way[:2] @ ahead[:2]) >= 0.99 * float(np.hypot(*way[:2]) * np.hypot(*ahead[:2]))

    return along(between) and along(before)


def _nearest_pieces(sequence: Sequence[Piece], groups: Sequence[Piece]) -> list[int]:
    """For each group the piece that passes nearest to the middle of its photos."""
    found = []
    for group in groups:
        middle = np.mean([w.enu_m[:2] for w in group.waypoints], axis=0)
        found.append(int(np.argmin([_distance_m(piece, middle) for piece in sequence])))
    return found


def _distance_m(piece: Piece, at_m: FloatArray) -> float:
    start, end = piece.ends_m[:, :2]
    way = end - start
    share = float(np.clip((at_m - start) @ way / max(float(way @ way), 1e-9), 0, 1))
    return float(np.linalg.norm(start + share * way - at_m))


def _most_that_fit(
    plan: Plan, site: Site, left: Sequence[Piece], groups: Sequence[Piece], home: Sequence[int], first: int
) -> int:
    """How many of the pieces ``left`` one battery takes, with the groups that belong to them if they fit."""

    def part(count: int) -> list[Piece]:
        own = [group for group, at in zip(groups, home, strict=True) if first <= at < first + count]
        return [*left[:count], *own]

    # A first guess without ways round anything, then the truth.
    low, high = 1, len(left)
    while low < high:
        middle = (low + high + 1) // 2
        flat = tuple(w for piece in part(middle) for w in piece.waypoints)
        low, high = (middle, high) if _fits(replace(plan, waypoints=flat), site) else (low, middle - 1)
    while low > 1 and not _fits(_built(plan, site, part(low)), site):
        low -= 1
    return low


def _built(plan: Plan, site: Site, pieces: Sequence[Piece]) -> Plan:
    """A complete mission of some pieces."""
    waypoints: list[Waypoint] = []
    around = site
    for piece in pieces:
        pattern = piece.waypoints[0].pattern
        around = site.wall_site() if pattern == "wall" else site
        here = waypoints[-1].enu_m if waypoints else np.array([0.0, 0.0, piece.ends_m[0, 2]])
        waypoints += joined(around, here, piece, pattern)
    waypoints += way_home(around, waypoints[-1])
    return replace(plan, waypoints=tuple(waypoints), return_height_m=return_height_m(site, waypoints))


def _fits(plan: Plan, site: Site) -> bool:
    vehicle = plan.vehicle
    share = timing(plan, site.wind).battery_share
    return share <= 1 - vehicle.reserve_share and item_count(plan) <= vehicle.most_items


def _checked(part: Plan, site: Site) -> Plan:
    if _fits(part, site):
        return part
    share = 100 * timing(part, site.wind).battery_share
    limit = 100 * (1 - part.vehicle.reserve_share)
    if not math.isfinite(share) or share > limit:
        raise InputError(
            f"Splitting does not help: one line or ring alone, with the way there and back, takes "
            f"{share:.0f} % of a battery of which {limit:.0f} % are available; move the launch point nearer, "
            "turn the lines (--heading), or plan a part of the area."
        )
    raise InputError(
        f"Splitting does not help: one line or ring alone has about {item_count(part)} mission items and the "
        f"autopilot holds {part.vehicle.most_items}."
    )

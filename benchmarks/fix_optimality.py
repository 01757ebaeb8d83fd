"""How near the extra photos of `plan --fix` are to the best ones: random nadir plans, every subset tried.

`python -m benchmarks.fix_optimality` writes benchmarks/fix_optimality.md. Each case is a nadir grid of
random size, height, overlaps and heading with ten random oblique stations; all 1023 subsets are
evaluated under the criterion of the search (sigma f, dome, any one photo missing).
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from calib.frames import LocalFrame
from mission.candidates import Candidates, single_stations
from mission.optimise import Choice, Criterion, Search, Worths
from mission.plan import Plan, Shot, Vehicle, Waypoint, stations
from mission.planned_network import Assumptions, planned_network
from mission.route import plan_gaps
from mission.terrain_height import LevelGround
from sim.flights import phantom3

HERE = Path(__file__).parent
STATIONS = 10


def nadir_plan(
    size_m: tuple[float, float],
    height_m: float,
    front: float = 0.8,
    side: float = 0.7,
    heading_deg: float = 0.0,
) -> Plan:
    """A nadir grid of the Phantom 3 over a rectangle around the launch point."""
    camera, turn = phantom3(), math.radians(heading_deg)
    across = camera.width / camera.f_px * height_m * (1 - side)
    along = camera.height / camera.f_px * height_m * (1 - front)
    waypoints = []
    for i, x in enumerate(np.linspace(-0.5, 0.5, math.ceil(size_m[0] / across) + 1) * size_m[0]):
        sign = 1 if i % 2 == 0 else -1
        for y, shot in ((-sign, Shot.LINE), (sign, Shot.NONE)):
            v = y * size_m[1] / 2
            east, north = x * math.cos(turn) + v * math.sin(turn), v * math.cos(turn) - x * math.sin(turn)
            yaw = (heading_deg + (0.0 if sign > 0 else 180.0)) % 360.0
            waypoints.append(Waypoint(float(east), float(north), height_m, yaw, -90.0, shot, along, "nadir"))
    return Plan("nadir", LocalFrame(50.0, 8.0), camera, "P3P", Vehicle(), tuple(waypoints), height_m)


@dataclass(frozen=True)
class Outcome:
    """One case: what the search chose, and the best subsets by number and by time (None: no subset does)."""

    photos: int
    chosen: Choice
    least_photos: int | None
    least_seconds: float | None
    search_s: float


def outcome(seed: int, count: int = STATIONS) -> Outcome:
    """Case ``seed``, with ``count`` stations to choose from."""
    rng = np.random.default_rng([seed, 77])
    height = float(rng.uniform(40, 100))
    size = (float(rng.uniform(1.2, 3.0) * height), float(rng.uniform(1.2, 3.0) * height))
    plan = nadir_plan(
        size,
        height,
        float(rng.uniform(0.7, 0.85)),
        float(rng.uniform(0.55, 0.75)),
        float(rng.uniform(0, 180)),
    )
    assumed = replace(Assumptions(), tie_points_per_photo=float(rng.uniform(500, 1500)))
    planned = planned_network(stations(plan), plan.camera, LevelGround(), assumed)
    middle = np.zeros(2)
    candidates = Candidates(planned, middle[None], plan.vehicle, plan_gaps(plan), None)
    grid = single_stations(middle, 0.0, planned.height_agl_m)
    picked = [grid[i] for i in rng.choice(len(grid), 3 * count, replace=False)]
    candidates.add(picked)
    del candidates.pool.rows[count:], candidates.stations[count:]
    candidates.detours.keep(count)
    started = time.process_time()
    search = Search(Worths(candidates.pool, planned.worth), candidates.detours, Criterion())
    chosen = search.best()
    search_s = time.process_time() - started
    return Outcome(len(stations(plan)), chosen, *_exhaustive(search, count), search_s)


def _exhaustive(search: Search, count: int) -> tuple[int | None, float | None]:
    """Fewest photos and least time of all subsets that meet the criterion.

    With any one photo missing the criterion holds where it holds for every subset of one photo less.
    """
    worth = search.worths.worth
    alone: dict[tuple[int, ...], float] = {(): search.criterion.ratio(worth(search.pool.joint.head))}
    least: int | None = None
    seconds: float | None = None
    for n in range(1, count + 1):
        for subset in combinations(range(count), n):
            parts = [tuple(p for p in subset if p != one) for one in subset]
            if max(alone[part] for part in parts) <= 1.0:
                least = n if least is None else least
                cost = search.detours.seconds(subset)
                seconds = cost if seconds is None else min(seconds, cost)
            # Information only grows: what holds for a part holds for the whole.
            if min(alone[part] for part in parts) <= 1.0:
                alone[subset] = 1.0
            else:
                head = search.pool.combined(subset).head
                alone[subset] = search.criterion.ratio(worth(head))
    return least, seconds


def report(found: list[Outcome]) -> str:
    """Markdown."""
    curable = [o for o in found if o.least_photos is not None and o.least_seconds is not None]
    solved = [o for o in curable if o.chosen.good]
    more = [len(o.chosen.photos) - (o.least_photos or 0) for o in solved]
    ratio = [o.chosen.seconds / (o.least_seconds or 1.0) for o in solved]
    lines = [
        "# How near the extra photos of --fix are to the best ones",
        "",
        *__doc__.split("\n\n", 1)[1].strip().splitlines(),
        "",
        f"* {len(found)} plans of {min(o.photos for o in found)}-{max(o.photos for o in found)} photos; "
        f"{len(curable)} can be cured with the stations offered.",
        f"* The search cured {len(solved)} of these.",
        f"* Photos more than the fewest possible: at most {max(more)}; "
        f"{sum(m <= 0 for m in more)} of {len(more)} need none, {sum(m == 1 for m in more)} one.",
        f"* Time in the air against the least possible: median {np.median(ratio):.3f}, "
        f"worst {max(ratio):.3f}; "
        f"{sum(r <= 1.1 for r in ratio)} of {len(ratio)} within 10 %.",
        f"* CPU of the search: median {1000 * np.median([o.search_s for o in found]):.0f} ms.",
        "",
        "| photos | chosen | fewest | s | least s |",
        "|---|---|---|---|---|",
        *(
            f"| {o.photos} | {len(o.chosen.photos) if o.chosen.good else 'none'} "
            f"| {o.least_photos or 'none'} "
            f"| {o.chosen.seconds:.1f} | {'' if o.least_seconds is None else f'{o.least_seconds:.1f}'} |"
            for o in found
        ),
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    """Run the cases and write the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=60)
    given = parser.parse_args()
    text = report([outcome(seed) for seed in range(given.cases)])
    print(text)
    (HERE / "fix_optimality.md").write_text(text)


if __name__ == "__main__":
    main()

"""``make paper``: docs/papers.md and its figures, from raw results that survive a restart."""

from __future__ import annotations

import argparse
import os
import resource
import time
from dataclasses import dataclass, field
from pathlib import Path

from sim.papers import domes, lines, senn, survey, tables, walls
from sim.papers.common import Place

HERE = Path(__file__).resolve().parents[2]
#: Bump to start again after a change of what is computed.
VERSION = 1


@dataclass(frozen=True)
class Plan:
    """How much is computed."""

    draws: int = 1_000_000
    wall: walls.Plan = field(default_factory=walls.Plan)
    flights: tables.Plan = field(default_factory=tables.Plan)
    lens_points: int = 400
    k4_repeats: int = 20


FULL = Plan()
#: A look at everything in about two minutes.
QUICK = Plan(100_000, walls.Plan((24, 22), (10, 9)), tables.Plan(4, 2, 1), 200, 3)


def page(place: Place, plan: Plan) -> str:
    """The whole page as Markdown; figures are written on the way."""
    flown = tables.fly_all(place, plan.flights)
    sections = [
        lines.section(place, plan.draws),
        walls.section(place, plan.wall),
        tables.section_3(flown),
        tables.section_4(flown),
        domes.section(place, flown),
        survey.section(place, plan.lens_points, plan.draws // 5),
        senn.section(place, repeats=plan.k4_repeats),
    ]
    if plan.flights.seeds < FULL.flights.seeds:
        note = ["This page is from a quick run: small grids and few seeds.", ""]
    else:
        note = []
    head = [
        "# The papers again, in simulation",
        "",
        "Written by `make paper`; every number labelled ours is computed in that run, every number labelled "
        "theirs is printed in [C&D] (Carbonneau & Dietrich 2017) or [SEN] (Senn et al. 2020), see "
        "[method.md](method.md#sources). The simulations know the truth, the papers' field work does not: "
        "where the two differ the text says what could be the reason, and leaves the difference as it is. "
        "K are in pixel units (px^-2, px^-4, px^-6) unless said otherwise.",
        "",
        *note,
    ]
    return "\n".join([*head, ""]) + "\n".join(one.text for one in sections).rstrip() + "\n"


def main() -> None:
    """Compute what is missing and write the page."""
    parser = argparse.ArgumentParser(prog="python -m sim.papers", description=__doc__)
    parser.add_argument("--out", type=Path, default=HERE / "docs" / "papers.md", help="the page")
    parser.add_argument("--raw", type=Path, default=HERE / "build" / "papers", help="raw results, kept")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--quick", action="store_true", help="small grids and few seeds")
    given = parser.parse_args()
    plan = QUICK if given.quick else FULL
    started = time.monotonic()
    place = Place(given.out.parent / given.out.stem, given.raw / f"v{VERSION}", given.workers)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text(page(place, plan), encoding="utf-8")
    spent = sum(
        resource.getrusage(who).ru_utime + resource.getrusage(who).ru_stime
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    print(f"{given.out}: {time.monotonic() - started:.0f} s, {spent:.0f} CPU-seconds")


if __name__ == "__main__":
    main()

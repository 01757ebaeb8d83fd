"""``make paper``: docs/papers.md and its figures, from raw results that survive a restart."""

from __future__ import annotations

import argparse
import os
import re
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from sim.papers import domes, lines, senn, senn_rows, survey, tables, through_assess, walls
from sim.papers.common import Place, Section

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
    assessed_seeds: int = 5


FULL = Plan()
#: A look at everything in about two minutes.
QUICK = Plan(100_000, walls.Plan((24, 22), (10, 9)), tables.Plan(4, 2, 1), 200, 3, 1)


def sections(place: Place, plan: Plan) -> dict[int, Callable[[], Section]]:
    """What makes each section of the page, by its number."""

    @cache
    def flown() -> tables.Flown:
        return tables.fly_all(place, plan.flights)

    return {
        1: lambda: lines.section(place, plan.draws),
        2: lambda: walls.section(place, plan.wall),
        3: lambda: tables.section_3(flown()),
        4: lambda: tables.section_4(flown()),
        5: lambda: domes.section(place, flown()),
        6: lambda: survey.section(place, plan.lens_points, plan.draws // 5),
        7: lambda: senn.section(place, repeats=plan.k4_repeats),
        8: lambda: through_assess.section(place, plan.assessed_seeds),
        9: lambda: senn_rows.section(place),
    }


def renewed(text: str, made: dict[int, str]) -> str:
    """The page ``text`` with some of its sections, by number, written anew or added at its end."""
    head, *old = re.split(r"^(?=## \d+\. )", text, flags=re.MULTILINE)
    parts = {int(part[3 : part.index(".")]): part.rstrip() for part in old} | made
    return "\n\n".join([head.rstrip(), *(parts[n].rstrip() for n in sorted(parts))]) + "\n"


def page(place: Place, plan: Plan) -> str:
    """The whole page as Markdown; figures are written on the way."""
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
    return renewed("\n".join(head), {n: make().text for n, make in sections(place, plan).items()})


def main() -> None:
    """Compute what is missing and write the page."""
    parser = argparse.ArgumentParser(prog="python -m sim.papers", description=__doc__)
    parser.add_argument("--out", type=Path, default=HERE / "docs" / "papers.md", help="the page")
    parser.add_argument("--raw", type=Path, default=HERE / "build" / "papers", help="raw results, kept")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--only", type=int, nargs="+", metavar="N", help="renew these sections alone")
    parser.add_argument("--quick", action="store_true", help="small grids and few seeds")
    given = parser.parse_args()
    plan = QUICK if given.quick else FULL
    started = time.monotonic()
    place = Place(given.out.parent / given.out.stem, given.raw / f"v{VERSION}", given.workers)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    if given.only:
        makers = sections(place, plan)
        text = renewed(given.out.read_text(encoding="utf-8"), {n: makers[n]().text for n in given.only})
    else:
        text = page(place, plan)
    given.out.write_text(text, encoding="utf-8")
    spent = sum(
        resource.getrusage(who).ru_utime + resource.getrusage(who).ru_stime
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    print(f"{given.out}: {time.monotonic() - started:.0f} s, {spent:.0f} CPU-seconds")


if __name__ == "__main__":
    main()

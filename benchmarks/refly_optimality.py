"""How near the extra pass is to the best one: random flights, every subset of a few stations tried.

`python -m benchmarks.refly_optimality` writes benchmarks/refly_optimality.md, and the raw numbers beside it;
cases that are there already are kept, whole flights and the time of the large one are measured anew. Each
case is the network of a nadir flight as a check keeps it (random size, height, overlap, noise, tie points),
with eight stations to choose from: two of an orbit and six single ones at random. All 255 subsets are
evaluated under the criterion of the search (sigma f, dome, any one photo missing, enough convergent photos,
no two alike); the limits are 1.1 to 2.2 times what all eight bring, so that few of them cure, but not any
few. Time is from the ground at the launch point and back. A few flights are searched with every station
allowed, beside the best plain orbit and the papers' eight photos, and one of 300 photos is timed.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import asdict, dataclass, replace
from itertools import combinations, starmap
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.resumed import read_rows, run_rows
from calib.align.selfcal import BASIC, lens_priors, mask
from calib.brownfit import fit_brown
from calib.findings import Verdict
from calib.flown import FlownNetwork, thinned
from calib.flown_file import FlownCheck
from calib.network_design import CameraNetwork, Known, dome_functional, lens_information
from mission.optimise import Search
from mission.refly_passes import circle, paper_fan, singles
from mission.refly_search import Found, PassSearch
from mission.refly_site import FlownSite, flown_site
from mission.site_file import SiteFile
from sim.flights import grid, jittered, phantom3
from sim.network import SimBlock, SimOptions, observe

HERE = Path(__file__).parent
STATIONS = 8
RETURN_M = 30.0


def flown_case(seed: int) -> FlownSite:
    """A random nadir flight."""
    rng = np.random.default_rng([seed, 66])
    height = float(rng.uniform(40, 90))
    side = float(rng.uniform(1.4, 2.6) * height)
    lines = int(rng.integers(3, 6)), int(rng.integers(5, 9))
    return flown(seed, height, side, lines, int(rng.integers(1000, 3000)))


def flown(seed: int, height_m: float, side_m: float, lines: tuple[int, int], points: int) -> FlownSite:
    """A square nadir flight of ``lines`` and photos a line, as its check keeps it (at the true values)."""
    rng = np.random.default_rng([seed, 67])
    options = SimOptions(
        n_points=points, noise_px=float(rng.uniform(0.3, 0.7)), site_m=side_m,
        match_share=float(rng.uniform(0.5, 0.8)),
    )  # fmt: skip
    plan = grid(*lines, height_m, side_m, heading_deg=float(rng.uniform(0, 180)))
    block = observe("nadir", jittered(plan, seed, 1.0, 0.5, 1.5), phantom3(), seed, options)
    return flown_site(check_of(block, options.noise_px, height_m), SiteFile())


def check_of(block: SimBlock, noise_px: float, height_m: float) -> FlownCheck:
    """What a check of an observed block would keep."""
    k, lens = len(block.centres_m), block.lens
    free = mask((*BASIC, "k3", "p1", "p2", "b1", "b2"), field=True)
    known = Known(
        np.full((k, 3), 5.0),
        np.full(k, math.radians(5.0)),
        lens_priors(lens.brown.width, lens.brown.f_px)[1],
        free,
    )
    obs = block.observations
    views = CameraNetwork(
        lens,
        block.rotations_cam_from_world,
        block.centres_m,
        block.points_m,
        obs.photo,
        obs.point,
        obs.sigma_px,
    )
    kept: FlownNetwork = thinned(views, known, noise_px)
    information = lens_information(kept.network, known, dome_functional(kept.network.points_m)[None])
    jacobian = fit_brown(lens)[1]
    covariance = jacobian @ information.covariance @ jacobian.T
    return FlownCheck(
        kept, Verdict.REFLY, "", (), "DJI FC6310", lens.brown, covariance, math.sqrt(covariance[0, 0]),
        float(information.functional_sigma[0]), height_m, (50.8, -0.1, 0.0), 0.0,
        tuple(str(i) for i in range(k)),
    )  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """One case: whether search and exhaustion found a cure, their seconds, and photos."""

    photos: int
    chosen: int
    chosen_s: float
    good: bool
    least_s: float | None
    search_s: float


def outcome(seed: int) -> Outcome:
    """Case ``seed``."""
    case = flown_case(seed)
    rng = np.random.default_rng([seed, 68])
    search = PassSearch(case.planned, case.site, RETURN_M)
    over = search.over
    first_deg = float(rng.uniform(0, 360))
    ring = circle(over.middle_m, over.ground_m, over.height_m, 35.0, 8, first_deg).stations
    every = singles(over)
    picked = [
        *(ring[i] for i in rng.choice(8, 2, replace=False)),
        *(every[i] for i in rng.permutation(len(every))),
    ]
    for station in picked:
        if len(search.candidates.stations) < STATIONS:
            search.candidates.add([station])
    # What all of them bring, and a random factor of it to spare: few stations cure, but not any few.
    sigma_f, dome = case.planned.worth(search.candidates.pool.combined(tuple(range(STATIONS))).head)
    spare = float(rng.uniform(1.1, 2.2))
    wanted = replace(search.criterion, sigma_f_percent=spare * sigma_f, dome_percent=spare * dome)
    hunt = search.search(wanted)
    started = time.process_time()
    choice = hunt.best()
    search_s = time.process_time() - started
    least = _exhaustive(hunt, len(search.candidates.stations))
    return Outcome(len(case.centres_m), len(choice.photos), choice.seconds, choice.good, least, search_s)


def _exhaustive(search: Search, count: int) -> float | None:
    """Least seconds of all subsets that meet the criterion.

    With any one photo missing it holds where it holds for every subset of one photo less.
    """
    single = replace(search.criterion, least_photos=0)
    holds: dict[tuple[int, ...], bool] = {
        (): single.ratio(search.worths.worth(search.pool.joint.head)) <= 1.0
    }
    least: float | None = None
    for n in range(1, count + 1):
        for subset in combinations(range(count), n):
            parts = [tuple(p for p in subset if p != one) for one in subset]
            apart = not any(starmap(search.alike, combinations(subset, 2)))
            if apart and n >= search.criterion.least_photos and all(holds[part] for part in parts):
                cost = search.detours.seconds(subset)
                least = cost if least is None else min(least, cost)
            # Information only grows: what holds for a part holds for the whole.
            holds[subset] = any(holds[part] for part in parts) or (
                single.ratio(search.worths.worth(search.pool.head(subset))) <= 1.0
            )
    return least


@dataclass(frozen=True)
class Compared:
    """A flight searched whole: the pass, the best plain orbit and the papers' eight photos; CPU seconds."""

    photos: int
    best: Found | None
    orbit: Found | None
    paper: Found | None
    cpu_s: float


def compared(case: FlownSite, built_s: float = 0.0) -> Compared:
    """``built_s``: CPU seconds that putting the flight together took."""
    started = time.process_time()
    search = PassSearch(case.planned, case.site, RETURN_M)
    search.fill()
    best = search.best()
    cpu_s = time.process_time() - started + built_s
    fan = paper_fan(search.middle_m, search.ground_m, case.planned.height_agl_m).stations
    photos = tuple(i for i in search.candidates.add(fan) if i is not None)
    paper = search.found(photos) if photos else None
    return Compared(len(case.centres_m), best, search.regular("orbit", whole=True), paper, cpu_s)


def _cell(found: Found | None) -> str:
    if found is None:
        return "none"
    return f"{len(found.stations)}, {found.seconds:.0f} s{'' if found.good else ', does not cure'}"


def report(found: list[Outcome], whole: list[Compared], large: Compared) -> str:
    """Markdown."""
    curable = [o for o in found if o.least_s is not None]
    ratio = [o.chosen_s / (o.least_s or 1.0) for o in curable if o.good]
    lines = [
        "# How near the extra pass is to the best one",
        "",
        *(__doc__ or "").split("\n\n", 1)[1].strip().splitlines(),
        "",
        f"* {len(found)} flights of {min(o.photos for o in found)}-{max(o.photos for o in found)} photos; "
        f"{len(curable)} can be cured with the stations offered, and the search cured {len(ratio)} of these.",
        f"* Time in the air against the least possible: median {np.median(ratio):.3f}, "
        f"worst {max(ratio):.3f}; "
        f"{sum(r <= 1.1 for r in ratio)} of {len(ratio)} within 10 %, "
        f"{sum(r <= 1.0001 for r in ratio)} exactly the best.",
        f"* CPU of the search: median {1000 * np.median([o.search_s for o in found]):.0f} ms.",
        "",
        "With every station allowed:",
        "",
        "| photos flown | pass | best plain orbit | eight photos [C&D] | CPU s |",
        "|---|---|---|---|---|",
        *(
            f"| {c.photos} | {_cell(c.best)} | {_cell(c.orbit)} | {_cell(c.paper)} | {c.cpu_s:.1f} |"
            for c in [*whole, large]
        ),
        "",
    ]
    return "\n".join(lines)


def large_case() -> Compared:
    """300 photos of 12 MP; the time includes reading the network into the site's frame."""
    case = flown(1, 60.0, 300.0, (15, 20), 16000)
    started = time.process_time()
    again = flown_site(case.check, SiteFile())
    return compared(again, time.process_time() - started)


def to_row(numbered: tuple[int, Outcome]) -> dict[str, object]:
    """As JSON has it."""
    return {"seed": numbered[0]} | asdict(numbered[1])


def from_row(row: dict[str, Any]) -> tuple[int, Outcome]:
    """Inverse of :func:`to_row`; raises KeyError or TypeError where it is none of these."""
    content = dict(row)
    return int(content.pop("seed")), Outcome(**content)


def _numbered(seed: int) -> tuple[int, Outcome]:
    return seed, outcome(seed)


def main() -> None:
    """Run the cases and write the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--whole", type=int, default=12)
    parser.add_argument("--out", type=Path, default=HERE)
    given = parser.parse_args()
    raw = given.out / "refly_optimality.jsonl"
    known = {one[0]: one for one in read_rows(raw, from_row)}
    found = [one for _, one in run_rows(given.cases, raw, 1, _numbered, to_row, known)]
    whole = [compared(flown_case(1000 + seed)) for seed in range(given.whole)]
    text = report(found, whole, large_case())
    print(text)
    (given.out / "refly_optimality.md").write_text(text)


if __name__ == "__main__":
    main()

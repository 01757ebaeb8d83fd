"""The search for an extra pass on real photos: lewis_oblique with views taken away and given back.

    python -m benchmarks.refly_lewis [--cache FOLDER]

The photos (FIELDCAL_DATA) are aligned once, by the project's own alignment, and kept in the cache, as is
every part of them that was solved; the rest works on their tie points. Writes benchmarks/refly_lewis.md.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import pickle
import tempfile
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.align.adjust import Priors, State
from calib.align.child import measured
from calib.align.engine import Aligned, Aligner, Settings
from calib.align.selfcal import calibrate
from calib.align.tracks import select
from calib.check import conclude, read_set
from calib.errors import AlignmentError
from calib.flown_file import FlownCheck, flown_check
from calib.frames import gimbal_from_rotation
from calib.limits import FOCAL_SIGMA_PERCENT, percent
from calib.result import Timing
from mission.candidates import Candidates
from mission.optimise import Criterion, Search, Worths
from mission.plan import Station, Vehicle
from mission.refly_site import FlownSite, flown_site
from mission.route import Gap
from mission.site_file import SiteFile

HERE = Path(__file__).parent
SET = "lewis_oblique"
#: Random orders in which views are given back, and in which they are taken away.
REPEATS, CASES = 20, 3
#: Views are taken away until sigma f is so many times its limit, or so few photos are left.
BEYOND, LEAST = 2.0, 8
WHAT = """
Views are taken away in random orders until sigma f is twice its limit (or eight photos are left); the
stations taken away are the only candidates of the refly search (where they really were, without their roll;
noise and tie points of what is left; any one photo missing). What it chooses is given back with its real
tie points and the block is calibrated again. Beside it, views are given back in random orders until sigma f
is inside its limit. A flight's own rules (22.5 to 42.5 degrees off nadir, heights, dome) are left away:
most of these photos look flatter (`python -m benchmarks.refly_lewis`).
"""


@dataclass(frozen=True)
class Known:
    """What a part of the photos knows of f, px."""

    f_px: float
    sigma_px: float


class Photos:
    """The aligned set, solved again from any part of its photos; what was solved stands in ``kept``."""

    def __init__(self, aligned: Aligned, kept: Path) -> None:
        self.aligned, self._kept = aligned, kept
        self.count = len(aligned.solution.photos)
        rows = [json.loads(line) for line in kept.read_text().splitlines()] if kept.is_file() else []
        self._known = {tuple(part): Known(f_px, sigma_px) for part, f_px, sigma_px in rows}

    def known(self, part: Sequence[int]) -> Known:
        """Self-calibration of ``part`` from its own tie points; infinite sigma where it falls apart."""
        key = tuple(sorted(int(p) for p in part))
        if key not in self._known:
            found = self.checked(key)
            known = Known(math.nan, math.inf)
            if found is not None:
                known = Known(found.brown.f_px, float(np.sqrt(found.brown_covariance[0, 0])))
            self._known[key] = known
            with self._kept.open("a") as out:
                out.write(json.dumps([key, known.f_px, known.sigma_px]) + "\n")
        return self._known[key]

    def checked(self, part: Sequence[int]) -> FlownCheck | None:
        """The check of ``part`` as planning takes it; None where it falls apart."""
        block, whole = self.aligned.calibrated, self.aligned.solution
        place = np.full(self.count, -1)
        index = sorted(part)
        place[index] = np.arange(len(index))
        seen = block.observations
        keep = place[seen.photo] >= 0
        counts = np.bincount(seen.point[keep], minlength=len(whole.points_m))
        keep &= (counts >= 2)[seen.point]
        obs, old = select(seen, keep)
        obs = replace(obs, photo=place[obs.photo])
        state = block.adjusted.state
        start = State(state.lens, state.rotations[index], state.centres_m[index], state.points_m[old])
        try:
            found = calibrate(obs, start, _part_of(block.adjustment.priors, index))
        except (AlignmentError, np.linalg.LinAlgError):
            return None
        photos = [whole.photos[i] for i in index]
        solution = found.solution(photos, whole.georeference, (len(photos),))
        result = conclude(measured(solution, found, None), (), None, "", Timing(0.0, 0.0, 0.0))
        return flown_check(result)


def _part_of(priors: Priors, index: list[int]) -> Priors:
    return replace(
        priors,
        centres_m=priors.centres_m[index],
        centre_sigma_m=priors.centre_sigma_m[index],
        rotations=priors.rotations[index],
        rotation_sigma_rad=priors.rotation_sigma_rad[index],
        way_information=None,
    )


@dataclass(frozen=True)
class Case:
    """Views taken away in one random order, and what it takes to be inside the limit again.

    ``chosen``: by the search (``rule_kept``: enough by its rule), ``predicted_px``: sigma of f that it
    promised for them; ``by_rule``: how many of each random order its rule takes (predicted, any one missing).
    ``needed``: how many of the chosen, best first, the real observations need; ``random``: the same for each
    random order. Sigmas and f in px.
    """

    left: int
    taken: int
    sigma_left_px: float
    f_left_px: float
    chosen: int
    rule_kept: bool
    predicted_px: float
    f_px: float
    sigma_px: float
    by_rule: tuple[int, ...]
    needed: int
    random: tuple[int, ...]


def run(photos: Photos) -> tuple[Known, list[Case]]:
    """All cases, and the full set."""
    full = photos.known(range(photos.count))
    limit_px = FOCAL_SIGMA_PERCENT / 100 * full.f_px
    return full, [_case(photos, limit_px, seed) for seed in range(CASES)]


def _case(photos: Photos, limit_px: float, seed: int) -> Case:
    left, taken = _taken_away(photos, limit_px, seed)
    weak, check = photos.known(left), photos.checked(left)
    assert check is not None
    rng = np.random.default_rng([seed, 2])
    orders = [rng.permutation(taken).tolist() for _ in range(REPEATS)]
    order, rule_kept, predicted_px, by_rule = _chosen(photos, check, left, taken, limit_px, orders)
    after = photos.known([*left, *order])
    random = tuple(_needed(photos, left, one, limit_px) for one in orders)
    return Case(
        left=len(left),
        taken=len(taken),
        sigma_left_px=weak.sigma_px,
        f_left_px=weak.f_px,
        chosen=len(order),
        rule_kept=rule_kept,
        predicted_px=predicted_px,
        f_px=after.f_px,
        sigma_px=after.sigma_px,
        by_rule=by_rule,
        needed=_needed(photos, left, [*order, *(t for t in taken if t not in order)], limit_px),
        random=random,
    )


def _taken_away(photos: Photos, limit_px: float, seed: int) -> tuple[list[int], list[int]]:
    """Photos that are left when sigma has left its limit for good, and those taken away, in random order."""
    order = np.random.default_rng([seed, 1]).permutation(photos.count).tolist()
    left, taken = sorted(order), []
    for one in order:
        rest = [p for p in left if p != one]
        if not math.isfinite(photos.known(rest).sigma_px):
            continue
        left = rest
        taken.append(one)
        if len(left) <= LEAST or photos.known(left).sigma_px > BEYOND * limit_px:
            break
    return left, taken


def _needed(photos: Photos, left: list[int], order: list[int], limit_px: float) -> int:
    """How many of ``order``, from its beginning, bring sigma inside the limit."""
    for count in range(1, len(order) + 1):
        if photos.known([*left, *order[:count]]).sigma_px <= limit_px:
            return count
    return len(order) + 1


def _chosen(
    photos: Photos,
    check: FlownCheck,
    left: list[int],
    taken: list[int],
    limit_px: float,
    orders: Sequence[Sequence[int]],
) -> tuple[list[int], bool, float, tuple[int, ...]]:
    """What the search takes of the removed stations, the most useful first, whether its rule holds then, the
    sigma of f that it promises (px), and how many of each of ``orders`` its rule would take."""
    site = flown_site(check, SiteFile())
    stations = _stations(photos, site, left, taken)
    middle = np.median(site.planned.network.points_m[:, :2], axis=0)
    vehicle = Vehicle(gimbal_lowest_deg=-90.0, gimbal_highest_deg=90.0)
    gaps = [Gap(np.zeros(3), np.zeros(3), 0)]
    candidates = Candidates(site.planned, middle[None], vehicle, gaps, None, even=True)
    pool = candidates.add(stations)
    known = {number: photo for number, photo in zip(pool, taken, strict=True) if number is not None}
    worths = Worths(candidates.pool, site.planned.worth)
    limit = Criterion(100 * limit_px / check.brown.f_px, math.inf)
    hunt = Search(worths, candidates.detours, limit)
    choice = hunt.exchange(hunt.greedy((), by_time=False))
    order: list[int] = []
    while len(order) < len(choice.photos):
        rest = [i for i in choice.photos if i not in order]
        order.append(min(rest, key=lambda i: worths.alone([*order, i])[0]))
    number = {photo: i for i, photo in known.items()}
    by_rule = tuple(_by_rule(hunt, [number[p] for p in one if p in number]) for one in orders)
    predicted_px = worths.alone(order)[0] / 100 * check.brown.f_px
    return [known[i] for i in order], choice.good, predicted_px, by_rule


def _by_rule(hunt: Search, order: list[int]) -> int:
    good = (n for n in range(2, len(order) + 1) if hunt.ratio(order[:n]) <= 1.0)
    return next(good, len(order) + 1)


def _stations(photos: Photos, site: FlownSite, left: list[int], taken: list[int]) -> list[Station]:
    """Where the photos taken away were, around the launch point of ``site``; their roll is lost."""
    solution = photos.aligned.solution
    shift = site.centres_m[0] - solution.centres_m[left[0]]
    found = []
    for one in taken:
        east, north, up = (solution.centres_m[one] + shift).tolist()
        angles = gimbal_from_rotation(solution.rotations_cam_from_world[one])
        found.append(Station(east, north, up, angles.yaw_deg, angles.pitch_deg))
    return found


def _summary(full: Known, cases: Sequence[Case]) -> str:
    count, mean = len(cases), np.mean
    off = [abs(c.f_px - full.f_px) / c.predicted_px for c in cases]
    kept = [c for c in cases if c.rule_kept]
    ratios = [c.sigma_px / c.predicted_px for c in cases]
    fewer = sum(c.needed < mean(c.random) for c in cases)
    parts = (
        f"f was back within its predicted sigma of the full set's in {sum(o <= 1 for o in off)} of {count}",
        f"cases, within two in {sum(o <= 2 for o in off)}. By its own rule (predicted, any one photo",
        f"missing) the search found a pass in {len(kept)} of {count} cases, with",
        f"{mean([c.chosen for c in kept]):.1f} photos on average; random orders took",
        f"{mean([n for c in kept for n in c.by_rule]):.1f} there.",
        "Elsewhere the rule holds with no number of photos, and it took all that it could use. Measured",
        "afterwards, without a spare, the search's photos, best first, needed",
        f"{mean([c.needed for c in cases]):.1f} to be inside the limit, random orders",
        f"{mean([n for c in cases for n in c.random]):.1f} (fewer in {fewer} of {count} cases). The",
        f"prediction errs here: sigma found over predicted is {min(ratios):.2f} to {max(ratios):.2f};",
        "below 1 passes are longer than these photos needed.",
    )
    return " ".join(parts)


def report(photos: Photos, full: Known, cases: Sequence[Case]) -> str:
    """Markdown."""
    lines = [
        "# The search on real photos",
        "",
        f"`{SET}`: {photos.count} photos, all aligned, f = {full.f_px:.2f} +- {full.sigma_px:.2f} px "
        f"({percent(100 * full.sigma_px / full.f_px)}; limit of the check {percent(FOCAL_SIGMA_PERCENT)}, "
        f"{FOCAL_SIGMA_PERCENT / 100 * full.f_px:.2f} px).",
        *WHAT.strip().splitlines(),
        f"{CASES} orders of taking away, {REPEATS} of giving back each.",
        "",
        "| photos left, taken | left: f, sigma px | chosen | random by the same rule: mean (range) "
        "| sigma px predicted, found | f after px (from the full set's) | needed of the chosen "
        "| needed in random order: mean (range) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {c.left}, {c.taken} | {c.f_left_px:.2f}, {c.sigma_left_px:.2f} "
        f"| {c.chosen}{'' if c.rule_kept else ', not enough'} "
        f"| {np.mean(c.by_rule):.1f} ({min(c.by_rule)} to {max(c.by_rule)}) "
        f"| {c.predicted_px:.2f}, {c.sigma_px:.2f} | {c.f_px:.2f} ({c.f_px - full.f_px:+.2f}) | {c.needed} "
        f"| {np.mean(c.random):.1f} ({min(c.random)} to {max(c.random)}) |"
        for c in cases
    ]
    lines += [
        "",
        textwrap.fill(_summary(full, cases), 108),
        "",
    ]
    return "\n".join(lines)


def _aligned(cache: Path) -> Aligned:
    kept = cache / "refly_lewis.pickle"
    if kept.is_file():
        found: Aligned = pickle.loads(kept.read_bytes())
        return found
    photos = read_set([Path(os.environ["FIELDCAL_DATA"]) / SET], lambda *_: None)
    aligner = Aligner(Settings(workers=1), lambda *_: None)
    aligner.add_all(photos.used)
    found = aligner.solve()
    cache.mkdir(parents=True, exist_ok=True)
    kept.write_bytes(pickle.dumps(found))
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Align or take up the alignment, run, and write the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "fieldcal-benchmarks")
    parser.add_argument("--out", type=Path, default=HERE)
    given = parser.parse_args(arguments)
    photos = Photos(_aligned(given.cache), given.cache / "refly_lewis_parts.jsonl")
    full, cases = run(photos)
    (given.out / "refly_lewis.md").write_text(report(photos, full, cases))


if __name__ == "__main__":
    main()

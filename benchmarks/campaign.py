"""How honest the reported sigmas are: hundreds of simulated surveys against truth.

`make campaign` runs all parts and writes benchmarks/honest_sigma.md and the raw numbers beside
it. Part 1 repeats the table of Brown alone against Brown with the residual field; part 2 puts
errors into the camera that the lens model does not contain; part 3 gives the same flight more and
more tie points. Observation level: tie points with noise, no images.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.truth import mapping_error
from calib.align.selfcal import mask
from calib.align.uncertainty import estimate
from calib.brownfit import fit_brown
from calib.field import Lens
from sim.network import SimOptions, survey
from sim.solve import calibrate_block

HERE = Path(__file__).parent
#: The file's nominal focal length is off by this share, as EXIF often is.
NOMINAL = 1.02
FLIGHTS = ("A1", "A2", "A3", "A4")
PATTERNS_PX = (0.0, 0.5, 1.5)
#: Errors put in, by name; [C&D]'s site and heights, an ordinary consumer drone's shutter and speed.
ERRORS: dict[str, dict[str, float]] = {
    "none": {},
    "rolling shutter 30 ms at 5 m/s": {"readout_s": 0.03, "speed_m_s": 5.0},
    "aspect 0.5 %": {"aspect": 0.005},
    "non-Brown pattern 1.5 px": {"pattern_px": 1.5},
    "correlated noise 0.3 px": {"correlated_px": 0.3},
}
#: Ground points simulated: fewer where more photos see each of them.
POINTS = {"A1": 1000, "A2": 800, "A3": 1500, "A4": 1000, "nadir_one_height": 900, "crosshatch": 700}
#: Part 3: ground points under flights A3 and A4.
GROWING = (500, 1000, 2000, 4000)
NETWORKS = {"nadir": "nadir_one_height", "cross-hatch": "crosshatch", "convergent": "A3"}


@dataclass(frozen=True)
class Case:
    flight: str
    error: str
    seed: int
    points: int


@dataclass(frozen=True)
class Score:
    """Errors against truth in units that can be pooled; sigmas as reported.

    ``profile_ratio``: rms error of the total mapping over the image against its reported rms.
    ``plain_*``: Brown alone, no residual field, formal sigma.
    """

    flight: str
    error: str
    seed: int
    points: int
    observations: int
    df_percent: float
    sigma_percent: float
    formal_percent: float
    dcx_sigmas: float
    dcy_sigmas: float
    k1_sigmas: float
    k2_sigmas: float
    k3_sigmas: float
    profile_px: float
    profile_ratio: float
    plain_df_percent: float
    plain_sigma_percent: float
    factor: float
    spread_percent: float
    rolls: bool
    cpu_s: float


def options_of(case: Case) -> SimOptions:
    """Simulator options of a case: ``pattern X`` of part 1, or a named error of part 2."""
    if case.error.startswith("pattern "):
        return SimOptions(n_points=case.points, pattern_px=float(case.error.split()[1]))
    return SimOptions(n_points=case.points, **ERRORS[case.error])  # type: ignore[arg-type]


def score(case: Case) -> Score:
    """Simulate, calibrate and compare with truth."""
    started = time.process_time()
    block = survey(case.flight, case.seed, options_of(case))
    calibrated = calibrate_block(block, NOMINAL * block.lens.brown.f_px, case.seed)
    found = estimate(calibrated)
    truth = block.lens.brown
    sigma = np.sqrt(np.diag(found.covariance))
    off = (found.brown.vector - truth.vector) / np.where(sigma > 0, sigma, np.inf)
    profile, ratio = mapping_error(found.lens, block.total_px, found.lens_covariance)
    plain_free = calibrated.adjusted.free & mask(("f", "cx", "cy", "k1", "k2", "k3", "p1", "p2"))
    start = replace(calibrated.adjusted.state, lens=Lens(found.brown))
    plain = calibrated.adjustment.run(start, plain_free, 40, decrement=0.1)
    plain_f = fit_brown(plain.state.lens)[0].f_px
    return Score(
        **asdict(case),
        observations=len(calibrated.observations),
        df_percent=100 * (found.brown.f_px / truth.f_px - 1),
        sigma_percent=100 * found.sigma_f_px / truth.f_px,
        formal_percent=100 * found.sigma_f_formal_px / truth.f_px,
        dcx_sigmas=float(off[1]),
        dcy_sigmas=float(off[2]),
        k1_sigmas=float(off[3]),
        k2_sigmas=float(off[4]),
        k3_sigmas=float(off[5]),
        profile_px=profile,
        profile_ratio=ratio,
        plain_df_percent=100 * (plain_f / truth.f_px - 1),
        plain_sigma_percent=100 * float(np.sqrt(plain.covariance[0, 0])) / truth.f_px,
        factor=found.correlation_factor,
        spread_percent=100 * found.spread_f_px / truth.f_px,
        rolls=calibrated.adjustment.priors.way_information is not None,
        cpu_s=time.process_time() - started,
    )


def cases_table(seeds: int) -> list[Case]:
    """Part 1."""
    return [
        Case(flight, f"pattern {pattern}", seed, POINTS[flight])
        for seed in range(seeds)
        for flight in FLIGHTS
        for pattern in PATTERNS_PX
    ]


def cases_errors(seeds: int) -> list[Case]:
    """Part 2."""
    return [
        Case(flight, error, 1000 + seed, POINTS[flight])
        for seed in range(seeds)
        for flight in NETWORKS.values()
        for error in ERRORS
    ]


def cases_points(seeds: int) -> list[Case]:
    """Part 3."""
    return [
        Case(flight, "pattern 0.5", 2000 + seed, points)
        for seed in range(seeds)
        for flight in ("A3", "A4")
        for points in GROWING
    ]


def run(cases: Sequence[Case], raw: Path, workers: int) -> list[Score]:
    """Score all cases, appending to ``raw`` (JSON lines) as they finish; cases already there are kept."""
    done: dict[Case, Score] = {}
    if raw.exists():
        for line in raw.read_text().splitlines():
            one = Score(**json.loads(line))
            done[Case(one.flight, one.error, one.seed, one.points)] = one
    todo = [c for c in cases if c not in done]
    started = time.monotonic()
    with ProcessPoolExecutor(workers) as pool, raw.open("a") as out:
        for index, one in enumerate(pool.map(score, todo)):
            out.write(json.dumps(asdict(one)) + "\n")
            out.flush()
            done[Case(one.flight, one.error, one.seed, one.points)] = one
            left = (time.monotonic() - started) / (index + 1) * (len(todo) - index - 1)
            print(f"\r{index + 1} of {len(todo)}, {left / 60:.0f} min left ", end="", file=sys.stderr)
    print(file=sys.stderr)
    return [done[c] for c in cases]


def wilson(hits: int, n: int) -> tuple[float, float]:
    """95 % confidence interval of a share, percent."""
    if n == 0:
        return 0.0, 100.0
    z, share = 1.96, hits / n
    middle = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return 100 * (middle - half), 100 * (middle + half)


def decisions(scores: Iterable[Score]) -> tuple[int, int, int]:
    """How the 0.1 % rule decides when the reference is the truth: right, wrong, open.

    The truth has not drifted, so a pass is right and a flag is wrong.
    """
    right = wrong = undecided = 0
    for one in scores:
        drift, reach = abs(one.df_percent), 1.96 * one.sigma_percent
        if drift + reach <= 0.1:
            right += 1
        elif drift - reach > 0.1:
            wrong += 1
        else:
            undecided += 1
    return right, wrong, undecided


def drift_decisions(scores: Iterable[Score], drift_percent: float) -> tuple[int, int, int]:
    """The same when the camera has truly drifted by ``drift_percent``: flagged, wrongly passed, open."""
    right = wrong = undecided = 0
    for one in scores:
        for sign in (-1, 1):
            drift, reach = abs(one.df_percent + sign * drift_percent), 1.96 * one.sigma_percent
            if drift - reach > 0.1:
                right += 1
            elif drift + reach <= 0.1:
                wrong += 1
            else:
                undecided += 1
    return right, wrong, undecided


def _group(scores: Sequence[Score], flight: str, error: str) -> list[Score]:
    return [s for s in scores if s.flight == flight and s.error == error]


def _rms(values: Iterable[float]) -> float:
    return float(np.sqrt(np.mean(np.square(list(values)))))


def report_table(scores: Sequence[Score]) -> list[str]:
    """Part 1 as Markdown."""
    lines = [
        "| flight | pattern px | seeds | Brown: worst / formal | fieldcal: worst / sigma | rms z f "
        "| z cx, cy | z K1, K2, K3 | profile rms px (ratio) | 0.1 %: right, wrong, open "
        "| drift 0.25 %: flagged, passed, open |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for flight in FLIGHTS:
        for pattern in PATTERNS_PX:
            group = _group(scores, flight, f"pattern {pattern}")
            if not group:
                continue
            z = _rms(s.df_percent / s.sigma_percent for s in group)
            lines.append(
                f"| {flight} | {pattern:g} | {len(group)} "
                f"| {max(abs(s.plain_df_percent) for s in group):.3f} / "
                f"{np.median([s.plain_sigma_percent for s in group]):.3f} "
                f"| {max(abs(s.df_percent) for s in group):.3f} / "
                f"{np.median([s.sigma_percent for s in group]):.3f} "
                f"| {z:.2f} "
                f"| {_rms(s.dcx_sigmas for s in group):.2f}, {_rms(s.dcy_sigmas for s in group):.2f} "
                f"| {_rms(s.k1_sigmas for s in group):.2f}, {_rms(s.k2_sigmas for s in group):.2f}, "
                f"{_rms(s.k3_sigmas for s in group):.2f} "
                f"| {_rms(s.profile_px for s in group):.3f} ({_rms(s.profile_ratio for s in group):.2f}) "
                f"| {', '.join(map(str, decisions(group)))} "
                f"| {', '.join(map(str, drift_decisions(group, 0.25)))} |"
            )
    return lines


def report_errors(scores: Sequence[Score]) -> list[str]:
    """Part 2 as Markdown."""
    lines = [
        "| network | error put in | surveys | median abs error of f % | median sigma % | median formal % | "
        "within 3 sigma | 95 % interval |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for label, flight in NETWORKS.items():
        for error in ERRORS:
            group = _group(scores, flight, error)
            if not group:
                continue
            held = sum(abs(s.df_percent) <= 3 * s.sigma_percent for s in group)
            low, high = wilson(held, len(group))
            lines.append(
                f"| {label} | {error} | {len(group)} | {np.median([abs(s.df_percent) for s in group]):.3f} "
                f"| {np.median([s.sigma_percent for s in group]):.3f} "
                f"| {np.median([s.formal_percent for s in group]):.3f} "
                f"| {held} | {low:.0f}-{high:.0f} % |"
            )
    wrong = [s for s in scores if s.error != "none"]
    held = sum(abs(s.df_percent) <= 3 * s.sigma_percent for s in wrong)
    low, high = wilson(held, len(wrong))
    lines.append("")
    lines.append(
        f"All surveys with an error put in: {held} of {len(wrong)} within 3 sigma ({low:.1f}-{high:.1f} %)."
    )
    return lines


def report_points(scores: Sequence[Score]) -> list[str]:
    """Part 3 as Markdown."""
    lines = [
        "Pattern of 0.5 px. The 0.1 % rule with the true lens as reference: the more tie points, the fewer "
        "flights are left open.",
        "",
        "| flight | points | observations | seeds | median sigma % | worst error % | right, wrong, open |",
        "|---|---|---|---|---|---|---|",
    ]
    for flight in ("A3", "A4"):
        for points in GROWING:
            group = [s for s in scores if s.flight == flight and s.points == points]
            if group:
                seen = np.median([s.observations for s in group])
                lines.append(
                    f"| {flight} | {points} | {seen:.0f} | {len(group)} "
                    f"| {np.median([s.sigma_percent for s in group]):.3f} "
                    f"| {max(abs(s.df_percent) for s in group):.3f} "
                    f"| {', '.join(map(str, decisions(group)))} |"
                )
    return lines


def main() -> None:
    """Run the campaign and write its report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=50, help="seeds a row of part 1 (0: leave it out)")
    parser.add_argument("--error-seeds", type=int, default=20, help="seeds a row of part 2 (0: leave it out)")
    parser.add_argument("--point-seeds", type=int, default=12, help="seeds a row of part 3 (0: leave it out)")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=HERE)
    given = parser.parse_args()
    table = run(cases_table(given.seeds), given.out / "honest_sigma_table.jsonl", given.workers)
    errors = run(cases_errors(given.error_seeds), given.out / "honest_sigma_errors.jsonl", given.workers)
    points = run(cases_points(given.point_seeds), given.out / "honest_sigma_points.jsonl", given.workers)
    body = [
        "# How honest the sigmas are",
        "",
        __doc__.split("\n\n", 1)[1].strip(),
        "",
        "## Brown alone against Brown with the residual field",
        "",
        *report_table(table),
        "",
        "## Errors that the lens model does not contain",
        "",
        *report_errors(errors),
        "",
        "## More tie points",
        "",
        *report_points(points),
        "",
    ]
    (given.out / "honest_sigma.md").write_text("\n".join(body))


if __name__ == "__main__":
    main()

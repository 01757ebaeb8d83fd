"""Calibrations on a simulated wall over many seeds: is a bent wall caught, a flat one accepted, is f right?

`python -m benchmarks.onsite --seeds 50` writes benchmarks/onsite.md; what is in benchmarks/onsite.jsonl is
not run again, so that it can be broken off at any time. At observation level: 24 photos of a Phantom 3,
0.3 px of noise, half of all views matched, a wall rough by 2 mm, and a lens with 0.5 px that Brown's
model cannot follow. Each seed has noise, pattern and photos of its own.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.campaign import wilson
from benchmarks.resumed import read_rows, run_rows
from calib.camera import BROWN_NAMES
from calib.findings import State
from calib.onsite import Kind, concluded
from calib.photos import Sorted
from calib.result import Timing
from sim.flights import phantom3
from sim.wall_block import WallOptions, wall_outcome

HERE = Path(__file__).parent
#: What of a bend is at the rim, where the check states it: within it lie 97 % of the points (1.5 % at
#: either end are left out), and a bend grows with the square.
RIM_SHARE = 0.97**2
#: Of the distance: to be caught.
BEND_PERCENT = 0.15
CASES = {
    "advised, flat": WallOptions(advised=True),
    "advised, bent": WallOptions(advised=True, bend_percent=BEND_PERCENT),
    "level pairs, flat": WallOptions(),
    "level pairs, bent": WallOptions(bend_percent=BEND_PERCENT),
}
SHOWN = ("f", "cx", "cy", "k1", "k2", "k3")


@dataclass(frozen=True)
class Row:
    """One calibration: what it says, and errors of ``SHOWN`` and of the bend in their own sigmas."""

    number: int
    case: str
    acceptance: str
    flat: bool
    bent: bool
    f_percent: float
    f_sigma_percent: float
    sigmas: tuple[float, ...]
    bend_percent: float
    bend_sigma_percent: float
    cpu_s: float


def one(number: int) -> Row:
    """Calibration ``number``: the cases of a seed one after the other, then the next seed."""
    seed, which = divmod(number, len(CASES))
    case = list(CASES)[which]
    started = time.process_time()
    outcome = wall_outcome(seed, CASES[case])
    photos = Sorted(outcome.solution.photos, (), ())
    made = concluded(outcome, Kind.WALL, photos, Timing(0.0, 0.0, 0.0))
    brown, truth = made.estimate.brown, phantom3()
    flatness = made.flatness
    assert flatness is not None
    bends = [f for f in made.findings if f.rule in ("wall-bend-along", "wall-twist", "wall-bend-up")]
    index = [BROWN_NAMES.index(name) for name in SHOWN]
    apart = (brown.vector - truth.vector)[index] / np.sqrt(np.diag(made.estimate.covariance)[index])
    return Row(
        number,
        case,
        made.acceptance.value,
        all(f.state is State.PASS for f in bends),
        any(f.state is State.FLAG for f in bends),
        100 * (brown.f_px / truth.f_px - 1),
        100 * made.estimate.sigma_f_px / truth.f_px,
        tuple(apart.tolist()),
        float(flatness.terms_percent[0]),
        float(flatness.sigmas_percent[0]),
        time.process_time() - started,
    )


def page(rows: Sequence[Row]) -> str:
    """What ran, as Markdown."""
    seeds = len({row.number // len(CASES) for row in rows})
    spent = sum(row.cpu_s for row in rows)
    lines = ["# Calibrations on a wall", "", (__doc__ or "").split("\n\n")[1].strip(), ""]
    lines += [
        f"{len(rows)} calibrations, {seeds} seeds, {spent:.0f} CPU seconds ({spent / len(rows):.1f} each).",
        "",
        _CASES,
        "",
        "## Accepted, caught",
        "",
        "Accepted: the whole calibration. Caught: not accepted. In brackets 95 % intervals. The bend is "
        f"stated at the rim of the measured points, where {RIM_SHARE * BEND_PERCENT:.3f} % of the "
        f"{BEND_PERCENT:g} % are left; its errors in sigmas are against that.",
        "",
        "| wall | seeds | accepted | caught | bend flagged | bend %, mean ± spread | rms, sigmas |",
        "|---|---|---|---|---|---|---|",
    ]
    parts = {case: [row for row in rows if row.case == case] for case in CASES}
    parts = {case: mine for case, mine in parts.items() if mine}
    for case, mine in parts.items():
        expected = -RIM_SHARE * CASES[case].bend_percent
        bend = np.array([row.bend_percent for row in mine])
        sigma = np.array([row.bend_sigma_percent for row in mine])
        taken = sum(row.acceptance == "ACCEPTED" for row in mine)
        lines.append(
            f"| {case} | {len(mine)} | {_share(taken, len(mine))} | {_share(len(mine) - taken, len(mine))} | "
            f"{_share(sum(row.bent for row in mine), len(mine))} | {bend.mean():+.3f} ± {bend.std():.3f} | "
            f"{_rms((bend - expected) / sigma):.2f} |"
        )
    lines += [
        "",
        "## The focal length",
        "",
        "| wall | error, rms % | largest % | within 0.02 % | sigma, median % |",
        "|---|---|---|---|---|",
    ]
    for case, mine in parts.items():
        f = np.array([row.f_percent for row in mine])
        lines.append(
            f"| {case} | {_rms(f):.4f} | {np.abs(f).max():.4f} | "
            f"{_share(int(np.sum(np.abs(f) < 0.02)), len(f))} | "
            f"{np.median([row.f_sigma_percent for row in mine]):.4f} |"
        )
    lines += [
        "",
        "## Errors in their own sigmas",
        "",
        "Rms (1 where sigmas are right) and the largest.",
        "",
        "| wall | " + " | ".join(SHOWN) + " | all within 3 |",
        "|---" * (len(SHOWN) + 2) + "|",
    ]
    for case, mine in parts.items():
        sizes = np.array([row.sigmas for row in mine])
        cells = [f"{_rms(sizes[:, i]):.2f}, {np.abs(sizes[:, i]).max():.1f}" for i in range(len(SHOWN))]
        lines.append(
            f"| {case} | {' | '.join(cells)} | {_share(int(np.sum(np.abs(sizes) < 3)), sizes.size)} |"
        )
    return "\n".join(lines) + "\n"


_CASES = (
    "*Advised*: what the manual asks for ([docs](../docs/calibrate.md)): at eight places along the wall "
    "three photos each, from the left, head-on and from the right, from 8 and 12 m by turns, at every other "
    "two places with the camera upright. *Level pairs*: the twelve pairs of [C&D], all level, all from 10 m, "
    f"none head-on. *Bent*: the wall's middle stands {BEND_PERCENT:g} % of the distance in front of its ends."
)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _share(hits: int, n: int) -> str:
    low, high = wilson(hits, n)
    return f"{100 * hits / n:.0f} % ({max(low, 0.0):.0f}-{high:.0f})"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, default=HERE)
    given = parser.parse_args()
    raw = given.out / "onsite.jsonl"
    known = {row.number: row for row in read_rows(raw, _row)}
    run_rows(len(CASES) * given.seeds, raw, given.workers, one, asdict, known)
    # All that is there, also of a longer run.
    rows = {row.number: row for row in read_rows(raw, _row)}
    (given.out / "onsite.md").write_text(page([rows[n] for n in sorted(rows)]), encoding="utf-8")


def _row(data: dict[str, object]) -> Row:
    row = Row(**data)  # type: ignore[arg-type]
    if list(CASES)[row.number % len(CASES)] != row.case:
        raise KeyError(row.case)
    return row


if __name__ == "__main__":
    main()

"""Calibrations on a wall, from an orbit and on control points over many seeds, against the true lens.

`python -m benchmarks.onsite --seeds 50` writes benchmarks/onsite.md; what is in benchmarks/onsite.jsonl is
not run again, so that it can be broken off at any time. At observation level, each seed with noise, lens
pattern and photos of its own; unless said otherwise a Phantom 3 whose lens has 0.5 px that Brown's model
cannot follow, 0.3 px of noise and half of all views matched.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.campaign import wilson
from benchmarks.resumed import read_rows, run_rows
from calib.camera import BROWN_NAMES, BrownCamera, FloatArray
from calib.control import MARK_SIGMA_PX, calibrate_control, prepare
from calib.findings import State
from calib.onsite import Acceptance, Kind, concluded
from calib.onsite_rules import reference_limit_percent
from calib.photos import Sorted
from calib.result import Timing
from calib.targets import DETECTED_SIGMA_PX, parse_board
from sim.control_block import Campaign, board_campaign, campaign
from sim.flights import Flight, convergent, grid, jittered, phantom3
from sim.network import SimOptions, observe
from sim.papers.orbit import TARGET_M, fly
from sim.solution import outcome_of
from sim.wall_block import WallOptions, wall_outcome

HERE = Path(__file__).parent
#: What of a bend is at the rim, where the check states it: within it lie 97 % of the points (1.5 % at
#: either end are left out), and a bend grows with the square.
RIM_SHARE = 0.97**2
#: Of the distance: to be caught.
BEND_PERCENT = 0.15
WALLS = {
    "advised, flat": WallOptions(advised=True),
    "advised, bent": WallOptions(advised=True, bend_percent=BEND_PERCENT),
    "level pairs, flat": WallOptions(),
    "level pairs, bent": WallOptions(bend_percent=BEND_PERCENT),
}
#: Of the lens that is not Brown's, and noise of a tie point, px.
PATTERN_PX, NOISE_PX = 0.5, 0.3
_CIRCLE = convergent(12, 40.0, 60.0)
ORBITS = {
    "orbit, one circle": _CIRCLE,
    "orbit, advised": _CIRCLE + convergent(12, 25.0, 80.0, first_azimuth_deg=15.0) + grid(2, 2, 60.0, 60.0),
}
BOARD, BOARD_PHOTOS = "9x7,60,45", 20
SHOWN = ("f", "cx", "cy", "k1", "k2", "k3")


@dataclass(frozen=True)
class Row:
    """One calibration: what it says, and errors of ``SHOWN`` and of the bend in their own sigmas.

    Of walls alone: ``flat``, ``bent`` and the bend.
    """

    seed: int
    case: str
    acceptance: str
    f_percent: float
    f_sigma_percent: float
    sigmas: tuple[float, ...]
    cpu_s: float
    flat: bool = False
    bent: bool = False
    bend_percent: float = 0.0
    bend_sigma_percent: float = 0.0

    @property
    def number(self) -> int:
        return self.seed * len(CASES) + list(CASES).index(self.case)


def wall(options: WallOptions, case: str, seed: int) -> Row:
    """On a wall."""
    started = time.process_time()
    outcome = wall_outcome(seed, options)
    photos = Sorted(outcome.solution.photos, (), ())
    made = concluded(outcome, Kind.WALL, photos, Timing(0.0, 0.0, 0.0))
    flatness = made.flatness
    assert flatness is not None
    bends = [f for f in made.findings if f.rule in ("wall-bend-along", "wall-twist", "wall-bend-up")]
    row = _row(
        seed, case, made.acceptance, made.estimate.brown, phantom3(), made.estimate.covariance, started
    )
    return replace(
        row,
        flat=all(f.state is State.PASS for f in bends),
        bent=any(f.state is State.FLAG for f in bends),
        bend_percent=float(flatness.terms_percent[0]),
        bend_sigma_percent=float(flatness.sigmas_percent[0]),
    )


def orbit(plan: Flight, case: str, seed: int) -> Row:
    """From a convergent flight."""
    started = time.process_time()
    camera, options = (
        own_camera(seed),
        SimOptions(n_points=1500, noise_px=NOISE_PX, match_share=0.5, pattern_px=PATTERN_PX),
    )
    flight = jittered(
        plan, seed, options.position_jitter_m, options.height_jitter_m, options.attitude_jitter_deg
    )
    block = observe("orbit", flight, camera, seed, options)
    outcome, _ = outcome_of(block, 1.02 * camera.f_px, seed, None)
    photos = Sorted(outcome.solution.photos, (), ())
    made = concluded(outcome, Kind.ORBIT, photos, Timing(0.0, 0.0, 0.0))
    return _row(seed, case, made.acceptance, made.estimate.brown, camera, made.estimate.covariance, started)


def board(pattern_px: float, case: str, seed: int) -> Row:
    """On a printed ChArUco board."""
    camera = own_camera(seed)
    made = board_campaign(parse_board(BOARD), camera, BOARD_PHOTOS, DETECTED_SIGMA_PX, pattern_px, seed)
    return on_points(made, camera, DETECTED_SIGMA_PX, case, seed)


def building(name: str, case: str, seed: int) -> Row:
    """On the targets of [SEN]'s building."""
    flown = fly(name, seed)
    return on_points(campaign(flown, TARGET_M), flown.camera, MARK_SIGMA_PX, case, seed)


def on_points(given: Campaign, camera: BrownCamera, sigma_px: float, case: str, seed: int) -> Row:
    """A calibration on control points."""
    started = time.process_time()
    photos, points, marks = given
    used, kept, chosen, notes = prepare(photos, points, marks, sigma_px)
    made = calibrate_control(used, kept, chosen, 0.97 * camera.f_px, notes)
    good = made.sigma_f_percent <= reference_limit_percent(camera.width)
    answer = Acceptance.ACCEPTED if good else Acceptance.RETAKE
    return _row(seed, case, answer, made.camera, camera, made.covariance, started)


def own_camera(seed: int) -> BrownCamera:
    """A Phantom 3 with a principal point and decentring of its own."""
    rng = np.random.default_rng([seed, 29])
    cx, cy = np.array([2000.0, 1500.0]) + 8 * rng.normal(size=2)
    p1, p2 = 1e-4 * rng.normal(size=2)
    return replace(phantom3(), cx_px=float(cx), cy_px=float(cy), p1=float(p1), p2=float(p2))


def _row(
    seed: int,
    case: str,
    answer: Acceptance,
    found: BrownCamera,
    truth: BrownCamera,
    covariance: FloatArray,
    started: float,
) -> Row:
    index = [BROWN_NAMES.index(name) for name in SHOWN]
    apart = (found.vector - truth.vector)[index] / np.sqrt(np.diag(covariance)[index])
    return Row(
        seed,
        case,
        answer.value,
        100 * (found.f_px / truth.f_px - 1),
        100 * float(np.sqrt(covariance[0, 0])) / truth.f_px,
        tuple(apart.tolist()),
        time.process_time() - started,
    )


CASES: dict[str, Callable[[str, int], Row]] = {
    **{name: partial(wall, options) for name, options in WALLS.items()},
    **{name: partial(orbit, plan) for name, plan in ORBITS.items()},
    "board, Brown's lens": partial(board, 0.0),
    "board": partial(board, PATTERN_PX),
    "building, RGB": partial(building, "RGB add6"),
    "building, thermal": partial(building, "thermal add6"),
}


def one(number: int) -> Row:
    """Calibration ``number``: the cases of a seed one after the other, then the next seed."""
    seed, which = divmod(number, len(CASES))
    case = list(CASES)[which]
    return CASES[case](case, seed)


def page(rows: Sequence[Row]) -> str:
    """What ran, as Markdown."""
    seeds = len({row.seed for row in rows})
    spent = sum(row.cpu_s for row in rows)
    lines = ["# Calibrations on site", "", (__doc__ or "").split("\n\n")[1].strip(), ""]
    lines += [
        f"{len(rows)} calibrations, {seeds} seeds, {spent:.0f} CPU seconds ({spent / len(rows):.1f} each).",
        "",
        *_CASES,
        "## Walls: accepted, caught",
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
        if case not in WALLS:
            continue
        expected = -RIM_SHARE * WALLS[case].bend_percent
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
        "Accepted: what fieldcal would keep as a reference (f known to 0.05 %; of the thermal camera to a "
        f"pixel of its own, {reference_limit_percent(640):.2f} %).",
        "",
        "| calibration | seeds | error, rms % | largest % | within 0.02 % | sigma, median % | accepted |",
        "|---|---|---|---|---|---|---|",
    ]
    for case, mine in parts.items():
        f = np.array([row.f_percent for row in mine])
        lines.append(
            f"| {case} | {len(mine)} | {_rms(f):.4f} | {np.abs(f).max():.4f} | "
            f"{_share(int(np.sum(np.abs(f) < 0.02)), len(f))} | "
            f"{np.median([row.f_sigma_percent for row in mine]):.4f} | "
            f"{_share(sum(row.acceptance == 'ACCEPTED' for row in mine), len(mine))} |"
        )
    lines += [
        "",
        "## Errors in their own sigmas",
        "",
        "Rms (1 where sigmas are right) and the largest.",
        "",
        "| calibration | " + " | ".join(SHOWN) + " | within 3, of all | f within 3 |",
        "|---" * (len(SHOWN) + 3) + "|",
    ]
    for case, mine in parts.items():
        sizes = np.array([row.sigmas for row in mine])
        cells = [f"{_rms(sizes[:, i]):.2f}, {np.abs(sizes[:, i]).max():.1f}" for i in range(len(SHOWN))]
        lines.append(
            f"| {case} | {' | '.join(cells)} | {_share(int(np.sum(np.abs(sizes) < 3)), sizes.size)} | "
            f"{_share(int(np.sum(np.abs(sizes[:, 0]) < 3)), len(sizes))} |"
        )
    return "\n".join(lines) + "\n"


_CASES = (
    "*Advised*: what the manual asks for ([docs](../docs/calibrate.md)): at eight places along a wall (rough "
    "by 2 mm) three photos each, from the left, head-on and from the right, from 8 and 12 m by turns, at "
    "every other two places with the camera upright. *Level pairs*: the twelve pairs of [C&D], all level, "
    f"all from 10 m, none head-on. *Bent*: the wall's middle stands {BEND_PERCENT:g} % of the distance in "
    "front of its ends.",
    "",
    "*Orbit*: *one circle* of 12 photos 40 degrees off straight down from 60 m; *advised*: with a second "
    "one, 25 degrees off from 80 m, and four photos straight down, 28 in all. Ground with 2 m of relief, "
    "receiver good to 2.5 m.",
    "",
    f"*Board*: {BOARD_PHOTOS} photos of a ChArUco board of 9 x 7 squares as the manual asks for them, "
    f"corners found to {DETECTED_SIGMA_PX:g} px, printed to 0.2 mm; with that lens, and with one that is "
    "Brown's. *Building*: the campaigns of [SEN] (21 RGB or 17 thermal photos at most, marks to "
    f"{MARK_SIGMA_PX:g} px, targets to {1000 * TARGET_M:g} mm); their lenses, with decentring and affinity.",
    "",
    "Level pairs and a single circle miss 0.02 % because every photo sees a flat thing under the same "
    "angle, and a change of f is then nearly a change of that angle; photos at other angles tell them "
    "apart. Marks on a building miss it because some hundred marks to half a pixel hold no more. The "
    "sigmas say so.",
    "",
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
    known = {row.number: row for row in read_rows(raw, _read)}
    run_rows(len(CASES) * given.seeds, raw, given.workers, one, asdict, known)
    # All that is there, also of a longer run.
    rows = {row.number: row for row in read_rows(raw, _read)}
    (given.out / "onsite.md").write_text(page([rows[n] for n in sorted(rows)]), encoding="utf-8")


def _read(data: dict[str, object]) -> Row:
    row = Row(**data)  # type: ignore[arg-type]
    if row.case not in CASES:
        raise KeyError(row.case)
    return row


if __name__ == "__main__":
    main()

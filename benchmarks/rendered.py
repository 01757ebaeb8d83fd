"""Rendered surveys against truth: the whole chain from JPEG to sigma.

    python -m benchmarks.rendered [--seeds 10] [--error-seeds 9] [--size 800x600]

Photos are rendered, written, read, aligned and calibrated; nothing is shared with the truth but
the files. Writes benchmarks/rendered.md and the raw numbers beside it.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.campaign import wilson
from benchmarks.truth import mapping_error
from calib.align.child import Job, work
from calib.align.engine import Settings
from calib.photos import collect, read_photos
from sim.flights import phantom3
from sim.render import RenderOptions
from sim.survey import SurveyOptions, lens_corrected, read_truth, write_survey

HERE = Path(__file__).parent
ERRORS = (
    "rolling shutter 30 ms at 5 m/s",
    "aspect 0.5 %",
    "in-camera correction, 1.5 px pattern",
    "correlated noise 1 px",
)
RECIPES = {"nadir": "demo_nadir", "cross-hatch": "demo_crosshatch", "convergent": "demo"}


@dataclass(frozen=True)
class Score:
    """``profile_px``: rms error of the total mapping over the image after the best rotation."""

    network: str
    error: str
    seed: int
    width: int
    aligned: int
    photos: int
    df_percent: float
    sigma_percent: float
    formal_percent: float
    profile_px: float
    rms_px: float
    factor: float
    cpu_s: float


def options_of(error: str, size: tuple[int, int]) -> SurveyOptions:
    """The survey with one error put in."""
    options = SurveyOptions()
    if error.startswith("rolling"):
        return replace(options, speed_m_s=5.0, render=RenderOptions(readout_s=0.03))
    if error.startswith("aspect"):
        return replace(options, aspect=0.005)
    if error.startswith("in-camera"):
        return replace(options, camera=lens_corrected(phantom3(*size)), lens_corrected=True, pattern_px=1.5)
    if error.startswith("correlated"):
        return replace(options, haze_px=1.0)
    return options


def score(network: str, error: str, seed: int, size: tuple[int, int]) -> Score:
    """Render, solve and compare one survey."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        write_survey(RECIPES[network], out, seed, size=size, options=options_of(error, size), workers=1)
        truth = read_truth(out)
        photos, _ = read_photos(collect([out]))
        started = time.process_time()
        found = work(Job(tuple(photos), None, Settings(workers=1)), lambda *_: None)
        cpu = time.process_time() - started
    camera = truth.camera
    estimate = found.estimate
    return Score(
        network=network,
        error=error,
        seed=seed,
        width=size[0],
        aligned=len(found.solution.photos),
        photos=len(photos),
        df_percent=100 * (estimate.brown.f_px / camera.f_px - 1),
        sigma_percent=100 * estimate.sigma_f_px / camera.f_px,
        formal_percent=100 * estimate.sigma_f_formal_px / camera.f_px,
        profile_px=mapping_error(estimate.lens, truth.total_px)[0],
        rms_px=found.solution.rms_px,
        factor=estimate.correlation_factor,
        cpu_s=cpu,
    )


def report(scores: Sequence[Score]) -> str:
    """Markdown."""
    lines = [
        "# Rendered surveys against truth",
        "",
        (__doc__ or "").split("\n\n")[-1].strip(),
        "",
        "| network | error put in | size | surveys | all aligned | abs error of f %: median, worst "
        "| sigma % | rms z | profile px: median, worst | within 3 sigma |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    keys = sorted({(s.network, s.error, s.width) for s in scores})
    for network, error, width in keys:
        group = [s for s in scores if (s.network, s.error, s.width) == (network, error, width)]
        off = [abs(s.df_percent) for s in group]
        held = sum(abs(s.df_percent) <= 3 * s.sigma_percent for s in group)
        z = float(np.sqrt(np.mean([(s.df_percent / s.sigma_percent) ** 2 for s in group])))
        lines.append(
            f"| {network} | {error} | {width} | {len(group)} | {sum(s.aligned == s.photos for s in group)} "
            f"| {np.median(off):.4f}, {max(off):.4f} | {np.median([s.sigma_percent for s in group]):.4f} "
            f"| {z:.2f} | {np.median([s.profile_px for s in group]):.3f}, "
            f"{max(s.profile_px for s in group):.3f} "
            f"| {held} |"
        )
    wrong = [s for s in scores if s.error != "none"]
    held = sum(abs(s.df_percent) <= 3 * s.sigma_percent for s in wrong)
    low, high = wilson(held, len(wrong))
    lines += [
        "",
        f"With an error put in: {held} of {len(wrong)} within 3 sigma ({low:.0f}-{high:.0f} %).",
        "",
    ]
    return "\n".join(lines)


@dataclass(frozen=True)
class Case:
    """One survey to be rendered and solved."""

    network: str
    error: str
    seed: int
    size: tuple[int, int]


def scored(case: Case) -> Score:
    """:func:`score` of a case, for a pool of processes."""
    return score(case.network, case.error, case.seed, case.size)


def main() -> None:
    """Run, appending raw numbers, and write the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10, help="surveys without an error")
    parser.add_argument("--error-seeds", type=int, default=9, help="surveys a network and error")
    parser.add_argument("--size", default="800x600", help="of surveys with an error")
    parser.add_argument("--clean-size", default="1600x1200", help="of those without")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=HERE)
    given = parser.parse_args()
    size, clean = ((int(w), int(h)) for w, h in (given.size.split("x"), given.clean_size.split("x")))
    raw = given.out / "rendered.jsonl"
    scores = [Score(**json.loads(line)) for line in raw.read_text().splitlines()] if raw.exists() else []
    done = {(s.network, s.error, s.seed, s.width) for s in scores}
    # All surveys of one seed fly over the same ground, which is made once.
    cases = [Case("convergent", "none", seed, clean) for seed in range(given.seeds)]
    cases += [Case(n, e, 100 + s, size) for s in range(given.error_seeds) for n in RECIPES for e in ERRORS]
    todo = [c for c in cases if (c.network, c.error, c.seed, c.size[0]) not in done]
    with ProcessPoolExecutor(given.workers) as pool, raw.open("a") as out:
        for index, one in enumerate(pool.map(scored, todo)):
            scores.append(one)
            out.write(json.dumps(asdict(one)) + "\n")
            out.flush()
            print(f"\r{index + 1} of {len(todo)} ", end="", file=sys.stderr)
    (given.out / "rendered.md").write_text(report(scores))


if __name__ == "__main__":
    main()

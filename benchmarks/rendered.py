"""Rendered surveys against truth: the whole chain from JPEG to sigma.

    python -m benchmarks.rendered [--seeds 10] [--error-seeds 10] [--size 800x600]

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
from scipy.interpolate import RegularGridInterpolator

from benchmarks.campaign import wilson
from benchmarks.truth import mapping_error
from benchmarks.verdict_truth import true_dome_percent
from calib.align.child import Job, work
from calib.align.engine import Settings
from calib.check import conclude
from calib.findings import State
from calib.limits import DOME_LIMIT_PERCENT, FOCAL_LIMIT_PERCENT, FOCAL_SIGMA_PERCENT
from calib.photos import collect, read_photos
from calib.reference_match import match_reference
from calib.result import Timing
from calib.similarity import fit_similarity
from calib.solution import Solution
from sim.flights import phantom3
from sim.render import RenderOptions
from sim.survey import SurveyOptions, SurveyTruth, lens_corrected, read_truth, write_survey
from sim.truth import true_reference

HERE = Path(__file__).parent
NAN = float("nan")
ERRORS = (
    "rolling shutter 30 ms at 5 m/s",
    "aspect 0.5 %",
    "in-camera correction, 1.5 px pattern",
    "correlated noise 1 px",
)
RECIPES = {"nadir": "demo_nadir", "cross-hatch": "demo_crosshatch", "convergent": "demo"}


@dataclass(frozen=True)
class Score:
    """``profile_px``: rms error of the total mapping over the image after the best rotation.

    ``verdict``: of the check with the true lens as reference ("": not asked, an older run). Domes in %
    of the flying height: the reconstructed points' against the true ground, and the predicted one.
    """

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
    verdict: str = ""
    flagged: tuple[str, ...] = ()
    true_dome_percent: float = NAN
    predicted_dome_percent: float = NAN
    sigma_dome_percent: float = NAN

    def calibration_bad(self, margin: float = 0.0) -> bool:
        """f or dome off by more than 0.1 % and ``margin`` stated sigmas."""
        return (
            abs(self.df_percent) > FOCAL_LIMIT_PERCENT + margin * self.sigma_percent
            or abs(self.true_dome_percent) > DOME_LIMIT_PERCENT + margin * self.sigma_dome_percent
        )

    @property
    def observable(self) -> bool:
        """Whether f came out as well known as the 0.1 % rule demands."""
        return self.sigma_percent <= FOCAL_SIGMA_PERCENT

    @property
    def dome_predicted(self) -> bool:
        """Whether the predicted dome is the true one to 25 % or two sigmas."""
        off = abs(self.true_dome_percent - self.predicted_dome_percent)
        return off <= max(0.25 * abs(self.true_dome_percent), 2 * self.sigma_dome_percent)


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
        reference, note = match_reference(true_reference(truth, "truth"), photos[0].camera, named=True)
        lens, covariance = (None, None) if reference is None else (reference.lens, reference.lens_covariance)
        job = Job(tuple(photos), lens, Settings(workers=1), reference_covariance=covariance)
        found = work(job, lambda *_: None)
        cpu = time.process_time() - started
    result = conclude(found, (), reference, note, Timing(0.0, 0.0, 0.0))
    dome = found.dome
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
        verdict=result.verdict.value,
        flagged=tuple(f.rule for f in result.findings if f.state is State.FLAG),
        true_dome_percent=_true_dome_percent(found.solution, truth, dome.flying_height_m),
        predicted_dome_percent=NAN if dome.amplitude_percent is None else dome.amplitude_percent,
        sigma_dome_percent=100 * dome.sigma_m / dome.flying_height_m,
    )


def _true_dome_percent(solution: Solution, truth: SurveyTruth, flying_height_m: float) -> float:
    """Of the solved points against the true ground, laid onto it by the cameras."""
    assert truth.heights is not None
    true_centre = dict(zip(truth.photos, truth.centres_m, strict=True))
    centres = np.array([true_centre[photo.path.name] for photo in solution.photos])
    points = fit_similarity(solution.centres_m, centres).apply(solution.points_m)
    grid = truth.heights
    ground = RegularGridInterpolator(
        (grid.north_m, grid.east_m), grid.z_m, bounds_error=False, fill_value=np.nan
    )(points[:, 1::-1])
    on = np.isfinite(ground)
    return true_dome_percent(points[on], np.column_stack([points[on, :2], ground[on]]), flying_height_m)


def verdicts(scores: Sequence[Score]) -> list[str]:
    """Markdown: what the check says of the surveys with the true lens as reference."""
    asked = [s for s in scores if s.verdict]
    lines = [
        "| network | surveys | TRUST, REFLY, CANNOT_TELL | false TRUST | false REFLY "
        "| CANNOT_TELL where f is known | dome within 25 % or 2 sigma |",
        "|---|---|---|---|---|---|---|",
    ]
    for network in (*RECIPES, "all"):
        group = [s for s in asked if network in (s.network, "all")]
        known = [s for s in group if s.observable]
        counts = ", ".join(str(sum(s.verdict == v for s in group)) for v in ("TRUST", "REFLY", "CANNOT_TELL"))
        false_trust = sum(s.verdict == "TRUST" and s.calibration_bad(1.0) for s in group)
        false_refly = sum(s.verdict == "REFLY" and not s.calibration_bad() for s in known)
        lines.append(
            f"| {network} | {len(group)} | {counts} | {false_trust} | {false_refly} "
            f"| {sum(s.verdict == 'CANNOT_TELL' for s in known)} of {len(known)} "
            f"| {sum(s.dome_predicted for s in group)} |"
        )
    return lines


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
        "## Verdicts",
        "",
        "With the true lens as reference; surveys scored before verdicts were recorded are not in it.",
        "TRUST is false where f or the dome is off by more than 0.1 % and the stated sigma, REFLY where both",
        "are within 0.1 % and f is known well enough to say so.",
        "",
        *verdicts(scores),
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
    parser.add_argument("--error-seeds", type=int, default=10, help="surveys a network and error")
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

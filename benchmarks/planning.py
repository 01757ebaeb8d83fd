"""How long prediction and fix of a plan take: 2, 20 and 500 ha on one core.

`OPENBLAS_NUM_THREADS=1 python -m benchmarks.planning` writes benchmarks/planning.md.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.fix_optimality import nadir_plan
from calib.camera import FloatArray
from calib.network_views import SIMULATED, VEGETATION, Matching
from mission.plan import Plan
from mission.predict import Fix, Prediction, fix, predict

HERE = Path(__file__).parent


class Hills:
    """Gentle hills of 12 m over some 400 m."""

    def height_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        """(n,), (n,) -> (n,)."""
        waves: FloatArray = 6 * np.sin(east_m / 65) * np.cos(north_m / 80)
        return waves


@dataclass(frozen=True)
class Timed:
    """One plan: CPU seconds of its prediction and of its fix, and what came out."""

    hectares: float
    plan: Plan
    predict_s: float
    fix_s: float
    before: Prediction
    fixed: Fix


def timed(hectares: float, height_m: float) -> Timed:
    """A square nadir survey, 80 % and 70 % overlap, over hills."""
    side = math.sqrt(hectares * 1e4)
    plan = nadir_plan((side, side), height_m)
    started = time.process_time()
    before = predict(plan, Hills())
    middle = time.process_time()
    fixed = fix(plan, Hills())
    return Timed(hectares, plan, middle - started, time.process_time() - middle, before, fixed)


def _falls(matching: Matching) -> str:
    pairs = zip(matching.angles_deg, matching.shares, strict=True)
    return ", ".join(f"{share:g} at {angle:g}" for angle, share in pairs)


def report(found: list[Timed]) -> str:
    """Markdown."""
    lines = [
        "# Planning: time, and what the plans need",
        "",
        *__doc__.splitlines(),
        "Phantom 3 camera, nadir grid of 80 % and 70 % overlap over hills of 12 m, CPU seconds of one core,",
        "everything from the plan on (`fix` predicts before and after by itself).",
        "",
        "| ha | height m | photos | predict s | fix s | sigma f now % | photos added | flying s "
        "| sigma f then % | dome then % H | expected |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
        *(
            f"| {t.hectares:g} | {t.before.height_agl_m:.0f} | {t.before.photos} | {t.predict_s:.2f} "
            f"| {t.fix_s:.2f} | {t.before.sigma_f_percent:.2f} | {len(t.fixed.added)} "
            f"| {t.fixed.seconds:.0f} "
            f"| {t.fixed.after.sigma_f_percent:.4f} | {t.fixed.after.dome_percent:.4f} "
            f"| {t.fixed.after.verdict.value} |"
            for t in found
        ),
        "",
        "## How sparse tie points between oblique and nadir views are",
        "",
        "Blocks aligned by fieldcal itself: of all views of a tie point that fall into an image, the share",
        "that was matched, by the angle to the nearest other view of the same point.",
        "",
        "| angle degrees | rendered demo (nadir and 40 degrees) | lewis_oblique (63 degrees, vegetation) |",
        "|---|---|---|",
        *(f"| {angle} | {demo} | {lewis} |" for angle, demo, lewis in MATCHED),
        "",
        f"Planned with (share of the full one, at degrees): {_falls(SIMULATED)}. "
        f"For vegetation: {_falls(VEGETATION)}.",
        "",
    ]
    return "\n".join(lines)


#: Measured once (demo: 20 photos of 1600 x 1200, 23,702 observations; lewis: 22 photos, 8,590).
MATCHED = (
    ("0-3", "0.73", "0.61"),
    ("3-6", "0.81", "0.43"),
    ("6-9", "0.81", "0.17"),
    ("9-12", "0.59", "0.14"),
    ("12-15", "0.66", "0.12"),
    ("15-18", "0.61", "0.03"),
    ("18-21", "0.53", "0.02"),
    ("21-25", "0.61", "0.02"),
    ("25-30", "0.40", "0.02"),
    ("30-35", "0.13", "0.01"),
    ("35-40", "0.05", "0.01"),
)


def main() -> None:
    """Measure and write the report."""
    found = []
    for hectares, height in ((2, 60), (12, 60), (20, 60), (500, 100)):
        found.append(timed(hectares, height))
        one = found[-1]
        print(f"{hectares} ha at {height} m, {one.before.photos} photos: ", end="")
        print(f"predict {one.predict_s:.2f} s, fix {one.fix_s:.2f} s; {one.fixed.reason}", flush=True)
    (HERE / "planning.md").write_text(report(found))


if __name__ == "__main__":
    main()

"""How long planning takes: whole commands over a terrain model, and prediction and fix by themselves.

`python -m benchmarks.planning` (part of `make bench`) writes benchmarks/planning.md.
"""

from __future__ import annotations

import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from pyproj import Transformer
from rasterio.transform import from_origin

from benchmarks.cost import Cost, measure
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


#: Whole commands: hectares, height m, patterns, options, most CPU seconds.
COMMANDS = (
    (20.0, 60.0, "nadir+orbit", (), 3.0),
    (500.0, 100.0, "nadir+orbit", (), 30.0),
    (20.0, 60.0, "nadir", ("--fix",), None),
)
#: Middle of the model of the ground, in degrees, and its projection.
PLACE, PROJECTION = (54.77, -1.58), 32630


@dataclass(frozen=True)
class Command:
    """One run of the command line as a user starts it, Python's start included."""

    hectares: float
    patterns: str
    photos: int
    cost: Cost
    target_s: float | None


def write_terrain(path: Path, across_m: float = 6000.0, step_m: float = 5.0) -> None:
    """The same hills as a GeoTIFF in UTM around ``PLACE``."""
    east, north = Transformer.from_crs(4326, PROJECTION, always_xy=True).transform(PLACE[1], PLACE[0])
    n = round(across_m / step_m)
    at = (np.arange(n) - n / 2) * step_m
    x, y = np.meshgrid(at, -at)
    with rasterio.open(
        path, "w", driver="GTiff", width=n, height=n, count=1, dtype="float32", crs=f"EPSG:{PROJECTION}",
        transform=from_origin(east - across_m / 2, north + across_m / 2, step_m, step_m),
    ) as file:  # fmt: skip
        file.write((100 + Hills().height_m(x, y)).astype(np.float32), 1)


def command(
    hectares: float, height_m: float, patterns: str, more: Sequence[str], target_s: float | None
) -> Command:
    """`fieldcal plan` of a round area over the terrain model, results written: the cheaper of two runs."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        write_terrain(work / "dem.tif")
        area = f"{PLACE[0]},{PLACE[1]},{math.sqrt(hectares * 1e4 / math.pi):.1f}"
        line = [
            sys.executable, "-m", "daemon.cli", "plan", patterns, "--area", area, "--height", f"{height_m:g}",
            "--camera", "dji-phantom-3-professional", "--dem", str(work / "dem.tif"), "--endurance", "300",
            "--most-items", "5000",
            "--out", str(work / "mission.plan"), "--json", str(work / "plan.json"), *more,
        ]  # fmt: skip
        runs = [measure(line, os.environ | {"OPENBLAS_NUM_THREADS": "1"}) for _ in range(2)]
        if any(run.code for run in runs):
            raise RuntimeError(f"fieldcal plan of {hectares:g} ha failed")
        photos = json.loads((work / "plan.json").read_text())["photos"]
    best = min(runs, key=lambda run: run.cpu_s)
    return Command(hectares, " ".join([patterns, *more]), photos, best, target_s)


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


def report(commands: list[Command], found: list[Timed]) -> str:
    """Markdown."""
    lines = [
        "# Planning: time, and what the plans need",
        "",
        *__doc__.splitlines(),
        "",
        "## Whole commands",
        "",
        "`fieldcal plan` over a terrain model (GeoTIFF, 5 m), mission and JSON written, one core, start of",
        f"Python included, the cheaper of two runs. Load of the machine before: {os.getloadavg()[0]:.1f} on "
        f"{os.cpu_count()} cores; on a busy machine wall and CPU seconds are both longer.",
        "",
        "| ha | patterns | photos | CPU s | wall s | target CPU s |",
        "|---|---|---|---|---|---|",
        *(
            f"| {c.hectares:g} | {c.patterns} | {c.photos} | {c.cost.cpu_s:.1f} | {c.cost.wall_s:.1f} "
            f"| {'' if c.target_s is None else f'{c.target_s:g}'} |"
            for c in commands
        ),
        "",
        "## Prediction and fix by themselves",
        "",
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
    commands = []
    for one in COMMANDS:
        commands.append(command(*one))
        print(f"{one[0]:g} ha, {commands[-1].patterns}: {commands[-1].cost.cpu_s:.1f} CPU s", flush=True)
    found = []
    for hectares, height in ((2, 60), (12, 60), (20, 60), (500, 100)):
        found.append(timed(hectares, height))
        last = found[-1]
        print(f"{hectares} ha at {height} m, {last.before.photos} photos: ", end="")
        print(f"predict {last.predict_s:.2f} s, fix {last.fix_s:.2f} s; {last.fixed.reason}", flush=True)
    (HERE / "planning.md").write_text(report(commands, found))


if __name__ == "__main__":
    main()

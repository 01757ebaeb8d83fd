"""How near predicted sigmas are to the scatter of simulated surveys: six kinds of plans, twenty each.

`python -m benchmarks.prediction` appends to benchmarks/prediction.jsonl, goes on where it was
stopped, and writes benchmarks/prediction.md. Every survey is flown on the planned stations as wind
and gimbal leave them, over relief, with the planned density of tie points and their planned loss
between unlike views, a lens with a smooth pattern that Brown's model does not contain, and solved
from what the vehicle measured. Observation level: tie points with noise, no images.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely import MultiPoint

from calib.align.dome import aligned_difference_m, dome_amplitude_m
from calib.brownfit import fit_brown
from calib.camera import FloatArray
from calib.network_views import nearest_view_deg
from calib.propagation import radial_px
from calib.solution import Observations
from mission.compose import compose
from mission.plan import Plan, stations
from mission.planned_network import Assumptions, footprint_m2, poses
from mission.prediction import Prediction, predict
from mission.site_build import build_site
from mission.site_file import SiteFile
from sim.flights import Flight, jittered
from sim.network import SimBlock, SimOptions, observe
from sim.solve import calibrate_block

HERE = Path(__file__).parent
KINDS = {
    "nadir": ("nadir",),
    "two heights": ("nadir", "height2"),
    "cross-hatch": ("crosshatch",),
    "fan": ("nadir", "fan"),
    "two heights and fan": ("nadir", "height2", "fan"),
    "orbit": ("nadir", "orbit"),
}
#: Sparse, for the sake of time: what is tested is the ratio.
ASSUMED = replace(Assumptions(), tie_points_per_photo=120.0, model_error_factor=1.0)
OPTIONS = SimOptions(pattern_px=1.0, match_share=1.0)
QUANTITIES = ("f_percent", "k1", "k2", "k3", "dome_percent")


def plan_of(kind: str) -> Plan:
    """A small plan of a kind over level ground, 60 m high."""
    keys = SiteFile(
        area="54.77,-1.58,40", camera="dji-phantom-3-professional", height_m=60.0,
        forward_overlap=0.75, side_overlap=0.6,
    )  # fmt: skip
    return compose(KINDS[kind], build_site(keys))


def flown(plan: Plan, seed: int) -> SimBlock:
    """One survey of the plan, thinned as the prediction thins."""
    photos = stations(plan)
    rotations, centres = poses(photos)
    yaw = np.radians([s.yaw_deg for s in photos])
    track = np.stack([np.sin(yaw), np.cos(yaw), np.zeros_like(yaw)], axis=-1)
    height = float(np.median(centres[:, 2]))
    hull = MultiPoint(centres[:, :2]).convex_hull.buffer(1.3 * height)
    half = max(abs(bound) for bound in hull.bounds)
    count = round((2 * half) ** 2 * ASSUMED.tie_points_per_photo / footprint_m2(plan.camera, height))
    options = replace(OPTIONS, n_points=count, site_m=2 * half, margin_m=0.0)
    flight = jittered(
        Flight(rotations, centres, track),
        seed,
        options.position_jitter_m,
        options.height_jitter_m,
        options.attitude_jitter_deg,
    )
    block = observe(plan.name, flight, plan.camera, seed, options)
    obs = block.observations
    angle = nearest_view_deg(obs.photo, obs.point, block.centres_m, block.points_m)
    kept = np.random.default_rng([seed, 11]).random(len(angle)) < ASSUMED.matching.share(angle)
    kept &= shapely.contains_xy(hull, block.points_m[:, 0], block.points_m[:, 1])[obs.point]
    kept &= (np.bincount(obs.point[kept], minlength=len(block.points_m)) >= 2)[obs.point]
    used, point = np.unique(obs.point[kept], return_inverse=True)
    thinned = Observations(obs.photo[kept], point, obs.pixels[kept], obs.sigma_px[kept])
    return replace(
        block, points_m=block.points_m[used], observations=thinned, mismatched=block.mismatched[kept]
    )


def errors(plan: Plan, seed: int, height_agl_m: float) -> dict[str, float]:
    """Errors of one survey against truth, as the prediction states them."""
    block = flown(plan, seed)
    solved = calibrate_block(block, 1.01 * plan.camera.f_px, seed)
    state = solved.adjusted.state
    found = fit_brown(state.lens)[0]
    k = (radial_px(found) - radial_px(block.lens.brown))[:3]
    truth_m = block.points_m[solved.point_index]
    dome = float(dome_amplitude_m(truth_m, aligned_difference_m(state.points_m, truth_m)[:, 2]))
    off = 100 * (found.f_px / block.lens.brown.f_px - 1)
    return dict(zip(QUANTITIES, (off, *map(float, k), 100 * dome / height_agl_m), strict=True))


def predicted(prediction: Prediction) -> FloatArray:
    """The same five as sigmas."""
    return np.array([prediction.sigma_f_percent, *prediction.sigma_k_px, prediction.dome_percent])


@dataclass(frozen=True)
class Kind:
    """A kind of plan: predicted sigmas (5,) and the surveys' errors (n, 5)."""

    name: str
    photos: int
    sigma: FloatArray
    errors: FloatArray

    @property
    def scatter(self) -> FloatArray:
        """Root mean square errors (5,)."""
        rms: FloatArray = np.sqrt((self.errors**2).mean(axis=0))
        return rms


def report(kinds: list[Kind]) -> str:
    """Markdown."""
    seeds = min(len(kind.errors) for kind in kinds)
    ratios = np.array([kind.sigma / kind.scatter for kind in kinds])
    lines = [
        "# Predicted sigmas against the scatter of simulated surveys",
        "",
        *(__doc__ or "").split("\n\n", 1)[1].strip().splitlines(),
        "",
        f"{ASSUMED.tie_points_per_photo:g} tie points per photo, {ASSUMED.noise_px:g} px noise, pattern of "
        f"{OPTIONS.pattern_px:g} px, receivers of {OPTIONS.gps_sigma_m:g} m; predicted without the factor",
        f"for model error. Scatter: root mean square error against truth of {seeds} surveys, itself known to "
        f"{100 / math.sqrt(2 * seeds):.0f} %.",
        "",
        "| plan | photos | sigma f %: predicted / scatter | ratio | dome % H: predicted / scatter | ratio "
        "| K1, K2, K3: ratios |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind, ratio in zip(kinds, ratios, strict=True):
        sigma, scatter = kind.sigma, kind.scatter
        lines.append(
            f"| {kind.name} | {kind.photos} | {sigma[0]:.3g} / {scatter[0]:.3g} | {ratio[0]:.2f} "
            f"| {sigma[4]:.3g} / {scatter[4]:.3g} | {ratio[4]:.2f} "
            f"| {', '.join(f'{r:.2f}' for r in ratio[1:4])} |"
        )
    inside = (ratios > 1 / 1.5) & (ratios < 1.5)
    lines += [
        "",
        f"Within a factor of 1.5: {int(inside[:, 0].sum())} of {len(kinds)} plans for sigma f, "
        f"{int(inside[:, 4].sum())} for the dome, {int(inside[:, 1:4].sum())} of {3 * len(kinds)} for K1-K3.",
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    """Fly what is missing and write the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--out", type=Path, default=HERE / "prediction.jsonl")
    given = parser.parse_args()
    plans = {name: plan_of(name) for name in KINDS}
    forecasts = {name: predict(plan, assumptions=ASSUMED) for name, plan in plans.items()}
    rows: list[dict[str, Any]] = []
    if given.out.exists():
        rows = [json.loads(line) for line in given.out.read_text().splitlines()]
    done = {(row["kind"], row["seed"]) for row in rows}
    # Seed by seed, so that a part of the campaign already says something about every kind.
    for seed in range(given.seeds):
        for name, plan in plans.items():
            if (name, seed) in done:
                continue
            started = time.process_time()
            row: dict[str, Any] = {"kind": name, "seed": seed}
            row |= errors(plan, seed, forecasts[name].height_agl_m)
            with given.out.open("a") as file:
                file.write(json.dumps(row) + "\n")
            rows.append(row)
            print(
                f"{name} {seed}: f {row['f_percent']:+.3f} %, {time.process_time() - started:.1f} s",
                flush=True,
            )
    kinds = [
        Kind(
            name,
            forecasts[name].photos,
            predicted(forecasts[name]),
            np.array([[row[q] for q in QUANTITIES] for row in rows if row["kind"] == name]),
        )
        for name in KINDS
    ]
    text = report(kinds)
    print(text)
    given.out.with_suffix(".md").write_text(text)


if __name__ == "__main__":
    main()

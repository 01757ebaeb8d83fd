"""Calibrations on a simulated wall over many seeds: is a bent wall caught, a flat one accepted, is f right?

python -m benchmarks.onsite --seeds 50
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from calib.findings import State
from calib.onsite import Kind, concluded
from calib.photos import Sorted
from calib.result import Timing
from sim.flights import phantom3
from sim.wall_block import WallOptions, wall_outcome

CASES = {
    "flat, level pairs": WallOptions(),
    "bent by 0.15 %, level pairs": WallOptions(bend_percent=0.15),
    "flat, every third photo upright": WallOptions(upright=3),
}


def one(seed: int, options: WallOptions) -> dict[str, float | bool | str]:
    """What a calibration says and how far it is from the truth."""
    outcome = wall_outcome(seed, options)
    photos = outcome.solution.photos
    made = concluded(outcome, Kind.WALL, Sorted(photos, (), ()), Timing(0.0, 0.0, 0.0))
    brown, truth = made.estimate.brown, phantom3()
    flatness = made.flatness
    assert flatness is not None
    bends = [f for f in made.findings if f.rule in ("wall-bend-along", "wall-twist", "wall-bend-up")]
    return {
        "seed": seed,
        "acceptance": made.acceptance.value,
        "flat": all(f.state is State.PASS for f in bends),
        "bent": any(f.state is State.FLAG for f in bends),
        "f_percent": 100 * (brown.f_px / truth.f_px - 1),
        "f_sigma_percent": 100 * made.estimate.sigma_f_px / truth.f_px,
        "bend_percent": float(flatness.terms_percent[0]),
        "bend_sigma_percent": float(flatness.sigmas_percent[0]),
        "chance": flatness.chance,
        "cx_sigmas": (brown.cx_px - truth.cx_px) / float(np.sqrt(made.estimate.covariance[1, 1])),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--out", default=None)
    given = parser.parse_args()
    for name, options in CASES.items():
        rows = [one(seed, options) for seed in range(given.seeds)]
        f = np.array([row["f_percent"] for row in rows], float)
        sigma = np.array([row["f_sigma_percent"] for row in rows], float)
        bend = np.array([row["bend_percent"] for row in rows], float)
        bend_sigma = np.array([row["bend_sigma_percent"] for row in rows], float)
        expected = -options.bend_percent
        share = {key: float(np.mean([bool(row[key]) for row in rows])) for key in ("flat", "bent")}
        taken = float(np.mean([row["acceptance"] == "ACCEPTED" for row in rows]))
        print(
            f"{name}: flat {share['flat']:.0%}, bent {share['bent']:.0%}, accepted {taken:.0%}; f off by "
            f"{np.sqrt(np.mean(f**2)):.3f} % rms (within 0.02 %: {np.mean(np.abs(f) < 0.02):.0%}), sigma "
            f"{np.median(sigma):.3f} %, {np.mean(np.abs(f / sigma) < 3):.0%} within 3 sigma, rms "
            f"{np.sqrt(np.mean((f / sigma) ** 2)):.2f} sigma; bend {np.mean(bend):+.4f} +- "
            f"{np.std(bend):.4f} %, rms {np.sqrt(np.mean(((bend - expected) / bend_sigma) ** 2)):.2f} sigma",
            flush=True,
        )
        if given.out:
            with Path(given.out).open("a", encoding="utf-8") as file:
                file.writelines(json.dumps({"case": name, **row}) + "\n" for row in rows)


if __name__ == "__main__":
    main()

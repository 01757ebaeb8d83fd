"""The slope of what is left against elevation: how often its sigma holds, over clouds whose truth is known.

`python -m benchmarks.elevation` writes benchmarks/elevation.md. Clouds are made from flat, gentle and steep
ground, a known stretch of heights and an error that neighbours share (a dome, bumps of several lengths), and
held against surveyed points by the code of `fieldcal assess`.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from calib.assess.model import similarity_of
from calib.assess.study import assess_cloud
from calib.assess.truth import Truth
from calib.camera import FloatArray
from calib.clouds import CloudFile, Kind, LoadedCloud
from sim.relief import Relief

HERE = Path(__file__).parent
#: Half the site; heights of the ground about its mean at most, and how much it inclines (m/m).
HALF_M = 60.0
GROUNDS = {"flat": (0.3, 0.0), "gentle": (2.0, 0.01), "steep": (10.0, 0.1)}
#: Errors of the cloud: a dome's height and the deviation of bumps, m, and the bumps' length, m.
ERRORS = {
    "noise alone": (0.0, 0.0, 1.0),
    "dome": (0.15, 0.0, 1.0),
    "bumps of 8 m": (0.0, 0.04, 8.0),
    "bumps of 20 m": (0.0, 0.04, 20.0),
    "bumps of 50 m": (0.0, 0.04, 50.0),
    "dome and bumps of 20 m": (0.15, 0.04, 20.0),
}
STRETCHES = (0.0, 0.03)
#: A sigma is too small where it leaves out the truth by more than two of itself.
TOO_SMALL = 2.0
REFERENCES = (60, 600)
REFERENCE_SIGMA_M, CLOUD_SIGMA_M, CLOUD_POINTS = 0.02, 0.03, 25_000
_WAVES = 60


@dataclass(frozen=True)
class Case:
    """One cloud: which ground and error (names), true stretch of heights, reference points."""

    ground: str
    error: str
    stretch: float
    references: int
    seed: int


def bumps_m(xy_m: FloatArray, sigma_m: float, length_m: float, rng: np.random.Generator) -> FloatArray:
    """A random smooth field (n,) whose correlation falls with distance as exp(-d2 / 2 length2)."""
    number = rng.normal(size=(_WAVES, 2)) / length_m
    phase = rng.uniform(0, 2 * np.pi, _WAVES)
    field: FloatArray = np.cos(xy_m @ number.T + phase).sum(axis=1)
    return field * float(sigma_m * np.sqrt(2 / _WAVES))


def cloud_of(case: Case) -> tuple[LoadedCloud, Truth]:
    """The cloud and its reference points."""
    rng = np.random.default_rng([case.seed, case.references])
    amplitude_m, incline = GROUNDS[case.ground]
    relief = Relief.random(case.seed, amplitude_m)
    azimuth = rng.uniform(0, 2 * np.pi)

    def ground_m(xy: FloatArray) -> FloatArray:
        way = xy @ np.array([np.cos(azimuth), np.sin(azimuth)])
        height: FloatArray = relief.height_m(xy[:, 0], xy[:, 1]) + incline * way
        return height

    dome_m, bump_m, length_m = ERRORS[case.error]
    xy = rng.uniform(-HALF_M - 10, HALF_M + 10, (CLOUD_POINTS, 2))
    values = np.concatenate([rng.normal(0, 1, 3), rng.normal(0, 0.5, 3), [100 + rng.normal()]])
    cloud = similarity_of(values).apply(np.column_stack([xy, (1 + case.stretch) * ground_m(xy)]))
    cloud[:, 2] += CLOUD_SIGMA_M * rng.normal(size=len(xy)) + bumps_m(xy, bump_m, length_m, rng)
    cloud[:, 2] += dome_m * (1 - np.sum(xy**2, axis=1) / HALF_M**2)
    at = rng.uniform(-HALF_M, HALF_M, (case.references, 2))
    reference = np.column_stack([at, ground_m(at)])
    reference += REFERENCE_SIGMA_M * rng.normal(size=reference.shape)
    loaded = LoadedCloud(
        CloudFile(Path("made.las"), Kind.LAS), np.zeros(3), cloud.astype(np.float32), len(xy), 0, 1
    )
    return loaded, Truth(tuple(f"P{i}" for i in range(len(at))), reference)


def answer(case: Case) -> dict[str, Any] | None:
    """What `assess` says of the slope, None where it says nothing."""
    trend = assess_cloud(*cloud_of(case)).trend
    return None if trend is None else {"slope": trend.slope, "sigma": trend.sigma, "told": trend.told}


def told(pairs: Sequence[tuple[Case, dict[str, Any] | None]]) -> tuple[FloatArray, FloatArray]:
    """Errors of the slopes that were told (n,), in their own sigmas, and these sigmas (n,)."""
    said = [(case, found) for case, found in pairs if found is not None and found["told"]]
    sigmas = np.array([found["sigma"] for _, found in said])
    return np.array([found["slope"] - case.stretch for case, found in said]) / sigmas, sigmas


def table(cases: Sequence[Case], answers: Sequence[dict[str, Any] | None]) -> list[str]:
    """Rows by ground, error and number of points."""
    lines = [
        "| ground | error of the cloud | points | told | sigma % | error / sigma, rms | beyond two sigma |",
        "|---|---|---|---|---|---|---|",
    ]
    for ground, error, references in product(GROUNDS, ERRORS, REFERENCES):
        mine = [
            (case, found)
            for case, found in zip(cases, answers, strict=True)
            if (case.ground, case.error, case.references) == (ground, error, references)
        ]
        z, sigmas = told(mine)
        head = f"| {ground} | {error} | {references} | {len(z)} of {len(mine)} |"
        if not len(z):
            lines.append(f"{head} - | - | - |")
            continue
        sigma = 100 * float(np.median(sigmas))
        beyond = int(np.sum(np.abs(z) > TOO_SMALL))
        lines.append(f"{head} {sigma:.2f} | {np.sqrt(np.mean(z**2)):.2f} | {beyond} |")
    return lines


def overall(cases: Sequence[Case], answers: Sequence[dict[str, Any] | None]) -> str:
    """All told slopes in one sentence."""
    z, _ = told(list(zip(cases, answers, strict=True)))
    return (
        f"{len(z)} of {len(cases)} slopes were told; error over sigma: rms {np.sqrt(np.mean(z**2)):.2f}, "
        f"worst {np.abs(z).max():.1f}; {100 * np.mean(np.abs(z) > TOO_SMALL):.1f} % beyond two sigma "
        "(4.6 % are to be expected)."
    )


_ABOUT = """{seeds} clouds of every kind, heights stretched by 0 % in one half and 3 % in the other; reference
points known to {reference:.0f} cm in each axis, {points} points of the cloud with {cloud:.0f} cm of noise, a
random shift, turn and scale. Flat: heights within 0.3 m of their mean; gentle: 2 m and 1 % of incline; steep:
10 m and 10 %. A dome is 15 cm high, bumps have a deviation of 4 cm. Not told: the command says that
the ground is too flat. Sigma: median of those told."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=16)
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    cases = [
        Case(ground, error, STRETCHES[seed % len(STRETCHES)], references, seed)
        for ground, error, references, seed in product(GROUNDS, ERRORS, REFERENCES, range(given.seeds))
    ]
    with ProcessPoolExecutor(given.workers) as pool:
        answers = list(pool.map(answer, cases, chunksize=8))
    about = _ABOUT.format(
        seeds=given.seeds, reference=100 * REFERENCE_SIGMA_M, cloud=100 * CLOUD_SIGMA_M, points=CLOUD_POINTS
    )
    head = ["# Slope against elevation: does its sigma hold?", "", (__doc__ or "").split("\n\n")[1], about]
    lines = [*head, "", overall(cases, answers), "", *table(cases, answers)]
    (HERE / "elevation.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

"""The eight flights of [C&D] Table 2, flown, self-calibrated and assessed in simulation.

Site A is the papers' 120 m square with rolling ground, site B a strip of half that width, nearly
flat ("significantly narrower"; [C&D] fig. 3 gives no lengths). The camera is the Phantom 3 of the
wall. Not simulated: the grass of site A, and their point-to-point registration without known pairs.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from calib.align.adjust import Adjusted, Adjustment, State
from calib.align.dome import dome_amplitude_m
from calib.align.selfcal import mask
from calib.align.uncertainty import estimate
from calib.assess import Assessment, assess, elevation_trend, profile
from calib.brownfit import fit_brown
from calib.camera import FloatArray
from calib.equifinal import Radial
from calib.equifinal_published import LINE_5, clip_to_line
from calib.errors import FieldcalError
from calib.field import LENS_NAMES, Lens
from calib.perturb import held_at
from sim.flights import Flight, convergent, flight_plan, grid, jittered, phantom3
from sim.network import SimBlock, SimOptions, observe
from sim.relief import Relief
from sim.solve import calibrate_block, priors_of, start_of

FLIGHTS = ("A1", "A2", "A3", "A4", "B1", "B2", "B3", "B4")
#: What the file says of f is off by this share, as EXIF often is.
NOMINAL = 1.02
SITE_M, STRIP = 120.0, 0.5
#: Heights of the ground, m; ground points; RTK points of the reference and their sigma, m.
RELIEF_M = {"A": 6.0, "B": 0.3}
POINTS = {"A": 800, "B": 700}
RTK_POINTS, RTK_SIGMA_M = 2500, 0.03
#: Lens errors that K1-K3 do not hold, largest in px: none, and as of a consumer's camera.
PATTERNS_PX = (0.0, 1.5)
#: The paper's software: f, principal point, K1-K3, decentring; nothing else, no priors on the lens.
PLAIN = mask(("f", "cx", "cy", "k1", "k2", "k3", "p1", "p2"))
BINS = 24


@dataclass(frozen=True)
class Case:
    """One flight of one seed. ``ours``: with fieldcal's own calibration as well, which takes longer."""

    flight: str
    pattern_px: float
    seed: int
    ours: bool


def plan_of(name: str) -> Flight:
    """The undisturbed flight; site B's are site A's on a strip of half the width.

    Raises:
        KeyError: no flight of that name.
    """
    if name[0] == "A":
        return flight_plan(name, SITE_M)
    low, high = SITE_M / 2, SITE_M / 1.5
    parts = {
        "1": (_strip(grid(2, 8, low, SITE_M)),),
        "2": (_strip(grid(2, 8, low, SITE_M)), _strip(grid(2, 6, high, SITE_M))),
    }
    parts["3"] = (*parts["1"], convergent(8, 40.0, low))
    parts["4"] = (*parts["2"], convergent(8, 40.0, low))
    first, *rest = parts[name[1]]
    for one in rest:
        first = first + one
    return first


def _strip(flight: Flight) -> Flight:
    return replace(flight, centres_m=flight.centres_m * [STRIP, 1.0, 1.0])


def flown(case: Case) -> SimBlock:
    """The flight with its disturbances; lens, ground and noise go with the seed."""
    site = case.flight[0]
    options = SimOptions(n_points=POINTS[site], relief_m=RELIEF_M[site], pattern_px=case.pattern_px)
    flight = jittered(
        plan_of(case.flight),
        case.seed,
        options.position_jitter_m,
        options.height_jitter_m,
        options.attitude_jitter_deg,
    )
    return observe(case.flight, flight, phantom3(), case.seed, options)


@dataclass(frozen=True)
class Block:
    """A flight being adjusted as the paper's software does: geotags of 5 m, free lens, no priors on it."""

    truth: SimBlock
    adjustment: Adjustment
    case: Case

    @classmethod
    def of(cls, case: Case) -> Block:
        truth = flown(case)
        priors = priors_of(truth, NOMINAL * truth.lens.brown.f_px)
        k = len(truth.gps_m)
        priors = replace(
            priors,
            rotation_sigma_rad=np.full(k, np.inf),
            lens_sigma=np.full(len(LENS_NAMES), np.inf),
        )
        return cls(truth, Adjustment(truth.observations, k, len(truth.points_m), priors), case)

    def plain(self) -> Adjusted:
        start = start_of(self.truth, NOMINAL * self.truth.lens.brown.f_px, self.case.seed)
        return self.adjustment.run(start, PLAIN, 200, decrement=0.1)

    def held(self, state: State, lens: Lens, free: tuple[str, ...]) -> Adjusted:
        return self.adjustment.run(replace(state, lens=lens), mask(free), 100, decrement=0.1)


def _on_site(block: Block) -> np.ndarray:
    half = np.array([STRIP if block.case.flight[0] == "B" else 1.0, 1.0]) * SITE_M / 2
    inside: np.ndarray = np.all(np.abs(block.truth.points_m[:, :2]) <= half, axis=1)
    return inside


def assessed(block: Block, points_m: FloatArray, kept: np.ndarray | None = None) -> tuple[Assessment, Any]:
    """M7 from the site's periphery and eta over the site; and the same points' true positions.

    ``kept``: index of every one of ``points_m`` (m, 3) among the true points (all by default).
    """
    case, truth = block.case, block.truth.points_m
    index = np.arange(len(truth)) if kept is None else kept
    rng = np.random.default_rng([case.seed, 77])
    half = np.array([STRIP if case.flight[0] == "B" else 1.0, 1.0]) * SITE_M / 2
    relief = Relief.random(case.seed, RELIEF_M[case.flight[0]])
    xy = rng.uniform(-1.05, 1.05, (RTK_POINTS, 2)) * half
    surface = np.column_stack([xy, relief.height_m(xy[:, 0], xy[:, 1])])
    surface[:, 2] += RTK_SIGMA_M * rng.normal(size=RTK_POINTS)
    inside = _on_site(block)[index]
    rim = inside & (np.abs(truth[index, :2]) / half > 0.8).any(axis=1)
    surveyed = truth[index][rim] + RTK_SIGMA_M * rng.normal(size=(int(rim.sum()), 3))
    found = assess(points_m[inside], surface, (surveyed, points_m[rim]))
    return found, truth[index][inside]


def _quality(block: Block, points_m: FloatArray, kept: np.ndarray | None = None) -> dict[str, Any]:
    """Numbers of one model: M7, eta_p, dome, what is left without it, vertical scale, profile."""
    found, true = assessed(block, points_m, kept)
    flat = found.seven.similarity
    back = (found.points_m - flat.shift) @ flat.rotation / flat.scale
    error = found.eta_m / flat.scale
    dome = float(dome_amplitude_m(back, error))
    x, y = (back[:, :2] / (SITE_M / 2)).T
    bowl = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    rest = error - bowl @ np.linalg.lstsq(bowl, error, rcond=None)[0]
    trend = elevation_trend(back[:, 2], rest)
    half = SITE_M / 2
    _, mean, _ = profile(back, error, np.array([0.0, -half]), np.array([0.0, half]), 20.0, BINS)
    return {
        "seven": found.seven.values.tolist(),
        "seven_sigma": found.seven.sigmas.tolist(),
        "registration": [found.seven.residual_mean_m, found.seven.residual_std_m],
        "eta_p": found.eta_p_m,
        "dome": dome,
        "noise": float(rest.std()),
        "robust_noise": float(1.4826 * np.median(np.abs(rest - np.median(rest)))),
        "trend": [trend.slope, trend.sigma, trend.correlation],
        "profile": [None if np.isnan(v) else float(v) for v in mean],
        "datum": float(np.median(points_m[:, 2] - block.truth.points_m[:, 2])) if kept is None else None,
        "on_site": len(true),
    }


def _lens(lens: Lens, sigma_f_px: float, sigma0: float) -> dict[str, Any]:
    brown = fit_brown(lens)[0]
    return {
        "f": brown.f_px,
        "k": [brown.k1_px, brown.k2_px, brown.k3_px],
        "sigma_f": sigma_f_px,
        "sigma0": sigma0,
    }


def fly(case: Case) -> dict[str, Any]:
    """Everything about one flight: plain Brown, its K moved onto (5), the wall's calibration, ours."""
    started = time.process_time()
    block = Block.of(case)
    plain = block.plain()
    lens = plain.state.lens
    result: dict[str, Any] = {
        "plain": _lens(lens, float(np.sqrt(plain.covariance[0, 0])), plain.sigma0)
        | _quality(block, plain.state.points_m)
    }
    on_line = clip_to_line(Radial.of(lens.brown), LINE_5)
    moved = held_at(lens, on_line.k1_px, on_line.k2_px, 0.0)
    wall = Lens(phantom3())
    for name, held, free in (
        ("line", moved, ("f", "cx", "cy")),
        ("line, f held", moved, ()),
        ("wall", wall, ()),
    ):
        adjusted = block.held(plain.state, held, free)
        result[name] = {"f": adjusted.state.lens.brown.f_px, "sigma0": adjusted.sigma0}
        result[name] |= _quality(block, adjusted.state.points_m)
    if case.ours:
        result["ours"] = _ours(block)
    return result | {"case": asdict(case), "cpu_s": time.process_time() - started}


def _ours(block: Block) -> dict[str, Any] | None:
    """fieldcal's own calibration; None where it refuses the block."""
    try:
        own = calibrate_block(block.truth, NOMINAL * block.truth.lens.brown.f_px, block.case.seed)
        found = estimate(own)
    except FieldcalError:
        return None
    quality = _quality(block, own.adjusted.state.points_m, own.point_index)
    return _lens(found.lens, found.sigma_f_px, own.adjusted.sigma0) | quality

"""A flight of the refly campaign in the simulator: the survey, and passes flown as well as they are flown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.refly_cases import LoopCase, generator, lines_of, number_of
from benchmarks.verdict_cases import Case
from benchmarks.verdict_world import READOUT_S, SPEED_M_S, true_camera
from calib.camera import FloatArray
from calib.frames import LocalFrame
from calib.network_views import SIMULATED, Matching
from mission.plan import Station
from sim.flights import Flight, convergent, grid, jittered, rotation_looking
from sim.network import SimBlock, SimOptions
from sim.relief import Relief
from sim.solution import FRAME
from sim.together import observe_together

#: Errors in flying a pass, standard deviations per axis, and the share of its photos that fail.
POSITION_M, GIMBAL_DEG, MISSING = 2.0, 2.0, 0.05
#: Views of a point that look alike are matched this often.
MATCHED = 0.7
#: Tie points simulated in a photo; each stands for several real ones and is measured as well as their mean.
SIMULATED_POINTS = 125
#: Ground beyond the site that photos see, in flying heights.
_MARGIN = 0.8


@dataclass(frozen=True)
class World:
    """What is simulated: ``survey`` as flown, ``launch_m`` (3,) where every flight starts."""

    case: LoopCase
    verdict_case: Case
    survey: Flight
    options: SimOptions
    matching: Matching
    launch_m: FloatArray

    def seen(self, later: tuple[int, Flight] | None = None) -> SimBlock:
        """The survey, alone or together with pass number ``later`` (1, 2, ...)."""
        flights = [(0, self.survey)] if later is None else [(0, self.survey), later]
        camera = true_camera(self.verdict_case)
        return observe_together(
            self.case.pattern, flights, camera, self.case.number, self.options, self.matching
        )

    @property
    def launch_lat_lon(self) -> tuple[float, float]:
        """As a site file has it."""
        latitude, longitude, _ = FRAME.geodetic(self.launch_m[None])[0].tolist()
        return latitude, longitude


def world_of(case: LoopCase) -> World:
    """The world of a flight."""
    like = Case(
        number=case.number, part="refly", pattern=case.pattern, lens=case.lens, relief=case.level("relief"),
        gps=case.level("gps"), noise=case.level("noise"), mismatches=case.level("mismatches"),
        error=case.level("error"),
        reference="true",
    )  # fmt: skip
    camera = true_camera(like)
    footprint = camera.width / camera.f_px, camera.height / camera.f_px
    lines = lines_of(case, footprint)
    rng = generator(case, 1)
    heading = float(rng.uniform(0, 180))
    off_nadir = number_of(case.pattern) if case.pattern.startswith("gently") else 0.0
    side, height = case.side_m, lines.height_m
    plan = grid(lines.lines, lines.per_line, height, side, heading_deg=heading, off_nadir_deg=off_nadir)
    if case.pattern == "nadir, two heights":
        plan = plan + grid(
            max(lines.lines - 1, 2), max(lines.per_line - 2, 3), height / 0.75, side, heading_deg=heading
        )
    elif case.pattern == "cross-hatch nadir":
        plan = plan + grid(lines.lines, lines.per_line, height, side, heading_deg=heading + 90.0)
    elif case.pattern == "nadir and one oblique":
        plan = plan + convergent(1, 35.0, height, first_azimuth_deg=float(rng.uniform(0, 360)))
    shutter = case.level("error") == "rolling shutter"
    whole = side + 2 * _MARGIN * height
    stands_for = float(case.level("tie points")) / SIMULATED_POINTS
    options = SimOptions(
        n_points=round(SIMULATED_POINTS / MATCHED * whole**2 / (footprint[0] * footprint[1] * height**2)),
        noise_px=number_of(case.level("noise")) / math.sqrt(stands_for),
        match_share=MATCHED,
        mismatch_rate=number_of(case.level("mismatches")) / 100,
        gps_sigma_m=0.03 if case.level("gps") == "RTK" else 2.5,
        relief_m=number_of(case.level("relief")),
        pattern_px=1.5 if case.level("error").startswith("pattern") else 0.0,
        readout_s=READOUT_S if shutter else 0.0,
        speed_m_s=SPEED_M_S if shutter else 0.0,
        correlated_px=0.3 if case.level("error").startswith("correlated") else 0.0,
        site_m=side,
        margin_m=_MARGIN * height,
    )  # fmt: skip
    survey = jittered(plan, case.number, 1.0, 0.5, 1.5)
    scale = number_of(case.level("matching")) if case.level("matching").startswith("angles") else 1.0
    matching = Matching(tuple(scale * a for a in SIMULATED.angles_deg), SIMULATED.shares)
    # Somewhere along the edge of the site.
    along, edge = float(rng.uniform(-0.5, 0.5)) * side, int(rng.integers(4))
    place = np.array([[along, -side / 2], [side / 2, along], [along, side / 2], [-side / 2, along]][edge])
    up = Relief.random(case.number, options.relief_m).height_m(place[:1], place[1:])
    return World(case, like, survey, options, matching, np.concatenate([place, up]))


def flown(world: World, stations: Sequence[Station], frame: LocalFrame, number: int) -> Flight:
    """Stations around the launch point as wind, gimbal and camera leave them; some photos are missing.

    ``number`` of the pass: 1, 2, ...
    """
    rng = generator(world.case, 30 + number)
    kept = rng.random(len(stations)) >= MISSING
    if not kept.any():
        kept[0] = True
    some = [station for station, stays in zip(stations, kept, strict=True) if stays]
    at = np.array([(s.east_m, s.north_m, 0.0) for s in some])
    latitude, longitude, _ = frame.geodetic(at).T
    centres = FRAME.enu(latitude, longitude, np.zeros(len(some)))
    centres[:, 2] = world.launch_m[2] + np.array([s.height_m for s in some])
    yaw, pitch = (np.array([getattr(s, name) for s in some]) for name in ("yaw_deg", "pitch_deg"))
    # Photos are taken standing: no way during the readout.
    plan = Flight(rotation_looking(yaw, 90.0 + pitch), centres, np.zeros((len(some), 3)))
    return jittered(plan, world.case.number + 1_000_000 * number, POSITION_M, POSITION_M, GIMBAL_DEG)

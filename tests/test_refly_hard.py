"""The extra pass where it is hard: steep ground, a handful of photos, faults that flying does not cure."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.refly_optimality import check_of
from calib.check import conclude
from calib.findings import Verdict
from calib.flown_file import FlownCheck, flown_check
from calib.network_views import SIMULATED
from calib.result import Timing
from mission.limits import hard_violations
from mission.plan import Station
from mission.refly import Refly, refly
from mission.refly_site import flown_site
from mission.site_file import SiteFile, checked
from sim.flights import Flight, grid, jittered, phantom3, rotation_looking
from sim.network import SimBlock, SimOptions, survey
from sim.relief import Relief
from sim.solution import identity_of, outcome_of
from sim.together import observe_together
from sim.truth import lens_reference

HEIGHT_M, NOISE_PX = 60.0, 0.5


class Site:
    """A nadir flight over ground of some relief, what its check keeps, and passes flown over it."""

    def __init__(self, seed: int, photos: int, relief_m: float) -> None:
        self.seed, side = seed, 110.0 if photos > 6 else 80.0
        self.options = SimOptions(
            n_points=1600 if photos > 6 else 900, relief_m=relief_m, site_m=side, margin_m=48.0
        )
        whole = grid(4, 7, HEIGHT_M, side) if photos > 6 else grid(2, 3, HEIGHT_M, side)
        first = Flight(
            whole.rotations_cam_from_world[:photos], whole.centres_m[:photos], whole.track[:photos]
        )
        self.survey = jittered(first, seed, 1.0, 0.5, 1.5)
        self.site = flown_site(self.check((0, self.survey)), SiteFile())

    def check(self, *flights: tuple[int, Flight]) -> FlownCheck:
        """At the true values."""
        block = observe_together("nadir", flights, phantom3(), self.seed, self.options, SIMULATED)
        return check_of(block, NOISE_PX, HEIGHT_M)

    def flown(self, stations: tuple[Station, ...]) -> FlownCheck:
        """The pass flown with 2 m and 2 degrees of error, and checked with the survey."""
        yaw, pitch = (np.array([getattr(s, name) for s in stations]) for name in ("yaw_deg", "pitch_deg"))
        places = self.in_the_world(stations)
        plan = Flight(rotation_looking(yaw, 90 + pitch), places, np.zeros((len(stations), 3)))
        return self.check((0, self.survey), (1, jittered(plan, self.seed + 5, 2.0, 2.0, 2.0)))

    def in_the_world(self, stations: tuple[Station, ...]) -> np.ndarray:
        """Stations around the launch point -> metres of the simulator (n, 3)."""
        places = np.array([(s.east_m, s.north_m, s.height_m) for s in stations])
        shift: np.ndarray = self.survey.centres_m[0] - self.site.centres_m[0]
        return places + shift


# --- The ground and the survey ---------------------------------------------------------------------


def test_over_steep_ground_the_pass_keeps_clear_of_it_and_cures() -> None:
    """Hills of 37 m under a survey at 60 m, and a drone that has to keep 45 m from them."""
    case = Site(3, 28, 25.0)
    relief = Relief.random(case.seed, case.options.relief_m)
    across = np.ptp(relief.height_m(*case.survey.centres_m[:, :2].T))
    assert across > 0.3 * HEIGHT_M
    found = refly(flown_site(case.site.check, checked({"clearance_m": 45}, "the test")))
    assert found.cures
    assert hard_violations(found.findings) == ()
    assert found.found is not None
    assert found.plan is not None
    at = case.in_the_world(found.found.stations)
    above = at[:, 2] - relief.height_m(at[:, 0], at[:, 1])
    # The ground is known from the tie points only.
    assert above.min() > 43.0
    assert case.flown(found.found.stations).sigma_f_percent < 0.03


def test_five_photos_are_cured_or_it_is_said_what_they_lack() -> None:
    case = Site(1, 5, 2.0)
    assert case.site.check.sigma_f_percent > 1.0
    found = refly(case.site)
    assert found.found is not None
    assert found.cures == (found.binding_limit is None)
    assert found.duration_s < 0.75 * found.flown.site.vehicle.endurance_s
    after = case.flown(found.found.stations).sigma_f_percent
    # Ground that only the pass sees is not counted before it is flown: it brings more than it promises.
    assert 0.8 < found.found.worth.sigma_f_percent / after < 3.5
    assert not found.cures or after < 0.03


# --- Faults that are not geometry ------------------------------------------------------------------


def _answer(block: SimBlock, **wrong: Any) -> tuple[Verdict, Refly]:
    """The check of a survey against the reference that is ``wrong``, and what refly says to it."""
    brown = replace(block.lens.brown, **wrong)
    held = lens_reference("mine", brown, identity_of(block))
    outcome, _ = outcome_of(block, 2320.0 * 1.02, 1, held, identity_of(block))
    result = conclude(outcome, (), held, "", Timing(0.0, 0.0, 0.0))
    kept = flown_check(result)
    assert kept is not None
    return result.verdict, refly(flown_site(kept, SiteFile()))


@pytest.fixture(scope="module")
def block() -> SimBlock:
    """Nadir and convergent photos: nothing is wrong with their geometry."""
    return survey("demo", 1, SimOptions(n_points=600, noise_px=0.15))


def _no_pass(answer: Refly) -> str:
    assert (answer.found, answer.plan, answer.helps, answer.cures) == (None, None, False, False)
    return answer.reason


def test_another_cameras_reference_is_not_cured_by_flying(block: SimBlock) -> None:
    verdict, answer = _answer(block, f_px=1.02 * block.lens.brown.f_px)
    assert verdict is Verdict.REFLY
    assert "is the reference another camera's?" in _no_pass(answer)


def test_a_zoom_that_changed_half_way_is_not_cured_by_flying(block: SimBlock) -> None:
    """One per cent from the eleventh photo on."""
    seen = block.observations
    middle = np.array([block.lens.brown.cx_px, block.lens.brown.cy_px])
    pixels = seen.pixels.copy()
    later = seen.photo >= 10
    pixels[later] = middle + 1.01 * (pixels[later] - middle)
    verdict, answer = _answer(replace(block, observations=replace(seen, pixels=pixels)))
    assert verdict is not Verdict.TRUST
    assert "Has the zoom or the focus moved" in _no_pass(answer)

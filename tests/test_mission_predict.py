"""Prediction of planned missions, and the photos that cure them."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from align_blocks import solved
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import box

from benchmarks.fix_optimality import nadir_plan, outcome
from calib.brownfit import fit_brown
from calib.camera import FloatArray
from calib.errors import InputError
from calib.findings import Verdict
from calib.frames import gimbal_from_rotation
from calib.network_views import EVERY_VIEW
from mission.optimise import Criterion
from mission.plan import Plan, Shot, Station, Vehicle, Waypoint, stations
from mission.planned_network import MANY_PHOTOS, Assumptions, even_points, planned_network
from mission.predict import Fix, LevelGround, fix, predict
from mission.prediction import predict_stations
from mission.route import Detours, Gap, legs_s, plan_gaps, with_stops
from sim.flights import Flight, flight_plan, phantom3

#: A small site, quickly predicted.
SITE = (100.0, 100.0)


def stations_of(flight: Flight) -> list[Station]:
    found = []
    for rotation, centre in zip(flight.rotations_cam_from_world, flight.centres_m, strict=True):
        gimbal = gimbal_from_rotation(rotation)
        found.append(Station(*map(float, centre), gimbal.yaw_deg, gimbal.pitch_deg))
    return found


def simulated(n_points: int) -> Assumptions:
    """What holds in ``sim.network`` with that many points and its defaults."""
    camera = phantom3()
    per_m2 = n_points / 200**2 * 0.7
    return Assumptions(
        tie_points_per_photo=per_m2 * camera.width * camera.height * (60 / camera.f_px) ** 2,
        matching=EVERY_VIEW,
        model_error_factor=1.0,
    )


# -- prediction -----------------------------------------------------------------------------------


def test_prediction_is_the_scatter_of_simulated_surveys() -> None:
    """Ten seeds with 0.5 px noise, solved from what the vehicle measured."""
    predicted = predict_stations(
        stations_of(flight_plan("demo")), phantom3(), LevelGround(), None, simulated(200)
    )
    errors = []
    for seed in range(10):
        _, calibrated = solved("demo", seed, 200)
        errors.append(100 * (fit_brown(calibrated.adjusted.state.lens)[0].f_px / phantom3().f_px - 1))
    scatter = float(np.sqrt(np.mean(np.square(errors))))
    assert 1 / 1.5 < predicted.sigma_f_percent / scatter < 1.5


@pytest.mark.parametrize(
    ("flight", "points", "scatter_percent"), [("A1", 1000, 0.58), ("A3", 1500, 0.024), ("A4", 1000, 0.021)]
)
def test_prediction_is_the_campaigns(flight: str, points: int, scatter_percent: float) -> None:
    """Sigmas of benchmarks/honest_sigma.md, first table, Brown's lens."""
    found = predict_stations(
        stations_of(flight_plan(flight)), phantom3(), LevelGround(), None, simulated(points)
    )
    assert 1 / 1.5 < found.sigma_f_percent / scatter_percent < 1.5


def test_nadir_plan_is_told_to_fly_again() -> None:
    found = predict(nadir_plan(SITE, 60.0))
    assert found.verdict is Verdict.REFLY
    assert found.sigma_f_percent > 0.5
    assert found.convergent_share == 0
    assert "straight down" in found.reason
    assert found.photos == len(stations(nadir_plan(SITE, 60.0)))
    assert found.gsd_mean_m == pytest.approx(60 / phantom3().f_px, rel=0.03)
    assert found.gsd_worst_m >= found.gsd_mean_m


def test_worst_place_is_found() -> None:
    plan = nadir_plan(SITE, 60.0)
    # Beyond the lines nothing is seen.
    found = predict(plan, area=box(-50, -50, 250, 50))
    assert found.least_views == 0
    assert found.least_views_at_m[0] > 100
    assert predict(plan, area=box(-50, -50, 50, 50)).least_views >= 4


def test_higher_ground_is_nearer() -> None:
    plan = nadir_plan(SITE, 60.0)
    raised = predict(plan, LevelGround(20.0))
    assert raised.height_agl_m == pytest.approx(40)
    assert raised.gsd_mean_m == pytest.approx(40 / phantom3().f_px, rel=0.03)


class HoleyTerrain:
    """A model that ends 60 m from the launch point."""

    def height_m(self, east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        if np.hypot(east_m, north_m).max() > 75:
            raise InputError("no cover")
        return np.full(np.shape(east_m), 5.0)


def test_terrain_that_ends_beyond_the_site_is_continued() -> None:
    assert predict(nadir_plan(SITE, 60.0), HoleyTerrain()).height_agl_m == pytest.approx(55)


def test_photos_that_share_nothing_are_refused() -> None:
    apart = Waypoint(0, 0, 60, shot=Shot.STOP), Waypoint(900, 0, 60, shot=Shot.STOP)
    plan = replace(nadir_plan(SITE, 60.0), waypoints=apart)
    with pytest.raises(InputError, match="overlap"):
        predict(plan)
    with pytest.raises(InputError, match="fewer than two"):
        predict(replace(plan, waypoints=apart[:1]))


def test_large_blocks_keep_their_information(monkeypatch: pytest.MonkeyPatch) -> None:
    photos = stations(nadir_plan((240.0, 240.0), 60.0))
    exact = predict_stations(photos, phantom3(), LevelGround(), None, Assumptions())
    assert len(photos) < MANY_PHOTOS
    monkeypatch.setattr("mission.planned_network.MANY_PHOTOS", len(photos) * 2 // 3)
    thinned = predict_stations(photos, phantom3(), LevelGround(), None, Assumptions())
    kept = planned_network(photos, phantom3(), LevelGround(), Assumptions())
    assert len(kept.network.centres_m) < len(photos)
    assert thinned.sigma_f_percent == pytest.approx(exact.sigma_f_percent, rel=0.25)
    assert thinned.dome_sigma_m == pytest.approx(exact.dome_sigma_m, rel=0.25)


@settings(max_examples=30)
@given(st.floats(1, 2000), st.floats(1, 2000))
def test_even_points_are_even(width: float, height: float) -> None:
    points = even_points(box(0, 0, width, height), width * height / 400)
    assert 380 <= len(points) <= 401
    quarter = (points[:, 0] < width / 2) & (points[:, 1] < height / 2)
    assert 85 <= quarter.sum() <= 115


# -- route ----------------------------------------------------------------------------------------


def test_leg_times() -> None:
    vehicle = Vehicle(speed_m_s=8, climb_m_s=3, descent_m_s=2, acceleration_m_s2=2)
    start = np.zeros(3)

    def seconds(*end: float) -> float:
        return float(legs_s(vehicle, start, np.array(end)))

    assert seconds(80, 0, 0) == pytest.approx(80 / 8 + 8 / 2)
    assert seconds(8, 0, 0) == pytest.approx(4)  # speeds up half the way
    assert seconds(0, 0, 30) == pytest.approx(30 / 3 + 3 / 2)
    assert seconds(0, 0, -30) == pytest.approx(30 / 2 + 2 / 2)
    assert seconds(0, 0, 0) == 0
    with pytest.raises(ValueError, match="positive"):
        legs_s(replace(vehicle, speed_m_s=0), start, start)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_detours_are_short(seed: int) -> None:
    """Against every order of up to five stations in one gap."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-80, 80, (int(rng.integers(1, 6)), 3)) * [1, 1, 0] + [0, 0, 60]
    vehicle, gap = Vehicle(), Gap(np.array([-90.0, 0, 60]), np.array([90.0, 0, 60]), 0)
    detours = Detours(vehicle, [gap], places)
    n = len(places)

    def through(order: tuple[int, ...]) -> float:
        path = np.array([gap.start_m, *places[list(order)], gap.end_m])
        return float(legs_s(vehicle, path[:-1], path[1:]).sum())

    direct = float(legs_s(vehicle, gap.start_m, gap.end_m))
    best = min(through(o) for o in permutations(range(n))) - direct + n * vehicle.settle_s
    found = detours.seconds(range(n))
    assert best - 1e-6 <= found <= 1.2 * best
    assert through(detours.order(range(n))[0]) - direct + n * vehicle.settle_s == pytest.approx(found)
    assert detours.insertion_s(())[0] == pytest.approx(detours.seconds([0]))


def test_lines_are_never_interrupted() -> None:
    plan = nadir_plan(SITE, 60.0)
    gaps = plan_gaps(plan)
    stop = Waypoint(0, 0, 70, 10, -55, Shot.STOP, pattern="fix")
    longer = with_stops(plan, gaps, [[stop] for _ in gaps])
    before, after = stations(plan), stations(longer)
    assert [s for s in after if s.pattern != "fix"] == list(before)
    assert len(after) == len(before) + len(gaps)


# -- fix ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fixed() -> Fix:
    return fix(nadir_plan(SITE, 60.0))


def test_fix_holds_with_any_photo_missing(fixed: Fix) -> None:
    assert fixed.binding_limit is None
    assert 2 <= len(fixed.added) <= 12
    assert fixed.after.verdict is Verdict.TRUST
    photos = stations(fixed.plan)
    assert set(fixed.added) <= set(photos)
    assert len(photos) == fixed.before.photos + len(fixed.added)
    for one in fixed.added:
        rest = predict_stations(
            [p for p in photos if p != one], phantom3(), LevelGround(), None, Assumptions()
        )
        assert rest.sigma_f_percent <= 1.1 * 0.03
        assert rest.dome_percent <= 1.1 * 0.05
    assert f"{len(fixed.added)} photos" in fixed.reason
    assert "degrees off nadir" in fixed.reason


def test_fix_is_the_same_every_time(fixed: Fix) -> None:
    assert fix(nadir_plan(SITE, 60.0)).added == fixed.added


def test_nothing_is_added_to_what_is_good(fixed: Fix) -> None:
    again = fix(fixed.plan)
    assert again.added == ()
    assert again.seconds == 0
    assert again.binding_limit is None
    assert again.plan == fixed.plan


def _only_down(plan: Plan) -> Plan:
    return replace(plan, vehicle=replace(plan.vehicle, gimbal_highest_deg=-90.0))


def test_what_stands_against_a_fix_is_said() -> None:
    plan = nadir_plan(SITE, 60.0)
    for given_plan, feasible in ((_only_down(plan), None), (plan, lambda _: False)):
        found = fix(given_plan, feasible=feasible)
        assert found.added == ()
        assert found.plan == given_plan
        assert found.binding_limit is not None
        assert "gimbal" in found.binding_limit
    corner = fix(plan, feasible=lambda s: s.yaw_deg == 45.0 and s.pitch_deg == -70.0 and s.height_m == 60.0)
    assert corner.binding_limit is not None
    assert "allowed photos" in corner.binding_limit


def test_allowed_stations_are_kept_to() -> None:
    def north(station: Station) -> bool:
        return station.north_m >= 0 and station.height_m <= 65

    found = fix(nadir_plan(SITE, 60.0), feasible=north)
    assert found.binding_limit is None
    assert all(north(s) for s in found.added)


def test_large_areas_get_photos_at_several_places(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mission.optimise.MOST_ADDED", 12)
    monkeypatch.setattr("mission.fixing.MOST_ADDED", 12)
    plan = nadir_plan((600.0, 120.0), 60.0)
    assumed = replace(Assumptions(), points_per_photo=20)
    found = fix(plan, assumptions=assumed, criterion=Criterion(dome_percent=0.004))
    assert 8 <= len(found.added) <= 12
    east = sorted(s.east_m for s in found.added)
    assert east[-1] - east[0] > 4 * 60
    assert found.after.dome_percent < found.before.dome_percent / 3
    # It says what binds, by how much, and what it would take.
    assert found.binding_limit is not None
    for words in ("bending to", "0.0040 % is asked", "photos and", "the battery has", "size of the area"):
        assert words in found.binding_limit, found.binding_limit
    assert "focal length to" not in found.binding_limit


def test_as_many_photos_as_asked_for() -> None:
    found = fix(nadir_plan(SITE, 60.0), criterion=Criterion(least_photos=12))
    assert len(found.added) >= 12


@pytest.mark.parametrize("seed", range(100, 106))
def test_search_is_nearly_the_best_there_is(seed: int) -> None:
    """Every subset of eight stations; more cases in benchmarks/fix_optimality.md."""
    case = outcome(seed, 8)
    assert case.chosen.good == (case.least_photos is not None)
    if case.least_photos is not None and case.least_seconds is not None:
        assert len(case.chosen.photos) <= case.least_photos + 1
        assert case.chosen.seconds <= 1.1 * case.least_seconds

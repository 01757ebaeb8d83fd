"""The extra pass: the network that a check keeps, the search, limits that bind, and when nothing is sold."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from align_blocks import solved
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.refly_optimality import check_of, flown, outcome
from calib.align.readout import way_information
from calib.camera import BROWN_NAMES, FloatArray
from calib.errors import FieldcalError, FormatError, InputError
from calib.field import LENS_NAMES
from calib.findings import Finding, State, Verdict
from calib.flown import flown_network
from calib.flown_file import NETWORK_FILE, FlownCheck, network_bytes, read_network
from calib.network_design import lens_information
from calib.network_views import SIMULATED
from daemon import cli
from mission.limits import hard_violations
from mission.plan import Vehicle, stations
from mission.refly import Refly, refly
from mission.refly_passes import paper_fan, tilts_for
from mission.refly_search import PassSearch, cured_sigma_f_percent
from mission.refly_sheet import render_refly_sheet
from mission.refly_site import FlownSite, flown_site
from mission.refly_words import short_of, why_no_pass
from mission.site_file import SiteFile, checked
from sim.flights import Flight, grid, jittered, phantom3, rotation_looking
from sim.network import SimOptions, observe
from sim.together import observe_together


@pytest.fixture(scope="module")
def case() -> FlownSite:
    return flown(2, 60.0, 110.0, (4, 7), 5000)


@pytest.fixture(scope="module")
def found(case: FlownSite) -> Refly:
    return refly(case)


def _with(case: FlownSite, **keys: Any) -> FlownSite:
    return flown_site(case.check, checked(keys, "the test"))


def _saying(check: FlownCheck, rule: str, verdict: Verdict = Verdict.REFLY) -> FlownCheck:
    finding = Finding(rule, State.FLAG, None, None, "", None, "", f"It is the {rule}.")
    return replace(check, verdict=verdict, findings=(finding,), headline="The headline.")


# --- What is asked for ---------------------------------------------------------------------------


def test_a_reference_takes_its_part_of_what_f_may_be_off() -> None:
    alone = cured_sigma_f_percent(0.0)
    # 1.96 sigma for the check's own doubt and 2.8 for chance within 0.1 %.
    assert alone * (1.96 + 2.8) == pytest.approx(0.1, rel=1e-3)
    for reference in (0.005, 0.01, 0.015):
        assert np.hypot(cured_sigma_f_percent(reference), reference) == pytest.approx(alone)
    # A poor reference is no reason for endless passes.
    assert cured_sigma_f_percent(0.05) == pytest.approx(0.6 * alone)


def test_the_reference_tells_of_a_pattern_that_a_weak_flight_does_not_show(case: FlownSite) -> None:
    check = case.check

    def beyond(own_px: float, reference_px: float | None) -> float:
        network = check.flown.network
        lens = replace(network.lens, field_px=np.full(24, own_px))
        flown = replace(check.flown, network=replace(network, lens=lens))
        known = None if reference_px is None else np.full(24, reference_px)
        planned = flown_site(replace(check, flown=flown, reference_field_px=known), SiteFile()).planned
        assert planned.beyond is not None
        return float(np.sqrt(np.diag(planned.beyond)[-24:].sum()))

    assert beyond(0.0, None) == beyond(0.0, 0.0) == 0.0
    assert beyond(0.0, 0.02) == pytest.approx(beyond(0.02, None), rel=0.05)
    assert beyond(0.02, 0.01) == beyond(0.02, None) > 1.02 * beyond(0.01, None)


# --- The file --------------------------------------------------------------------------------------


def test_a_network_comes_back_as_it_was_written(case: FlownSite, tmp_path: Path) -> None:
    check = _saying(case.check, "focal-sigma")
    data = network_bytes(check)
    assert 2_000 < len(data) < 200_000
    assert network_bytes(check) == data
    (tmp_path / NETWORK_FILE).write_bytes(data)
    again = read_network(tmp_path / NETWORK_FILE)
    assert again.findings == check.findings
    assert (again.verdict, again.photos, again.origin_wgs84) == (
        check.verdict,
        check.photos,
        check.origin_wgs84,
    )
    one, two = check.flown.network, again.flown.network
    assert np.array_equal(one.rotations, two.rotations)
    assert np.array_equal(one.point, two.point)
    assert np.abs(one.points_m - two.points_m).max() <= 0.0005
    assert again.sigma_f_percent == pytest.approx(check.sigma_f_percent)


@settings(max_examples=40, deadline=None)
@given(at=st.floats(0, 1, exclude_max=True), value=st.integers(0, 255), cut=st.booleans())
def test_a_damaged_network_is_refused_or_whole(
    tmp_path_factory: pytest.TempPathFactory, at: float, value: int, cut: bool
) -> None:
    data = bytearray(_DATA)
    place = int(at * len(data))
    if cut:
        del data[place:]
    else:
        data[place] = value
    path = tmp_path_factory.mktemp("damaged") / NETWORK_FILE
    path.write_bytes(bytes(data))
    try:
        again = read_network(path)
    except FormatError:
        return  # Refused in one sentence.
    assert len(again.photos) == len(again.flown.network.centres_m)


def _small_network() -> bytes:
    plan = jittered(grid(2, 3, 60.0, 80.0), 1, 1.0, 0.5, 1.5)
    block = observe("nadir", plan, phantom3(), 1, SimOptions(n_points=200, site_m=80.0))
    return network_bytes(check_of(block, 0.5, 60.0))


_DATA = _small_network()


def test_ways_during_the_readout_are_kept(tmp_path: Path) -> None:
    path = tmp_path / NETWORK_FILE
    path.write_bytes(_DATA)
    check = read_network(path)
    assert check.flown.known.way_information is None
    ways = way_information(check.flown.network.centres_m, 60.0)

    def through(check: FlownCheck) -> FlownCheck:
        path.write_bytes(network_bytes(check))
        return read_network(path)

    def moving(ways: FloatArray) -> FlownCheck:
        return replace(
            check, flown=replace(check.flown, known=replace(check.flown.known, way_information=ways))
        )

    kept = through(moving(ways)).flown.known.way_information
    assert kept is not None
    assert np.array_equal(kept, ways)
    with pytest.raises(FormatError, match="check the photos again"):
        through(moving(-ways))
    # Before there were directions one sigma stood for all.
    path.write_bytes(_DATA)
    with np.load(path) as archive:
        arrays = dict(archive)
    about = json.loads(bytes(arrays["about"])) | {"shutter_sigma_m": 0.24}
    arrays["about"] = np.frombuffer(json.dumps(about).encode(), np.uint8)
    np.savez_compressed(path, allow_pickle=False, **arrays)
    old = read_network(path).flown.known.way_information
    assert old is not None
    assert np.allclose(old, np.eye(3) / 0.24**2)


def test_what_is_kept_knows_as_much_as_all_of_it() -> None:
    plan = jittered(grid(4, 6, 60.0, 110.0), 5, 1.0, 0.5, 1.5)
    block = observe("nadir", plan, phantom3(), 5, SimOptions(n_points=3000, site_m=110.0))
    check = check_of(block, 0.5, 60.0)
    kept = check.flown
    obs = block.observations
    full = replace(
        kept.network,
        points_m=block.points_m,
        photo=obs.photo,
        point=obs.point,
        sigma_px=np.full(len(obs), kept.noise_px),
    )
    assert len(kept.network.points_m) < 0.4 * len(block.points_m)
    assert np.bincount(kept.network.photo).min() >= 8
    ratio = lens_information(kept.network, kept.known).covariance[0, 0]
    ratio /= lens_information(full, kept.known).covariance[0, 0]
    assert 0.85 < np.sqrt(ratio) < 1.15


def test_a_point_that_hangs_in_the_air_is_not_kept() -> None:
    """All rays of one point but two from one place are down-weighted: nothing tells its height any more."""
    _, calibrated = solved("demo", 1, 200)
    adjusted, obs = calibrated.adjusted, calibrated.observations
    seen = np.bincount(obs.point)
    one = int(np.argmax(seen))
    rays = np.flatnonzero(obs.point == one)
    centres = adjusted.state.centres_m.copy()
    centres[obs.photo[rays[1]]] = centres[obs.photo[rays[0]]] + [0.1, 0.0, 0.0]
    weights = adjusted.weights.copy()
    weights[rays[2:]] = 0.01
    state = replace(adjusted.state, centres_m=centres)
    hanging = replace(calibrated, adjusted=replace(adjusted, state=state, weights=weights))
    place = adjusted.state.points_m[one]
    for block, there in ((calibrated, True), (hanging, False)):
        kept = flown_network(block, 1.0).network
        assert (np.linalg.norm(kept.points_m - place, axis=1).min() < 1e-9) == there
        assert np.bincount(kept.point).min() >= 2


# --- The pass --------------------------------------------------------------------------------------


def test_the_pass_cures_inside_every_limit(found: Refly) -> None:
    assert found.cures
    assert found.binding_limit is None
    assert found.found is not None
    assert found.plan is not None
    assert hard_violations(found.findings) == ()
    assert stations(found.plan) == found.found.stations
    assert 5 <= len(found.found.stations) <= 14
    assert found.found.worth.sigma_f_percent <= 0.0221
    assert found.found.worth.dome_percent <= 0.04
    assert all(22.4 <= 90 + s.pitch_deg <= 42.6 for s in found.found.stations)
    # What the search counts is what the plan takes.
    assert found.duration_s == pytest.approx(found.found.seconds, rel=0.1)


def test_the_pass_is_never_worse_than_an_orbit_or_the_papers_eight_photos(
    case: FlownSite, found: Refly
) -> None:
    search = PassSearch(case.planned, case.site, 30.0)
    search.fill()
    orbit = search.regular("orbit", whole=True)
    fan = paper_fan(search.middle_m, search.ground_m, case.planned.height_agl_m).stations
    paper = search.found(tuple(i for i in search.candidates.add(fan) if i is not None))
    assert found.found is not None
    assert orbit is not None
    for other in (orbit, paper):
        if other.good:
            assert found.found.seconds <= other.seconds + 0.5
    assert orbit.good or paper.good


def test_what_is_predicted_is_what_the_flown_photos_then_know() -> None:
    """[C&D]'s eight photos over a nadir survey, flown with 2 m and 2 degrees of error."""
    options = SimOptions(n_points=2500, site_m=140.0, margin_m=48.0)
    survey = jittered(grid(4, 7, 60.0, 140.0, heading_deg=30.0), 1, 1.0, 0.5, 1.5)
    before = observe_together("nadir", [(0, survey)], phantom3(), 1, options, SIMULATED)
    site = flown_site(check_of(before, 0.5, 60.0), SiteFile())
    exact = replace(site.planned.assumptions, model_error_factor=1.0)
    search = PassSearch(replace(site.planned, assumptions=exact), site.site, 30.0)
    # The oblique photos see the whole of this site, and tie it together: few points stand for all.
    assert 40 <= len(search.candidates.joint.points_m) <= 120
    fan = paper_fan(search.middle_m, search.ground_m, 60.0).stations
    photos = tuple(i for i in search.candidates.add(fan) if i is not None)
    assert len(photos) == 8
    predicted = search.found(photos).worth
    yaw, pitch = (np.array([getattr(s, name) for s in fan]) for name in ("yaw_deg", "pitch_deg"))
    places = np.array([(s.east_m, s.north_m, s.height_m) for s in fan])
    places += survey.centres_m[0] - site.centres_m[0]
    plan = Flight(rotation_looking(yaw, 90 + pitch), places, np.zeros((8, 3)))
    flights = [(0, survey), (1, jittered(plan, 6, 2.0, 2.0, 2.0))]
    after = check_of(observe_together("both", flights, phantom3(), 1, options, SIMULATED), 0.5, 60.0)
    assert 0.02 < after.sigma_f_percent < 0.04
    assert 0.85 < predicted.sigma_f_percent / after.sigma_f_percent < 1.2
    assert 0.8 < predicted.dome_percent / after.dome_percent < 2.5


def test_thinned_points_tell_as_much_as_all_of_them(case: FlownSite, monkeypatch: pytest.MonkeyPatch) -> None:
    """A point that stands for several is known as well as their mean."""
    fan = paper_fan(np.zeros(2), 0.0, 60.0).stations[:4]
    sigmas = []
    for in_view in (12, 24, 1000):
        monkeypatch.setattr("mission.candidates.CHECK_IN_VIEW", in_view)
        search = PassSearch(case.planned, case.site, 30.0)
        photos = tuple(i for i in search.candidates.add(fan) if i is not None)
        sigmas.append(search.found(photos).worth.sigma_f_percent)
    assert len(photos) == 4
    assert sigmas[2] < 0.5 * case.check.sigma_f_percent
    assert 0.95 < sigmas[1] / sigmas[2] < 1.1
    assert 0.95 < sigmas[0] / sigmas[2] < 1.2


@pytest.mark.parametrize(
    ("share", "sigma_share", "hides"), [(1.2e-3, 1e-4, True), (1e-5, 1e-3, True), (1e-4, 1e-5, False)]
)
def test_a_shutter_that_hides_in_the_affinity_is_designed_for(
    case: FlownSite, share: float, sigma_share: float, hides: bool
) -> None:
    check, f = case.check, case.check.brown.f_px
    covariance = check.brown_covariance.copy()
    at = BROWN_NAMES.index("b1")
    covariance[at:, :] = covariance[:, at:] = 0.0
    covariance[at, at] = covariance[at + 1, at + 1] = (sigma_share * f) ** 2
    brown = replace(check.brown, b1_px=-share * f, b2_px=0.0)
    told = replace(check, brown=brown, brown_covariance=covariance, camera_name="DJI FC300X")
    # A mechanical shutter hides nothing.
    assert (
        flown_site(replace(told, camera_name="DJI FC6310"), SiteFile()).planned.known.way_information is None
    )
    believed = flown_site(told, SiteFile(mechanical_shutter=True))
    assert believed.planned.known.way_information is None
    assert not any("rolling" in note for note in believed.notes)
    site = flown_site(replace(told, camera_name="DJI FC6310"), SiteFile(mechanical_shutter=False))
    ways = site.planned.known.way_information
    assert (ways is not None) == hides
    assert (site.planned.new_way_information is not None) == hides
    if ways is not None:
        sigmas = np.linalg.eigvalsh(np.linalg.inv(ways)) ** 0.5
        assert 0.1 < np.median(sigmas[:, 2]) / np.sqrt(len(ways)) < 0.5
        assert np.median(sigmas[:, 1]) < 0.05
    assert any("rolling shutter" in note for note in site.notes) == hides


def test_what_no_lens_model_follows_stays_in_the_dome(case: FlownSite) -> None:
    planned = replace(case.planned, beyond=None)
    head = PassSearch(planned, case.site, 30.0).candidates.joint.head
    q = len(planned.f_gradient)
    gain = np.linalg.solve(head[:q, :q], head[q, :q])
    beyond = 0.1 * np.diag(np.diag(head[:q, :q]))
    more = replace(planned, beyond=beyond)
    own = 100 * float(np.sqrt(gain @ beyond @ gain)) / planned.height_agl_m
    assert more.dome_beyond_percent(head) == pytest.approx(own, rel=1e-4)
    assert planned.dome_beyond_percent(head) == 0.0
    assert more.worth(head)[1] == pytest.approx(np.hypot(planned.worth(head)[1], own), rel=1e-4)
    assert more.worth(head)[0] > planned.worth(head)[0]


def test_a_dome_that_rounding_ate_is_what_the_lens_leaves_open(case: FlownSite) -> None:
    planned = replace(case.planned, reference=None)
    head = PassSearch(planned, case.site, 30.0).candidates.joint.head
    q = len(planned.f_gradient)
    gain = np.linalg.solve(head[:q, :q], head[q, :q])
    assert planned.beyond is not None
    least = planned.assumptions.model_error_factor**2 * float(gain @ head[:q, q])
    least += float(gain @ planned.beyond @ gain)
    eaten = head.copy()
    eaten[q, q] = -1e-9
    said = planned.worth(eaten)[1]
    assert said == pytest.approx(100 * np.sqrt(least) / planned.height_agl_m, rel=1e-3)
    assert 0.5 * planned.worth(head)[1] < said <= planned.worth(head)[1] * (1 + 1e-9)


def test_a_loose_reference_stays_in_the_dome_and_not_in_f(
    case: FlownSite, found: Refly, tmp_path: Path
) -> None:
    free = case.planned.known.free
    covariance = np.zeros((len(free), len(free)))
    k1 = LENS_NAMES.index("k1")
    covariance[k1, k1] = 1e-4**2
    (tmp_path / NETWORK_FILE).write_bytes(network_bytes(replace(case.check, reference_covariance=covariance)))
    kept = read_network(tmp_path / NETWORK_FILE)
    assert kept.reference_covariance is not None
    assert np.array_equal(kept.reference_covariance, covariance)
    planned = flown_site(kept, SiteFile()).planned
    head = PassSearch(planned, case.site, 30.0).candidates.joint.head
    q = len(planned.f_gradient)
    gain = np.linalg.solve(head[:q, :q], head[q, :q])[np.flatnonzero(free).tolist().index(k1)]
    own = 100 * 1e-4 * abs(float(gain)) / planned.height_agl_m
    alone = replace(planned, reference=None)
    assert planned.dome_reference_percent(head) == pytest.approx(own, rel=1e-4)
    assert alone.dome_reference_percent(head) == 0.0
    assert planned.worth(head)[1] == pytest.approx(np.hypot(alone.worth(head)[1], own), rel=1e-4)
    assert planned.worth(head)[0] == alone.worth(head)[0]
    assert found.found is not None
    loose = replace(found.found, worth=replace(found.found.worth, dome_reference_percent=0.05))
    assert "Not a limit but the reference" in short_of(loose, 300.0, 0.5)
    assert "Not a limit but the survey" in short_of(found.found, 300.0, 0.5)


def test_any_one_photo_may_be_missing(case: FlownSite, found: Refly) -> None:
    assert found.found is not None
    search = PassSearch(case.planned, case.site, 30.0)
    photos = [i for i in search.candidates.add(found.found.stations) if i is not None]
    worst = max(
        search.criterion.ratio(
            (search.found(tuple(p for p in photos if p != one)).worth.sigma_f_percent, 0.0)
        )
        for one in photos
    )
    assert 0.2 < worst <= 1.02


@pytest.mark.parametrize("seed", [3, 11, 17])
def test_the_search_is_within_a_tenth_of_the_best_subset(seed: int) -> None:
    one = outcome(seed)
    assert one.good
    assert one.least_s is not None
    assert 0.999 <= one.chosen_s / one.least_s <= 1.1


def test_the_sheet_has_everything(found: Refly) -> None:
    text = render_refly_sheet(found)
    assert "FLY THIS" in text
    assert text.count("<figure>") == 2
    assert found.found is not None
    for station in found.found.stations:
        assert f"{station.yaw_deg % 360:.0f}°" in text


# --- Limits that bind ------------------------------------------------------------------------------


def test_a_camera_fixed_straight_down_cannot_be_cured_in_the_air(case: FlownSite) -> None:
    fixed = refly(_with(case, vehicle={"gimbal_lowest_deg": -90, "gimbal_highest_deg": -89}))
    assert not fixed.cures
    assert "gimbal binds" in str(fixed.binding_limit)
    assert fixed.found is not None
    assert all(s.pitch_deg == -90 for s in fixed.found.stations)
    assert "wall" in fixed.alternatives[0].text
    assert fixed.found.worth.sigma_f_percent < case.check.sigma_f_percent * 1.5


def test_a_nearly_empty_battery_binds(case: FlownSite) -> None:
    """Forty seconds of it may be used."""
    short = refly(_with(case, vehicle={"endurance_s": 40 / 0.75}))
    assert not short.cures
    assert "battery binds" in str(short.binding_limit)
    assert short.duration_s <= 40.0


def test_under_a_low_ceiling_the_pass_stays_below_it(case: FlownSite) -> None:
    ceiling = round(0.7 * case.check.height_agl_m)
    low = refly(_with(case, ceiling_m=ceiling))
    assert low.found is not None
    assert max(s.height_m for s in low.found.stations) <= ceiling
    assert low.cures == (low.binding_limit is None)


def test_a_short_gimbal_gives_its_end() -> None:
    assert tilts_for(Vehicle()) == (25.0, 32.0, 40.0)
    assert tilts_for(Vehicle(gimbal_highest_deg=-60.0)) == (25.0, 30.0)
    assert tilts_for(Vehicle(gimbal_highest_deg=-75.0)) == ()


def _outline(case: FlownSite, east_m: tuple[float, float], north_m: tuple[float, float]) -> list[list[float]]:
    corners = np.array([[east_m[i], north_m[j], 0.0] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))])
    latitude, longitude, _ = case.site.frame.geodetic(corners).T
    return np.column_stack([latitude, longitude]).tolist()


def test_round_a_building_in_the_middle(case: FlownSite) -> None:
    east, north = PassSearch(case.planned, case.site, 30.0).middle_m
    outline = _outline(case, (east - 12, east + 12), (north - 12, north + 12))
    found = refly(_with(case, structure=[{"outline": outline, "height_m": 70.0}]))
    assert found.cures
    assert found.found is not None
    assert 5 <= len(found.found.stations) <= 14
    away = [max(abs(s.east_m - east), abs(s.north_m - north)) - 12 for s in found.found.stations]
    assert all(10 < a < 60 or s.height_m > 80 for a, s in zip(away, found.found.stations, strict=True))


def test_from_one_side_of_a_fence(case: FlownSite) -> None:
    north = float(PassSearch(case.planned, case.site, 30.0).middle_m[1])
    south = _outline(case, (-50.0, 140.0), (-50.0, north - 5.0))
    found = refly(_with(case, fence=[{"keep": "in", "outline": south}]))
    assert found.cures
    assert found.found is not None
    assert 5 <= len(found.found.stations) <= 14
    assert all(-50.0 < s.north_m < north - 5.0 for s in found.found.stations)


def test_a_gimbal_that_reaches_thirty_degrees_is_enough(case: FlownSite) -> None:
    found = refly(_with(case, vehicle={"gimbal_lowest_deg": -90, "gimbal_highest_deg": -60}))
    assert found.cures
    assert found.found is not None
    assert all(22.4 <= 90 + s.pitch_deg <= 30.0 for s in found.found.stations)
    assert 5 <= len(found.found.stations) <= 14


# --- When flying does not help ---------------------------------------------------------------------


def test_nothing_is_sold_for_a_trusted_calibration(case: FlownSite) -> None:
    check = replace(case.check, verdict=Verdict.TRUST, headline="It can be trusted.")
    assert str(why_no_pass(check, strong=True)).startswith("Nothing needs to be flown.")
    nothing = refly(replace(case, check=check))
    assert (nothing.plan, nothing.found, nothing.helps) == (None, None, False)


@pytest.mark.parametrize(
    ("rule", "words"),
    [
        ("focal-drift", "zoom"),
        ("equifinal-deviation", "reference"),
        ("model-sensitivity", "blurred"),
        ("cross-validation", "water"),
        ("coverage", "overlap"),
    ],
)
def test_a_strong_network_gets_a_reason_and_no_pass(case: FlownSite, rule: str, words: str) -> None:
    why = why_no_pass(_saying(case.check, rule), strong=True)
    assert why is not None
    assert words in why
    assert f"It is the {rule}." in why
    assert why_no_pass(_saying(case.check, rule), strong=False) is None


def test_a_broken_block_comes_first(case: FlownSite) -> None:
    assert "in order" in str(why_no_pass(_saying(case.check, "alignment"), strong=False))


# --- The command -----------------------------------------------------------------------------------


def test_the_command_refuses_what_is_no_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setenv("FIELDCAL_SESSIONS", str(tmp_path / "sessions"))
    assert cli.run(["refly", str(tmp_path)]) == 2
    assert "run fieldcal check" in capsys.readouterr().err
    assert cli.run(["refly", str(tmp_path / "nothing")]) == 2
    (tmp_path / NETWORK_FILE).write_bytes(b"PK\x03\x04 no network")
    assert cli.run(["refly", str(tmp_path)]) == 2
    assert "damaged" in capsys.readouterr().err
    assert cli.run(["refly", str(tmp_path), "--out", "pass.doc"]) == 2


def test_without_places_the_reason_is_given(case: FlownSite, tmp_path: Path) -> None:
    lost = replace(case.check, origin_wgs84=None, geotag_fault="The geotags are wrong.")
    (tmp_path / NETWORK_FILE).write_bytes(network_bytes(lost))
    assert cli.run(["refly", str(tmp_path), "--json", str(tmp_path / "x.json")]) == 4
    told = json.loads((tmp_path / "x.json").read_text())
    assert (told["photos"], told["cures"]) == (0, False)
    assert "The geotags are wrong." in told["reason"]
    with pytest.raises(InputError, match="by hand"):
        flown_site(lost, SiteFile())


def test_a_block_that_cannot_be_computed_with_is_said_in_a_sentence(
    case: FlownSite, monkeypatch: pytest.MonkeyPatch
) -> None:
    def singular(_: PassSearch) -> None:
        raise np.linalg.LinAlgError

    monkeypatch.setattr(PassSearch, "fill", singular)
    with pytest.raises(InputError, match=r"too weak .* fly the circle"):
        refly(case)


def test_a_far_launch_point_is_questioned(case: FlownSite) -> None:
    with pytest.raises(FieldcalError, match="is it right"):
        _with(case, launch=[51.5, -0.1])

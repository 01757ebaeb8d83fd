"""Patterns and their composition: coverage at the worst place, fences, short paths, right angles."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from mission_sites import FRAME, Hills, make_site, places_in, views
from shapely import Point, Polygon, box

from calib.errors import InputError
from calib.frames import LocalFrame
from mission.compose import compose, compose_with_notes
from mission.fence import Circle, Fence
from mission.limits import check_limits, hard_violations
from mission.limits_path import path_samples_m, way_home_m
from mission.patterns import COMPOSED, PATTERNS, pattern_names
from mission.patterns.piece import Piece, backwards
from mission.plan import Plan, Shot, Waypoint, stations
from mission.reroute import allowed_station, rerouted
from mission.site import PatternOptions, Site, Wall
from mission.space import Structure
from mission.timing import timing


@st.composite
def areas(draw: st.DrawFn, least_m: float = 5.0, most_m: float = 150.0) -> Polygon:
    """Star-shaped areas, as concave as they come, some with a hole."""
    scale = 10 ** draw(st.floats(math.log10(least_m), math.log10(most_m)))
    count = draw(st.integers(3, 9))
    radii = np.array(draw(st.lists(st.floats(0.25, 1.0), min_size=count, max_size=count)))
    shift = np.array(draw(st.lists(st.floats(-0.3, 0.3), min_size=count, max_size=count)))
    angle = 2 * np.pi * (np.arange(count) + shift) / count
    area = Polygon(scale * np.stack([radii * np.cos(angle), radii * np.sin(angle)], axis=-1))
    assume(area.is_valid and area.area > 4)
    if draw(st.booleans()):
        with_hole = area.difference(area.representative_point().buffer(0.1 * scale))
        area = with_hole if isinstance(with_hole, Polygon) else area
    return area


@settings(deadline=None, max_examples=25)
@given(
    area=areas(),
    name=st.sampled_from(["nadir", "oblique", "height2"]),
    forward=st.floats(0.5, 0.85),
    side=st.floats(0.3, 0.8),
    height=st.floats(30, 90),
    hills=st.one_of(st.none(), st.tuples(st.floats(2, 10), st.floats(80, 400), st.floats(-0.1, 0.1))),
    heading=st.one_of(st.none(), st.floats(0, 360)),
)
def test_the_worst_place_has_the_overlap_asked_for(
    area: Polygon,
    name: str,
    forward: float,
    side: float,
    height: float,
    hills: tuple[float, float, float] | None,
    heading: float | None,
) -> None:
    """Every place in as many photos as both overlaps promise, projected through the true lens."""
    site = make_site(
        area,
        forward_overlap=forward,
        side_overlap=side,
        height_m=height,
        options=PatternOptions(heading_deg=heading),
        **({} if hills is None else {"terrain": Hills(*hills)}),
    )
    plan = compose([name], site)
    promised = math.floor(1 / (1 - forward) + 1e-6) * math.floor(1 / (1 - side) + 1e-6)
    assert views(plan, site.terrain, places_in(area, 150)).min() >= promised


@pytest.mark.parametrize(("size_m", "height_m"), [(10, 20), (700, 100), (5000, 400)])
def test_areas_of_ten_metres_to_five_kilometres(size_m: float, height_m: float) -> None:
    area = box(0, 0, size_m, size_m)
    site = make_site(area, height_m=height_m)
    plan = compose(["nadir"], site)
    # Corners, edges and some places inside; the rest is as good by symmetry.
    places = np.concatenate([places_in(area, 36)[-24:], [[size_m / 2, size_m / 2], [size_m / 3, size_m / 7]]])
    assert views(plan, site.terrain, places).min() >= 15
    footprint = site.footprint()
    lines = size_m / (2 * footprint.half_across * height_m * 0.3) + 4
    assert sum(w.shot is Shot.LINE for w in plan.waypoints) <= lines
    length = np.linalg.norm(np.diff(plan.path_m, axis=0), axis=1).sum()
    assert length < 1.25 * lines * (size_m + 1.2 * footprint.along * height_m) + 3 * size_m


def _geodetic(ring: np.ndarray, frame: LocalFrame) -> tuple[tuple[float, float], ...]:
    found = frame.geodetic(np.column_stack([ring, np.zeros(len(ring))]))
    return tuple((float(g[0]), float((g[1] + 180) % 360 - 180)) for g in found)


@settings(deadline=None, max_examples=25)
@given(
    area=areas(20, 150),
    names=st.sampled_from([("nadir",), ("nadir", "fan"), ("orbit",), ("crosshatch", "orbit"), ("rings",)]),
    keep_in=st.floats(1.0, 1.6),
    discs=st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(3, 40)), max_size=3),
    frame=st.sampled_from(
        [FRAME, LocalFrame(-43.5, 179.9999, 20.0), LocalFrame(81.0, -180.0), LocalFrame(0, 0)]
    ),
)
def test_no_leg_leaves_the_fence(
    area: Polygon,
    names: tuple[str, ...],
    keep_in: float,
    discs: list[tuple[float, float, float]],
    frame: LocalFrame,
) -> None:
    """Legs and the way home sampled to a metre, against the fence as it was given."""
    reach = max(abs(v) for v in area.bounds)
    ring = keep_in * reach * np.array([[1, 1], [-1, 1.2], [-1.1, -1], [0, -0.6], [1, -1.2]])
    out = [(x * reach, y * reach, r) for x, y, r in discs if math.hypot(x * reach, y * reach) > r + 8]
    circles = tuple(Circle(*_geodetic(np.array([[x, y]]), frame)[0], r, inside=False) for x, y, r in out)
    fence = Fence(keep_in=(_geodetic(ring, frame),), circles=circles)
    site = make_site(area, fence=fence, frame=frame, height_m=40.0)
    try:
        plan = compose(names, site)
    except InputError:  # No way through, or nothing left to fly.
        return
    samples = np.vstack([path_samples_m(plan), way_home_m(plan)])[:, :2]
    assert np.linalg.norm(np.diff(path_samples_m(plan), axis=0), axis=1).max() < 1.001
    legal = Polygon(ring)
    assert shapely.distance(legal, shapely.points(samples)).max() < 1e-6
    for x, y, r in out:
        assert np.hypot(*(samples - [x, y]).T).min() > r - 1e-6
    fence_finding = next(f for f in check_limits(plan, site) if f.rule == "fence")
    assert fence_finding.ok
    assert fence_finding.value is not None
    assert fence_finding.value > 4.9


def test_concave_areas_are_flown_without_crossing_the_gap_with_photos() -> None:
    area = Polygon([(0, 0), (1000, 0), (1000, 800), (800, 800), (800, 200), (200, 200), (200, 800), (0, 800)])
    gap = box(450, 500, 550, 800)
    plan = compose(["nadir"], make_site(area, options=PatternOptions(heading_deg=90.0)))
    assert not any(gap.contains(Point(s.east_m, s.north_m)) for s in stations(plan))
    assert views(plan, make_site(area).terrain, places_in(area, 100)).min() >= 15


def test_best_heading_follows_the_long_side() -> None:
    area = shapely.affinity.rotate(box(-300, -40, 300, 40), 30)
    plan = compose(["nadir"], make_site(area))
    lines = [w for w in plan.waypoints if w.shot is Shot.LINE]
    assert {round(w.yaw_deg % 180) for w in lines} == {60}


def test_fan_looks_at_the_middle_forty_degrees_off_nadir() -> None:
    site = make_site(box(100, 50, 220, 170))
    photos = stations(compose(["fan"], site))
    assert len(photos) == 8
    for s in photos:
        reach = s.height_m * math.tan(math.radians(s.pitch_deg + 90))
        seen = (
            s.east_m + reach * math.sin(math.radians(s.yaw_deg)),
            s.north_m + reach * math.cos(math.radians(s.yaw_deg)),
        )
        assert seen == pytest.approx((160, 110), abs=1e-6)
        assert s.pitch_deg == -50
    azimuths = sorted(s.yaw_deg for s in photos)
    assert np.diff(azimuths) == pytest.approx([45] * 7)


def test_orbit_direction_arc_tilt_and_radius() -> None:
    area = box(0, 0, 100, 100)
    options = PatternOptions(poi_m=(50, 60), photos=10, arc_deg=(270, 30), clockwise=True, tilt_deg=30.0)
    photos = stations(compose(["orbit"], make_site(area, options=options)))
    azimuth = [math.degrees(math.atan2(s.east_m - 50, s.north_m - 60)) % 360 for s in photos]
    assert azimuth == pytest.approx(list((270 + np.linspace(0, 120, 10)) % 360))
    assert {round(math.hypot(s.east_m - 50, s.north_m - 60), 6) for s in photos} == {
        round(60 * math.tan(math.radians(30)), 6)
    }
    back = replace(options, clockwise=False)
    assert [s.yaw_deg for s in stations(compose(["orbit"], make_site(area, options=back)))] == pytest.approx(
        [s.yaw_deg for s in photos][::-1]
    )
    by_radius = PatternOptions(radius_m=60.0)
    tilted = stations(compose(["orbit"], make_site(area, options=by_radius)))
    assert {round(s.pitch_deg, 6) for s in tilted} == {-45.0}


def test_rings_look_at_the_building_from_all_sides_off_centre() -> None:
    house = Structure(box(14, 16, 26, 24), 10.5, 10.5, "house")
    site = make_site(box(-40, -40, 40, 40), structures=(house,), height_m=40.0)
    plan = compose(["rings"], site)
    photos = stations(plan)
    assert len({round(s.height_m) for s in photos}) == 3
    rotations = []
    for s in photos:
        to = np.array([20 - s.east_m, 20 - s.north_m])
        bearing = math.degrees(math.atan2(*to))
        rotations.append(((s.yaw_deg - bearing + 180) % 360 - 180, s.pitch_deg, s.height_m))
        assert 35 < math.dist((s.east_m, s.north_m, s.height_m), (20, 20, 5.25)) < 60
    sides = {np.sign(round(turn)) for turn, _, _ in rotations}
    assert {1.0, -1.0} <= sides, "left and right of the image centre"
    quadrants = {(s.east_m > 20, s.north_m > 20) for s in photos}
    assert len(quadrants) == 4
    assert not hard_violations(check_limits(plan, site))


def test_wall_pairs_meet_on_the_wall() -> None:
    wall = Wall((0.0, 30.0), (40.0, 30.0), 8.0)
    site = make_site(box(0, 0, 40, 28), options=PatternOptions(wall=wall), clearance_m=2.0)
    photos = stations(compose(["wall"], site))
    assert len(photos) == 24
    hits = []
    for s in photos:
        assert s.north_m == pytest.approx(20.0)
        along = 10 * math.tan(math.radians((s.yaw_deg + 180) % 360 - 180))
        assert abs(along) == pytest.approx(10.0)
        hits.append((round(s.east_m + along, 6), round(s.height_m, 6)))
    assert all(hits.count(hit) == 2 for hit in hits)
    assert all(0 < east < 40 for east, _ in hits)


@pytest.mark.parametrize("name", [*PATTERNS, *COMPOSED, "nadir+orbit+fan"])
def test_every_pattern_flies(name: str) -> None:
    house = Structure(box(40, 40, 52, 48), 9.0, 9.0)
    site = make_site(box(0, 0, 120, 100), structures=(house,), clearance_m=3.0)
    plan = compose(pattern_names(name), site)
    assert len(stations(plan)) >= 8
    assert {s.pattern for s in stations(plan)} == set(pattern_names(name))
    broken = [f.rule for f in hard_violations(check_limits(plan, site)) if f.rule != "endurance"]
    assert broken == []


def test_names() -> None:
    assert pattern_names("fan+nadir") == ("nadir", "fan")
    assert pattern_names("cd4+orbit") == ("nadir", "height2", "orbit", "fan")
    with pytest.raises(InputError, match="did you mean orbit"):
        pattern_names("nadir+orbitt")


def test_backwards_takes_the_same_photos() -> None:
    area = box(0, 0, 300, 200)
    site = make_site(area, terrain=Hills(15, 150), options=PatternOptions(heading_deg=90.0))
    plan = compose(["nadir"], site)
    piece = Piece(
        plan.waypoints[:-1] if plan.waypoints[-1].shot is Shot.LINE else plan.waypoints, turning=True
    )
    turned = backwards(piece)

    def places(waypoints: tuple[Waypoint, ...]) -> set[tuple[float, ...]]:
        found = stations(replace(plan, waypoints=waypoints))
        return {(round(s.east_m, 4), round(s.north_m, 4), round(s.height_m, 4)) for s in found}

    assert places(turned.waypoints) == places(piece.waypoints)
    assert places(backwards(turned).waypoints) == places(piece.waypoints)


def test_terrain_following_keeps_the_height_and_takes_no_place_twice() -> None:
    site = make_site(box(0, 0, 400, 300), terrain=Hills(25, 350, 0.05))
    plan = compose(["nadir"], site)
    photos = np.array([[s.east_m, s.north_m, s.height_m] for s in stations(plan)])
    above = photos[:, 2] - site.terrain.height_m(photos[:, 0], photos[:, 1])
    assert np.abs(above - 60).max() < 0.02 * 60 + 1e-6
    distances = np.linalg.norm(photos[:, None] - photos[None], axis=2)[np.triu_indices(len(photos), 1)]
    assert distances.min() > 1.0
    assert next(f for f in check_limits(plan, site) if f.rule == "terrain-clearance").ok


def test_a_hill_between_is_flown_over() -> None:
    class _Hill(Hills):
        def height_m(self, east_m: np.ndarray, north_m: np.ndarray) -> np.ndarray:
            return np.asarray(
                90 * np.exp(-(((np.asarray(east_m) - 400) / 60) ** 2)) + 0 * np.asarray(north_m)
            )

    area = box(700, -50, 800, 50)
    site = make_site(area, terrain=_Hill(0, 1), height_m=50.0)
    plan = compose(["nadir"], site)
    findings = {f.rule: f for f in check_limits(plan, site)}
    assert findings["terrain-clearance"].ok, findings["terrain-clearance"].message
    assert findings["return-path"].ok
    assert plan.return_height_m > 100


def test_relief_too_steep_says_how_high_to_fly() -> None:
    site = make_site(box(0, 0, 300, 300), terrain=Hills(80, 100), height_m=40.0)
    with pytest.raises(InputError, match=r"rises by .* fly at"):
        compose(["nadir"], site)


def test_speed_is_lowered_for_the_camera() -> None:
    site = make_site(box(0, 0, 100, 100), height_m=25.0)
    made = compose_with_notes(["nadir"], site)
    assert made.plan.vehicle.speed_m_s < 4
    assert any("speed is lowered" in note for note in made.notes)
    assert next(f for f in check_limits(made.plan, site) if f.rule == "trigger-interval").ok


# --- Limits ----------------------------------------------------------------------------------------


def _plan(site: Site, *corners: tuple[float, float, float], home: float = 40.0) -> Plan:
    waypoints = tuple(Waypoint(*c, shot=Shot.STOP) for c in corners)
    return Plan("p", site.frame, site.camera, "c", site.vehicle, waypoints, home)


def test_each_broken_limit_is_found_and_measured() -> None:
    keep_out = Fence(
        keep_in=(_geodetic(np.array([[-200, -200], [200, -200], [200, 200], [-200, 200]]), FRAME),),
        keep_out=(_geodetic(np.array([[40, -20], [60, -20], [60, 20], [40, 20]]), FRAME),),
        ceiling_m=50.0,
    )
    mast = Structure(box(-100, -2, -96, 2), 60.0, 60.0, "mast")
    site = make_site(box(0, 0, 50, 50), fence=keep_out, structures=(mast,), height_m=40.0)
    cases = {
        "fence": _plan(site, (100, 0, 40)),  # The leg crosses the keep-out zone, its ends do not.
        "ceiling": _plan(site, (10, 0, 62)),
        "terrain-clearance": _plan(site, (10, 0, 4)),
        "stand-off": _plan(site, (-98, 40, 40), (-98, -40, 40)),
        "return-path": _plan(site, (-150, 0, 30), home=31.0),
        "gimbal-range": replace(_plan(site, (10, 0, 30)), waypoints=(
            Waypoint(10, 0, 30, pitch_deg=15, shot=Shot.STOP),)),
        "trigger-interval": replace(_plan(site, (10, 0, 30)), waypoints=(
            Waypoint(10, 0, 30, shot=Shot.LINE, spacing_m=2), Waypoint(30, 0, 30))),
        "endurance": _plan(site, *[(10.0 * (i % 2), 10.0, 30.0) for i in range(300)]),
        "item-limit": _plan(site, *[(10.0 * (i % 2), 10.0, 30.0) for i in range(300)]),
        "first-waypoint": _plan(site, (950, 0, 30)),
    }  # fmt: skip
    for rule, plan in cases.items():
        finding = next(f for f in check_limits(plan, site) if f.rule == rule)
        assert not finding.ok, rule
        assert finding.message.endswith((".", "?"))
        assert finding.value is not None
    good = check_limits(_plan(site, (10, 10, 30), (20, 10, 30)), site)
    assert all(f.ok for f in good), [f.message for f in good if not f.ok]
    ceiling = next(f for f in check_limits(cases["ceiling"], site) if f.rule == "ceiling")
    assert "12 m too high" in ceiling.message
    outside = replace(site, space=replace(site.space, fence_area=shapely.MultiPolygon([box(10, 10, 90, 90)])))
    launch = next(f for f in check_limits(cases["fence"], outside) if f.rule == "launch-inside-fence")
    assert not launch.ok
    assert launch.value == pytest.approx(math.hypot(10, 10))


def test_timing_of_a_known_flight() -> None:
    """Up 40 m at 3 m/s, 100 m at 8 m/s and back, down at 2 m/s, accelerating by 2 m/s2, one stop."""
    site = make_site(box(0, 0, 50, 50))
    cost = timing(_plan(site, (100, 0, 40)))
    climb, level, descent = 40 / 3 + 3 / 2, 100 / 8 + 8 / 2, 40 / 2 + 2 / 2
    assert cost.duration_s == pytest.approx(climb + level + 2.0 + level + descent)
    assert cost.length_m == pytest.approx(280)
    assert cost.photos == 1
    assert 0.5 < cost.battery_share * site.vehicle.endurance_s / cost.duration_s < 1.5


def test_photos_added_by_others_are_joined_legally() -> None:
    zone = _geodetic(np.array([[40, -20], [60, -20], [60, 20], [40, 20]]), FRAME)
    site = make_site(box(0, 0, 50, 50), fence=Fence(keep_out=(zone,)), height_m=40.0)
    crossing = _plan(site, (100, 0, 40))
    assert not next(f for f in check_limits(crossing, site) if f.rule == "fence").ok
    joined = rerouted(crossing, site)
    outward = joined.path_m[:-1]
    legs = shapely.linestrings(np.stack([outward[:-1, :2], outward[1:, :2]], axis=1))
    assert shapely.covers(site.space.fence_area, legs).all()
    assert stations(joined) == stations(crossing)
    allowed = allowed_station(site)
    photo = stations(crossing)[0]
    assert allowed(photo)
    assert not allowed(replace(photo, east_m=50.0))
    assert not allowed(replace(photo, height_m=5.0))
    assert not allowed(replace(photo, pitch_deg=10.0))

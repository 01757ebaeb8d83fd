"""Missions for several batteries: complete, allowed, and together the same photos."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest
from mission_sites import FRAME, Hills, make_site
from shapely import box

from calib.errors import InputError
from calib.findings import Verdict
from mission.compose import compose
from mission.fence import Circle, Fence
from mission.limits import check_limits, hard_violations
from mission.plan import Plan, Shot, Station, Vehicle, stations
from mission.planned import Planned
from mission.prediction import Prediction
from mission.site import Site
from mission.split import split, worst_findings

PREDICTION = Prediction(
    0.01,
    (1e-11, 1e-18, 1e-25),
    -0.9,
    0.01,
    0.02,
    0.1,
    100,
    60.0,
    0.03,
    0.026,
    15,
    (0, 0),
    Verdict.TRUST,
    "Good.",
)


def site_of(**vehicle: float) -> Site:
    fence = Fence(circles=(Circle(FRAME.latitude_deg, FRAME.longitude_deg, 400.0),))
    return make_site(
        box(-40, -150, 260, 150), fence=fence, terrain=Hills(10, 200), vehicle=replace(Vehicle(), **vehicle)
    )


def planned_of(names: list[str], site: Site) -> Planned:
    plan = compose(names, site)
    return Planned(site, plan, PREDICTION, check_limits(plan, site))


def photos_of(plan: Plan) -> Counter[tuple[float, ...]]:
    def key(s: Station) -> tuple[float, ...]:
        return tuple(round(v, 3) for v in (s.east_m, s.north_m, s.height_m, s.yaw_deg, s.pitch_deg))

    return Counter(key(s) for s in stations(plan))


@pytest.mark.parametrize("names", [["nadir", "orbit"], ["crosshatch"], ["nadir", "height2", "fan"]])
def test_parts_are_complete_and_together_the_whole(names: list[str]) -> None:
    whole = planned_of(names, site_of(endurance_s=600.0))
    assert {f.rule for f in hard_violations(whole.findings)} == {"endurance"}
    parts = split(whole)
    assert len(parts) >= 2
    for number, part in enumerate(parts, 1):
        assert hard_violations(part.findings) == ()
        assert part.plan.name == f"{whole.plan.name}-{number}"
        assert f"Part {number} of {len(parts)}" in part.notes[-1]
        assert part.timing.battery_share <= 0.75
        # No line is left without its end.
        assert part.plan.waypoints[-1].shot is not Shot.LINE
    assert sum((photos_of(part.plan) for part in parts), Counter()) == photos_of(whole.plan)
    # As few as they can be: two neighbours would not fit into one.
    assert sum(part.timing.battery_share for part in parts) > 0.75 * (len(parts) - 1) * 0.75


def test_an_orbit_stays_whole_and_is_flown_first_with_lines_under_it() -> None:
    parts = split(planned_of(["nadir", "orbit"], site_of(endurance_s=600.0)))
    of_orbit = [[s for s in stations(part.plan) if s.pattern == "orbit"] for part in parts]
    assert [len(o) for o in of_orbit] == [24] + [0] * (len(parts) - 1)
    assert "fly it first" in parts[0].notes[-1]
    # Lines stay whole: no line has photos in two parts.
    lines = [{round(s.east_m) for s in stations(part.plan) if s.pattern == "nadir"} for part in parts]
    assert sum(len(line) for line in lines) == len(set().union(*lines))
    below = [s for s in stations(parts[0].plan) if s.pattern == "nadir"]
    assert min(abs(s.east_m - 110) + abs(s.north_m) for s in below) < 30


def test_what_fits_is_not_split() -> None:
    whole = planned_of(["nadir"], site_of(endurance_s=3600.0))
    assert split(whole) == (whole,)


def test_mission_items_split_too() -> None:
    whole = planned_of(["nadir", "orbit"], site_of(endurance_s=3600.0, most_items=120))
    parts = split(whole)
    assert len(parts) >= 2
    assert all(hard_violations(part.findings) == () for part in parts)


def test_rings_alone_are_split_photo_by_photo() -> None:
    whole = planned_of(["orbit"], site_of(endurance_s=150.0))
    parts = split(whole)
    assert len(parts) >= 2
    assert sum((photos_of(part.plan) for part in parts), Counter()) == photos_of(whole.plan)


def test_where_splitting_does_not_help_it_says_why() -> None:
    with pytest.raises(InputError, match=r"one line or ring alone.*% of a battery"):
        split(planned_of(["nadir"], site_of(endurance_s=60.0)))
    with pytest.raises(InputError, match="mission items"):
        split(planned_of(["nadir"], site_of(endurance_s=3600.0, most_items=5)))


def test_the_worst_finding_speaks_for_all_parts() -> None:
    parts = split(planned_of(["nadir", "orbit"], site_of(endurance_s=600.0)))
    bad = replace(parts[1], findings=tuple(replace(f, ok=f.rule != "fence") for f in parts[1].findings))
    worst = worst_findings((parts[0], bad))
    assert [f.rule for f in worst] == [f.rule for f in parts[0].findings]
    assert [f.rule for f in worst if not f.ok] == ["fence"]

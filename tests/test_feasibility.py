"""Mission files held against the vehicle at hand."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from mission import encode
from mission.encode import Flavour, ReadPlan
from mission.encode import constants as mav
from mission.encode.items import wait
from mission.feasibility import Place, check_file
from mission.fence import Circle, Fence
from tests.mission_plans import LAUNCH, line, orbit, plan_of

HERE = Place(LAUNCH.latitude_deg, LAUNCH.longitude_deg)
PLAN = plan_of(*line(), *orbit(6))


def _read(flavour: Flavour, folder: Path, fence: Fence | None = None) -> ReadPlan:
    path = folder / "a.plan"
    encode.write(PLAN, path, fence=fence, flavour=flavour)
    return encode.read(path)


def _broken(plan: ReadPlan, flavour: Flavour = "ardupilot", place: Place | None = HERE) -> dict[str, str]:
    findings = check_file(plan, flavour, place)
    assert len({f.rule for f in findings}) == len(findings) == 12
    return {f.rule: f.message for f in findings if not f.ok}


@pytest.mark.parametrize("flavour", encode.FLAVOURS)
def test_our_own_plans_break_nothing(flavour: Flavour, tmp_path: Path) -> None:
    fence = Fence(circles=(Circle(LAUNCH.latitude_deg, LAUNCH.longitude_deg, 150.0),))
    assert _broken(_read(flavour, tmp_path, fence), flavour) == {}


def test_each_rule_breaks(tmp_path: Path) -> None:
    plan = _read("ardupilot", tmp_path)
    items = plan.items
    waypoint = next(n for n, i in enumerate(items) if i.command == 16)

    def changed(**new: object) -> ReadPlan:
        other = replace(items[waypoint], **new)  # type: ignore[arg-type]
        return replace(plan, items=(*items[:waypoint], other, *items[waypoint + 1 :]))

    assert "plan it again with --autopilot px4" in _broken(plan, "px4")["autopilot"]
    assert "650" in _broken(replace(plan, items=items * 20))["item-limit"]
    assert "nothing to fly" in _broken(replace(plan, items=()))["item-limit"]
    assert f"item {waypoint + 1}:" in _broken(changed(param2=math.nan))["numbers"]
    assert "numbers" not in _broken(changed(param4=math.nan))
    assert "stay where it is" in _broken(changed(x=0, y=0))["places"]
    assert "places" in _broken(changed(z=0.0))
    assert "in the air" in _broken(replace(plan, items=items[1:]))["take-off"]
    assert "bring the vehicle home" in _broken(replace(plan, items=items[:-1]))["way-home"]
    assert "room for error" in _broken(changed(z=3.0))["heights"]
    assert "terrain data" in _broken(changed(frame=10))["heights"]
    assert "takes no photos" in _broken(replace(plan, stations=()))["photos"]
    armed = replace(items[0], command=400)
    assert "400" in _broken(replace(plan, items=(*items, armed)))["commands"]


def test_px4s_gimbal_has_to_be_taken_and_its_delays_are_not_safe(tmp_path: Path) -> None:
    """Flown: without the first the camera looked ahead on all photos, with the second PX4 flew down."""
    plan = _read("px4", tmp_path)
    taking = next(item for item in plan.items if item.command == mav.DO_GIMBAL_MANAGER_CONFIGURE)
    without = tuple(item for item in plan.items if item is not taking)
    assert "looks ahead" in _broken(replace(plan, items=without), "px4")["commands"]
    assert "looks ahead" in _broken(replace(plan, items=(*without, taking)), "px4")["commands"]
    waiting = (*plan.items[:4], wait(2.0), *plan.items[4:])
    assert "can fly down" in _broken(replace(plan, items=waiting), "px4")["commands"]


def test_where_the_vehicle_stands(tmp_path: Path) -> None:
    plan = _read("px4", tmp_path)
    assert "does not know where it is" in _broken(plan, "px4", None)["launch-place"]
    near = Place(LAUNCH.latitude_deg + 0.001, LAUNCH.longitude_deg)
    assert "111 m" in _broken(plan, "px4", near)["launch-place"]
    assert "first-waypoint" not in _broken(plan, "px4", near)
    far = Place(LAUNCH.latitude_deg + 0.1, LAUNCH.longitude_deg)
    assert "is this the right mission" in _broken(plan, "px4", far)["first-waypoint"]


def test_legs_that_leave_the_fence(tmp_path: Path) -> None:
    """Both ends of a leg are allowed, and a zone to stay out of lies between them."""
    between = Circle(LAUNCH.latitude_deg, LAUNCH.longitude_deg + 50 / 76_000, 10.0, inside=False)
    broken = _broken(_read("ardupilot", tmp_path, Fence(circles=(between,))))
    assert "leave the file's fence" in broken["fence"]
    small = Circle(LAUNCH.latitude_deg, LAUNCH.longitude_deg, 80.0)
    message = _broken(_read("ardupilot", tmp_path, Fence(circles=(small,))))["fence"]
    assert "2 of" in message
    assert "by up to 2" in message or "by up to 1" in message

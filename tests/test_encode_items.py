"""Mission items of both autopilots: what they hold, what they evade, how they are compared."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given, settings

from calib.errors import InputError
from calib.frames import LocalFrame
from mission import encode
from mission.encode import Flavour, Item
from mission.encode import constants as mav
from mission.plan import Plan, Shot, Waypoint, stations
from tests.mission_plans import LAUNCH, line, orbit, place_loss_m, plan_of, plans, same_photos, triggered

mavlink = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega", reason="pip install fieldcal[flight]")

both = pytest.mark.parametrize("flavour", encode.FLAVOURS)
_NOT_COMMANDS = {"GLOBAL", "MISSION", "ROLL_LOCK", "PITCH_LOCK", "YAW_LOCK", "ARDUPILOTMEGA", "PX4"}


def test_constants_are_mavlinks() -> None:
    names = [n for n, value in vars(mav).items() if n.isupper() and isinstance(value, int)]
    assert len(names) > 30
    for name in names:
        prefixes = ("MAV_CMD_", "MAV_FRAME_", "GIMBAL_MANAGER_FLAGS_", "MAV_AUTOPILOT_")
        values = {getattr(mavlink, p + name) for p in prefixes if hasattr(mavlink, p + name)}
        assert getattr(mav, name) in values, name


@settings(max_examples=60, deadline=None)
@given(plan=plans())
def test_any_plan_decodes_to_its_photos(plan: Plan) -> None:
    want = triggered(plan)
    ardupilot = encode.stations_of_items(encode.items(plan, "ardupilot"), plan.launch)
    same_photos(want, ardupilot, place_loss_m(plan), 1e-6, 0.5)
    px4 = encode.stations_of_items(encode.items(plan, "px4"), plan.launch)
    same_photos(want, px4, 0.01, 1e-6, 1e-6)


@settings(max_examples=60, deadline=None)
@given(plan=plans())
def test_items_are_what_the_autopilots_take(plan: Plan) -> None:
    for item in encode.items(plan, "ardupilot"):
        assert item.frame in (0, 2, 3)
        assert not any(map(math.isnan, (item.param1, item.param2, item.param3, item.param4, item.z)))
        if item.command == mav.NAV_WAYPOINT and item.frame == mav.GLOBAL_RELATIVE_ALT:
            assert (item.x, item.y) != (0, 0)
            assert item.z != 0
            assert item.param1 == int(item.param1)
        if item.command == mav.DO_GIMBAL_MANAGER_PITCHYAW:
            assert item.param1 == int(item.param1)
    for item in encode.items(plan, "px4"):
        assert item.frame == (mav.GLOBAL_RELATIVE_ALT if item.command in mav.WITH_PLACE else mav.MISSION)
        assert item.command not in (mav.CONDITION_YAW, mav.NAV_LOITER_TURNS)


def stays(items: tuple[Item, ...], index: int) -> bool:
    """A waypoint where the vehicle is already, as it is."""
    here = replace(items[index], param1=0.0)
    before = [one for one in items[:index] if one.command == mav.NAV_WAYPOINT]
    return bool(before) and replace(before[-1], param1=0.0) == here


def waits(items: tuple[Item, ...], index: int) -> float:
    """Seconds that the vehicle waits here."""
    held = items[index].command == mav.NAV_DELAY or stays(items, index)
    return items[index].param1 if held else 0.0


@both
@settings(max_examples=30, deadline=None)
@given(plan=plans())
def test_taken_up_at_any_waypoint_the_rest_is_photographed(flavour: Flavour, plan: Plan) -> None:
    """From any waypoint on, everything that begins there or later has its aim and its camera commands.

    Not from where a vehicle only stays: PX4 itself runs the last commands again there.
    """
    items = encode.items(plan, flavour)
    whole = encode.stations_of_items(items, plan.launch, flavour)
    first = next(i for i, item in enumerate(items) if item.command == mav.NAV_TAKEOFF)
    starts = [i for i in range(first + 1, len(items)) if items[i].command == mav.NAV_WAYPOINT]
    for start in [i for i in starts if not stays(items, i)]:
        rest = encode.stations_of_items(items[start:], plan.launch, flavour)
        # The photo at the end of the line flown to just then has nothing before it to aim it.
        line_end = items[start + 1].command == mav.IMAGE_START_CAPTURE
        rest = rest[1:] if line_end else rest
        tail = whole[len(whole) - len(rest) :]
        same_photos(tail, rest, 1e-6, 1e-6, 1e-6)


@both
@pytest.mark.parametrize(("length_m", "spacing_m"), [(59.49, 15.0), (200.0, 4.0), (12.0, 3.0), (8.0, 40.0)])
def test_no_line_ends_in_two_photos(flavour: Flavour, length_m: float, spacing_m: float) -> None:
    """ArduCopter flew 0.5 m past the end of a line of 59.49 m and took the photo that was due there by
    distance 0.4 m before the one by command (measured): none is due there any more."""
    items = encode.items(plan_of(*line(length_m, spacing_m)), flavour)
    (gap,) = (i.param1 for i in items if i.command == mav.DO_SET_CAM_TRIGG_DIST and i.param1 > 0)
    planned = math.ceil(length_m / spacing_m - 1e-9)
    beyond = gap * planned - length_m
    assert beyond == pytest.approx(min(1.0, length_m / planned / 4), abs=1e-6)
    assert gap * (planned - 1) < length_m - gap / 2  # nor is one lost


@both
def test_each_photo_waits_for_gimbal_and_vehicle(flavour: Flavour) -> None:
    items = encode.items(plan_of(*orbit(), settle_s=3.0), flavour)
    photos = [i for i, item in enumerate(items) if item.command == mav.IMAGE_START_CAPTURE]
    assert len(photos) == 8
    for index in photos:
        assert waits(items, index - 1) >= 3.0
        assert items[index - 2].command in (mav.CONDITION_YAW, mav.DO_GIMBAL_MANAGER_PITCHYAW)
        assert items[index + 1] == replace(items[index - 1], param1=0.5)


def test_copter_keeps_the_heading_on_lines() -> None:
    """Starting a waypoint turns Copter to the flight direction; the second command after it does not."""
    items = encode.items(plan_of(*line()), "ardupilot")
    start = next(i for i, item in enumerate(items) if item.command == mav.DO_SET_CAM_TRIGG_DIST)
    assert [item.command for item in items[start : start + 3]] == [
        mav.DO_SET_CAM_TRIGG_DIST,
        mav.CONDITION_YAW,
        mav.NAV_WAYPOINT,
    ]
    assert (items[start].param1, items[start].param3) == (pytest.approx(10.1), 1.0)
    after = items[start + 3 : start + 5]
    assert [item.command for item in after] == [mav.IMAGE_START_CAPTURE, mav.DO_SET_CAM_TRIGG_DIST]
    assert after[1].param1 == 0


@both
def test_lines_that_go_on_do_not_stop(flavour: Flavour) -> None:
    bend = [Waypoint(100.0 * i, 0, 60 + i, 90.0, -90.0, Shot.LINE, 10.0) for i in range(4)]
    items = encode.items(plan_of(*bend, Waypoint(400, 0, 60)), flavour)
    assert sum(waits(items, index) > 0 for index in range(len(items))) == 2
    assert sum(item.command == mav.DO_SET_CAM_TRIGG_DIST and item.param1 == 0 for item in items) == 1


@settings(max_examples=60, deadline=None)
@given(plan=plans())
def test_px4_always_has_a_place_while_it_waits_or_begins_a_line(plan: Plan) -> None:
    """Where its home's height is corrected meanwhile it flies towards sea level else (flown)."""
    items = encode.items(plan, "px4")
    for index, item in enumerate(items):
        assert item.command != mav.NAV_DELAY
        if item.command == mav.DO_SET_CAM_TRIGG_DIST and item.param1 > 0:
            goes_on = items[index - 2].command == mav.IMAGE_START_CAPTURE
            assert goes_on or stays(items, index + 1)


def test_home_takeoff_and_return() -> None:
    plan = plan_of(*line(), launch=LAUNCH)
    ardupilot, px4 = encode.items(plan, "ardupilot"), encode.items(plan, "px4")
    home = Item(mav.NAV_WAYPOINT, mav.GLOBAL, x=470000000, y=85000000, z=430.0)
    assert ardupilot[0] == home
    assert [i.command for i in (ardupilot[1], px4[0])] == [mav.NAV_TAKEOFF] * 2
    assert ardupilot[1].z == px4[0].z == 60.0
    assert ardupilot[-1].command == px4[-1].command == mav.NAV_RETURN_TO_LAUNCH
    low = encode.items(plan_of(Waypoint(10, 10, 20, shot=Shot.STOP)), "px4")
    assert (low[-2].command, low[-2].z) == (mav.NAV_WAYPOINT, 40.0), "climbs to the return height"


def test_copters_traps_are_evaded_by_the_smallest_step() -> None:
    nowhere = plan_of(Waypoint(0, 0, 0.0, shot=Shot.STOP), launch=LocalFrame(0.0, 0.0))
    items = encode.items(nowhere, "ardupilot")
    stop = items[3]
    assert (stop.x, stop.y, stop.z) == (0, 1, 0.01)
    same_photos(stations(nowhere), encode.stations_of_items(items, nowhere.launch), 0.022, 1e-6, 0.5)


@both
def test_too_many_items_say_so(flavour: Flavour) -> None:
    with pytest.raises(InputError, match=r"has \d+ items, but the autopilot holds only 30"):
        encode.items(plan_of(*orbit(), most_items=30), flavour)


@both
@pytest.mark.parametrize(
    "waypoints",
    [line()[:1], (Waypoint(0, 0, 1, shot=Shot.LINE), Waypoint(9, 0, 1)), (Waypoint(math.nan, 0, 5),)],
)
def test_impossible_plans_are_refused(flavour: Flavour, waypoints: tuple[Waypoint, ...]) -> None:
    with pytest.raises(InputError, match="cannot be written"):
        encode.items(plan_of(*waypoints), flavour)


# --- Points of interest --------------------------------------------------------------------------


@both
def test_orbits_by_point_of_interest(flavour: Flavour) -> None:
    plan = plan_of(*line(), *orbit(), *line())
    items = encode.items(plan, flavour, "roi")
    rois = [item for item in items if item.command == mav.DO_SET_ROI_LOCATION]
    assert len(rois) == 8
    assert len(set(rois)) == 1
    assert sum(item.command == mav.DO_SET_ROI_NONE for item in items) == 1
    same_photos(triggered(plan), encode.stations_of_items(items, plan.launch), 0.01, 0.05, 0.05)


@both
def test_views_that_do_not_meet_keep_their_angles(flavour: Flavour) -> None:
    fan = tuple(replace(w, yaw_deg=w.yaw_deg + 20 * (-1) ** i) for i, w in enumerate(orbit()))
    nadir = tuple(replace(w, pitch_deg=-90.0) for w in orbit())
    away = tuple(replace(w, yaw_deg=w.yaw_deg + 180, pitch_deg=20.0) for w in orbit())
    for waypoints in (fan, nadir, away, orbit()[:2]):
        items = encode.items(plan_of(*waypoints), flavour, "roi")
        assert not any(item.command == mav.DO_SET_ROI_LOCATION for item in items)


# --- Comparison with what a vehicle holds --------------------------------------------------------


@both
def test_the_same_mission_has_no_differences(flavour: Flavour) -> None:
    items = encode.items(plan_of(*line(), *orbit()), flavour)
    assert encode.compare(items, items, flavour) == []
    assert encode.compare(items, items[:-1], flavour) == [
        f"The vehicle holds {len(items) - 1} items, but {len(items)} were sent."
    ]


@both
@pytest.mark.parametrize(
    "change",
    [{"x": 1}, {"y": -5}, {"z": 3.0}, {"frame": 10}, {"command": 17}, {"param1": 7.0}],
)
def test_every_other_difference_is_named(flavour: Flavour, change: dict[str, float]) -> None:
    items = list(encode.items(plan_of(*line(), *orbit()), flavour))
    index = next(i for i in range(4, len(items)) if items[i].command == mav.NAV_WAYPOINT)
    (name, value) = next(iter(change.items()))
    changed = items.copy()
    base = getattr(items[index], name)
    changed[index] = replace(items[index], **{name: value if name in ("frame", "command") else base + value})
    (sentence,) = encode.compare(items, changed, flavour)
    assert sentence.startswith(f"Item {index} has {name} ")

"""The simulated vehicle does what was measured on ArduCopter 4.6 and PX4 1.16. No sockets, no clock."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from typing import Any

import pytest

pytest.importorskip("pymavlink", reason="pip install fieldcal[flight]")

from daemon.link import events as ev
from daemon.link.attitude import angles_of, earth_angles
from daemon.link.decode import Context, decode
from daemon.link.message import from_pymavlink
from mission import encode
from mission.encode import Flavour, Item
from mission.encode import constants as mav
from mission.encode.items import do
from sim.vehicle import Faults, Vehicle, VehicleOptions
from sim.vehicle.dialect import mavlink
from sim.vehicle.faults import FaultyLink
from tests.mission_plans import LAUNCH, line, orbit, plan_of, triggered

PLAN = plan_of(*line(60.0, 10.0, 30.0), *orbit(6, radius=25.0, height=30.0), speed_m_s=5.0)


class Ground:
    """A ground station that talks to the core directly."""

    def __init__(self, flavour: Flavour, faults: Faults | None = None, **options: Any) -> None:
        self.flavour = flavour
        self.vehicle = Vehicle(VehicleOptions(flavour, LAUNCH, **options), random.Random(1), faults)
        self.heard: list[Any] = []

    def send(self, message: Any, system: int = 245) -> list[Any]:
        sent = message.pack(mavlink.MAVLink(None, system, 190))
        (arrived,) = mavlink.MAVLink(None).parse_buffer(sent)
        found = self.vehicle.receive(arrived)
        self.heard += found
        return found

    def command(self, number: int, *params: float) -> int:
        values = [*params, *[0.0] * 7][:7]
        answers = self.send(mavlink.MAVLink_command_long_message(1, 1, number, 0, *values))
        return next(int(a.result) for a in answers if a.get_type() == "COMMAND_ACK")

    def count(self, count: int, system: int = 245) -> list[Any]:
        return self.send(mavlink.MAVLink_mission_count_message(1, 1, count, 0), system)

    def item(self, index: int, item: Item) -> list[Any]:
        fields = (item.param1, item.param2, item.param3, item.param4, item.x, item.y, item.z)
        make = mavlink.MAVLink_mission_item_int_message
        return self.send(make(1, 1, index, item.frame, item.command, 0, 1, *fields, 0))

    def upload(self, items: Sequence[Item]) -> int:
        """MAV_MISSION_RESULT."""
        answers = self.count(len(items))
        while answers[-1].get_type().startswith("MISSION_REQUEST"):
            index = answers[-1].seq
            answers = self.item(index, items[index])
        return int(answers[-1].type)

    def pass_s(self, seconds: float) -> list[Any]:
        found = []
        for _ in range(round(seconds / 0.1)):
            found += self.vehicle.step(0.1)
        self.heard += found
        return found

    def until(self, true: Any, seconds: float = 600.0) -> None:
        for _ in range(round(seconds / 0.1)):
            if true():
                return
            self.pass_s(0.1)
        raise AssertionError("it never happened")

    def start(self) -> None:
        assert self.upload(encode.items(PLAN, self.flavour)) == 0
        assert self.command(400, 1) == 0
        assert self.command(300) == 0


def names(messages: Sequence[Any]) -> list[str]:
    return [m.get_type() for m in messages]


@pytest.mark.parametrize("flavour", encode.FLAVOURS)
def test_a_refused_upload(flavour: Flavour) -> None:
    """ArduPilot keeps the good items and the old tail, PX4 the old mission."""
    ground = Ground(flavour, Faults(reject_item=4))
    old = list(encode.items(PLAN, flavour))[:8]
    ground.vehicle.transfer.reject_item = None
    assert ground.upload(old) == 0
    ground.vehicle.transfer.reject_item = 4
    before = list(ground.vehicle.transfer.mission)
    new = [*old[:2], do(178, 1, 3.0, -1), *old[3:]]
    assert ground.upload(new) != 0
    held = ground.vehicle.transfer.mission
    if flavour == "px4":
        assert held == before
    else:
        assert held[2].param2 == 3.0
        assert held[3:] == before[3:]


@pytest.mark.parametrize("flavour", encode.FLAVOURS)
def test_a_stalled_upload(flavour: Flavour) -> None:
    ground = Ground(flavour)
    ground.count(5)
    ground.item(0, encode.items(PLAN, flavour)[0])
    heard = ground.pass_s(10)
    asked = "MISSION_REQUEST" if flavour == "ardupilot" else "MISSION_REQUEST_INT"
    assert 6 <= names(heard).count(asked) <= 8
    acks = [m.type for m in heard if m.get_type() == "MISSION_ACK"]
    assert acks == ([15] if flavour == "ardupilot" else [])
    assert ground.upload(encode.items(PLAN, flavour)) == 0  # and it goes on


def test_copters_answers_to_bad_manners() -> None:
    ground = Ground("ardupilot")
    items = encode.items(PLAN, "ardupilot")
    ground.count(3)
    ground.item(0, items[0])
    assert ground.item(0, items[0])[0].type == 13  # a duplicate; not final:
    assert ground.count(3, system=99)[0].type == 14  # a second uploader
    assert ground.item(1, items[1])[0].get_type() == "MISSION_REQUEST"
    assert ground.item(2, items[2])[0].type == 0
    assert ground.count(651)[0].type == 4
    assert ground.send(mavlink.MAVLink_mission_clear_all_message(1, 1, 255))[0].type == 3


def test_the_link_dies_in_the_middle_of_an_upload() -> None:
    link = FaultyLink(Faults(cut_at_item=2, cut_s=5.0), random.Random(0))
    make = mavlink.MAVLink_mission_item_int_message
    items = [make(1, 1, n, 3, 16, 0, 1, 0, 0, 0, 0, 1, 1, 1, 0) for n in range(4)]
    assert [link.lets_in(one, 10.0) for one in items] == [True, True, False, False]
    assert link.send([mavlink.MAVLink_heartbeat_message(2, 3, 1, 0, 3, 3)], 12.0) == []
    assert link.lets_in(items[3], 15.1)


def test_items_that_are_not_taken() -> None:
    items = list(encode.items(PLAN, "px4"))
    assert Ground("px4").upload(encode.items(PLAN, "ardupilot")) != 0
    nan = [*encode.items(PLAN, "ardupilot")[:2], do(1000, -45.0, 0.0, math.nan, math.nan)]
    assert Ground("ardupilot").upload(nan) == 8  # INVALID_PARAM3
    assert Ground("px4").upload(items) == 0
    assert Ground("px4").upload([*items[:3], Item(18, 3, x=1, y=1, z=20.0)]) == 3


def test_mission_start() -> None:
    copter = Ground("ardupilot")
    assert copter.command(300) == 0  # accepted without mission and disarmed
    assert copter.upload(encode.items(PLAN, "ardupilot")[1:]) == 0  # without home
    copter.command(400, 1)
    assert copter.command(300) == 0
    copter.pass_s(5)
    assert any(m.get_type() == "STATUSTEXT" and "Missing Takeoff" in m.text for m in copter.heard)
    assert not copter.vehicle.pilot.flying
    assert Ground("px4").command(300) == 2


def test_copter_does_not_arm_where_its_last_mission_ended() -> None:
    copter = Ground("ardupilot")
    assert copter.command(176, 1, 3) == 0
    assert copter.command(400, 1) == 4
    assert any(m.get_type() == "STATUSTEXT" and "AUTO mode not armable" in m.text for m in copter.pass_s(1))
    assert copter.command(176, 1, 5) == 0
    assert copter.command(400, 1) == 0


def test_no_streams_until_asked_and_feedback_repeats_then() -> None:
    ground = Ground("ardupilot")
    assert set(names(ground.pass_s(5))) == {"HEARTBEAT"}
    assert ground.command(511, 180, 200_000) == 0
    empty = [m for m in ground.pass_s(2) if m.get_type() == "CAMERA_FEEDBACK"]
    assert len(empty) >= 10
    assert {(m.img_idx, m.time_usec, m.lat, m.lng) for m in empty} == {(0, 0, 0, 0)}  # no photo yet
    assert [ground.command(203, 0, 0, 0, 0, 1) for _ in range(20)] == [0] * 20
    assert len(ground.vehicle.photos) == 1  # accepted does not mean a photo
    told = [m.img_idx for m in ground.pass_s(2) if m.get_type() == "CAMERA_FEEDBACK"]
    assert set(told) == {1}
    assert len(told) >= 10
    assert ground.command(511, 180, -1) == 0
    assert "CAMERA_FEEDBACK" not in names(ground.pass_s(2))


def test_px4s_mission_current_is_no_stream() -> None:
    ground = Ground("px4")
    assert ground.command(511, mavlink.MAVLINK_MSG_ID_MISSION_CURRENT, 500_000) == 4  # FAILED
    assert names(ground.pass_s(5)).count("MISSION_CURRENT") == 5


def test_copter_loses_commands_when_a_mission_is_taken_up_again() -> None:
    """Interrupted between the aim and the photo of a stop: the photo by distance goes on outside AUTO."""
    ground = Ground("ardupilot")
    ground.start()
    ground.until(lambda: len(ground.vehicle.photos) == 3)
    ground.command(176, 1, 5)  # LOITER on the line
    assert ground.vehicle.camera.spacing_m > 0
    waypoint = ground.vehicle.pilot.current
    ground.pass_s(5)
    ground.vehicle.camera.by_distance(0.0)
    ground.command(176, 1, 3)
    assert ground.vehicle.pilot.current == waypoint
    ground.until(lambda: ground.vehicle.pilot.current > waypoint)
    assert len(ground.vehicle.photos) <= 4  # none of the line's but its last, by command


def test_px4_stops_the_photos_and_goes_back() -> None:
    ground = Ground("px4")
    ground.start()
    ground.until(lambda: len(ground.vehicle.photos) == 3)
    item = ground.vehicle.pilot.current
    ground.command(176, 1, 4, 3)
    assert ground.vehicle.camera.spacing_m == 0
    ground.command(176, 1, 4, 4)
    assert ground.vehicle.pilot.current <= item
    ground.until(lambda: ground.vehicle.done)
    reached = [m.seq for m in ground.heard if m.get_type() == "MISSION_ITEM_REACHED"]
    assert len(reached) > len(set(reached))  # repeats
    assert not {CAM for CAM in names(ground.heard) if CAM == "CAMERA_FEEDBACK"}


def test_px4_turns_its_gimbal_only_for_whom_it_is_given_to() -> None:
    """A mission that does not take the gimbal looks ahead on all photos (flown with PX4)."""
    items = encode.items(PLAN, "px4")
    without = [item for item in items if item.command != mav.DO_GIMBAL_MANAGER_CONFIGURE]
    assert len(without) == len(items) - 1
    for mission, taken in ((items, True), (without, False)):
        ground = Ground("px4")
        assert ground.upload(mission) == 0
        assert ground.command(400, 1) == 0
        assert ground.command(300) == 0
        ground.until(lambda: ground.vehicle.done)  # noqa: B023
        level = [photo.pitch_deg == 0 for photo in ground.vehicle.photos]
        assert len(level) == len(triggered(PLAN))
        assert not any(level) if taken else all(level)
    assert Ground("px4").command(1000, -90.0) == 2  # DENIED


def test_px4_turns_the_gimbal_ahead_where_a_mission_is_left_and_back_where_it_is_taken_up() -> None:
    ground = Ground("px4")
    ground.start()
    ground.until(lambda: len(ground.vehicle.photos) == 3)
    aim = ground.vehicle.body.gimbal_pitch_deg
    assert aim < -80
    ground.command(176, 1, 4, 3)
    ground.pass_s(3)
    assert ground.vehicle.body.gimbal_pitch_deg == 0
    ground.command(176, 1, 4, 4)
    ground.until(lambda: len(ground.vehicle.photos) == 5)
    assert ground.vehicle.body.gimbal_pitch_deg == aim


@pytest.mark.parametrize("stabilised", [0.0, 1.0])
def test_the_angles_of_servos_that_px4_holds_level(stabilised: float) -> None:
    """Told, though with lock flags, as the servos stand; read as such they are the camera's."""
    ground = Ground("px4", parameters=(("MNT_DO_STAB", stabilised),))
    ground.command(511, 285, 1e5)
    ground.command(511, 30, 1e5)
    ground.start()
    ground.until(lambda: len(ground.vehicle.photos) == 3)
    told = {m.get_type(): m.pack(mavlink.MAVLink(None, 1, 1)) for m in ground.heard}
    heard = {name: mavlink.MAVLink(None).parse_buffer(sent)[0] for name, sent in told.items()}
    context = Context(ev.Autopilot.PX4, stabilised == 1)
    vehicle = decode(from_pymavlink(heard["ATTITUDE"]), context)
    gimbal = decode(from_pymavlink(heard["GIMBAL_DEVICE_ATTITUDE_STATUS"]), context)
    assert isinstance(vehicle, ev.Attitude)
    assert isinstance(gimbal, ev.GimbalAttitude)
    assert abs(vehicle.angles.pitch_deg) > 3
    earth = earth_angles(gimbal, vehicle.angles)
    assert earth is not None
    assert earth.pitch_deg == pytest.approx(-90, abs=1.0)
    captured = angles_of(heard["CAMERA_IMAGE_CAPTURED"].q)
    assert captured is not None
    assert (abs(captured.pitch_deg + 90) < 0.1) is (stabilised == 0)


def test_a_mission_cleared_in_flight() -> None:
    for flavour, flying_on in (("ardupilot", True), ("px4", False)):
        ground = Ground(flavour)  # type: ignore[arg-type]
        ground.start()
        ground.until(lambda: ground.vehicle.pilot.flying)  # noqa: B023
        ack = ground.send(mavlink.MAVLink_mission_clear_all_message(1, 1, 0))[0]
        assert (ack.type == 0) is not flying_on
        assert (ground.vehicle.pilot.mode == "mission") is flying_on


@pytest.mark.parametrize("restarted", [False, True])
def test_copter_begins_a_mission_uploaded_in_the_air_where_the_old_one_was_left(restarted: bool) -> None:
    """Its first photos are missing then, unless the pilot restarts it (from the source of 4.7)."""
    ground = Ground("ardupilot")
    ground.start()
    ground.until(lambda: len(ground.vehicle.photos) == 9)
    ground.command(176, 1, 4)  # GUIDED holds
    extra = plan_of(*orbit(5, radius=20.0, height=40.0), speed_m_s=5.0)
    assert ground.upload(encode.items(extra, "ardupilot")) == 0
    if restarted:
        assert ground.command(224, 1, 1) == 0
    assert ground.command(300) == 0
    ground.until(lambda: ground.vehicle.done)
    taken = len(ground.vehicle.photos) - 9
    assert taken == 5 if restarted else taken < 5


def test_a_shorter_mission_in_flight_leaves_copter_at_the_vanished_item() -> None:
    ground = Ground("ardupilot")
    ground.start()
    ground.until(lambda: len(ground.vehicle.photos) == 9)
    goal = ground.vehicle.body.goal_m
    assert ground.upload(encode.items(PLAN, "ardupilot")[:8]) == 0
    assert ground.vehicle.body.goal_m == goal
    ground.pass_s(60)
    assert ground.vehicle.pilot.stage == "complete"
    assert ground.command(224, 1, 1) == 0
    assert ground.vehicle.pilot.stage == "active"


def test_pin_counts_in_boot_time_and_the_battery_drains() -> None:
    ground = Ground("ardupilot", feedback_pin=True, endurance_s=300.0)
    ground.command(511, 147, 1e6)
    ground.start()
    ground.until(lambda: ground.vehicle.done)
    told = [m for m in ground.heard if m.get_type() == "CAMERA_FEEDBACK"]
    assert [m.completed_captures for m in told] == list(range(1, 14))
    assert all(m.time_usec < 1e9 for m in told)
    left = [m.battery_remaining for m in ground.heard if m.get_type() == "BATTERY_STATUS"]
    assert left[0] > 95
    assert left[-1] < 70
    assert left == sorted(left, reverse=True)

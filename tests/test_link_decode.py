"""The decode table, fed by both adapters with messages as pymavlink encodes them."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest

mavlink: Any = pytest.importorskip(
    "pymavlink.dialects.v20.ardupilotmega", reason="pip install fieldcal[flight]"
)

from calib.errors import FormatError  # noqa: E402
from daemon.link import events as ev  # noqa: E402
from daemon.link.attitude import angles_of, earth_angles, quaternion_of  # noqa: E402
from daemon.link.decode import Context, decode, servo_mount  # noqa: E402
from daemon.link.message import Message, from_mavsdk, from_pymavlink  # noqa: E402

NAN = math.nan
ARDUPILOT = Context(ev.Autopilot.ARDUPILOT, servo_mount=True)
PX4 = Context(ev.Autopilot.PX4)


def over_the_wire(message: Any, component: int = 1) -> Any:
    sent = message.pack(mavlink.MAVLink(None, 1, component))
    (heard,) = mavlink.MAVLink(None).parse_buffer(sent)
    return heard


def as_mavsdk(heard: Any) -> Message:
    """The JSON of MAVSDK's mavlink_direct: NaN is null, the rest as it is."""
    fields = {k: v for k, v in heard.to_dict().items() if k != "mavpackettype"}
    plain = {
        k: [None if x != x else x for x in v] if isinstance(v, list) else None if v != v else v
        for k, v in fields.items()
    }
    text = json.dumps({"message_id": heard.get_msgId(), "message_name": heard.get_type()} | plain)
    return from_mavsdk(heard.get_type(), text, heard.get_srcSystem(), heard.get_srcComponent())


def read(message: Any, context: Context = ARDUPILOT, component: int = 1) -> Any:
    """The event, the same through both adapters."""
    heard = over_the_wire(message, component)
    event = decode(from_pymavlink(heard), context)
    assert decode(as_mavsdk(heard), context) == event
    return event


def heartbeat(autopilot: int, base: int, custom: int, kind: int = 2) -> Any:
    return read(mavlink.MAVLink_heartbeat_message(kind, autopilot, base, custom, 4, 3))


def test_heartbeats() -> None:
    assert heartbeat(3, 129, 3) == ev.Heartbeat(ev.Autopilot.ARDUPILOT, True, "auto", True, False)
    assert heartbeat(3, 1, 5) == ev.Heartbeat(ev.Autopilot.ARDUPILOT, False, "loiter", False, True)
    assert heartbeat(12, 129, 4 << 16 | 4 << 24) == ev.Heartbeat(
        ev.Autopilot.PX4, True, "mission", True, False
    )
    assert heartbeat(12, 129, 4 << 16 | 3 << 24).holding
    assert heartbeat(12, 1, 1 << 16).mode == "manual"
    assert heartbeat(3, 1, 99).mode == "99"
    assert heartbeat(8, 0, 0, kind=6) is None  # a ground station
    assert heartbeat(8, 0, 0, kind=30) is None  # a camera


def test_position_units_and_unknowns() -> None:
    make = mavlink.MAVLink_global_position_int_message
    event = read(make(1500, 471234567, -85000000, 512340, -2500, 100, -200, 50, 35999))
    assert event == ev.Position(
        1.5, pytest.approx(47.1234567), pytest.approx(-8.5), 512.34, -2.5, (-2.0, 1.0, -0.5), 359.99
    )
    assert read(make(1, 1, 0, 0, 0, 0, 0, 0, 65535)).yaw_deg is None
    assert read(make(1, 0, 0, 0, 0, 0, 0, 0, 0)) is None  # no place yet
    assert read(make(1, 0, 85000000, 0, 0, 0, 0, 0, 0)).latitude_deg == 0.0  # on the equator


def test_attitude_in_degrees() -> None:
    event = read(mavlink.MAVLink_attitude_message(250, 0.1, -0.2, -math.pi / 2, 0, 0, 0))
    assert event.vehicle_boot_s == 0.25
    assert event.angles.yaw_deg == pytest.approx(270, abs=1e-4)
    assert event.angles.pitch_deg == pytest.approx(math.degrees(-0.2), abs=1e-4)


def gimbal(pitch: float, yaw: float, flags: int, context: Context, component: int = 1) -> Any:
    q = list(quaternion_of(ev.Angles(0.0, pitch, yaw)))
    make = mavlink.MAVLink_gimbal_device_attitude_status_message
    return read(make(0, 0, 2000, flags, q, NAN, NAN, NAN, 0), context, component)


def test_a_servo_mount_tells_body_angles_despite_its_lock_flags() -> None:
    """-67.5 was told while the camera looked straight down, the vehicle leaning by 22.5."""
    told = gimbal(-67.5, 0.0, 4 | 8, ARDUPILOT)
    assert told.frame is ev.AngleFrame.BODY
    earth = earth_angles(told, ev.Angles(0.0, -22.5, 120.0))
    assert earth is not None
    assert earth.pitch_deg == pytest.approx(-90, abs=1e-2)
    unsure = gimbal(-67.5, 0.0, 4 | 8, Context(ev.Autopilot.ARDUPILOT))
    assert unsure.frame is ev.AngleFrame.UNSURE
    assert earth_angles(unsure, ev.Angles(0.0, 0.0, 0.0)) is None


def test_servos_that_px4_holds_level_tell_body_angles_too() -> None:
    """-54.4 was told, with both lock flags, of a camera straight down, the vehicle pitched by -35.5."""
    stabilised = {"MNT_MODE_OUT": 0.0, "MNT_DO_STAB": 1.0}
    assert servo_mount(ev.Autopilot.PX4, stabilised) is True
    assert servo_mount(ev.Autopilot.PX4, stabilised | {"MNT_DO_STAB": 0.0}) is False  # it does that itself
    assert servo_mount(ev.Autopilot.PX4, stabilised | {"MNT_MODE_OUT": 2.0}) is False
    assert servo_mount(ev.Autopilot.PX4, {}) is None
    context = Context(ev.Autopilot.PX4, servo_mount=True)
    told = gimbal(-54.4, 0.0, 4 | 8, context)
    assert told.frame is ev.AngleFrame.BODY
    earth = earth_angles(told, ev.Angles(0.0, -35.5, 120.0))
    assert earth is not None
    assert earth.pitch_deg == pytest.approx(-89.9, abs=0.1)
    assert gimbal(-54.4, 0.0, 4 | 8, context, component=154).frame is ev.AngleFrame.LEVEL
    turned = mavlink.MAVLink_mount_orientation_message(1000, 1.0, -54.4, 0.0, 120.0)
    assert read(turned, context) == ev.GimbalAttitude(
        1.0, ev.Angles(1.0, pytest.approx(-54.4, abs=1e-4), 0.0), ev.AngleFrame.BODY
    )


def test_px4_tells_its_own_attitude_of_a_photo_without_a_gimbal() -> None:
    """And with a servo mount, the turns of its servos with its heading: the camera's are in neither."""
    q = list(quaternion_of(ev.Angles(1.0, -32.3, 19.6)))
    message = mavlink.MAVLink_camera_image_captured_message(9, 0, 1, 1, 1, 1, 1, q, 4, 1, b"")
    fixed = read(message, Context(ev.Autopilot.PX4, gimbal=False))
    assert fixed.camera_angles is None
    assert fixed.vehicle_angles.pitch_deg == pytest.approx(-32.3, abs=1e-3)
    servos = read(message, Context(ev.Autopilot.PX4, servo_mount=True))
    assert (servos.camera_angles, servos.vehicle_angles) == (None, None)
    other = read(message, Context(ev.Autopilot.PX4, servo_mount=True, gimbal=False), component=100)
    assert other.camera_angles.pitch_deg == pytest.approx(-32.3, abs=1e-3)


def test_other_gimbals_tell_the_truth() -> None:
    level = gimbal(-40.0, 10.0, 4 | 8, PX4)
    assert level.frame is ev.AngleFrame.LEVEL
    earth = earth_angles(level, ev.Angles(0.0, -22.5, 355.0))
    assert earth is not None
    assert (earth.pitch_deg, earth.yaw_deg) == (pytest.approx(-40, abs=1e-3), pytest.approx(5, abs=1e-3))
    assert gimbal(-40.0, 10.0, 4 | 8 | 16, PX4).frame is ev.AngleFrame.EARTH
    assert gimbal(-40.0, 10.0, 4 | 8 | 16, ARDUPILOT, component=154).frame is ev.AngleFrame.EARTH
    make = mavlink.MAVLink_gimbal_device_attitude_status_message
    assert read(make(0, 0, 1, 12, [NAN] * 4, NAN, NAN, NAN, 0), PX4) is None
    orientation = read(mavlink.MAVLink_mount_orientation_message(1000, 1.0, -30.0, -5.0, 200.0), PX4)
    assert orientation == ev.GimbalAttitude(1.0, ev.Angles(1.0, -30.0, 200.0), ev.AngleFrame.EARTH)


def test_mount_status_is_in_hundredths_of_a_degree() -> None:
    event = read(mavlink.MAVLink_mount_status_message(0, 0, -4550, 100, -1000))
    assert event.angles == ev.Angles(1.0, -45.5, 350.0)
    assert event.vehicle_boot_s is None


@pytest.mark.parametrize("angles", [(0, 0, 0), (10, -40, 350), (-170, 80, 90), (0, -90, 33), (0, 90, 200)])
def test_angles_survive_the_quaternion(angles: tuple[float, float, float]) -> None:
    found = angles_of(quaternion_of(ev.Angles(*angles)))
    assert found is not None
    assert (found.roll_deg, found.pitch_deg, found.yaw_deg) == pytest.approx(angles, abs=1e-4)


def feedback(usec: int, index: int = 7, completed: int = 0, lat: int = 471234567) -> Any:
    make = mavlink.MAVLink_camera_feedback_message
    return make(usec, 0, 0, index, lat, 85000000, 500.5, 60.25, 1.0, -5.0, 270.0, 0.0, 0, completed)


def test_feedback_in_either_clock() -> None:
    utc = read(feedback(1_780_000_000_250_000))
    assert (utc.utc_s, utc.vehicle_boot_s) == (1_780_000_000.25, None)
    assert (utc.index, utc.camera, utc.completed) == (7, 0, None)
    assert (utc.altitude_msl_m, utc.height_m) == (500.5, 60.25)
    assert utc.vehicle_angles == ev.Angles(1.0, -5.0, 270.0)
    assert utc.camera_angles is None  # they are the vehicle's
    boot = read(feedback(12_500_000, completed=7))
    assert (boot.utc_s, boot.vehicle_boot_s, boot.completed) == (None, 12.5, 7)


def test_a_feedback_before_the_first_photo_is_no_photo() -> None:
    """As ArduCopter 4.7 sends it when it is asked for the message before it has taken a photo."""
    make = mavlink.MAVLink_camera_feedback_message
    assert read(make(0, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0)) is None


def test_px4_trigger_and_captured() -> None:
    trigger = read(mavlink.MAVLink_camera_trigger_message(12_500_000, 4), PX4)
    assert trigger == ev.PhotoReport(ev.PhotoSource.TRIGGER, 1, 0, 4, 12.5, None)
    q = list(quaternion_of(ev.Angles(0.0, -60.0, 90.0)))
    make = mavlink.MAVLink_camera_image_captured_message
    message = make(12_500, 0, 0, 471234567, 85000000, 500_500, 60_250, q, 4, 1, b"http://a/b.jpg")
    captured = read(message, PX4)
    assert (captured.vehicle_boot_s, captured.utc_s, captured.confirmed) == (12.5, None, True)
    assert captured.altitude_msl_m == 500.5
    assert captured.height_m is None  # the distance to the ground
    assert captured.camera_angles.pitch_deg == pytest.approx(-60, abs=1e-3)
    assert captured.url == "http://a/b.jpg"
    camera = read(message, ARDUPILOT, component=100)
    assert camera.vehicle_boot_s is None  # its own clock
    assert camera.height_m == 60.25
    still = read(make(1, 0, 0, 0, 0, 0, 0, [1, 0, 0, 0], 0, 0, b""), PX4)
    assert (still.camera_angles, still.latitude_deg, still.confirmed) == (None, None, False)


def test_mission_state() -> None:
    make = mavlink.MAVLink_mission_current_message
    assert read(make(3, 9, 3, 0)) == ev.MissionCurrent(3, 9, ev.MissionState.ACTIVE, 0)
    none = read(make(0, 65535, 0, 0), PX4)
    assert (none.total, none.state) == (None, ev.MissionState.NONE)
    assert read(make(2, 9, 0, 0), PX4).state is ev.MissionState.UNKNOWN
    assert read(mavlink.MAVLink_mission_item_reached_message(5)) == ev.ItemReached(5)


def test_battery_with_and_without_knowledge() -> None:
    make = mavlink.MAVLink_battery_status_message
    full = read(make(0, 0, 3, 32767, [4100, 4000, 3900] + [65535] * 7, 1550, 320, -1, 75))
    assert full == ev.Battery(0, pytest.approx(12.0), 15.5, 0.75, 0.32)
    assert read(make(1, 0, 3, 32767, [65535] * 10, -1, -1, -1, -1)) == ev.Battery(1, *[None] * 4)


def test_health_of_the_estimate_is_not_the_prearm_bit() -> None:
    sys = mavlink.MAVLink_sys_status_message(0, 0, 1 << 28, 250, 12000, -1, -1, 150, 0, 0, 0, 0, 0)
    assert read(sys) == ev.Health(True, 0.25, 0.015)
    ekf = mavlink.MAVLink_ekf_status_report_message
    assert not read(ekf(0b10100111, 0, 0, 0, 0, 0)).absolute_position
    assert read(ekf(0b1100111111, 0, 0, 0, 0, 0)).absolute_position


def test_times_texts_and_answers() -> None:
    assert read(mavlink.MAVLink_timesync_message(5_000_000_000, 1_500_000_000)) == ev.TimeSync(5.0, 1.5)
    assert read(mavlink.MAVLink_timesync_message(0, 77)) is None  # a question
    time = mavlink.MAVLink_system_time_message
    assert read(time(1_780_000_000_000_000, 2500)) == ev.SystemTime(2.5, 1_780_000_000.0)
    assert read(time(0, 2500)).utc_s is None
    assert read(time(30_000_000, 2500)).utc_s is None  # no date yet
    assert read(mavlink.MAVLink_statustext_message(3, b"PreArm: no")).text == "PreArm: no"
    assert read(mavlink.MAVLink_command_ack_message(400, 5, 40)) == ev.CommandAck(400, 5, 40)
    assert read(mavlink.MAVLink_command_ack_message(400, 0)) == ev.CommandAck(400, 0, None)
    home = read(mavlink.MAVLink_home_position_message(471234567, 1, 500_000, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0))
    assert home == ev.HomePosition(pytest.approx(47.1234567), pytest.approx(1e-7), 500.0)
    assert read(mavlink.MAVLink_extended_sys_state_message(0, 2)).on_ground is False
    fix = read(mavlink.MAVLink_gps_raw_int_message(0, 3, 1, 1, 0, 0, 0, 0, 0, 255, 0, 1500, 0, 0, 0))
    assert fix == ev.GnssFix(3, None, 1.5, None)


def test_damaged_json_and_missing_fields() -> None:
    with pytest.raises(FormatError, match="ATTITUDE"):
        from_mavsdk("ATTITUDE", '{"roll": 1', 1, 1)
    with pytest.raises(FormatError, match="fields"):
        from_mavsdk("ATTITUDE", "[]", 1, 1)
    from daemon.link.decode import TABLE

    for name in TABLE:  # an older dialect has fewer fields
        decode(from_mavsdk(name, "{}", 1, 1), ARDUPILOT)
        nulls = '{"q": null, "time_usec": null, "roll": null, "voltages": null, "text": null, "lat": null}'
        decode(from_mavsdk(name, nulls, 1, 1), PX4)

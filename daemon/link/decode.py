"""The one table from MAVLink message to event.

Pure: one message in, one event or none out. What needs memory (a photo reported twice, an item
reached twice) is counted by :mod:`daemon.link.triggers` and :mod:`daemon.link.progress`.
Messages of no use here are named in :data:`IGNORED`, so that an unknown one can be logged (once).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from daemon.link import events as ev
from daemon.link.attitude import angles_of
from daemon.link.message import Message
from daemon.link.modes import heartbeat

#: A time in microseconds from here on (2001) can only be UTC; before it, only time since boot (32 years).
UTC_FROM_US = 10**15
#: Components that are an autopilot, a camera (100-105, or attached to the autopilot).
_AUTOPILOT_COMPONENT = 1
#: MAV_PARAM_TYPE: whole numbers of up to 32 bits.
_WHOLE_PARAMETERS = frozenset(range(1, 7))
_HEARTBEAT_TYPES_NOT_FLYING = frozenset({5, 6, 18, 26, 27, 30})  # tracker, ground station, companion...


@dataclass(frozen=True)
class Context:
    """What else has to be known to read a message. ``servo_mount``: a mount that the autopilot itself holds
    level (see :func:`servo_mount`), so its angles are the body's, whatever its flags say; None: not known.
    ``gimbal``: the vehicle has told of one."""

    autopilot: ev.Autopilot = ev.Autopilot.OTHER
    servo_mount: bool | None = None
    gimbal: bool = True


#: What tells of a servo mount.
MOUNT_PARAMETERS: Mapping[ev.Autopilot, tuple[str, ...]] = {
    ev.Autopilot.ARDUPILOT: ("MNT1_TYPE",),
    ev.Autopilot.PX4: ("MNT_MODE_OUT", "MNT_DO_STAB"),
    ev.Autopilot.OTHER: (),
}


def servo_mount(autopilot: ev.Autopilot, parameters: Mapping[str, float]) -> bool | None:
    """Whether the autopilot moves a mount's servos against the vehicle's turns; None: not known.

    ArduPilot's servo mount; PX4's servos (MNT_MODE_OUT 0) where it stabilises all axes (MNT_DO_STAB 1).
    """
    found = [parameters.get(name) for name in MOUNT_PARAMETERS[autopilot]]
    if not found or None in found:
        return None
    return found == ([1.0] if autopilot is ev.Autopilot.ARDUPILOT else [0.0, 1.0])


def decode(message: Message, context: Context) -> ev.Event | None:
    """The event in ``message``; None where it holds nothing, or is not in the table."""
    reader = TABLE.get(message.name)
    return None if reader is None else reader(message, context)


def is_known(name: str) -> bool:
    """In the table, or left out on purpose."""
    return name in TABLE or name in IGNORED


def _heartbeat(m: Message, _: Context) -> ev.Event | None:
    if m.integer("type") in _HEARTBEAT_TYPES_NOT_FLYING or m.integer("autopilot", 8) == 8:
        return None
    return heartbeat(m.integer("autopilot"), m.integer("base_mode"), m.integer("custom_mode"))


def _position(m: Message, _: Context) -> ev.Event | None:
    place = _place(m, "lat", "lon")
    if place is None:
        return None
    yaw = m.known("hdg", 65535)
    east, north, down = (m.integer(name) / 100 for name in ("vy", "vx", "vz"))
    return ev.Position(
        m.integer("time_boot_ms") / 1e3,
        *place,
        m.integer("alt") / 1e3,
        m.integer("relative_alt") / 1e3,
        (east, north, -down),
        None if yaw is None else yaw / 100 % 360,
    )


def _gnss(m: Message, _: Context) -> ev.Event:
    satellites = m.known("satellites_visible", 255)
    accuracies = _accuracy_m(m, "h_acc"), _accuracy_m(m, "v_acc")
    return ev.GnssFix(
        m.integer("fix_type"), satellites, *accuracies, _dilution(m, "eph"), _dilution(m, "epv")
    )


def _attitude(m: Message, _: Context) -> ev.Event | None:
    roll, pitch, yaw = (m.number(name) for name in ("roll", "pitch", "yaw"))
    if roll is None or pitch is None or yaw is None:
        return None
    angles = ev.Angles(math.degrees(roll), math.degrees(pitch), math.degrees(yaw) % 360)
    return ev.Attitude(m.integer("time_boot_ms") / 1e3, angles)


def _gimbal(m: Message, context: Context) -> ev.Event | None:
    angles = angles_of(m.numbers("q"))
    if angles is None:
        return None
    flags = m.integer("flags")
    in_vehicle, in_earth, yaw_lock = flags & 32, flags & 64, flags & 16
    claimed = ev.AngleFrame.EARTH if in_earth or (yaw_lock and not in_vehicle) else ev.AngleFrame.LEVEL
    frame = claimed
    if context.autopilot is ev.Autopilot.ARDUPILOT and m.component_id == _AUTOPILOT_COMPONENT:
        # Only a separate gimbal component measures itself; a servo mount repeats its servos' angles.
        frame = {True: ev.AngleFrame.BODY, False: claimed, None: ev.AngleFrame.UNSURE}[context.servo_mount]
    elif context.servo_mount and m.component_id == _AUTOPILOT_COMPONENT:
        frame = ev.AngleFrame.BODY
    return ev.GimbalAttitude(m.integer("time_boot_ms") / 1e3, angles, frame)


def _mount(m: Message, context: Context) -> ev.Event:
    roll, pitch, yaw = (m.integer(f"pointing_{axis}") / 100 for axis in "bac")
    frame = ev.AngleFrame.BODY if context.servo_mount else ev.AngleFrame.UNSURE
    return ev.GimbalAttitude(None, ev.Angles(roll, pitch, yaw % 360), frame)


def _mount_orientation(m: Message, context: Context) -> ev.Event | None:
    """PX4: pitch and roll from the horizon, yaw from the nose or (where given) from north."""
    roll, pitch, yaw = (m.number(name) for name in ("roll", "pitch", "yaw"))
    north = m.number("yaw_absolute")
    if roll is None or pitch is None or (yaw is None and north is None):
        return None
    frame = ev.AngleFrame.LEVEL if north is None else ev.AngleFrame.EARTH
    if context.servo_mount:
        north, frame = None, ev.AngleFrame.BODY
    found = north if north is not None else yaw or 0.0
    return ev.GimbalAttitude(m.integer("time_boot_ms") / 1e3, ev.Angles(roll, pitch, found % 360), frame)


def _camera_pose(m: Message, _: Context) -> ev.Event | None:
    place, angles = _place(m, "lat_camera", "lon_camera"), angles_of(m.numbers("q"))
    if place is None or angles is None:
        return None
    return ev.CameraPose(m.integer("time_boot_ms") / 1e3, *place, m.integer("alt_camera") / 1e3, angles)


def _feedback(m: Message, _: Context) -> ev.Event | None:
    """ArduPilot. UTC, or with a feedback pin time since boot; only then ``completed_captures`` counts.

    Asked for before its first photo it sends one all of zeros, which is no photo (measured).
    """
    if m.integer("time_usec") == 0:
        return None
    boot_s, utc_s = _either(m.integer("time_usec"))
    roll, pitch, yaw = (m.number(name) for name in ("roll", "pitch", "yaw"))
    angles = None
    if roll is not None and pitch is not None and yaw is not None:
        angles = ev.Angles(roll, pitch, yaw % 360)
    place = _place(m, "lat", "lng")
    placed = place is not None
    return ev.PhotoReport(
        ev.PhotoSource.FEEDBACK,
        m.component_id,
        m.integer("cam_idx"),
        m.integer("img_idx"),
        boot_s,
        utc_s,
        latitude_deg=place[0] if place else None,
        longitude_deg=place[1] if place else None,
        altitude_msl_m=m.number("alt_msl") if placed else None,
        height_m=m.number("alt_rel") if placed else None,
        vehicle_angles=angles,
        completed=m.known("completed_captures", 0),
    )


def _trigger(m: Message, _: Context) -> ev.Event:
    boot_s, utc_s = _either(m.integer("time_usec"))
    return ev.PhotoReport(ev.PhotoSource.TRIGGER, m.component_id, 0, m.integer("seq"), boot_s, utc_s)


def _captured(m: Message, context: Context) -> ev.Event:
    """``relative_alt`` is the height above home, but on PX4 the distance to the ground (not passed on).

    The boot time is the sender's: a separate camera has its own clock, so only the autopilot's counts.
    PX4's attitude is the vehicle's where it has no gimbal, and neither's with a servo mount (measured).
    """
    place = _place(m, "lat", "lon")
    placed = place is not None
    own_clock = m.component_id == _AUTOPILOT_COMPONENT
    above_home = placed and context.autopilot is not ev.Autopilot.PX4
    _, utc_s = _either(m.integer("time_utc"))
    boot_ms = m.integer("time_boot_ms")
    angles = _camera_angles(m)
    of_px4 = own_clock and context.autopilot is ev.Autopilot.PX4
    of_camera = not of_px4 or (context.gimbal and not context.servo_mount)
    return ev.PhotoReport(
        # Beside PX4's own report of a photo its camera's may come: two sources, each with its numbers.
        ev.PhotoSource.CAPTURED if own_clock else ev.PhotoSource.CAMERA,
        m.component_id,
        m.integer("camera_id"),
        m.integer("image_index"),
        boot_ms / 1e3 if own_clock and boot_ms > 0 else None,
        utc_s,
        latitude_deg=place[0] if place else None,
        longitude_deg=place[1] if place else None,
        altitude_msl_m=m.integer("alt") / 1e3 if placed else None,
        height_m=m.integer("relative_alt") / 1e3 if above_home else None,
        vehicle_angles=angles if of_px4 and not context.gimbal else None,
        camera_angles=angles if of_camera else None,
        confirmed={1: True, 0: False}.get(m.integer("capture_result", -1)),
        url=m.text("file_url"),
    )


def _camera_angles(m: Message) -> ev.Angles | None:
    """A quaternion of no rotation, level and to the north, is what senders without a gimbal fill in."""
    numbers = m.numbers("q")
    return None if numbers[:1] == (1.0,) and not any(numbers[1:]) else angles_of(numbers)


def _mission_current(m: Message, _: Context) -> ev.Event:
    total = m.known("total", 65535)
    states = {
        **{1: ev.MissionState.NONE, 2: ev.MissionState.NOT_STARTED, 3: ev.MissionState.ACTIVE},
        **{4: ev.MissionState.PAUSED, 5: ev.MissionState.COMPLETE},
    }
    state = states.get(m.integer("mission_state"), ev.MissionState.UNKNOWN)
    if state is ev.MissionState.UNKNOWN and total is None:
        state = ev.MissionState.NONE
    return ev.MissionCurrent(m.integer("seq"), total, state, m.integer("mission_id"))


def _reached(m: Message, _: Context) -> ev.Event:
    return ev.ItemReached(m.integer("seq"))


def _battery(m: Message, _: Context) -> ev.Event:
    cells = [v / 1e3 for v in m.numbers("voltages") if 0 < v < 65535]
    cells += [v / 1e3 for v in m.numbers("voltages_ext") if 0 < v < 65535]
    current, remaining = m.known("current_battery", -1), m.known("battery_remaining", -1)
    used = m.known("current_consumed", -1)
    return ev.Battery(
        m.integer("id"),
        sum(cells) if cells else None,
        None if current is None else current / 100,
        None if remaining is None else remaining / 100,
        None if used is None else used / 1000,
    )


def _health(m: Message, _: Context) -> ev.Event:
    prearm = 1 << 28
    ready = bool(m.integer("onboard_control_sensors_health") & prearm)
    return ev.Health(ready, m.integer("load") / 1000, m.integer("drop_rate_comm") / 10_000)


def _ekf(m: Message, _: Context) -> ev.Event:
    """Absolute horizontal position without "constant position" (7) or "uninitialised" (10)."""
    flags = m.integer("flags")
    return ev.EstimatorHealth(bool(flags & 16) and not flags & (1 << 7 | 1 << 10))


def _estimator(m: Message, _: Context) -> ev.Event:
    flags = m.integer("flags")
    return ev.EstimatorHealth(bool(flags & 16) and not flags & (1 << 7))


def _home(m: Message, _: Context) -> ev.Event | None:
    place = _place(m, "latitude", "longitude")
    return None if place is None else ev.HomePosition(*place, m.integer("altitude") / 1e3)


def _text(m: Message, _: Context) -> ev.Event:
    return ev.StatusText(m.integer("severity"), m.text("text"), m.integer("id"), m.integer("chunk_seq"))


def _ack(m: Message, _: Context) -> ev.Event:
    result = m.integer("result")
    progress = m.known("progress", 255) if result == 5 else None
    return ev.CommandAck(m.integer("command"), result, progress)


def _timesync(m: Message, _: Context) -> ev.Event | None:
    """Only answers: the vehicle's own questions have no time of its own in them (tc1 is 0)."""
    vehicle_ns = m.integer("tc1")
    return None if vehicle_ns == 0 else ev.TimeSync(vehicle_ns / 1e9, m.integer("ts1") / 1e9)


def _system_time(m: Message, _: Context) -> ev.Event:
    return ev.SystemTime(m.integer("time_boot_ms") / 1e3, _either(m.integer("time_unix_usec"))[1])


def _landed(m: Message, _: Context) -> ev.Event:
    return ev.LandedState({1: True, 2: False, 3: False, 4: False}.get(m.integer("landed_state")))


def _radio(m: Message, _: Context) -> ev.Event:
    return ev.Radio(m.integer("rssi"), m.integer("remrssi"), m.integer("rxerrors"))


def _parameter(m: Message, context: Context) -> ev.Event | None:
    """PX4 sends whole numbers as the bits of a float, ArduPilot as their value."""
    name, value = m.text("param_id"), m.number("param_value")
    if not name:
        return None
    whole = m.integer("param_type") in _WHOLE_PARAMETERS
    if context.autopilot is ev.Autopilot.PX4 and whole:
        if value is None:  # bits that make no number: a negative whole one
            return None
        return ev.Parameter(name, float(struct.unpack("<i", struct.pack("<f", value))[0]))
    return None if value is None else ev.Parameter(name, value)


def _firmware(m: Message, _: Context) -> ev.Event | None:
    version = m.integer("flight_sw_version")
    return ev.Firmware(".".join(str(version >> shift & 0xFF) for shift in (24, 16, 8))) if version else None


TABLE: dict[str, Callable[[Message, Context], ev.Event | None]] = {
    "HEARTBEAT": _heartbeat,
    "GLOBAL_POSITION_INT": _position,
    "GPS_RAW_INT": _gnss,
    "ATTITUDE": _attitude,
    "GIMBAL_DEVICE_ATTITUDE_STATUS": _gimbal,
    "MOUNT_STATUS": _mount,
    "MOUNT_ORIENTATION": _mount_orientation,
    "CAMERA_FOV_STATUS": _camera_pose,
    "CAMERA_FEEDBACK": _feedback,
    "CAMERA_TRIGGER": _trigger,
    "CAMERA_IMAGE_CAPTURED": _captured,
    "MISSION_CURRENT": _mission_current,
    "MISSION_ITEM_REACHED": _reached,
    "BATTERY_STATUS": _battery,
    "SYS_STATUS": _health,
    "EKF_STATUS_REPORT": _ekf,
    "ESTIMATOR_STATUS": _estimator,
    "HOME_POSITION": _home,
    "STATUSTEXT": _text,
    "COMMAND_ACK": _ack,
    "TIMESYNC": _timesync,
    "SYSTEM_TIME": _system_time,
    "EXTENDED_SYS_STATE": _landed,
    "RADIO_STATUS": _radio,
    "PARAM_VALUE": _parameter,
    "AUTOPILOT_VERSION": _firmware,
}

#: Seen on links and of no use here: transfers that the client library handles, and raw sensors.
IGNORED = frozenset(
    """
    AHRS AHRS2 ALTITUDE ATTITUDE_QUATERNION ATTITUDE_TARGET CURRENT_EVENT_SEQUENCE
    CAMERA_CAPTURE_STATUS CAMERA_INFORMATION CAMERA_SETTINGS COMMAND_INT COMMAND_LONG EVENT FENCE_STATUS
    FILE_TRANSFER_PROTOCOL GIMBAL_MANAGER_INFORMATION GIMBAL_MANAGER_STATUS GPS2_RAW GPS_GLOBAL_ORIGIN
    HIGHRES_IMU HWSTATUS LINK_NODE_STATUS LOCAL_POSITION_NED MCU_STATUS MEMINFO MISSION_ACK MISSION_COUNT
    MISSION_ITEM MISSION_ITEM_INT MISSION_REQUEST MISSION_REQUEST_INT MISSION_REQUEST_LIST
    NAV_CONTROLLER_OUTPUT ODOMETRY OPEN_DRONE_ID_LOCATION PING POSITION_TARGET_GLOBAL_INT
    POSITION_TARGET_LOCAL_NED POWER_STATUS PROTOCOL_VERSION RAW_IMU RC_CHANNELS SCALED_IMU2 SCALED_IMU3
    SCALED_IMU SCALED_PRESSURE SCALED_PRESSURE2 SENSOR_OFFSETS SERVO_OUTPUT_RAW SIMSTATE STORAGE_INFORMATION
    TERRAIN_REPORT TERRAIN_REQUEST UTM_GLOBAL_POSITION VFR_HUD VIBRATION WIND WIND_COV
    """.split()  # noqa: SIM905
)


def _place(m: Message, latitude: str, longitude: str) -> tuple[float, float] | None:
    """Degrees; both zero is "no place yet" on both autopilots, the largest integer is MAVLink's mark."""
    y, x = m.integer(latitude), m.integer(longitude)
    unknown = (y == 0 and x == 0) or 2**31 - 1 in (y, x)
    return None if unknown else (y * 1e-7, x * 1e-7)


def _accuracy_m(m: Message, name: str) -> float | None:
    value = m.known(name, 0)
    return None if value is None or value >= 2**32 - 1 else value / 1e3


def _dilution(m: Message, name: str) -> float | None:
    value = m.known(name, 65535)
    return value / 100 if value else None


def _either(time_us: int) -> tuple[float | None, float | None]:
    """Microseconds of either clock -> (since boot, UTC) in seconds, one of them or none."""
    if time_us <= 0:
        return None, None
    return (None, time_us / 1e6) if time_us >= UTC_FROM_US else (time_us / 1e6, None)

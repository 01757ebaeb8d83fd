"""What the vehicle sends by itself or at a rate asked for."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mission.encode import Item
from sim.vehicle.camera import PhotoTaken
from sim.vehicle.dialect import MavMessage, mavlink
from sim.vehicle.motion import Body
from sim.vehicle.options import VehicleOptions
from sim.vehicle.pilot import MissionStage, Mode, Pilot
from sim.vehicle.receiver import Place, Receiver

_COPTER_MODES = {
    **{Mode.MANUAL: 0, Mode.HOLD: 5, Mode.GUIDED: 4, Mode.MISSION: 3, Mode.RETURN: 6, Mode.LAND: 9},
}
_PX4_MODES = {
    **{Mode.MANUAL: (1, 0), Mode.HOLD: (4, 3), Mode.GUIDED: (6, 0), Mode.MISSION: (4, 4)},
    **{Mode.RETURN: (4, 5), Mode.LAND: (4, 6)},
}
#: MAVLink's mark for a place that is not known (INT32_MAX).
UNKNOWN = 2**31 - 1
#: REQUEST_DATA_STREAM's groups (ArduPilot) -> messages.
STREAM_GROUPS = {
    1: ("SYS_STATUS", "SYSTEM_TIME"),
    2: ("SYS_STATUS", "GPS_RAW_INT", "MISSION_CURRENT"),
    6: ("GLOBAL_POSITION_INT",),
    10: ("ATTITUDE", "GIMBAL_DEVICE_ATTITUDE_STATUS"),
    12: ("SYSTEM_TIME", "BATTERY_STATUS", "EKF_STATUS_REPORT"),
}


def mode_number(flavour: str, mode: Mode) -> int:
    """``custom_mode`` of HEARTBEAT and DO_SET_MODE."""
    if flavour == "ardupilot":
        return _COPTER_MODES[mode]
    main, sub = _PX4_MODES[mode]
    return main << 16 | sub << 24


def mode_of(flavour: str, param2: float, param3: float) -> Mode | None:
    """DO_SET_MODE's params -> mode; None for one that is not simulated."""
    if flavour == "ardupilot":
        return {number: mode for mode, number in _COPTER_MODES.items()}.get(int(param2))
    return {pair: mode for mode, pair in _PX4_MODES.items()}.get((int(param2), int(param3)))


@dataclass
class Telemetry:
    """Messages built from the state of the others; all times in seconds since boot."""

    options: VehicleOptions
    body: Body
    receiver: Receiver
    pilot: Pilot
    used_share: float = 0.0
    last_photo: PhotoTaken | None = None
    rates_hz: dict[str, float] = field(default_factory=dict)
    _next_s: dict[str, float] = field(default_factory=dict)

    def want(self, name: str, rate_hz: float) -> bool:
        """Send ``name`` at a rate from now on (0: no more); False if it cannot be sent."""
        if name not in _BUILDERS or (name, self.options.flavour) == ("MISSION_CURRENT", "px4"):
            return False
        self.rates_hz[name] = rate_hz
        self._next_s.pop(name, None)
        return True

    def due(self, now_s: float) -> list[MavMessage]:
        """Heartbeat each second, and the streams asked for. PX4's MISSION_CURRENT comes unasked."""
        out: list[MavMessage] = []
        unasked = ("HEARTBEAT",) if self.options.flavour == "ardupilot" else ("HEARTBEAT", "MISSION_CURRENT")
        for name, rate in (*((name, 1.0) for name in unasked), *self.rates_hz.items()):
            if rate <= 0 or now_s < self._next_s.get(name, 0.0):
                continue
            self._next_s[name] = max(self._next_s.get(name, now_s) + 1 / rate, now_s)
            message = self.build(name, now_s)
            if message is not None:
                out.append(message)
        return out

    def build(self, name: str, now_s: float) -> MavMessage | None:
        """None where there is nothing to tell (no photo yet), or the name is not known."""
        builder = _BUILDERS.get(name)
        return None if builder is None else builder(self, now_s)

    def switched_off(self, options: VehicleOptions) -> None:
        """Nobody has asked for anything yet."""
        self.options, self.last_photo = options, None
        self.rates_hz.clear()
        self._next_s.clear()

    def boot_ms(self, now_s: float) -> int:
        return int(now_s * 1e3)

    def utc_us(self, now_s: float) -> int:
        return round((self.options.boot_utc_s + now_s) * 1e6)

    def place(self, at_m: Place) -> tuple[int, int, float]:
        """Latitude, longitude in 1e-7 degrees, altitude in m."""
        latitude, longitude, altitude = self.options.home.geodetic(np.array([at_m]))[0]
        return round(float(latitude) * 1e7), round(float(longitude) * 1e7), float(altitude)

    def home_item(self) -> Item:
        home = self.options.home
        x, y = round(home.latitude_deg * 1e7), round(home.longitude_deg * 1e7)
        return Item(16, 0, x=x, y=y, z=home.altitude_m)

    def text(self, text: str, severity: int = 6) -> MavMessage:
        return mavlink.MAVLink_statustext_message(severity, text.encode()[:50])

    def feedback(self, photo: PhotoTaken) -> MavMessage:
        """CAMERA_FEEDBACK: UTC, or with a feedback pin boot time; the vehicle's angles."""
        x, y, altitude = self.place(photo.believed_m)
        pin = self.options.feedback_pin
        stamp = round(photo.boot_s * 1e6) if pin else self.utc_us(photo.boot_s)
        return mavlink.MAVLink_camera_feedback_message(
            *(stamp, 0, 0, photo.index, x, y, altitude, photo.believed_m[2], photo.vehicle_roll_deg),
            *(photo.vehicle_pitch_deg, photo.yaw_deg % 360, 0.0, 0),
            photo.index if pin else 0,
        )

    def trigger(self, photo: PhotoTaken) -> MavMessage:
        return mavlink.MAVLink_camera_trigger_message(round(photo.boot_s * 1e6), photo.index)

    def captured(self, photo: PhotoTaken, camera_component: bool) -> MavMessage:
        """CAMERA_IMAGE_CAPTURED: of PX4 (always camera 1), or of a separate camera on its own clock."""
        x, y, altitude = self.place(photo.believed_m)
        boot_s = photo.boot_s - 7.0 if camera_component else photo.boot_s
        index = photo.index - 1 if camera_component else photo.index
        looks = quaternion(0.0, photo.pitch_deg, photo.yaw_deg)
        if self._held_level and not camera_component:
            # Of the mount's angles it takes for granted that they are level.
            heading = quaternion(0.0, 0.0, -photo.yaw_deg)
            body = quaternion(photo.vehicle_roll_deg, photo.vehicle_pitch_deg, 0.0)
            looks = turned_back(heading, turned_back(body, quaternion(0.0, photo.pitch_deg, 0.0)))
        return mavlink.MAVLink_camera_image_captured_message(
            *(self.boot_ms(max(boot_s, 0.001)), self.utc_us(photo.boot_s), int(not camera_component), x, y),
            *(round(altitude * 1e3), round(photo.believed_m[2] * 1e3)),
            *(looks, index, 1, b""),
        )

    def camera_pose(self, photo: PhotoTaken) -> MavMessage:
        """CAMERA_FOV_STATUS: where the camera was and how it looked as the photo was taken, without error."""
        x, y, altitude = self.place(photo.at_m)
        looked = quaternion(0.0, photo.pitch_deg, photo.yaw_deg)
        return mavlink.MAVLink_camera_fov_status_message(
            *(self.boot_ms(photo.boot_s), x, y, round(altitude * 1e3)),
            *(UNKNOWN, UNKNOWN, UNKNOWN, looked, math.nan, math.nan),
        )

    def _heartbeat(self, _: float) -> MavMessage:
        pilot, flavour = self.pilot, self.options.flavour
        base = 1 | (128 if pilot.armed else 0)
        state = mavlink.MAV_STATE_ACTIVE if pilot.armed else mavlink.MAV_STATE_STANDBY
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR,
            3 if flavour == "ardupilot" else 12,
            *(base, mode_number(flavour, pilot.mode), state, 3),
        )

    def _position(self, now_s: float) -> MavMessage:
        told_m = self.receiver.told_m(self.body.at_m)
        x, y, altitude = self.place(told_m)
        east, north, up = self.body.velocity_m_s
        return mavlink.MAVLink_global_position_int_message(
            *(self.boot_ms(now_s), x, y, round(altitude * 1e3), round(told_m[2] * 1e3)),
            *(round(north * 100), round(east * 100), round(-up * 100)),
            round(self.body.yaw_deg * 100) % 36000,
        )

    def _gps(self, now_s: float) -> MavMessage:
        x, y, altitude = self.place(self.receiver.told_m(self.body.at_m))
        stated = [round(1e3 * value) for value in self.receiver.gnss.stated_m]
        if not self.receiver.gnss.accuracies:
            stated = [0, 0]
        return mavlink.MAVLink_gps_raw_int_message(
            *(round(now_s * 1e6), 3, x, y, round(altitude * 1e3), *self._dilutions, 0, 65535, 14),
            *(0, *stated, 300, 0, 0),
        )

    @property
    def _dilutions(self) -> tuple[int, int]:
        """HDOP and VDOP, in hundredths: what the receiver's errors are held to come of."""
        horizontal, vertical = self.receiver.gnss.stated_m
        return (round(80 * horizontal / 1.5), round(120 * vertical / 2.5))

    def _attitude(self, now_s: float) -> MavMessage:
        roll, pitch = math.radians(self.body.roll_deg), math.radians(-self.body.lean_deg)
        yaw = math.radians(self.body.yaw_deg)
        return mavlink.MAVLink_attitude_message(
            self.boot_ms(now_s), roll, pitch, (yaw + math.pi) % (2 * math.pi) - math.pi, 0.0, 0.0, 0.0
        )

    def _gimbal(self, now_s: float) -> MavMessage:
        """A servo mount tells body angles, whatever its lock flags (roll, pitch) say."""
        body, nan = self.body, math.nan
        looks = quaternion(0.0, body.gimbal_pitch_deg, 0.0)
        if self._held_level:
            looks = turned_back(quaternion(body.roll_deg, -body.lean_deg, 0.0), looks)
        return mavlink.MAVLink_gimbal_device_attitude_status_message(
            *(0, 0, self.boot_ms(now_s), 4 | 8, looks, nan, nan, nan, 0)
        )

    @property
    def _held_level(self) -> bool:
        """Whether the autopilot moves the mount's servos against the vehicle's turns: on PX4 if told to."""
        return self.options.flavour == "ardupilot" or dict(self.options.parameters).get("MNT_DO_STAB") == 1

    def _mission_current(self, _: float) -> MavMessage:
        items = len(self.pilot.mission())
        if self.options.flavour == "px4":
            total = items if items else 65535
            return mavlink.MAVLink_mission_current_message(self.pilot.current, total, 0, 0)
        states = {
            **{MissionStage.NOT_STARTED: 2, MissionStage.ACTIVE: 3, MissionStage.PAUSED: 4},
            MissionStage.COMPLETE: 5,
        }
        state = states[self.pilot.stage] if items > 1 else 1
        return mavlink.MAVLink_mission_current_message(self.pilot.current, max(items - 1, 0), state, 0)

    def _battery(self, _: float) -> MavMessage:
        left = max(0.0, 1 - self.used_share)
        cell = round((3.3 + 0.9 * left) * 1e3)
        amperes = 15.0 if self.pilot.flying else 0.5
        return mavlink.MAVLink_battery_status_message(
            *(0, 0, 3, 32767, [cell] * 4 + [65535] * 6, round(amperes * 100)),
            *(round(5000 * self.used_share), -1, round(left * 100)),
        )

    def _sys_status(self, _: float) -> MavMessage:
        left = max(0.0, 1 - self.used_share)
        bits = 1 << 28 | 0b101111
        volts = round((3.3 + 0.9 * left) * 4e3)
        return mavlink.MAVLink_sys_status_message(
            *(bits, bits, bits, 250, volts, -1, round(left * 100), 0, 0, 0, 0, 0, 0)
        )

    def _ekf(self, _: float) -> MavMessage | None:
        if self.options.flavour == "px4":
            return None
        return mavlink.MAVLink_ekf_status_report_message(0b1100111111, 0.1, 0.1, 0.1, 0.1, 0.0)

    def _system_time(self, now_s: float) -> MavMessage:
        return mavlink.MAVLink_system_time_message(self.utc_us(now_s), self.boot_ms(now_s))

    def _home(self, _: float) -> MavMessage:
        x, y, altitude = self.place((0.0, 0.0, 0.0))
        return mavlink.MAVLink_home_position_message(
            *(x, y, round(altitude * 1e3), 0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0)
        )

    def _landed(self, _: float) -> MavMessage:
        return mavlink.MAVLink_extended_sys_state_message(0, 2 if self.pilot.flying else 1)

    def _last_feedback(self, _: float) -> MavMessage | None:
        """Asked for as a stream, the last photo's message comes again and again (ArduPilot), and before the
        first photo one without a time, a number and a place."""
        if self.options.flavour == "px4":
            return None
        if self.last_photo is None:
            return mavlink.MAVLink_camera_feedback_message(*(0,) * 6, *(0.0,) * 6, 0, 0)
        return self.feedback(self.last_photo)

    def _version(self, _: float) -> MavMessage:
        capabilities = 4 | 8 | 64 | 8192  # MISSION_INT, COMMAND_INT, SET_ATTITUDE_TARGET, MAVLINK2
        version = 0x040603FF if self.options.flavour == "ardupilot" else 0x011000FF
        return mavlink.MAVLink_autopilot_version_message(
            *(capabilities, version, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 1)
        )


_BUILDERS = {
    "HEARTBEAT": Telemetry._heartbeat,
    "GLOBAL_POSITION_INT": Telemetry._position,
    "GPS_RAW_INT": Telemetry._gps,
    "ATTITUDE": Telemetry._attitude,
    "GIMBAL_DEVICE_ATTITUDE_STATUS": Telemetry._gimbal,
    "MISSION_CURRENT": Telemetry._mission_current,
    "BATTERY_STATUS": Telemetry._battery,
    "SYS_STATUS": Telemetry._sys_status,
    "EKF_STATUS_REPORT": Telemetry._ekf,
    "SYSTEM_TIME": Telemetry._system_time,
    "HOME_POSITION": Telemetry._home,
    "EXTENDED_SYS_STATE": Telemetry._landed,
    "CAMERA_FEEDBACK": Telemetry._last_feedback,
    "AUTOPILOT_VERSION": Telemetry._version,
}


def quaternion(roll_deg: float, pitch_deg: float, yaw_deg: float) -> list[float]:
    """w, x, y, z in single precision, as the message carries them."""
    half = [math.radians(v) / 2 for v in (roll_deg, pitch_deg, yaw_deg)]
    (sr, sp, sy), (cr, cp, cy) = map(math.sin, half), map(math.cos, half)
    exact = (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )
    return _single(exact)


def turned_back(frame: Sequence[float], turn: Sequence[float]) -> list[float]:
    """A rotation as seen from a frame that is itself turned: inverse of ``frame``, then ``turn``."""
    a, b, c, d = frame[0], -frame[1], -frame[2], -frame[3]
    e, f, g, h = turn
    return _single(
        (
            a * e - b * f - c * g - d * h,
            a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e,
        )
    )


def _single(exact: Sequence[float]) -> list[float]:
    return list(struct.unpack("<4f", struct.pack("<4f", *exact)))

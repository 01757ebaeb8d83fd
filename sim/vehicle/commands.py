"""COMMAND_LONG and COMMAND_INT, and the answers of each flavour."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mission.encode import Item
from sim.vehicle.dialect import MavMessage, mavlink
from sim.vehicle.pilot import Mode, Pilot
from sim.vehicle.telemetry import Telemetry, mode_of

ACCEPTED, REJECTED, DENIED, UNSUPPORTED, FAILED = 0, 1, 2, 3, 4


@dataclass
class Commands:
    pilot: Pilot
    telemetry: Telemetry

    def receive(self, message: MavMessage, now_s: float) -> list[MavMessage]:
        """The acknowledgement, and what was asked for."""
        one, two, three, four = (float(getattr(message, f"param{n}")) for n in range(1, 5))
        whole = message.get_type() == "COMMAND_INT"
        last = (
            (message.x, message.y, message.z) if whole else (message.param5, message.param6, message.param7)
        )
        scale = 1 if whole or message.command not in (195, 201, 22) else 1e7
        x, y = (round(v * scale) if v == v else 0 for v in last[:2])
        item = Item(
            message.command, message.frame if whole else 3, one, two, three, four, x, y, float(last[2])
        )
        extra: list[MavMessage] = []
        if message.command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            result = self._request(item, now_s, extra)
        else:
            run = _COMMANDS.get(message.command)
            result = UNSUPPORTED if run is None else run(self, item)
        peer = (message.get_srcSystem(), message.get_srcComponent())
        return [mavlink.MAVLink_command_ack_message(message.command, result, 0, 0, *peer), *extra]

    @property
    def _ardupilot(self) -> bool:
        return self.telemetry.options.flavour == "ardupilot"

    def _request(self, item: Item, now_s: float, extra: list[MavMessage]) -> int:
        built = self.telemetry.build(_name(item.param1), now_s)
        if built is None:
            return FAILED if self._ardupilot else DENIED
        extra.append(built)
        return ACCEPTED

    def _interval(self, item: Item) -> int:
        rate = 0.0 if item.param2 < 0 else 1.0 if item.param2 == 0 else 1e6 / item.param2
        if self.telemetry.want(_name(item.param1), rate):
            return ACCEPTED
        return DENIED if self._ardupilot else FAILED

    def _arm(self, item: Item) -> int:
        return ACCEPTED if self.pilot.arm(item.param1 == 1) else FAILED

    def _mode(self, item: Item) -> int:
        mode = mode_of(self.telemetry.options.flavour, item.param2, item.param3)
        if mode is None:
            return UNSUPPORTED
        return ACCEPTED if self.pilot.set_mode(mode) else REJECTED

    def _start(self, _: Item) -> int:
        return self.pilot.start_mission()

    def _take_off(self, item: Item) -> int:
        """Copter from GUIDED, to a height above home."""
        if self._ardupilot and self.pilot.mode is not Mode.GUIDED:
            return FAILED
        return ACCEPTED if self.pilot.take_off(item.z) else FAILED

    def _return(self, _: Item) -> int:
        return ACCEPTED if self.pilot.set_mode(Mode.RETURN) else REJECTED

    def _pause(self, item: Item) -> int:
        if not self._ardupilot:
            return UNSUPPORTED
        return ACCEPTED if self.pilot.pause(item.param1 == 0) else DENIED

    def _jump(self, item: Item) -> int:
        if not self._ardupilot:
            return UNSUPPORTED
        return ACCEPTED if self.pilot.jump(max(int(item.param1), 0), item.param2 == 1) else DENIED

    def _photo(self, item: Item) -> int:
        """Accepted does not mean a photo."""
        if not self._ardupilot and item.command == mavlink.MAV_CMD_IMAGE_START_CAPTURE:
            return UNSUPPORTED
        self.pilot.do(item)
        return ACCEPTED

    def _camera_or_gimbal(self, item: Item) -> int:
        self.pilot.do(item)
        return ACCEPTED

    def _gimbal(self, item: Item) -> int:
        """PX4 obeys whom the gimbal was given to; a ground station never asks for it here."""
        return self._camera_or_gimbal(item) if self._ardupilot else DENIED


_COMMANDS: dict[int, Callable[[Commands, Item], int]] = {
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: Commands._interval,
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: Commands._arm,
    mavlink.MAV_CMD_DO_SET_MODE: Commands._mode,
    mavlink.MAV_CMD_MISSION_START: Commands._start,
    mavlink.MAV_CMD_NAV_TAKEOFF: Commands._take_off,
    mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: Commands._return,
    mavlink.MAV_CMD_DO_PAUSE_CONTINUE: Commands._pause,
    mavlink.MAV_CMD_DO_SET_MISSION_CURRENT: Commands._jump,
    mavlink.MAV_CMD_IMAGE_START_CAPTURE: Commands._photo,
    mavlink.MAV_CMD_DO_DIGICAM_CONTROL: Commands._photo,
    mavlink.MAV_CMD_DO_SET_CAM_TRIGG_DIST: Commands._camera_or_gimbal,
    mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW: Commands._gimbal,
    mavlink.MAV_CMD_DO_CHANGE_SPEED: Commands._camera_or_gimbal,
    mavlink.MAV_CMD_DO_SET_ROI_LOCATION: Commands._camera_or_gimbal,
    mavlink.MAV_CMD_DO_SET_ROI: Commands._camera_or_gimbal,
    mavlink.MAV_CMD_DO_SET_ROI_NONE: Commands._camera_or_gimbal,
}


def _name(number: float) -> str:
    known = mavlink.mavlink_map.get(int(number))
    return "" if known is None else str(known.msgname)

"""Who arms and starts in the demonstration: fieldcal never does. A ground station in a few lines."""

from __future__ import annotations

import importlib
import time
from types import TracebackType
from typing import Any

from calib.errors import FieldcalError

_mavutil: Any = importlib.import_module("pymavlink.mavutil")
SET_MODE, ARM, START = 176, 400, 300
ACCEPTED = 0
_GROUND_STATION = 255
#: MAV_AUTOPILOT_ARDUPILOTMEGA, and Copter's LOITER: it does not arm in AUTO, where its last flight ended.
_ARDUPILOT, _LOITER = 3, 5
#: MAV_MODE_FLAG_CUSTOM_MODE_ENABLED.
_CUSTOM = 1.0


class PilotError(FieldcalError):
    """The vehicle does not do what the pilot asks."""


class Pilot:
    """Listens where the link is forwarded to, and commands through it."""

    def __init__(self, port: int) -> None:
        self._link = _mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=_GROUND_STATION)

    def __enter__(self) -> Pilot:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._link.close()

    def take_off(self, timeout_s: float = 30.0) -> None:
        """Arm and start the mission.

        Raises:
            PilotError: nothing is heard, or a command is refused.
        """
        beat = self._link.recv_match(
            type="HEARTBEAT", condition="HEARTBEAT.autopilot != 8", blocking=True, timeout=timeout_s
        )
        if beat is None:
            raise PilotError("The pilot hears no vehicle on the forwarded link.")
        steps = [(ARM, "arm", (1.0, 0.0)), (START, "start the mission", (0.0, 0.0))]
        if beat.autopilot == _ARDUPILOT:
            steps.insert(0, (SET_MODE, "loiter", (_CUSTOM, float(_LOITER))))
        for command, name, params in steps:
            result = self._command(command, params, timeout_s)
            if result != ACCEPTED:
                raise PilotError(f"The vehicle would not {name} (result {result}).")

    def _command(self, command: int, params: tuple[float, float], timeout_s: float) -> int | None:
        until = time.monotonic() + timeout_s
        while time.monotonic() < until:
            self._link.mav.command_long_send(1, 1, command, 0, *params, 0, 0, 0, 0, 0)
            again = time.monotonic() + 2.0
            while time.monotonic() < again:
                heard = self._link.recv_match(type="COMMAND_ACK", blocking=True, timeout=0.5)
                if heard is not None and heard.command == command:
                    return int(heard.result)
        return None

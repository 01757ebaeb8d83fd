"""Who arms and starts in the demonstration: fieldcal never does. A ground station in a few lines."""

from __future__ import annotations

import importlib
import time
from types import TracebackType
from typing import Any

from calib.errors import FieldcalError

_mavutil: Any = importlib.import_module("pymavlink.mavutil")
ARM, START = 400, 300
ACCEPTED = 0
_GROUND_STATION = 255


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
        if self._link.wait_heartbeat(timeout=timeout_s) is None:
            raise PilotError("The pilot hears no vehicle on the forwarded link.")
        for command, name, first in ((ARM, "arm", 1.0), (START, "start the mission", 0.0)):
            result = self._command(command, first, timeout_s)
            if result != ACCEPTED:
                raise PilotError(f"The vehicle would not {name} (result {result}).")

    def _command(self, command: int, first: float, timeout_s: float) -> int | None:
        until = time.monotonic() + timeout_s
        while time.monotonic() < until:
            self._link.mav.command_long_send(1, 1, command, 0, first, 0, 0, 0, 0, 0, 0)
            again = time.monotonic() + 2.0
            while time.monotonic() < again:
                heard = self._link.recv_match(type="COMMAND_ACK", blocking=True, timeout=0.5)
                if heard is not None and heard.command == command:
                    return int(heard.result)
        return None

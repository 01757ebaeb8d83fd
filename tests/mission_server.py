"""A vehicle that speaks MAVLink's mission protocol over UDP, with the storage of a real autopilot.

Upload: MISSION_COUNT -> MISSION_REQUEST (ArduPilot asks so even of INT clients) or
MISSION_REQUEST_INT -> MISSION_ITEM_INT -> MISSION_ACK; download the other way round. What the
storage of ArduCopter 4.6 and PX4 1.16 does to items is written down here from measurements, on
purpose apart from :mod:`mission.encode.compare`.
"""

from __future__ import annotations

import math
import threading
import time
from typing import Any

from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mission.encode import Flavour

_WAYPOINT_FRAMES = {"ardupilot": {0, 2, 3, 5, 6, 10, 11}, "px4": {0, 3, 5, 6}}
_PLACED = {16, 17, 18, 19, 21, 22, 82, 195}
_FIELDS = ("param1", "param2", "param3", "param4", "x", "y", "z")
HOME = (471234567, 87654321, 512.3)


class MissionServer:
    """Context manager; ``url`` is for MAVSDK's ``add_any_connection``."""

    def __init__(self, flavour: Flavour, port: int) -> None:
        self.flavour = flavour
        self.url = f"udpin://127.0.0.1:{port}"
        self.stored: list[dict[str, Any]] = []
        self.refused: int | None = None
        self._link = mavutil.mavlink_connection(
            f"udpout:127.0.0.1:{port}", source_system=1, source_component=1, dialect="ardupilotmega"
        )
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._expected = 0
        self._incoming: list[dict[str, Any]] = []
        self._kind = 0
        self._peer = (0, 0)

    def __enter__(self) -> MissionServer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(5)
        self._link.close()

    def _run(self) -> None:
        beat = 0.0
        while not self._stop.is_set():
            if time.monotonic() - beat > 0.2:
                beat = time.monotonic()
                self._heartbeat()
            message = self._link.recv_match(blocking=True, timeout=0.05)
            if message is not None:
                self._handle(message)

    def _heartbeat(self) -> None:
        autopilot = 3 if self.flavour == "ardupilot" else 12
        self._link.mav.heartbeat_send(mavlink.MAV_TYPE_QUADROTOR, autopilot, 81, 0, mavlink.MAV_STATE_STANDBY)

    def _handle(self, message: Any) -> None:
        kind = message.get_type()
        self._peer = (message.get_srcSystem(), message.get_srcComponent())
        if kind == "MISSION_COUNT":
            self._kind, self._expected, self._incoming = message.mission_type, message.count, []
            self._ask() if self._expected else self._finish(mavlink.MAV_MISSION_ACCEPTED)
        elif kind == "MISSION_ITEM_INT":
            self._take(message)
        elif kind == "MISSION_REQUEST_LIST":
            count = len(self.stored) if message.mission_type == 0 else 0
            self._link.mav.mission_count_send(*self._peer, count, message.mission_type)
        elif kind in ("MISSION_REQUEST_INT", "MISSION_REQUEST") and message.seq < len(self.stored):
            self._send(message.seq)
        elif kind == "COMMAND_LONG":
            self._link.mav.command_ack_send(message.command, mavlink.MAV_RESULT_UNSUPPORTED)

    def _ask(self) -> None:
        mav = self._link.mav
        ask = mav.mission_request_send if self.flavour == "ardupilot" else mav.mission_request_int_send
        ask(*self._peer, len(self._incoming), self._kind)

    def _take(self, message: Any) -> None:
        if message.seq != len(self._incoming) or not self._expected:
            if self.flavour == "ardupilot" and self._expected:
                self._link.mav.mission_ack_send(*self._peer, mavlink.MAV_MISSION_INVALID_SEQUENCE, self._kind)
            return
        item = {name: getattr(message, name) for name in (*_FIELDS, "frame", "command", "autocontinue")}
        reason = self._refusal(item)
        if reason:
            self.refused = message.seq
            self._finish(reason)
            return
        self._incoming.append(item)
        if len(self._incoming) == self._expected:
            if self._kind == 0:
                keep = _copter_storage if self.flavour == "ardupilot" else _px4_storage
                self.stored = [keep(i, one) for i, one in enumerate(self._incoming)]
            self._finish(mavlink.MAV_MISSION_ACCEPTED)
        else:
            self._ask()

    def _refusal(self, item: dict[str, Any]) -> int:
        placed = item["command"] in _PLACED
        if placed and item["frame"] not in _WAYPOINT_FRAMES[self.flavour]:
            return int(mavlink.MAV_MISSION_UNSUPPORTED_FRAME)
        if self.flavour == "px4":
            if not placed and item["frame"] != 2:
                return int(mavlink.MAV_MISSION_UNSUPPORTED)
            return int(mavlink.MAV_MISSION_UNSUPPORTED) if item["command"] in (115, 18) else 0
        for index in range(1, 5):
            free = index == 4 and item["command"] in (16, 17, 21, 22)
            if math.isnan(item[f"param{index}"]) and not free:
                return int(mavlink.MAV_MISSION_INVALID_PARAM1) + index - 1
        return 0

    def _finish(self, result: int) -> None:
        self._expected = 0
        self._link.mav.mission_ack_send(*self._peer, result, self._kind)

    def _send(self, index: int) -> None:
        item = self.stored[index]
        params = [item[f"param{n}"] for n in range(1, 5)]
        self._link.mav.mission_item_int_send(
            *self._peer,
            index,
            item["frame"],
            item["command"],
            int(index == 1),
            item["autocontinue"],
            *params,
            item["x"],
            item["y"],
            item["z"],
            0,
        )


def _copter_storage(index: int, item: dict[str, Any]) -> dict[str, Any]:
    item = dict(item)
    if index == 0:
        x, y, z = HOME
        return {
            **dict.fromkeys(_FIELDS, 0.0),
            "x": x,
            "y": y,
            "z": z,
            "frame": 0,
            "command": 16,
            "autocontinue": 1,
        }
    item["frame"] = {5: 0, 6: 3, 11: 10}.get(item["frame"], item["frame"])
    command = item["command"]
    if command in _PLACED:
        item["z"] = math.trunc(item["z"] * 100) / 100
        item |= {"param2": 0.0, "param3": 0.0, "param4": 0.0}
        item["param1"] = float(int(item["param1"]))
    else:
        item["frame"] = 0
    if command == 1000:
        item |= {"param1": float(int(item["param1"])), "param2": float(int(item["param2"]))}
    if command == 206:
        item["param2"] = 0.0
    return item


def _px4_storage(_: int, item: dict[str, Any]) -> dict[str, Any]:
    item = dict(item)
    if item["command"] in _PLACED:
        # In radians, single precision, 0 to 2 pi; and integer clients get integer frames back.
        item["param4"] = math.degrees(math.radians(item["param4"]) % (2 * math.pi))
        item["frame"] = {0: 5, 3: 6}.get(item["frame"], item["frame"])
    return item

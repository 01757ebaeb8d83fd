"""MAVLink on the wire: bytes to frames and back. The one door to pymavlink's generated dialect."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

from calib.errors import InputError
from daemon.link.message import Message, from_pymavlink

try:
    # Generated code of 30,000 lines that no type checker should read.
    mavlink: Any = importlib.import_module("pymavlink.dialects.v20.ardupilotmega")
except ModuleNotFoundError as error:
    raise InputError(
        "The vehicle link needs a part that is not installed: pip install 'fieldcal[flight]'."
    ) from error

#: An instance of one of the dialect's message classes.
Outgoing = Any

#: Not 255: autopilots watch for that ground station, and a link of ours that still beats must not hide
#: that the pilot's own station is gone.
SYSTEM_ID = 245
COMPONENT_ID = int(mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)
GROUND_STATION = int(mavlink.MAV_TYPE_GCS)
_MAVLINK2, _MAVLINK1 = 0xFD, 0xFE
FILE_TRANSFER = "FILE_TRANSFER_PROTOCOL"
FILE_PAYLOAD_BYTES, FILE_HEADER_BYTES = 251, 12


@dataclass(frozen=True)
class Frame:
    """One message as it was on the wire. ``message``: None where the dialect does not know it."""

    raw: bytes
    sequence: int
    system_id: int
    component_id: int
    message: Message | None


class Splitter:
    """Bytes in pieces of any size -> frames; what is not MAVLink is left out and counted in bytes."""

    def __init__(self) -> None:
        self.garbage_bytes = 0
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True

    def feed(self, data: bytes) -> list[Frame]:
        found = []
        for parsed in self._parser.parse_buffer(data) or []:
            raw = bytes(parsed.get_msgbuf())
            if parsed.get_type() == "BAD_DATA":
                self.garbage_bytes += len(raw)
            else:
                found.append(_frame(raw, parsed))
        return found


def _frame(raw: bytes, parsed: Any) -> Frame:
    sequence, system, component = raw[4:7] if raw[0] == _MAVLINK2 else raw[2:5]
    known = not parsed.get_type().startswith("UNKNOWN_")
    return Frame(raw, sequence, system, component, from_pymavlink(parsed) if known else None)


class Packer:
    """Messages of ours -> bytes, numbered one after the other."""

    def __init__(self, system_id: int = SYSTEM_ID, component_id: int = COMPONENT_ID) -> None:
        self._sender = mavlink.MAVLink(None, system_id, component_id)

    def pack(self, message: Outgoing) -> bytes:
        raw: bytes = message.pack(self._sender)
        self._sender.seq = (self._sender.seq + 1) % 256
        return raw


def heartbeat() -> Outgoing:
    """We are a companion: neither a vehicle nor the pilot's ground station."""
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
    )


def time_question(own_s: float) -> Outgoing:
    return mavlink.MAVLink_timesync_message(0, round(own_s * 1e9))


def ask_stream(system_id: int, message_name: str, rate_hz: float) -> Outgoing:
    """MAV_CMD_SET_MESSAGE_INTERVAL to the autopilot."""
    return command(
        system_id, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number_of(message_name), round(1e6 / rate_hz)
    )


def ask_message(system_id: int, message_name: str) -> Outgoing:
    """MAV_CMD_REQUEST_MESSAGE to the autopilot."""
    return command(system_id, mavlink.MAV_CMD_REQUEST_MESSAGE, number_of(message_name))


def command(system_id: int, number: int, *params: float) -> Outgoing:
    seven = [*params, *[0.0] * (7 - len(params))]
    return mavlink.MAVLink_command_long_message(system_id, 1, number, 0, *seven)


def file_transfer(system_id: int, component_id: int, payload: bytes) -> Outgoing:
    """FILE_TRANSFER_PROTOCOL; ``payload`` up to :data:`FILE_PAYLOAD_BYTES`."""
    full = payload.ljust(FILE_PAYLOAD_BYTES, b"\0")
    return mavlink.MAVLink_file_transfer_protocol_message(0, system_id, component_id, list(full))


def without_content(frame: Frame) -> bytes:
    """A frame as it belongs into a log: of a file's content that is carried over the link only the header.

    Sequence number and sender stay, so that a replay counts as the link did.
    """
    message = frame.message
    if message is None or message.name != FILE_TRANSFER:
        return frame.raw
    sender = mavlink.MAVLink(None, frame.system_id, frame.component_id)
    sender.seq = frame.sequence
    to = (message.integer("target_system"), message.integer("target_component"))
    short: bytes = file_transfer(*to, message.octets("payload")[:FILE_HEADER_BYTES]).pack(sender)
    return short


def read_parameter(system_id: int, name: str) -> Outgoing:
    return mavlink.MAVLink_param_request_read_message(system_id, 1, name.encode(), -1)


def number_of(message_name: str) -> int:
    """The id of a message by its name; KeyError for one that the dialect does not have."""
    return _NUMBERS[message_name]


_NUMBERS: dict[str, int] = {str(kind.msgname): int(number) for number, kind in mavlink.mavlink_map.items()}

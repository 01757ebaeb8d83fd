"""What this program may say to a vehicle: a short list; everything else is refused before it is sent.

It never arms, never starts a mission, never changes a mode, a parameter or the place that is flown to.
A ground station whose frames are passed on speaks for itself and is not held against this list.
"""

from __future__ import annotations

from daemon.link.wire import FILE_TRANSFER, Outgoing, mavlink

MESSAGES = frozenset(
    {
        *("HEARTBEAT", "TIMESYNC", "PARAM_REQUEST_READ", "COMMAND_LONG"),
        *("MISSION_COUNT", "MISSION_ITEM_INT", "MISSION_ACK", "MISSION_CLEAR_ALL"),
        *("MISSION_REQUEST_LIST", "MISSION_REQUEST_INT"),
        FILE_TRANSFER,
    }
)
COMMANDS = frozenset({int(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL), int(mavlink.MAV_CMD_REQUEST_MESSAGE)})
#: Of the file transfer only what reads: close one session, close all, open for reading, read.
FILE_OPERATIONS = frozenset({1, 2, 4, 5})


class ForbiddenError(RuntimeError):
    """A defect of ours: a message that this program must never send. It was not sent."""


def check(message: Outgoing) -> Outgoing:
    """``message`` itself.

    Raises:
        ForbiddenError: it is not on the list.
    """
    name = message.get_type()
    if name not in MESSAGES:
        raise ForbiddenError(f"{name} is nothing that this program may send")
    if name == "COMMAND_LONG" and message.command not in COMMANDS:
        raise ForbiddenError(f"command {message.command} is nothing that this program may send")
    if name == FILE_TRANSFER and message.payload[3] not in FILE_OPERATIONS:
        raise ForbiddenError(f"file operation {message.payload[3]} is nothing that this program may send")
    if name == "MISSION_ITEM_INT" and message.current not in (0, 1):
        # 2 and 3 are no mission: ArduPilot flies there at once.
        raise ForbiddenError("a mission item that is flown to at once may not be sent")
    return message

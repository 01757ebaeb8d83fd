"""A MAVLink message as both libraries deliver it, brought to one form."""

from __future__ import annotations

import base64
import binascii
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from calib.errors import FormatError


class PymavlinkMessage(Protocol):
    """What is used of pymavlink's ``MAVLink_message``."""

    def get_type(self) -> str: ...
    def get_srcSystem(self) -> int: ...
    def get_srcComponent(self) -> int: ...
    def to_dict(self) -> dict[str, Any]: ...


@dataclass(frozen=True)
class Message:
    """``fields`` as MAVLink's XML names them, in MAVLink's units. The readers never return NaN."""

    name: str
    fields: Mapping[str, object] = field(repr=False)
    system_id: int = 1
    component_id: int = 1

    def number(self, name: str) -> float | None:
        """None where the field is missing (an older dialect), null or NaN."""
        value = self.fields.get(name)
        if isinstance(value, str):  # 64-bit numbers in JSON
            try:
                value = int(value)
            except ValueError:
                return None
        if isinstance(value, bool | int | float) and math.isfinite(value):
            return float(value)
        return None

    def integer(self, name: str, default: int = 0) -> int:
        """Whole, without the loss that a float would bring to 64 bits."""
        value = self.fields.get(name)
        if isinstance(value, int):
            return int(value)
        if isinstance(value, str) and value.lstrip("-").isdigit():
            return int(value)
        number = self.number(name)
        return default if number is None else int(number)

    def known(self, name: str, unknown: int) -> int | None:
        """A whole number, None where it is missing or has the value that MAVLink gives to unknown."""
        value = self.integer(name, unknown)
        return None if value == unknown else value

    def numbers(self, name: str) -> tuple[float, ...]:
        """An array; empty where it is missing. NaN and null stay NaN in it."""
        value = self.fields.get(name)
        if isinstance(value, str):
            try:
                return tuple(float(b) for b in base64.b64decode(value, validate=True))
            except (binascii.Error, ValueError):
                return ()
        if not isinstance(value, Sequence):
            return ()
        return tuple(float(v) if isinstance(v, int | float) else math.nan for v in value)

    def octets(self, name: str) -> bytes:
        """An array of bytes; empty where it is missing or none."""
        value = self.fields.get(name)
        return bytes(value) if isinstance(value, list) else b""

    def text(self, name: str) -> str:
        value = self.fields.get(name)
        return value.split("\0", 1)[0] if isinstance(value, str) else ""


def from_mavsdk(name: str, fields_json: str, system_id: int, component_id: int) -> Message:
    """A message of MAVSDK's ``mavlink_direct`` (arguments: attributes of its ``MavlinkMessage``).

    Raises:
        FormatError: the JSON is damaged.
    """
    try:
        fields = json.loads(fields_json)
    except ValueError as error:
        raise FormatError(f"A {name} message came with damaged JSON: {error}.") from error
    if not isinstance(fields, dict):
        raise FormatError(f"A {name} message came without fields.")
    return Message(name, fields, system_id, component_id)


def from_pymavlink(message: PymavlinkMessage) -> Message:
    """A message of pymavlink, live or from a log."""
    fields = message.to_dict()
    fields.pop("mavpackettype", None)
    return Message(message.get_type(), fields, message.get_srcSystem(), message.get_srcComponent())

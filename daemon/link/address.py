"""Where a vehicle is: ``udp://:14550``, ``tcp://HOST:PORT``, ``serial:///dev/ttyACM0:57600``, a log."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from calib.errors import InputError

SERIAL_BAUD = 57600
UDP_PORT, TCP_PORT = 14550, 5760
EXAMPLES = "udp://:14550, udpout://HOST:14550, tcp://HOST:5760, serial:///dev/ttyACM0:57600 or FLIGHT.tlog"
_HOST_PORT = re.compile(r"(?P<host>\[[0-9A-Fa-f:.%]+\]|[^:/\[\]\s]*)(?::(?P<port>[0-9]{1,5}))?/?")


class Kind(StrEnum):
    UDP_IN = "udpin"
    UDP_OUT = "udpout"
    TCP = "tcp"
    SERIAL = "serial"
    LOG = "log"


@dataclass(frozen=True)
class Address:
    """``place``: host, serial device, or the path of a log. ``number``: port or baud rate, 0 for a log."""

    kind: Kind
    place: str
    number: int = 0

    def __str__(self) -> str:
        if self.kind is Kind.LOG:
            return self.place
        host = f"[{self.place}]" if ":" in self.place else self.place
        return f"{self.kind}://{host}:{self.number}"


def parse(text: str) -> Address:
    """The address that ``text`` names.

    ``udp`` listens (as ``udpin``) where no host or this computer's own is given.

    Raises:
        InputError: not an address.
    """
    scheme, separator, rest = text.strip().partition("://")
    scheme = scheme.lower()
    if not separator:
        return _bare(text.strip())
    if scheme == "serial":
        return _serial(rest, text)
    if scheme in ("udp", "udpin", "udpout", "tcp", "tcpout"):
        return _network(scheme, rest, text)
    raise InputError(f"{text!r} is no address of a vehicle: write {EXAMPLES}.")


def _bare(text: str) -> Address:
    if text.lower().endswith(".tlog"):
        return Address(Kind.LOG, text)
    if text.startswith("/dev/") or re.fullmatch(r"COM[0-9]+(:[0-9]+)?", text, re.IGNORECASE):
        return _serial(text, text)
    raise InputError(f"{text!r} is no address of a vehicle: write {EXAMPLES}.")


def _serial(rest: str, text: str) -> Address:
    device, separator, baud = rest.rpartition(":")
    if not separator:
        device, baud = rest, str(SERIAL_BAUD)
    if not device or not baud.isascii() or not baud.isdigit() or not 0 < int(baud) <= 10_000_000:
        raise InputError(f"{text!r} names no serial device and speed: write serial:///dev/ttyACM0:57600.")
    return Address(Kind.SERIAL, device, int(baud))


def _network(scheme: str, rest: str, text: str) -> Address:
    match = _HOST_PORT.fullmatch(rest)
    if match is None:
        raise InputError(f"{text!r} has no host and port: write {EXAMPLES}.")
    host = (match["host"] or "").strip("[]")
    usual = TCP_PORT if scheme.startswith("tcp") else UDP_PORT
    port = int(match["port"] or usual)
    if not 0 < port < 65536:
        raise InputError(f"{text!r} has a port that does not exist ({port}).")
    kind = {"tcp": Kind.TCP, "tcpout": Kind.TCP, "udpout": Kind.UDP_OUT}.get(scheme, Kind.UDP_IN)
    if kind is not Kind.UDP_IN and not host:
        raise InputError(f"{text!r} needs a host: write {kind}://HOST:{port}.")
    return Address(kind, host or "0.0.0.0", port)


def log_path(address: Address) -> Path:
    return Path(address.place).expanduser()

"""Bytes to and from a vehicle over UDP, TCP or a serial line. No threads, no MAVLink."""

from __future__ import annotations

import errno
import importlib
import os
import socket
import termios
from collections.abc import Callable
from typing import Any, Protocol

from calib.errors import InputError
from daemon.link.address import Address, Kind

#: Largest read at once; a datagram of MAVLink is far smaller.
CHUNK_BYTES = 65536
CONNECT_S = 2.0
#: Whoever sent bytes: a UDP address, or None where there is only one.
Origin = tuple[Any, ...] | None


class Transport(Protocol):
    """Every method may raise OSError: the link is cut, close it and open another."""

    def fileno(self) -> int:
        """For select."""
        ...

    def read(self) -> list[tuple[bytes, Origin]]:
        """What has arrived; never waits."""
        ...

    def write(self, data: bytes) -> bool:
        """False where nobody is there yet, or the line is full: the data is dropped."""
        ...

    def answer(self, origin: Origin) -> None:
        """Write to ``origin`` from now on: the vehicle was heard from there."""
        ...

    def close(self) -> None: ...


def open_transport(address: Address) -> Transport:
    """
    Raises:
        OSError: nobody there now; trying again makes sense.
        InputError: no such device, port taken, not allowed: trying again does not.
    """
    if address.kind is Kind.SERIAL:
        return _Serial(address)
    if address.kind is Kind.TCP:
        return _Tcp(address)
    if address.kind in (Kind.UDP_IN, Kind.UDP_OUT):
        return Udp(address)
    raise InputError(f"{address} is a recorded flight: nothing can be sent to it.")


class Udp:
    """Listening (answers whoever :meth:`answer` names), or sending to a host."""

    def __init__(self, address: Address) -> None:
        self._peer: Origin = None
        family, where = _resolved(address, socket.SOCK_DGRAM)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            if address.kind is Kind.UDP_IN:
                self._bind(where, address)
            else:
                self._peer = where
                self._socket.bind(("", 0) if family == socket.AF_INET else ("::", 0))
            self._socket.setblocking(False)
        except BaseException:
            self._socket.close()
            raise
        self._fixed = address.kind is Kind.UDP_OUT

    def _bind(self, where: tuple[Any, ...], address: Address) -> None:
        try:
            self._socket.bind(where)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise InputError(
                    f"Port {address.number} is taken by another program (a ground station?): end it, or "
                    "let it forward to another port."
                ) from error
            if error.errno == errno.EADDRNOTAVAIL:
                raise InputError(
                    f"{address.place} is not this computer: to send there, write "
                    f"udpout://{address.place}:{address.number}."
                ) from error
            if error.errno == errno.EACCES:
                raise InputError(
                    f"You may not listen on port {address.number}: use one above 1023."
                ) from error
            raise

    def fileno(self) -> int:
        return self._socket.fileno()

    def read(self) -> list[tuple[bytes, Origin]]:
        found: list[tuple[bytes, Origin]] = []
        while len(found) < 256:
            try:
                found.append(self._socket.recvfrom(CHUNK_BYTES))
            except BlockingIOError:
                break
            except ConnectionError:  # an earlier datagram found nobody: the vehicle is not up yet
                continue
        return found

    def write(self, data: bytes) -> bool:
        if self._peer is None:
            return False
        try:
            self._socket.sendto(data, self._peer)
        except (BlockingIOError, ConnectionError):
            return False
        return True

    def answer(self, origin: Origin) -> None:
        if not self._fixed:
            self._peer = origin

    def close(self) -> None:
        self._socket.close()


class _Whole:
    """Writes to a stream: a message is never cut in the middle, its rest goes first next time."""

    def __init__(self, send: Callable[[bytes], int]) -> None:
        self._send, self._rest = send, b""

    def write(self, data: bytes) -> bool:
        """Whether the message is on its way; False: the one before still is."""
        self._flush()
        if self._rest:
            return False
        self._rest = data
        self._flush()
        return True

    def _flush(self) -> None:
        while self._rest:
            try:
                sent = self._send(self._rest)
            except BlockingIOError:
                return
            self._rest = self._rest[sent:]


class _Tcp:
    def __init__(self, address: Address) -> None:
        _, where = _resolved(address, socket.SOCK_STREAM)
        self._socket = socket.create_connection(where[:2], CONNECT_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)
        self._out = _Whole(self._socket.send)

    def fileno(self) -> int:
        return self._socket.fileno()

    def read(self) -> list[tuple[bytes, Origin]]:
        try:
            data = self._socket.recv(CHUNK_BYTES)
        except BlockingIOError:
            return []
        if not data:
            raise ConnectionResetError(errno.ECONNRESET, "the other side closed the connection")
        return [(data, None)]

    def write(self, data: bytes) -> bool:
        return self._out.write(data)

    def answer(self, origin: Origin) -> None:
        del origin

    def close(self) -> None:
        self._socket.close()


class _Serial:
    def __init__(self, address: Address) -> None:
        serial: Any = importlib.import_module("serial")
        try:
            self._port = serial.Serial(address.place, address.number, timeout=0, write_timeout=0)
        except serial.SerialException as error:
            _explain_serial(address, error)
            raise OSError(error.errno or errno.EIO, str(error)) from error
        except ValueError as error:
            raise InputError(f"{address.place} cannot be set to {address.number} baud.") from error
        self._fd = int(self._port.fileno())
        self._out = _Whole(lambda data: os.write(self._fd, data))

    def fileno(self) -> int:
        return self._fd

    def read(self) -> list[tuple[bytes, Origin]]:
        try:
            data = os.read(self._fd, CHUNK_BYTES)
        except BlockingIOError:
            return []
        if not data:
            raise OSError(errno.EIO, "the device is gone")
        return [(data, None)]

    def write(self, data: bytes) -> bool:
        return self._out.write(data)

    def answer(self, origin: Origin) -> None:
        del origin

    def close(self) -> None:
        try:
            self._port.close()
        except (OSError, termios.error):  # an unplugged device cannot even be closed
            self._fd = -1


def _explain_serial(address: Address, error: Any) -> None:
    """InputError for what the user has to change; a device that is unplugged may come back."""
    if error.errno in (errno.EACCES, errno.EPERM):
        raise InputError(
            f"You may not use {address.place}: add your user to the group that owns it (often dialout) and "
            "log in again."
        ) from error
    if error.errno == errno.EBUSY or "exclusively lock" in str(error):
        raise InputError(f"{address.place} is in use by another program: end that first.") from error


def _resolved(address: Address, kind: socket.SocketKind) -> tuple[socket.AddressFamily, tuple[Any, ...]]:
    try:
        family, _, _, _, where = socket.getaddrinfo(address.place, address.number, type=kind)[0]
    except socket.gaierror as error:
        raise OSError(errno.EHOSTUNREACH, f"no host is named {address.place}") from error
    return family, where

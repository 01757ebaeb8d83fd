"""The proxy's end towards the ground: a UDP sender, a TCP server, or a serial line (a pseudo-terminal)."""

from __future__ import annotations

import os
import select
import socket
import tty
from typing import Protocol


class End(Protocol):
    """``url``: what the ground opens."""

    url: str

    def fileno(self) -> int: ...
    def read(self) -> list[bytes]: ...
    def write(self, data: bytes) -> None: ...
    def close(self) -> None: ...


class UdpEnd:
    """Sends to 127.0.0.1:``port`` (0: a free one), where the ground listens."""

    def __init__(self, port: int = 0) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self._ground = ("127.0.0.1", port or free_port())
        self.url = f"udp://127.0.0.1:{self._ground[1]}"

    def fileno(self) -> int:
        return self._socket.fileno()

    def read(self) -> list[bytes]:
        found = []
        while True:
            try:
                found.append(self._socket.recv(65536))
            except BlockingIOError:
                return found
            except ConnectionError:  # nobody listens at the moment
                continue

    def write(self, data: bytes) -> None:
        try:
            self._socket.sendto(data, self._ground)
        except (BlockingIOError, ConnectionError):
            return

    def close(self) -> None:
        self._socket.close()


class TcpEnd:
    """One client at a time; another one takes its place. :meth:`hang_up` cuts it off."""

    def __init__(self) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self._server.setblocking(False)
        self._client: socket.socket | None = None
        self.url = f"tcp://127.0.0.1:{self._server.getsockname()[1]}"

    def fileno(self) -> int:
        # Another thread may hang up at any instant: a closed client has the number -1.
        client = self._client
        number = -1 if client is None else client.fileno()
        return number if number >= 0 else self._server.fileno()

    def read(self) -> list[bytes]:
        client = self._client
        if client is None:
            readable, _, _ = select.select([self._server], [], [], 0)
            if readable:
                self._client, _ = self._server.accept()
                self._client.setblocking(False)
            return []
        try:
            data = client.recv(65536)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if not data and self._client is client:
            self.hang_up()
        return [data] if data else []

    def write(self, data: bytes) -> None:
        client = self._client
        if client is not None:
            try:
                client.sendall(data)
            except OSError:
                if self._client is client:
                    self.hang_up()

    def hang_up(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            client.close()

    def close(self) -> None:
        self.hang_up()
        self._server.close()


class SerialEnd:
    """A pseudo-terminal: its other side looks like a serial device."""

    def __init__(self) -> None:
        self._here, self._there = os.openpty()
        tty.setraw(self._here)
        tty.setraw(self._there)
        os.set_blocking(self._here, False)
        self.url = f"serial://{os.ttyname(self._there)}:115200"

    def fileno(self) -> int:
        return self._here

    def read(self) -> list[bytes]:
        try:
            data = os.read(self._here, 65536)
        except BlockingIOError:
            return []
        return [data] if data else []

    def write(self, data: bytes) -> None:
        try:
            os.write(self._here, data)
        except BlockingIOError:  # the line is full: the ground does not read
            return

    def close(self) -> None:
        os.close(self._here)
        os.close(self._there)


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])

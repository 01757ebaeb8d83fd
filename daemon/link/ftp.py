"""A camera's files over MAVLink's file transfer protocol, read only and a piece at a time.

https://mavlink.io/en/services/ftp.html. Several reads are under way at once, more while all are answered and
half as many when one is not: small autopilots keep a queue of a few, radios lose. A file is read in pieces,
each with a session of its own, so that an upload or a question to the vehicle waits for a piece at most.
"""

from __future__ import annotations

import re
import struct
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import IntEnum

from daemon.link.live import Link
from daemon.link.message import Message
from daemon.link.transfer import Patience
from daemon.link.wire import (
    COMPONENT_ID,
    FILE_HEADER_BYTES,
    FILE_PAYLOAD_BYTES,
    FILE_TRANSFER,
    SYSTEM_ID,
    Outgoing,
    file_transfer,
)
from daemon.remote import MOST_BYTES, CutError, RefusedError

#: seq_number, session, opcode, size, req_opcode, burst_complete, padding, offset.
_HEADER = struct.Struct("<HBBBBBxI")
DATA_BYTES = FILE_PAYLOAD_BYTES - FILE_HEADER_BYTES
#: A piece ends after so many bytes or seconds.
PIECE_BYTES, PIECE_S = 512 * 1024, 3.0
#: Reads under way.
_FIRST_WINDOW, _MOST_WINDOW = 4, 32
_CLOSE_S = 1.0
_LOOK_S = 0.01
_URL = re.compile(r"mftp://(?:\[;comp=(\d{1,3})\])?(.+)", re.IGNORECASE | re.DOTALL)


class _Code(IntEnum):
    TERMINATE, RESET, OPEN, READ = 1, 2, 4, 5
    ACK, NAK = 128, 129


_NO_SESSION_FREE, _END_OF_FILE = 5, 6
REASONS = {
    1: "it reports an error", 2: "its disk reports an error", 3: "it does not take such a size",
    4: "it lost the session", 5: "it serves others now", 7: "it does not give files", 9: "it may not give it",
    10: "it has no such file",
}  # fmt: skip


def address_of(url: str, component_id: int) -> tuple[int, str] | None:
    """Component and path of an ``mftp://`` address told by ``component_id``; None for other addresses."""
    found = _URL.fullmatch(url)
    if found is None:
        return None
    component = int(found[1]) if found[1] else component_id
    path = found[2] if found[2].startswith("/") else f"/{found[2]}"
    return (component, path) if component < 256 else None


@dataclass
class ReadPiece:
    """An exchange: ``path`` of a component, from a byte on -> ``data``, bytes without a hole.

    ``size_bytes`` of the file as told. ``ended``: ``data`` goes up to its end. ``refused``: why nothing
    (more) is given. None of both: the piece is full, or the vehicle fell silent (``data`` holds what came).
    """

    system_id: int
    component_id: int
    path: str
    start_byte: int
    patience: Patience = field(default_factory=lambda: Patience(0.4, 4.0))
    over: bool = False
    data: bytearray = field(default_factory=bytearray)
    size_bytes: int | None = None
    ended: bool = False
    refused: str | None = None
    _session: int | None = None
    _number: int = 0
    _window: float = _FIRST_WINDOW
    _next: int = 0
    _began_s: float = 0.0
    _heard_s: float = 0.0
    _closing_s: float | None = None
    _freed: bool = False
    _halved_s: float = 0.0
    #: Sequence number -> (payload, offset, bytes asked for, when).
    _asked: dict[int, tuple[bytes, int, int, float]] = field(default_factory=dict)
    _ahead: dict[int, bytes] = field(default_factory=dict)
    _again: list[tuple[int, int]] = field(default_factory=list)

    def start(self, now_s: float) -> list[Outgoing]:
        self._began_s = self._heard_s = now_s
        self._next = self.start_byte
        # Servers answer a number that they know with what they said then, be it of another file.
        self._number = 2 * round(now_s * 1e3) % 2**16
        return self._open(now_s)

    def receive(self, message: Message, now_s: float) -> list[Outgoing]:
        to_us = (message.integer("target_system"), message.integer("target_component"))
        if self.over or message.name != FILE_TRANSFER or message.component_id != self.component_id:
            return []
        payload = message.octets("payload").ljust(FILE_PAYLOAD_BYTES, b"\0")
        number, session, code, size, _, _, _ = _HEADER.unpack_from(payload)
        asked = self._asked.get((number - 1) % 2**16)
        if to_us != (SYSTEM_ID, COMPONENT_ID) or asked is None or code not in (_Code.ACK, _Code.NAK):
            return []
        del self._asked[(number - 1) % 2**16]
        self._heard_s = now_s
        data = payload[FILE_HEADER_BYTES : FILE_HEADER_BYTES + min(size, DATA_BYTES)]
        if self._closing_s is not None:
            self.over = self.over or asked[0][3] == _Code.TERMINATE
            return []
        if code == _Code.NAK:
            return self._denied(data[0] if data else 1, asked, now_s)
        if asked[0][3] == _Code.RESET:
            return self._open(now_s)
        if asked[0][3] == _Code.OPEN:
            self._session = session
            self.size_bytes = int.from_bytes(data[:4], "little")
            if self.size_bytes < self.start_byte:
                self.refused = "it has become shorter"
        else:
            self._window = min(self._window + 1 / self._window, _MOST_WINDOW)
            self._take(asked[1], asked[2], data)
        return self._go_on(now_s)

    def tick(self, now_s: float) -> list[Outgoing]:
        if self.over:
            return []
        silent = now_s - self._heard_s > self.patience.silence_s
        if silent or (self._closing_s is not None and now_s - self._closing_s > _CLOSE_S):
            self.over = True
            return []
        late = [n for n, asked in self._asked.items() if now_s - asked[3] > self.patience.repeat_s]
        if late and now_s - self._halved_s > self.patience.repeat_s:
            self._halved_s, self._window = now_s, max(1.0, self._window / 2)
        said = []
        for number in late[: max(1, int(self._window))]:
            payload, offset, size, _ = self._asked[number]
            self._asked[number] = (payload, offset, size, now_s)
            said.append(self._message(payload))
        return said

    def _open(self, now_s: float) -> list[Outgoing]:
        return [self._ask(_Code.OPEN, now_s, data=self.path.encode())]

    def _denied(self, reason: int, asked: tuple[bytes, int, int, float], now_s: float) -> list[Outgoing]:
        if asked[0][3] == _Code.READ and reason == _END_OF_FILE:
            # Shorter than it said, or empty: what is before is all.
            self.size_bytes = min(self.size_bytes or 0, asked[1])
        elif asked[0][3] == _Code.OPEN and reason == _NO_SESSION_FREE and not self._freed:
            # Most likely ours of before we were killed: nobody else closes it.
            self._freed = True
            return [self._ask(_Code.RESET, now_s)]
        else:
            self.refused = REASONS.get(reason, f"it gives reason {reason}")
        return self._go_on(now_s)

    def _take(self, offset: int, asked: int, data: bytes) -> None:
        end = offset + len(data)
        if not data:
            self.size_bytes = min(self.size_bytes or 0, offset)
        elif len(data) < asked and end < (self.size_bytes or 0):
            self._again.append((end, asked - len(data)))
        self._ahead[offset] = data
        while (more := self._ahead.pop(self._place, None)) is not None and more:
            self.data += more

    @property
    def _place(self) -> int:
        """The first byte that is missing."""
        return self.start_byte + len(self.data)

    def _go_on(self, now_s: float) -> list[Outgoing]:
        size = self.size_bytes or 0
        self.ended = self._session is not None and self.refused is None and self._place >= size
        full = self._next - self.start_byte >= PIECE_BYTES or now_s - self._began_s > PIECE_S
        waiting = bool(self._again) or any(asked[0][3] == _Code.READ for asked in self._asked.values())
        if self.refused is not None or self.ended or (full and not waiting):
            return self._close(now_s)
        said = []
        while len(self._asked) < int(self._window):
            if self._again:
                offset, length = self._again.pop()
            elif self._next < size and not full:
                offset, length = self._next, min(DATA_BYTES, size - self._next)
                self._next += length
            else:
                break
            said.append(self._ask(_Code.READ, now_s, offset, length))
        return said

    def _close(self, now_s: float) -> list[Outgoing]:
        self._asked.clear()
        if self._session is None:
            self.over = True
            return []
        self._closing_s = now_s
        return [self._ask(_Code.TERMINATE, now_s)]

    def _ask(
        self, code: _Code, now_s: float, offset: int = 0, length: int = 0, data: bytes = b""
    ) -> Outgoing:
        number, self._number = self._number, (self._number + 2) % 2**16
        size = len(data) or length
        payload = _HEADER.pack(number, self._session or 0, code, size, 0, 0, offset) + data
        self._asked[number] = (payload, offset, length, now_s)
        return self._message(payload)

    def _message(self, payload: bytes) -> Outgoing:
        return file_transfer(self.system_id, self.component_id, payload)


def read_file(
    link: Link, component_id: int, path: str, start_byte: int, going: Callable[[], bool]
) -> Iterator[bytes]:
    """The file's content from ``start_byte`` on, in pieces as they come, while ``going()``.

    Raises:
        RefusedError: there is no such file, or it is too large. CutError: the vehicle is not heard.
    """
    if len(path.encode()) > DATA_BYTES:
        raise RefusedError("its name is too long")
    place, ended = start_byte, False
    while not ended:
        vehicle = link.state.system_id
        if vehicle is None or not link.connected:
            raise CutError("the vehicle is not heard")
        piece = ReadPiece(vehicle, component_id, path, place)
        link.ask(piece)
        while not piece.over:
            if not going():
                piece.over = True
                return
            time.sleep(_LOOK_S)
        if piece.size_bytes is not None and piece.size_bytes > MOST_BYTES:
            raise RefusedError(f"it has {piece.size_bytes / 2**20:.0f} MB")
        if piece.refused is not None:
            raise RefusedError(piece.refused)
        if not piece.data and not piece.ended:
            raise CutError("the camera does not answer")
        place, ended = place + len(piece.data), piece.ended
        yield bytes(piece.data)

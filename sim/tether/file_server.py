"""A folder, read over MAVLink's file transfer protocol: the side of a small camera. No socket, no clock.

https://mavlink.io/en/services/ftp.html: one session, one read at a time, answers repeated where a number is.
"""

from __future__ import annotations

import struct
from pathlib import Path

_HEADER = struct.Struct("<HBBBBBxI")
_TERMINATE, _RESET, _OPEN, _READ = 1, 2, 4, 5
_ACK, _NAK = 128, 129
_WRONG_SESSION, _NO_SESSION_FREE, _END_OF_FILE, _UNKNOWN, _NOT_FOUND = 4, 5, 6, 7, 10
DATA_BYTES = 239
_SESSION = 1


class FileServer:
    """``reads``: answered so far."""

    def __init__(self, folder: Path) -> None:
        self.reads = 0
        self._folder = folder.resolve()
        self._content: bytes | None = None
        self._last: tuple[int, bytes] | None = None

    def answer(self, request: bytes) -> bytes:
        """Payload of a request -> payload of the answer."""
        number, session, code, size, _, _, offset = _HEADER.unpack_from(request)
        if self._last is not None and self._last[0] == number:
            return self._last[1]
        data = request[_HEADER.size : _HEADER.size + size]
        error, found = self._do(code, session, size, offset, data)
        reply = _HEADER.pack(
            *((number + 1) % 2**16, _SESSION if code == _OPEN else session),
            *(_NAK if error else _ACK, 1 if error else len(found), code, 0, offset),
        )
        reply += bytes([error]) if error else found
        self._last = (number, reply)
        return reply

    def _do(self, code: int, session: int, size: int, offset: int, data: bytes) -> tuple[int, bytes]:
        """Error (0: none) and data."""
        if code == _RESET:
            self._content = None
            return 0, b""
        if code == _OPEN:
            return self._open(data)
        if code not in (_READ, _TERMINATE):
            return _UNKNOWN, b""
        if self._content is None or session != _SESSION:
            return _WRONG_SESSION, b""
        if code == _TERMINATE:
            self._content = None
            return 0, b""
        self.reads += 1
        found = self._content[offset : offset + min(size, DATA_BYTES)]
        return (0, found) if found else (_END_OF_FILE, b"")

    def _open(self, data: bytes) -> tuple[int, bytes]:
        if self._content is not None:
            return _NO_SESSION_FREE, b""
        path = (self._folder / data.decode(errors="replace").lstrip("/")).resolve()
        if not path.is_relative_to(self._folder) or not path.is_file():
            return _NOT_FOUND, b""
        self._content = path.read_bytes()
        return 0, len(self._content).to_bytes(4, "little")

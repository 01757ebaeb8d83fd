"""Telemetry logs (``.tlog``), as ground stations write them: before each frame the time of its arrival,
microseconds since 1970 as eight bytes, the first the highest. Mission Planner, MAVProxy and pymavlink
read them."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path

from calib.errors import FormatError, InputError
from calib.files import output_errors
from daemon.closing import Closing
from daemon.link.wire import Frame, Splitter

_STAMP = struct.Struct(">Q")
_LEAST_BYTES = 8
#: 2001 and 2100: a time outside is no time, and the log is damaged there.
_EARLIEST_US, _LATEST_US = 10**15, 4 * 10**15


class LogWriter(Closing):
    """Appends to a log. Each frame is handed to the system at once: killing this process loses none.

    A full disk never stops the link: :attr:`fault` says what is wrong, and frames are left out until
    there is room again.
    """

    def __init__(self, path: Path) -> None:
        """
        Raises:
            OutputError: it cannot be written.
        """
        self.path = path
        self.frames = 0
        self.left_out = 0
        self.fault: str | None = None
        with output_errors(path):
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
            self._size = os.fstat(self._file).st_size

    def write(self, at_us: int, raw: bytes) -> None:
        data = _STAMP.pack(at_us) + raw
        try:
            written = os.write(self._file, data)
            if written < len(data):
                os.ftruncate(self._file, self._size)
                raise OSError("the disk is full")
        except OSError as error:
            self.left_out += 1
            self.fault = f"{self.path.name} cannot be written: {(error.strerror or str(error)).lower()}."
            return
        self._size += written
        self.frames += 1
        self.fault = None

    def close(self) -> None:
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def read_log(path: Path) -> Iterator[tuple[int, Frame]]:
    """Time (microseconds since 1970) and frame, one after the other.

    An end that is cut (a killed program, a pulled card) is left out. Damage in the middle is passed
    over to the next frame that is whole.

    Raises:
        InputError: it cannot be read. FormatError: there is no frame in it.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"Cannot read {path}: {(error.strerror or str(error)).lower()}.") from error
    found = False
    for at_us, raw in _records(data):
        for frame in Splitter().feed(raw):
            found = True
            yield at_us, frame
    if not found:
        raise FormatError(
            f"{path} holds no MAVLink messages: it is no telemetry log (.tlog), or an empty one."
        )


def _records(data: bytes) -> Iterator[tuple[int, bytes]]:
    place = 0
    while place + _STAMP.size + _LEAST_BYTES <= len(data):
        (at_us,) = _STAMP.unpack_from(data, place)
        size = _frame_bytes(data, place + _STAMP.size)
        whole = size is not None and place + _STAMP.size + size <= len(data)
        if not whole or size is None or not _EARLIEST_US < at_us < _LATEST_US:
            place += 1
            continue
        start = place + _STAMP.size
        yield at_us, data[start : start + size]
        place = start + size


def _frame_bytes(data: bytes, start: int) -> int | None:
    """Length of the frame that starts at ``start`` by its header; None where none starts."""
    if data[start] == 0xFE:
        return data[start + 1] + 8
    if data[start] == 0xFD and start + 2 < len(data):
        return data[start + 1] + 12 + (13 if data[start + 2] & 1 else 0)
    return None

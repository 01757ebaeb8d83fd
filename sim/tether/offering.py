"""A camera that offers its photos: a MAVLink component beside the vehicle that tells of each file
(CAMERA_IMAGE_CAPTURED with ``file_url``) and gives it, over MAVLink or HTTP."""

from __future__ import annotations

import functools
import http.server
import queue
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from daemon.closing import Closing
from daemon.link.address import Address
from daemon.link.transport import Origin, Transport, open_transport
from daemon.link.wire import FILE_PAYLOAD_BYTES, Packer
from sim.tether.file_server import FileServer
from sim.tether.shutter import Exposure
from sim.vehicle.dialect import MavMessage, mavlink

COMPONENT = 100
Way = Literal["mftp", "http"]
_HEARTBEAT_S = 1.0
_RANGE = re.compile(r"bytes=(\d+)-")


class Offering(Closing):
    """Photos of ``folder``. Speaks on the line that :meth:`open_line` opens, in that line's thread."""

    def __init__(self, folder: Path, way: Way, clock: Callable[[], float] = time.monotonic) -> None:
        self.files = FileServer(folder)
        self._way, self._clock = way, clock
        self._told: queue.SimpleQueue[MavMessage] = queue.SimpleQueue()
        self._began_s = clock()
        self._web: http.server.ThreadingHTTPServer | None = None
        if way == "http":
            handler = functools.partial(_Handler, directory=str(folder))
            self._web = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
            threading.Thread(target=self._web.serve_forever, name="web", daemon=True).start()

    def close(self) -> None:
        if self._web is not None:
            self._web.shutdown()
            self._web.server_close()

    def url(self, name: str) -> str:
        if self._web is not None:
            return f"http://127.0.0.1:{self._web.server_port}/{name}"
        return f"mftp://[;comp={COMPONENT}]/{name}"

    def tell(self, index: int, name: str, exposure: Exposure) -> None:
        """The file of the camera's photo ``index`` is there. From any thread."""
        boot_ms = round(1e3 * (self._clock() - self._began_s))
        self._told.put(
            mavlink.MAVLink_camera_image_captured_message(
                *(boot_ms, round(exposure.utc_s * 1e6), 0, 0, 0, 0, 0),
                *([1.0, 0.0, 0.0, 0.0], index, 1, self.url(name).encode()),
            )
        )

    def open_line(self, address: Address) -> Transport:
        """For :class:`daemon.link.live.Link`."""
        return _Shared(open_transport(address), self)

    def due(self) -> list[MavMessage]:
        """What is to be told now."""
        found = []
        while not self._told.empty():
            found.append(self._told.get())
        return found


class _Shared:
    """A line on which the camera speaks as a component of the vehicle, beside whoever uses it."""

    def __init__(self, line: Transport, offering: Offering) -> None:
        self._line, self._offering = line, offering
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self._packer: Packer | None = None
        self._system = 0
        self._beat_s = 0.0

    def read(self) -> list[tuple[bytes, Origin]]:
        found = self._line.read()
        for data, _ in found:
            for message in self._parser.parse_buffer(data) or []:
                self._hear(message)
        self._tell()
        return found

    def write(self, data: bytes) -> bool:
        self._tell()
        return self._line.write(data)

    def _hear(self, message: MavMessage) -> None:
        kind = message.get_type()
        if kind == "HEARTBEAT" and message.get_srcComponent() == 1 and self._packer is None:
            self._system = message.get_srcSystem()
            self._packer = Packer(self._system, COMPONENT)
        to_us = (getattr(message, "target_system", 0), getattr(message, "target_component", 0))
        if kind == "FILE_TRANSFER_PROTOCOL" and to_us == (self._system, COMPONENT):
            reply = self._offering.files.answer(bytes(message.payload)).ljust(FILE_PAYLOAD_BYTES, b"\0")
            asker = (message.get_srcSystem(), message.get_srcComponent())
            self._say(mavlink.MAVLink_file_transfer_protocol_message(0, *asker, list(reply)))

    def _tell(self) -> None:
        if self._packer is None:
            return
        if time.monotonic() - self._beat_s > _HEARTBEAT_S:
            self._beat_s = time.monotonic()
            self._say(
                mavlink.MAVLink_heartbeat_message(
                    *(mavlink.MAV_TYPE_CAMERA, mavlink.MAV_AUTOPILOT_INVALID, 0, 0),
                    *(mavlink.MAV_STATE_ACTIVE, 3),
                )
            )
        for message in self._offering.due():
            self._say(message)

    def _say(self, message: MavMessage) -> None:
        if self._packer is not None:
            self._line.write(self._packer.pack(message))

    def fileno(self) -> int:
        return self._line.fileno()

    def answer(self, origin: Origin) -> None:
        self._line.answer(origin)

    def close(self) -> None:
        self._line.close()


class _Handler(http.server.SimpleHTTPRequestHandler):
    """Files with their parts, as web servers of cameras give them; says nothing."""

    def do_GET(self) -> None:
        path = Path(self.translate_path(self.path))
        if not path.is_file():
            self.send_error(404)
            return
        content = path.read_bytes()
        wanted = _RANGE.fullmatch(self.headers.get("Range", ""))
        start = int(wanted[1]) if wanted else 0
        if start and start >= len(content):
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{len(content)}")
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        self.send_response(206 if wanted else 200)
        if wanted:
            self.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
        self.send_header("Content-Length", str(len(content) - start))
        self.end_headers()
        self.wfile.write(content[start:])

    def log_message(self, format: str, *args: object) -> None:
        del format, args

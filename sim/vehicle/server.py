"""A :class:`Vehicle` on a UDP socket, in wall time times ``speed_up``: the rim around the pure core."""

from __future__ import annotations

import random
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from sim.vehicle.dialect import MavMessage, mavlink
from sim.vehicle.faults import Faults, FaultyLink
from sim.vehicle.options import VehicleOptions
from sim.vehicle.vehicle import CAMERA_COMPONENT, Vehicle

#: Wall time between two looks at the socket (s).
LOOK_S = 0.005
#: After a stall (suspended machine, debugger) time goes on from there, not at once (s of wall time).
LONGEST_STEP_S = 0.25
DATAGRAM_BYTES = 1400


class VehicleServer:
    """Context manager that runs the vehicle in a thread; sends to ``address``, hears from anywhere.

    ``camera``: a simulated camera listens there, on a wire of its own: it hears everything without the
    faults of the link, each photo's true pose before the photo, and its questions are answered to it alone.
    ``speed_up`` and ``vehicle`` may be looked at while it runs; :meth:`run` serves without a thread.
    """

    def __init__(
        self,
        options: VehicleOptions,
        address: tuple[str, int],
        *,
        speed_up: float = 1.0,
        faults: Faults | None = None,
        seed: int = 0,
        camera: tuple[str, int] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        faults = faults or Faults()
        self._rng, self._faults = random.Random(seed), faults
        self.vehicle = Vehicle(options, self._rng, faults)
        self.speed_up = speed_up
        self.dropped = 0
        self._address, self._camera = address, camera
        self._clock = clock
        self._link = FaultyLink(faults, random.Random(seed + 1))
        self._senders = _senders(options.system_id)
        self._to_camera = _senders(options.system_id)
        self._poses_told = 0
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self._before_s = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.run, name="vehicle", daemon=True)

    def __enter__(self) -> VehicleServer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self._thread.join(5)

    def power_cycle(self, off_s: float) -> None:
        """A battery out and the next one in, ``off_s`` later: clock, numbers and streams begin anew; what is
        stored stays."""
        before = self.vehicle
        boot_utc_s = before.options.boot_utc_s + before.boot_s + off_s
        after = Vehicle(replace(before.options, boot_utc_s=boot_utc_s), self._rng, self._faults)
        after.transfer.stored = before.transfer.stored
        after.link_s = before.link_s
        self._poses_told = 0
        self.vehicle = after

    def stop(self) -> None:
        self._stop.set()

    def run(self) -> None:
        """Serve until :meth:`stop`."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
            link.settimeout(LOOK_S)
            link.bind(("", 0))
            self._before_s = self._clock()
            while not self._stop.is_set():
                out = self._hear(link) + self._let_time_pass()
                self._tell_camera(link, [*self._poses(), *out])
                for message in self._link.send(out, self.vehicle.link_s):
                    self._send(link, self._address, _packed(message, self._senders))

    def _let_time_pass(self) -> list[MavMessage]:
        now = self._clock()
        passed, self._before_s = min(now - self._before_s, LONGEST_STEP_S), now
        return self.vehicle.step(passed * self.speed_up, passed)

    def _poses(self) -> list[MavMessage]:
        """Of the photos since the last look."""
        photos = self.vehicle.photos[self._poses_told :]
        self._poses_told += len(photos)
        return [self.vehicle.telemetry.camera_pose(photo) for photo in photos]

    def _tell_camera(self, link: socket.socket, messages: list[MavMessage]) -> None:
        """In few datagrams: a camera that renders looks at its socket seldom."""
        if self._camera is None:
            return
        data = b""
        for message in messages:
            packed = _packed(message, self._to_camera)
            if len(data) + len(packed) > DATAGRAM_BYTES:
                self._send(link, self._camera, data)
                data = b""
            data += packed
        if data:
            self._send(link, self._camera, data)

    def _send(self, link: socket.socket, address: tuple[str, int], data: bytes) -> None:
        try:
            link.sendto(data, address)
        except OSError:  # nobody listens yet: a vehicle does not mind
            self.dropped += 1

    def _hear(self, link: socket.socket) -> list[MavMessage]:
        """Everything that has arrived, answered; waits a moment where there is nothing."""
        out: list[MavMessage] = []
        try:
            data, origin = link.recvfrom(4096)
            out += self._let_time_pass()  # What it answers is said at the time of the question.
            link.setblocking(False)
            while data:
                for message in self._parser.parse_buffer(data) or []:
                    if origin == self._camera:
                        out += self._from_camera(link, message)
                    elif self._link.lets_in(message, self.vehicle.link_s):
                        out += self._from_ground(link, message)
                data, origin = link.recvfrom(4096)
        except (TimeoutError, BlockingIOError, ConnectionError):
            pass
        link.settimeout(LOOK_S)
        return out

    def _from_camera(self, link: socket.socket, message: MavMessage) -> list[MavMessage]:
        """What the camera says as a component of the vehicle is passed on, as autopilots do."""
        own = (message.get_srcSystem(), message.get_srcComponent())
        if own == (self.vehicle.options.system_id, CAMERA_COMPONENT):
            message.from_component = CAMERA_COMPONENT
            return [message]
        self._tell_camera(link, self.vehicle.receive(message))
        return []

    def _from_ground(self, link: socket.socket, message: MavMessage) -> list[MavMessage]:
        to = (getattr(message, "target_system", 0), getattr(message, "target_component", 0))
        if self._camera is not None and to == (self.vehicle.options.system_id, CAMERA_COMPONENT):
            self._send(link, self._camera, bytes(message.get_msgbuf()))
            return []
        return self.vehicle.receive(message)


def _senders(system_id: int) -> dict[int, Any]:
    """By component: each numbers its messages for itself."""
    return {component: mavlink.MAVLink(None, system_id, component) for component in (1, 100)}


def _packed(message: MavMessage, senders: dict[int, Any]) -> bytes:
    sender = senders[getattr(message, "from_component", 1)]
    data: bytes = message.pack(sender)
    sender.seq = (sender.seq + 1) % 256
    return data

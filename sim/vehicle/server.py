"""A :class:`Vehicle` on a UDP socket, in wall time times ``speed_up``: the rim around the pure core."""

from __future__ import annotations

import random
import socket
import threading
import time
from collections.abc import Callable

from sim.vehicle.dialect import MavMessage, mavlink
from sim.vehicle.faults import Faults, FaultyLink
from sim.vehicle.options import VehicleOptions
from sim.vehicle.vehicle import Vehicle

#: Wall time between two looks at the socket (s).
LOOK_S = 0.005
#: After a stall (suspended machine, debugger) time goes on from there, not at once (s of wall time).
LONGEST_STEP_S = 0.25


class VehicleServer:
    """Context manager that runs the vehicle in a thread; sends to ``address``, hears from anywhere.

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
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        faults = faults or Faults()
        self.vehicle = Vehicle(options, random.Random(seed), faults)
        self.speed_up = speed_up
        self.dropped = 0
        self._address = address
        self._clock = clock
        self._link = FaultyLink(faults, random.Random(seed + 1))
        self._senders = {c: mavlink.MAVLink(None, options.system_id, c) for c in (1, 100)}
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
                for message in self._link.send(out, self.vehicle.link_s):
                    sender = self._senders[getattr(message, "from_component", 1)]
                    self._send(link, message.pack(sender))
                    sender.seq = (sender.seq + 1) % 256

    def _let_time_pass(self) -> list[MavMessage]:
        now = self._clock()
        passed, self._before_s = min(now - self._before_s, LONGEST_STEP_S), now
        return self.vehicle.step(passed * self.speed_up, passed)

    def _send(self, link: socket.socket, data: bytes) -> None:
        try:
            link.sendto(data, self._address)
        except OSError:  # nobody listens yet: a vehicle does not mind
            self.dropped += 1

    def _hear(self, link: socket.socket) -> list[MavMessage]:
        """Everything that has arrived, answered; waits a moment where there is nothing."""
        out: list[MavMessage] = []
        try:
            data = link.recv(4096)
            out += self._let_time_pass()  # What it answers is said at the time of the question.
            link.setblocking(False)
            while data:
                for message in self._parser.parse_buffer(data) or []:
                    if self._link.lets_in(message, self.vehicle.link_s):
                        out += self.vehicle.receive(message)
                data = link.recv(4096)
        except (TimeoutError, BlockingIOError, ConnectionError):
            pass
        link.settimeout(LOOK_S)
        return out

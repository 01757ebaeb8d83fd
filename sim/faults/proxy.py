"""A :class:`FaultyLine` between real sockets: vehicle on one side, the ground on the other."""

from __future__ import annotations

import contextlib
import random
import select
import socket
import threading
import time
from collections.abc import Sequence

from mission.encode import Item
from sim.faults import station
from sim.faults.ends import End, UdpEnd
from sim.faults.line import FaultyLine, LineFaults
from sim.faults.station import OtherStation
from sim.vehicle.dialect import MavMessage, mavlink

LOOK_S = 0.005


class Proxy:
    """Context manager that runs in a thread. The vehicle sends to :attr:`vehicle_address`.

    Args:
        other: what another ground station uploads when a moment OVERWRITE comes.
    """

    def __init__(
        self, faults: LineFaults, seed: int = 0, end: End | None = None, other: Sequence[Item] = ()
    ) -> None:
        self.end = end or UdpEnd()
        self.line = FaultyLine(faults, random.Random(seed))
        self.station = OtherStation(1, other)
        self.open = True
        self._vehicle = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._vehicle.bind(("127.0.0.1", 0))
        self._vehicle.setblocking(False)
        self.vehicle_address: tuple[str, int] = self._vehicle.getsockname()
        self._peer: tuple[str, int] | None = None
        self._parsers = {side: _parser() for side in (True, False)}
        self._sender = mavlink.MAVLink(None, station.SYSTEM_ID, station.COMPONENT_ID)
        self._overwrites = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="proxy", daemon=True)

    @property
    def url(self) -> str:
        return self.end.url

    def __enter__(self) -> Proxy:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(5)
        self.end.close()
        self._vehicle.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            with contextlib.suppress(OSError):  # The end was hung up just now.
                select.select([self._vehicle.fileno(), self.end.fileno()], [], [], LOOK_S)
            now = time.monotonic()
            self._from_vehicle(now)
            for data in self.end.read():
                for frame in self._frames(data, True):
                    self.line.send(frame, True, now)
            self._other_station(now)
            for to_vehicle, data in self.line.arrived(time.monotonic()):
                if not self.open:
                    continue
                if to_vehicle:
                    self._to_vehicle(data)
                else:
                    self.end.write(data)

    def _from_vehicle(self, now: float) -> None:
        while True:
            try:
                data, self._peer = self._vehicle.recvfrom(65536)
            except BlockingIOError:
                return
            except ConnectionError:
                continue
            for message in self._parsers[False].parse_buffer(data) or []:
                self.line.send(bytes(message.get_msgbuf()), False, now)
                self._speak(self.station.receive(message, now))

    def _other_station(self, now: float) -> None:
        if self.line.overwrites > self._overwrites and not self.station.busy:
            self._overwrites += 1
            self._speak(self.station.begin(now))
        self._speak(self.station.tick(now))

    def _speak(self, messages: Sequence[MavMessage]) -> None:
        """The other station has a line of its own, without faults."""
        for message in messages:
            self._to_vehicle(message.pack(self._sender))
            self._sender.seq = (self._sender.seq + 1) % 256

    def _to_vehicle(self, data: bytes) -> None:
        if self._peer is not None:
            self._vehicle.sendto(data, self._peer)

    def _frames(self, data: bytes, side: bool) -> list[bytes]:
        return [bytes(m.get_msgbuf()) for m in self._parsers[side].parse_buffer(data) or []]


def _parser() -> MavMessage:
    made = mavlink.MAVLink(None)
    made.robust_parsing = True
    return made

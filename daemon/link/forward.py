"""Passing the link on to a ground station over UDP, byte for byte, both ways."""

from __future__ import annotations

from daemon.link.address import Address, Kind
from daemon.link.transport import Udp
from daemon.link.wire import Frame, Splitter


class Forward:
    """One ground station at a host and port; it answers to where we send from.

    Its frames are passed on as they are, its own signature included: it speaks for itself.
    """

    def __init__(self, host: str, port: int) -> None:
        """
        Raises:
            OSError: no such host.
        """
        self._udp = Udp(Address(Kind.UDP_OUT, host, port))
        self._splitter = Splitter()
        self.dropped = 0

    def fileno(self) -> int:
        return self._udp.fileno()

    def send(self, raw: bytes) -> None:
        try:
            sent = self._udp.write(raw)
        except OSError:  # its network is down: the vehicle's link must not mind
            sent = False
        self.dropped += not sent

    def read(self) -> list[Frame]:
        """What the station says, as whole frames."""
        try:
            found = self._udp.read()
        except OSError:
            return []
        return [frame for data, _ in found for frame in self._splitter.feed(data)]

    def close(self) -> None:
        self._udp.close()

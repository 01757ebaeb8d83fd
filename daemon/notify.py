"""Tells systemd how the program does: sd_notify(3) by hand, one datagram for each word.

Without ``NOTIFY_SOCKET`` nothing is sent. What is told comes from the main loop, so that the watchdog
notices when that hangs; long work without a message is announced with the time it may take.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from daemon.closing import Closing
from daemon.live.schemas import Capture, Message, Status, Verdict

#: The status is told no more often.
STATUS_S = 1.0


class Notifier(Closing):
    """Ready on the first message, stopping when it is closed.

    Args:
        environment: where ``NOTIFY_SOCKET``, ``WATCHDOG_USEC`` and ``WATCHDOG_PID`` are looked for.
        clock: seconds on a clock that never steps.
    """

    def __init__(
        self,
        environment: Mapping[str, str] = os.environ,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._socket: socket.socket | None = None
        place = environment.get("NOTIFY_SOCKET", "")
        if place.startswith(("/", "@")):
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)
        # "@" stands for the zero byte of a socket without a file.
        self._place = "\0" + place[1:] if place.startswith("@") else place
        self._watchdog_s = _watchdog_s(environment)
        self._beat_s = self._told_s = -1e9
        self._ready = False
        self._phase, self._photos, self._verdict = "waiting", 0, ""
        self._told = ""

    def tell(self, message: Message) -> None:
        """A sign of life; and the status, if ``message`` changes it."""
        if self._socket is None:
            return
        if isinstance(message, Status):
            self._phase = message.phase
        elif isinstance(message, Capture):
            self._photos = message.photos
        elif isinstance(message, Verdict):
            self._verdict = ("" if message.final else "so far ") + message.verdict.replace("_", " ")
        now = self._clock()
        # What could not be sent is sent with the next message.
        self._ready = self._ready or self._send("READY=1")
        if self._watchdog_s is not None and now - self._beat_s >= self._watchdog_s / 4:
            self._beat_s = now if self._send("WATCHDOG=1") else self._beat_s
        status = ", ".join([self._phase, f"{self._photos} photos", *filter(None, [self._verdict])])
        if status != self._told and now - self._told_s >= STATUS_S and self._send(f"STATUS={status}"):
            self._told, self._told_s = status, now

    @contextmanager
    def busy(self, longest_s: float) -> Iterator[None]:
        """Signs of life while something goes on that says nothing, for so long at most."""
        if self._socket is None or self._watchdog_s is None:
            yield
            return
        every_s, over = self._watchdog_s / 4, threading.Event()

        def beat() -> None:
            end = time.monotonic() + longest_s
            while time.monotonic() < end:
                self._send("WATCHDOG=1")
                if over.wait(every_s):
                    return

        thread = threading.Thread(target=beat, name="signs of life", daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()

    def close(self) -> None:
        if self._socket is not None:
            self._send("STOPPING=1")
            self._socket.close()
            self._socket = None

    def _send(self, text: str) -> bool:
        """Whether it arrived."""
        assert self._socket is not None
        try:
            self._socket.sendto(text.encode(), self._place)
        except OSError:  # systemd is busy or gone: the work goes on
            return False
        return True


def _watchdog_s(environment: Mapping[str, str]) -> float | None:
    """How often a sign of life is due at least; None: nobody watches this process."""
    given, pid = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
    if not given.isdigit() or int(given) == 0 or (pid and pid != str(os.getpid())):
        return None
    return int(given) / 1e6

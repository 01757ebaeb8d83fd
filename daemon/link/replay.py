"""A recorded flight as a source: the same events in the same order at the log's times, at once."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from pathlib import Path

from daemon.closing import Closing
from daemon.link.state import Heard, LinkState
from daemon.link.tlog import read_log


class Replay(Closing):
    """Reads as fast as it is asked. Two replays of one log are equal, and equal to the flight itself.
    Whoever leaves :meth:`events` and comes back goes on where he was. ``ended``: all of it was read.

    Raises (while it runs):
        InputError: the log cannot be read. FormatError: it is none.
    """

    def __init__(self, path: Path) -> None:
        self._frames = read_log(path)
        self._state = LinkState()
        self._at_s = 0.0
        self._closed = False
        self._ahead: deque[Heard] = deque()
        self.ended = False

    @property
    def state(self) -> LinkState:
        return self._state

    def now_s(self) -> float:
        return self._at_s

    def events(self, wait_s: float | None = None) -> Iterator[Heard]:
        del wait_s
        while not self._closed:
            while self._ahead:
                yield self._ahead.popleft()
            frame_at = next(self._frames, None)
            if frame_at is None:
                self.ended = True
                return
            self._at_s = frame_at[0] / 1e6
            self._state, events = self._state.hear(frame_at[1], self._at_s)
            self._ahead.extend(Heard(self._at_s, event) for event in events)

    def close(self) -> None:
        self._closed = True

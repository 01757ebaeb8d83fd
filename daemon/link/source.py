"""Where events come from: a vehicle now (:class:`daemon.link.live.Link`), or a recorded flight
(:class:`daemon.link.replay.Replay`), behind one interface."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from daemon.link.state import Heard, LinkState


class Source(Protocol):
    """Typed events in their order, and what is known so far."""

    @property
    def state(self) -> LinkState: ...

    def now_s(self) -> float:
        """The receiver's clock, seconds since 1970; in a replay the time of the last frame."""
        ...

    def events(self, wait_s: float | None = None) -> Iterator[Heard]:
        """Events as they come. Ends when the source is closed or at its end, or (``wait_s``) when for so
        long none came."""
        ...

    def close(self) -> None: ...

"""What goes wrong between vehicle and ground: a link that loses, doubles and delays messages.

The mission transfer itself is spared from random loss by default (``lose_transfers``), because
both sides repeat it; what is never repeated is what the daemon must cope with.
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Iterable
from dataclasses import dataclass, field

from sim.vehicle.dialect import MavMessage

_TRANSFER = ("MISSION_", "COMMAND_ACK", "PARAM_", "AUTOPILOT_VERSION")


@dataclass(frozen=True)
class Faults:
    """``drop_share``, ``repeat_share``: of the vehicle's messages. ``delay_s`` +- ``jitter_s`` (link
    time; jitter larger than the spacing of messages reorders them). ``reject_item``: this item of the
    first upload is refused. ``cut_at_item``: the link dies when this item of an upload arrives, for
    ``cut_s``. ``miss_photo_share``: triggers whose photo is never taken. ``power_cycles_s``: so long in the
    air the autopilot's power fails for ``off_s``; it flies on, as after a watchdog's restart."""

    drop_share: float = 0.0
    repeat_share: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0
    lose_transfers: bool = False
    reject_item: int | None = None
    cut_at_item: int | None = None
    cut_s: float = 10.0
    miss_photo_share: float = 0.0
    power_cycles_s: tuple[float, ...] = ()
    off_s: float = 1.5


@dataclass
class FaultyLink:
    """Pure but for the given random generator: messages and times in, messages out."""

    faults: Faults
    rng: random.Random
    cut_until_s: float = -1.0
    _queue: list[tuple[float, int, MavMessage]] = field(default_factory=list)
    _count: int = 0
    _cut_done: bool = False

    def lets_in(self, message: MavMessage, now_s: float) -> bool:
        """Whether a message to the vehicle arrives."""
        item = self.faults.cut_at_item
        uploading = item is not None and message.get_type().startswith("MISSION_ITEM")
        if uploading and not self._cut_done and message.seq >= item:
            self._cut_done, self.cut_until_s = True, now_s + self.faults.cut_s
        return now_s >= self.cut_until_s

    def send(self, messages: Iterable[MavMessage], now_s: float) -> list[MavMessage]:
        """What leaves the link now, of ``messages`` and of what was held back."""
        for message in messages:
            for _ in range(self._copies(message.get_type(), now_s)):
                due = now_s + max(0.0, self.faults.delay_s + self.faults.jitter_s * self.rng.uniform(-1, 1))
                self._count += 1
                heapq.heappush(self._queue, (due, self._count, message))
        out = []
        while self._queue and self._queue[0][0] <= now_s:
            out.append(heapq.heappop(self._queue)[2])
        return out

    def _copies(self, name: str, now_s: float) -> int:
        if now_s < self.cut_until_s:
            return 0
        if name.startswith(_TRANSFER) and not self.faults.lose_transfers:
            return 1
        copies = 2 if self.rng.random() < self.faults.repeat_share else 1
        return sum(self.rng.random() >= self.faults.drop_share for _ in range(copies))

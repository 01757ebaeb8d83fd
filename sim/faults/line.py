"""What happens to the bytes on their way. Pure but for the random generator given to it."""

from __future__ import annotations

import heapq
import random
from dataclasses import dataclass, field
from enum import StrEnum

_TRANSFER = frozenset({39, 40, 43, 44, 45, 47, 51, 73})


class MomentKind(StrEnum):
    CUT = "cut"  # nothing gets through, either way
    SILENT = "silent"  # nothing from the vehicle gets through
    DEAF = "deaf"  # nothing to the vehicle gets through
    OVERWRITE = "overwrite"  # another ground station uploads its own mission


@dataclass(frozen=True)
class Moment:
    """Begins when the ground sends its ``step``-th message of the mission protocol (from 1, reading and
    writing alike) and lasts ``seconds``."""

    step: int
    kind: MomentKind
    seconds: float = 0.0


@dataclass(frozen=True)
class LineFaults:
    """Shares and delays hold in both directions; a jitter larger than the messages' spacing reorders."""

    drop_share: float = 0.0
    repeat_share: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0
    moments: tuple[Moment, ...] = ()


@dataclass
class FaultyLine:
    """``send`` what somebody says, ``arrived`` what gets through by now. Times in seconds, any clock."""

    faults: LineFaults
    rng: random.Random
    steps: int = 0
    overwrites: int = 0
    _blocked_until_s: dict[bool, float] = field(default_factory=lambda: {True: -1.0, False: -1.0})
    _queue: list[tuple[float, int, bool, bytes]] = field(default_factory=list)
    _count: int = 0

    def send(self, data: bytes, to_vehicle: bool, now_s: float) -> None:
        if to_vehicle and is_transfer(data):
            self.steps += 1
            for moment in self.faults.moments:
                if moment.step == self.steps:
                    self._begin(moment, now_s)
        if now_s < self._blocked_until_s[to_vehicle]:
            return
        for _ in range(2 if self.rng.random() < self.faults.repeat_share else 1):
            if self.rng.random() < self.faults.drop_share:
                continue
            late_s = max(0.0, self.faults.delay_s + self.faults.jitter_s * self.rng.uniform(-1, 1))
            self._count += 1
            heapq.heappush(self._queue, (now_s + late_s, self._count, to_vehicle, data))

    def arrived(self, now_s: float) -> list[tuple[bool, bytes]]:
        """(to the vehicle, bytes), in the order of their arrival."""
        found = []
        while self._queue and self._queue[0][0] <= now_s:
            _, _, to_vehicle, data = heapq.heappop(self._queue)
            if now_s >= self._blocked_until_s[to_vehicle]:
                found.append((to_vehicle, data))
        return found

    def _begin(self, moment: Moment, now_s: float) -> None:
        if moment.kind is MomentKind.OVERWRITE:
            self.overwrites += 1
            return
        for to_vehicle, without in ((True, MomentKind.SILENT), (False, MomentKind.DEAF)):
            if moment.kind is not without:
                self._blocked_until_s[to_vehicle] = now_s + moment.seconds


def is_transfer(data: bytes) -> bool:
    """A MAVLink 2 frame of the mission protocol: item, request, list, count, clear, acknowledgement."""
    return len(data) >= 12 and data[0] == 0xFD and not data[8] and not data[9] and data[7] in _TRANSFER

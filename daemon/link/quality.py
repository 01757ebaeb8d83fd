"""How good the link is: messages lost by their numbers, age of the last heartbeat. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

WINDOW_S = 10.0
#: A number that lies further back than this in a circle of 256 is a jump ahead.
_BACK = 64


@dataclass(frozen=True)
class Numbers:
    """One sender's sequence numbers. ``missing``: not come so far, the latest of them.

    Messages that come late are taken off the lost again; those that come twice count as repeated.
    """

    last: int
    received: int = 1
    lost: int = 0
    repeated: int = 0
    missing: tuple[int, ...] = ()

    def add(self, sequence: int) -> Numbers:
        ahead = (sequence - self.last) % 256
        if 0 < ahead < 256 - _BACK:
            gap = tuple((self.last + step) % 256 for step in range(1, ahead))
            missing = (*(n for n in self.missing if n not in gap and n != sequence), *gap)[-_BACK:]
            lost = self.lost + len(gap)
            return replace(self, last=sequence, received=self.received + 1, lost=lost, missing=missing)
        if sequence in self.missing:
            left = tuple(n for n in self.missing if n != sequence)
            return replace(self, received=self.received + 1, lost=self.lost - 1, missing=left)
        return replace(self, repeated=self.repeated + 1)


@dataclass(frozen=True)
class Quality:
    """Counts of one vehicle since the start of the link; shares over the last :data:`WINDOW_S`."""

    senders: dict[int, Numbers] = field(default_factory=dict)
    heartbeat_s: float | None = None
    _marks: tuple[tuple[float, int, int], ...] = ()

    def hear(self, component_id: int, sequence: int, at_s: float) -> Quality:
        """With one more message of the vehicle's component ``component_id``."""
        before = self.senders.get(component_id)
        now = Numbers(sequence) if before is None else before.add(sequence)
        senders = {**self.senders, component_id: now}
        marks = self._marks
        if not marks or at_s >= marks[-1][0] + 1.0:
            start = tuple(mark for mark in marks if mark[0] >= at_s - WINDOW_S)
            marks = (*start, (at_s, *_sums(senders)))
        return replace(self, senders=senders, _marks=marks)

    def beat(self, at_s: float) -> Quality:
        return replace(self, heartbeat_s=at_s)

    def age_s(self, now_s: float) -> float | None:
        """Since the last heartbeat; None before the first."""
        return None if self.heartbeat_s is None else max(0.0, now_s - self.heartbeat_s)

    @property
    def received(self) -> int:
        return _sums(self.senders)[0]

    @property
    def lost(self) -> int:
        return _sums(self.senders)[1]

    @property
    def repeated(self) -> int:
        return sum(n.repeated for n in self.senders.values())

    @property
    def loss_share(self) -> float | None:
        """Of the messages sent lately, those that did not come; None before anything came."""
        received, lost = _sums(self.senders)
        if not received:
            return None
        _, received0, lost0 = self._marks[0]
        if received == received0:
            received0 = lost0 = 0
        sent = received - received0 + lost - lost0
        return max(0.0, (lost - lost0) / sent) if sent > 0 else 0.0


def _sums(senders: dict[int, Numbers]) -> tuple[int, int]:
    return sum(n.received for n in senders.values()), sum(n.lost for n in senders.values())

"""MAVLink's mission protocol, the ground's side, as state machines without clock or socket.

https://mavlink.io/en/services/mission.html, and what autopilots do beside it (measured): ArduPilot asks
with MISSION_REQUEST even of integer clients, answers items out of order with INVALID_SEQUENCE which
ends nothing, and gives a stalled upload up after 8 s; PX4 gives up without a word. Every message may be
lost, late or doubled: each exchange repeats what is not answered and gives up after a time of silence.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Protocol

from daemon.link.message import Message
from daemon.link.wire import COMPONENT_ID, SYSTEM_ID, Outgoing, ask_message, mavlink, read_parameter
from mission.encode import Item

_AUTOPILOT = 1
_INVALID_SEQUENCE = int(mavlink.MAV_MISSION_INVALID_SEQUENCE)
REASONS = {
    1: "it reports an error", 2: "it does not know the frame of an item", 3: "it does not know a command",
    4: "it has no room for so many items", 5: "an item is not valid",
    **{number: f"param {number - 5} of an item is not valid" for number in range(6, 13)},
    13: "items came out of order", 14: "it takes no mission now, perhaps from another ground station",
    15: "it gave the transfer up",
}  # fmt: skip


class Kind(IntEnum):
    """MAV_MISSION_TYPE."""

    MISSION = 0
    FENCE = 1


@dataclass(frozen=True)
class Patience:
    """``repeat_s``: what is not answered is said again. ``silence_s``: then it is given up; longer than the
    autopilots take to give an upload up themselves (8 s, 5 s), so that they answer again afterwards."""

    repeat_s: float = 1.5
    silence_s: float = 12.0


class Exchange(Protocol):
    """Something said to the vehicle that it answers. ``over``: nothing more will be said."""

    over: bool

    def start(self, now_s: float) -> list[Outgoing]: ...

    def receive(self, message: Message, now_s: float) -> list[Outgoing]:
        """``message`` came from the vehicle."""
        ...

    def tick(self, now_s: float) -> list[Outgoing]: ...


class _Repeating(ABC):
    """Says its question again while it is not answered, and gives up after a silence.

    ``_heard_s``: when the vehicle last answered (at first: when it was first asked).
    """

    patience: Patience
    over: bool
    _heard_s: float
    _said_s: float

    def start(self, now_s: float) -> list[Outgoing]:
        self._heard_s = now_s
        return self._ask(now_s)

    def tick(self, now_s: float) -> list[Outgoing]:
        if self.over:
            return []
        if now_s - self._heard_s > self.patience.silence_s:
            self.over = True
            return []
        return self._ask(now_s) if self._open() and now_s - self._said_s > self.patience.repeat_s else []

    def _ask(self, now_s: float) -> list[Outgoing]:
        self._said_s = now_s
        return self._question()

    def _open(self) -> bool:
        """Whether it is for us to say something."""
        return True

    @abstractmethod
    def _question(self) -> list[Outgoing]: ...


def _for_us(message: Message, kind: Kind) -> bool:
    to_us = (message.integer("target_system"), message.integer("target_component")) == (
        SYSTEM_ID,
        COMPONENT_ID,
    )
    return to_us and message.integer("mission_type") == kind


@dataclass
class Upload(_Repeating):
    """``items`` -> vehicle. ``sent``: items that it has asked for. ``result``: None while under way or after
    silence, else MAV_MISSION_RESULT; 0 is accepted."""

    system_id: int
    items: Sequence[Item]
    kind: Kind = Kind.MISSION
    patience: Patience = field(default_factory=Patience)
    over: bool = False
    result: int | None = None
    sent: int = 0
    _heard_s: float = 0.0
    _said_s: float = 0.0
    _answered_s: dict[int, float] = field(default_factory=dict)

    @property
    def asked(self) -> int:
        """Number of the item asked for last."""
        return self.sent - 1

    def receive(self, message: Message, now_s: float) -> list[Outgoing]:
        if self.over or not _for_us(message, self.kind):
            return []
        if message.name in ("MISSION_REQUEST", "MISSION_REQUEST_INT"):
            return self._give(message.integer("seq"), now_s)
        if message.name == "MISSION_ACK":
            self._acknowledged(message.integer("type"), now_s)
        return []

    def _open(self) -> bool:
        # Once it asks for items it repeats its questions by itself.
        return self.sent == 0

    def _question(self) -> list[Outgoing]:
        return [mavlink.MAVLink_mission_count_message(*self._to, len(self.items), int(self.kind))]

    def _give(self, number: int, now_s: float) -> list[Outgoing]:
        # A question that was doubled on its way is answered once, one that is repeated again.
        just_now = now_s - self._answered_s.get(number, -1e9) < self.patience.repeat_s / 3
        if not 0 <= number < len(self.items) or just_now:
            return []
        self._heard_s = self._answered_s[number] = now_s
        self.sent = max(self.sent, number + 1)
        return [item_message(self._to, number, self.items[number], self.kind)]

    def _acknowledged(self, result: int, now_s: float) -> None:
        if result == _INVALID_SEQUENCE:
            self._heard_s = now_s
            return
        if result == 0 and self.sent < len(self.items):
            return  # late, of a transfer before this one
        self.over, self.result = True, result

    @property
    def _to(self) -> tuple[int, int]:
        return self.system_id, _AUTOPILOT


@dataclass
class Download(_Repeating):
    """Vehicle -> ``items``, complete when ``ok``. ``count`` None until told."""

    system_id: int
    kind: Kind = Kind.MISSION
    patience: Patience = field(default_factory=Patience)
    over: bool = False
    ok: bool = False
    result: int | None = None
    count: int | None = None
    items: list[Item] = field(default_factory=list)
    _heard_s: float = 0.0
    _said_s: float = 0.0

    def receive(self, message: Message, now_s: float) -> list[Outgoing]:
        if self.over or not _for_us(message, self.kind):
            return []
        if message.name == "MISSION_COUNT" and self.count is None:
            self._heard_s = now_s
            self.count = message.integer("count")
            return self._ask(now_s) if self.count else self._finish()
        if message.name == "MISSION_ITEM_INT" and self.count is not None:
            if message.integer("seq") != len(self.items):
                return []
            self._heard_s = now_s
            self.items.append(item_of(message))
            return self._ask(now_s) if len(self.items) < self.count else self._finish()
        if message.name == "MISSION_ACK" and message.integer("type") not in (0, _INVALID_SEQUENCE):
            self.over, self.result = True, message.integer("type")
        return []

    def _question(self) -> list[Outgoing]:
        to = (self.system_id, _AUTOPILOT)
        if self.count is None:
            return [mavlink.MAVLink_mission_request_list_message(*to, int(self.kind))]
        return [mavlink.MAVLink_mission_request_int_message(*to, len(self.items), int(self.kind))]

    def _finish(self) -> list[Outgoing]:
        self.over = self.ok = True
        return [mavlink.MAVLink_mission_ack_message(self.system_id, _AUTOPILOT, 0, int(self.kind))]


@dataclass
class Clear(_Repeating):
    """The vehicle forgets its mission or fence."""

    system_id: int
    kind: Kind = Kind.MISSION
    patience: Patience = field(default_factory=Patience)
    over: bool = False
    result: int | None = None
    _heard_s: float = 0.0
    _said_s: float = 0.0

    def receive(self, message: Message, now_s: float) -> list[Outgoing]:
        del now_s
        if not self.over and message.name == "MISSION_ACK" and _for_us(message, self.kind):
            self.over, self.result = True, message.integer("type")
        return []

    def _question(self) -> list[Outgoing]:
        return [mavlink.MAVLink_mission_clear_all_message(self.system_id, _AUTOPILOT, int(self.kind))]


@dataclass
class ReadParameters(_Repeating):
    """Settings of the autopilot by name; those it does not have stay unanswered. ``found`` as it sent them
    (:class:`daemon.link.state.LinkState` holds their values)."""

    system_id: int
    names: Sequence[str]
    patience: Patience = field(default_factory=lambda: Patience(0.7, 3.0))
    over: bool = False
    found: set[str] = field(default_factory=set)
    _heard_s: float = 0.0
    _said_s: float = 0.0

    def receive(self, message: Message, now_s: float) -> list[Outgoing]:
        if message.name == "PARAM_VALUE" and message.text("param_id") in self.names:
            self.found.add(message.text("param_id"))
            self._heard_s = now_s
            self.over = len(self.found) == len(self.names)
        return []

    def _question(self) -> list[Outgoing]:
        return [read_parameter(self.system_id, name) for name in self.names if name not in self.found]


@dataclass
class AskMessage(_Repeating):
    """One message that the autopilot sends only when asked. ``came``: it did."""

    system_id: int
    name: str
    patience: Patience = field(default_factory=lambda: Patience(0.7, 3.0))
    over: bool = False
    came: bool = False
    _heard_s: float = 0.0
    _said_s: float = 0.0

    def receive(self, message: Message, now_s: float) -> list[Outgoing]:
        del now_s
        if message.name == self.name:
            self.over = self.came = True
        return []

    def _question(self) -> list[Outgoing]:
        return [ask_message(self.system_id, self.name)]


def item_message(to: tuple[int, int], number: int, item: Item, kind: Kind) -> Outgoing:
    return mavlink.MAVLink_mission_item_int_message(
        *(*to, number, item.frame, item.command, int(number == 0), int(item.autocontinue)),
        *(item.param1, item.param2, item.param3, item.param4, item.x, item.y, item.z, int(kind)),
    )


def item_of(message: Message) -> Item:
    """Of MISSION_ITEM_INT; NaN stays NaN."""
    one, two, three, four = (
        float("nan") if (value := message.number(f"param{n}")) is None else value for n in range(1, 5)
    )
    return Item(
        *(message.integer("command"), message.integer("frame"), one, two, three, four),
        *(message.integer("x"), message.integer("y"), message.number("z") or 0.0),
        bool(message.integer("autocontinue", 1)),
    )

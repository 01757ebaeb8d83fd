"""The vehicle's side of MAVLink's mission protocol, as each autopilot does it.

ArduPilot: asks with MISSION_REQUEST; stores each item as it comes, so that a refused or stalled
upload leaves the good items, followed by the tail of the old mission; an item out of order is
answered with INVALID_SEQUENCE and the upload goes on;
requests repeat each second, after 8 s it gives up with OPERATION_CANCELLED; a second uploader is
DENIED. PX4: asks with MISSION_REQUEST_INT, keeps the old mission unless all went well, and gives
up without a word.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from mission.encode import Flavour, Item
from sim.vehicle.dialect import MavMessage, mavlink
from sim.vehicle.storage import MOST_ITEMS, kept, refusal

REPEAT_S = 1.0
GIVE_UP_S = 8.0
_PARAMS = ("param1", "param2", "param3", "param4")


@dataclass
class _Upload:
    peer: tuple[int, int]
    kind: int
    count: int
    items: list[Item] = field(default_factory=list)
    asked_s: float = 0.0
    heard_s: float = 0.0


@dataclass
class MissionTransfer:
    """``stored``: by mission type (0 mission, 1 fence, 2 rally). ``may_clear`` and ``changed`` ask and
    tell the pilot. ``reject_item``: this item of the next upload is refused. Times are link time in s."""

    flavour: Flavour
    home: Callable[[], Item]
    may_clear: Callable[[], bool]
    changed: Callable[[], None]
    reject_item: int | None = None
    stored: dict[int, list[Item]] = field(default_factory=lambda: {0: [], 1: [], 2: []})
    mission_id: int = 0
    _upload: _Upload | None = None

    @property
    def mission(self) -> list[Item]:
        return self.stored[0]

    def receive(self, message: MavMessage, now_s: float) -> list[MavMessage]:
        """Answers to a message of the mission protocol; nothing to any other."""
        name = message.get_type()
        peer = (message.get_srcSystem(), message.get_srcComponent())
        if name == "MISSION_COUNT":
            return self._begin(peer, message.mission_type, message.count, now_s)
        if name in ("MISSION_ITEM_INT", "MISSION_ITEM"):
            return self._take(peer, message, now_s)
        if name == "MISSION_REQUEST_LIST":
            count = len(self.stored.get(message.mission_type, []))
            return [mavlink.MAVLink_mission_count_message(*peer, count, message.mission_type)]
        if name in ("MISSION_REQUEST_INT", "MISSION_REQUEST"):
            return self._give(peer, message)
        if name == "MISSION_CLEAR_ALL":
            return self._clear(peer, message.mission_type)
        return []

    def tick(self, now_s: float) -> list[MavMessage]:
        """Repeated requests, and the end of an upload that has stalled."""
        upload = self._upload
        if upload is None:
            return []
        if now_s - upload.heard_s > GIVE_UP_S:
            self._upload = None
            if self.flavour == "px4":
                return []
            return [_ack(upload.peer, mavlink.MAV_MISSION_OPERATION_CANCELLED, upload.kind)]
        return self._ask(now_s) if now_s - upload.asked_s > REPEAT_S else []

    def _begin(self, peer: tuple[int, int], kind: int, count: int, now_s: float) -> list[MavMessage]:
        if self._upload is not None and self._upload.peer != peer:
            return [_ack(peer, mavlink.MAV_MISSION_DENIED, kind)]
        if kind not in self.stored:
            return [_ack(peer, mavlink.MAV_MISSION_UNSUPPORTED, kind)]
        if count > MOST_ITEMS[self.flavour]:
            return [_ack(peer, mavlink.MAV_MISSION_NO_SPACE, kind)]
        if count == 0:
            return self._clear(peer, kind)
        self._upload = _Upload(peer, kind, count, heard_s=now_s)
        return self._ask(now_s)

    def _ask(self, now_s: float) -> list[MavMessage]:
        upload = self._upload
        if upload is None:
            return []
        upload.asked_s = now_s
        ardupilot = self.flavour == "ardupilot"
        ask = mavlink.MAVLink_mission_request_message if ardupilot else _request_int
        return [ask(*upload.peer, len(upload.items), upload.kind)]

    def _take(self, peer: tuple[int, int], message: MavMessage, now_s: float) -> list[MavMessage]:
        upload = self._upload
        if upload is None or upload.peer != peer:
            return []
        if message.seq != len(upload.items):
            out_of_order = _ack(peer, mavlink.MAV_MISSION_INVALID_SEQUENCE, upload.kind)
            return [out_of_order] if self.flavour == "ardupilot" else self._ask(now_s)
        upload.heard_s = now_s
        item = item_of(message)
        result = refusal(self.flavour, item) if upload.kind == 0 else 0
        if self.reject_item == message.seq and upload.kind == 0:
            result, self.reject_item = int(mavlink.MAV_MISSION_INVALID_PARAM1), None
        if result:
            self._upload = None
            return [_ack(peer, result, upload.kind)]
        upload.items.append(item)
        if len(upload.items) < upload.count:
            if self.flavour == "ardupilot" and upload.kind == 0:
                self._keep_part(upload)
            return self._ask(now_s)
        self._upload = None
        self._store(upload.kind, self._kept(upload))
        return [_ack(peer, mavlink.MAV_MISSION_ACCEPTED, upload.kind)]

    def _kept(self, upload: _Upload) -> list[Item]:
        if upload.kind != 0:
            return list(upload.items)
        return [kept(self.flavour, i, one, self.home()) for i, one in enumerate(upload.items)]

    def _keep_part(self, upload: _Upload) -> None:
        """The items so far, followed by the old mission's tail."""
        good = self._kept(upload)
        self._store(upload.kind, [*good, *self.stored[upload.kind][len(good) :]])

    def _store(self, kind: int, items: list[Item]) -> None:
        self.stored[kind] = items
        if kind == 0:
            self.mission_id += 1
            self.changed()

    def _clear(self, peer: tuple[int, int], kind: int) -> list[MavMessage]:
        if kind == 255 and self.flavour == "px4":
            for one in self.stored:
                self._store(one, [])
            return [_ack(peer, mavlink.MAV_MISSION_ACCEPTED, kind)]
        if kind not in self.stored:
            return [_ack(peer, mavlink.MAV_MISSION_UNSUPPORTED, kind)]
        if kind == 0 and not self.may_clear():
            return [_ack(peer, mavlink.MAV_MISSION_ERROR, kind)]
        self._store(kind, [])
        return [_ack(peer, mavlink.MAV_MISSION_ACCEPTED, kind)]

    def _give(self, peer: tuple[int, int], message: MavMessage) -> list[MavMessage]:
        items = self.stored.get(message.mission_type, [])
        if message.seq >= len(items):
            return [_ack(peer, mavlink.MAV_MISSION_INVALID_SEQUENCE, message.mission_type)]
        item = items[message.seq]
        params = [getattr(item, name) for name in _PARAMS]
        return [
            mavlink.MAVLink_mission_item_int_message(
                *(*peer, message.seq, item.frame, item.command, int(message.seq == 1)),
                *(int(item.autocontinue), *params, item.x, item.y, item.z, message.mission_type),
            )
        ]


def item_of(message: MavMessage) -> Item:
    """Of MISSION_ITEM_INT, or of the float MISSION_ITEM with its loss of places."""
    one, two, three, four = (float(getattr(message, name)) for name in _PARAMS)
    scale = 1.0 if message.get_type() == "MISSION_ITEM_INT" else 1e7
    x, y = round(message.x * scale), round(message.y * scale)
    return Item(
        *(message.command, message.frame, one, two, three, four, x, y, float(message.z)),
        bool(message.autocontinue),
    )


def _request_int(*fields: int) -> MavMessage:
    return mavlink.MAVLink_mission_request_int_message(*fields)


def _ack(peer: tuple[int, int], result: int, kind: int) -> MavMessage:
    return mavlink.MAVLink_mission_ack_message(*peer, result, kind)

"""Another ground station that uploads its own mission whenever it is told to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from mission.encode import Item
from sim.vehicle.dialect import MavMessage, mavlink

SYSTEM_ID, COMPONENT_ID = 255, 190
_PARAMS = ("param1", "param2", "param3", "param4", "x", "y", "z")
_REPEAT_S, _GIVE_UP_S = 1.0, 6.0


@dataclass
class OtherStation:
    """Pure: messages in, messages out. ``uploads``: those that the vehicle accepted."""

    vehicle: int
    items: Sequence[Item]
    uploads: int = 0
    refused: int = 0
    _since_s: float | None = None
    _said_s: float = 0.0
    _asked: bool = field(default=False)

    @property
    def busy(self) -> bool:
        return self._since_s is not None

    def begin(self, now_s: float) -> list[MavMessage]:
        self._since_s, self._asked = now_s, False
        return self._count(now_s)

    def receive(self, message: MavMessage, now_s: float) -> list[MavMessage]:
        if not self.busy or getattr(message, "target_system", None) != SYSTEM_ID:
            return []
        if message.get_type() in ("MISSION_REQUEST", "MISSION_REQUEST_INT") and message.mission_type == 0:
            self._asked, self._since_s = True, now_s
            return [self._item(message.seq)] if message.seq < len(self.items) else []
        if message.get_type() == "MISSION_ACK" and message.mission_type == 0:
            self._since_s = None
            self.uploads += message.type == 0
            self.refused += message.type != 0
        return []

    def tick(self, now_s: float) -> list[MavMessage]:
        if self._since_s is None:
            return []
        if now_s - self._since_s > _GIVE_UP_S:
            self._since_s = None
            return []
        return self._count(now_s) if not self._asked and now_s - self._said_s > _REPEAT_S else []

    def _count(self, now_s: float) -> list[MavMessage]:
        self._said_s = now_s
        return [mavlink.MAVLink_mission_count_message(self.vehicle, 1, len(self.items), 0)]

    def _item(self, number: int) -> MavMessage:
        item = self.items[number]
        values = [getattr(item, name) for name in _PARAMS]
        return mavlink.MAVLink_mission_item_int_message(
            *(self.vehicle, 1, number, item.frame, item.command, int(number == 0), 1, *values, 0)
        )

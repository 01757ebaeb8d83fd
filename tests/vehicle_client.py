"""A MAVSDK client for the simulated vehicle's tests: upload, commands, every message as it comes."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from typing import Any

from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync
from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync
from mavsdk.plugins.mavlink_direct import MavlinkMessage
from mavsdk.plugins.mission_raw import MissionItem

from daemon.link.message import Message, from_mavsdk
from mission.encode import Item


class Client:
    def __init__(self, system: Any) -> None:
        self.mission = MissionRawAsync(system)
        self.direct = MavlinkDirectAsync(system)
        self.heard: list[tuple[float, Message]] = []

    async def listen(self) -> None:
        async for m in self.direct.subscribe_message(""):
            message = from_mavsdk(m.message_name, m.fields_json, m.system_id, m.component_id)
            self.heard.append((time.monotonic(), message))

    async def upload(self, items: Sequence[Item]) -> None:
        await asyncio.wait_for(self.mission.upload_mission(to_mavsdk(items)), 15)

    async def command(self, number: int, *params: float) -> int:
        """MAV_RESULT."""
        values = dict(zip((f"param{n}" for n in range(1, 8)), [*params, *[0.0] * 7], strict=False))
        fields = {"target_system": 1, "target_component": 1, "command": number, "confirmation": 0} | values
        asked = MavlinkMessage("COMMAND_LONG", 245, 190, 1, 1, json.dumps(fields))
        answer = await asyncio.wait_for(self.direct.send_command(asked), 30)
        return int(json.loads(answer.fields_json)["result"])

    async def until(self, true: Callable[[], bool], seconds: float) -> None:
        end = time.monotonic() + seconds
        while not true():
            assert time.monotonic() < end, "the vehicle took too long"
            await asyncio.sleep(0.05)


@asynccontextmanager
async def client(url: str) -> AsyncIterator[Client]:
    async with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as mavsdk:
        await mavsdk.add_any_connection(url)
        system = await mavsdk.first_autopilot(timeout_s=30.0)
        assert system is not None, "the vehicle was not found"
        found = Client(system)
        listening = asyncio.create_task(found.listen())
        try:
            yield found
        finally:
            listening.cancel()
            await asyncio.gather(listening, return_exceptions=True)


def to_mavsdk(items: Sequence[Item]) -> list[Any]:
    return [
        MissionItem(
            *(index, i.frame, i.command, int(index == 0), int(i.autocontinue)),
            *(i.param1, i.param2, i.param3, i.param4, i.x, i.y, i.z, 0),
        )
        for index, i in enumerate(items)
    ]


def from_mavsdk_items(items: Sequence[Any]) -> list[Item]:
    return [Item(i.command, i.frame, i.param1, i.param2, i.param3, i.param4, i.x, i.y, i.z) for i in items]

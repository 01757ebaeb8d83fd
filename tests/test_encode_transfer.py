"""A plan through a real MAVLink transfer: MAVSDK as the client, a vehicle's storage at the other end."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any

import pytest

pytest.importorskip("pymavlink", reason="pip install fieldcal[flight]")
mavsdk = pytest.importorskip("mavsdk", reason="pip install fieldcal[flight]")

from mavsdk.asyncio import ComponentType, Configuration, Mavsdk  # noqa: E402
from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync  # noqa: E402
from mavsdk.plugins.mission_raw import MissionItem  # noqa: E402

from mission import encode  # noqa: E402
from mission.encode import Flavour, Item  # noqa: E402
from mission.plan import Plan  # noqa: E402
from sim.faults.ends import free_port  # noqa: E402
from tests.mission_plans import line, orbit, plan_of, same_photos, triggered  # noqa: E402
from tests.mission_server import MissionServer  # noqa: E402

PLAN = plan_of(*line(spacing=11.0), *orbit(12, radius=33.3), *line(height=72.345))


def _to_mavsdk(items: Sequence[Item]) -> list[Any]:
    return [
        MissionItem(
            *(index, i.frame, i.command, int(index == 0), int(i.autocontinue)),
            *(i.param1, i.param2, i.param3, i.param4, i.x, i.y, i.z, 0),
        )
        for index, i in enumerate(items)
    ]


def _from_mavsdk(items: Sequence[Any]) -> list[Item]:
    return [Item(i.command, i.frame, i.param1, i.param2, i.param3, i.param4, i.x, i.y, i.z) for i in items]


async def _there_and_back(server: MissionServer, items: Sequence[Item]) -> list[Item]:
    async with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as client:
        await client.add_any_connection(server.url)
        system = await client.first_autopilot(timeout_s=30.0)
        assert system is not None, "the vehicle was not found"
        mission = MissionRawAsync(system)
        await asyncio.wait_for(mission.upload_mission(_to_mavsdk(items)), 15)
        return _from_mavsdk(await asyncio.wait_for(mission.download_mission(), 15))


@pytest.mark.parametrize("aim", ["angles", "roi"])
@pytest.mark.parametrize("flavour", encode.FLAVOURS)
def test_a_plan_survives_the_vehicles_storage(flavour: Flavour, aim: encode.Aim) -> None:
    plan: Plan = PLAN
    sent = encode.items(plan, flavour, aim)
    with MissionServer(flavour, free_port()) as server:
        held = asyncio.run(_there_and_back(server, sent))
        assert server.refused is None
    assert encode.compare(sent, held, flavour) == []
    photos = encode.stations_of_items(held, plan.launch, flavour)
    # ArduPilot cuts heights to the centimetre that single precision leaves.
    place_m = 0.02 if flavour == "ardupilot" else 0.01
    angle_deg = 0.5 if flavour == "ardupilot" or aim == "roi" else 1e-4
    same_photos(triggered(plan), photos, place_m, 0.05 if aim == "roi" else 1e-4, angle_deg)


def test_the_difference_is_found_after_the_transfer() -> None:
    sent = encode.items(PLAN, "px4")
    with MissionServer("px4", free_port()) as server:
        held = asyncio.run(_there_and_back(server, sent))
    held[5] = held[6]
    assert encode.compare(sent, held, "px4")


def test_the_server_refuses_what_the_autopilot_would() -> None:
    """Copter's mission on PX4: CONDITION_YAW is not known there."""
    with MissionServer("px4", free_port()) as server:
        with pytest.raises(Exception, match=r"(?i)unsupported|denied|error"):
            asyncio.run(_there_and_back(server, encode.items(PLAN, "ardupilot")))
        assert server.refused is not None

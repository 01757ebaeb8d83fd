"""Our mission transfer beside MAVSDK's over the same bad lines: the reason for ours.

`python -m benchmarks.transfer` writes benchmarks/transfer.md. Real sockets and real time.
"""

from __future__ import annotations

import asyncio
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync
from mavsdk.exceptions import MavsdkError
from mavsdk.plugins.mission_raw import MissionItem

from benchmarks.faults import items
from daemon.link.address import parse
from daemon.link.live import Link
from daemon.link.transfer import Upload
from daemon.link.vehicle_mission import mission_differences
from mission.encode import FLAVOURS, Flavour, Item
from sim.faults import LineFaults, Proxy
from sim.vehicle import VehicleOptions, VehicleServer

HERE = Path(__file__).parent
WAYPOINTS = 12
SEEDS = (1, 2, 3)
LINES = {
    "clean": LineFaults(),
    "0.3 s to and fro": LineFaults(delay_s=0.15),
    "0.8 s to and fro": LineFaults(delay_s=0.4),
    "a tenth doubled": LineFaults(repeat_share=0.1),
    "5 % lost": LineFaults(drop_share=0.05),
    "5 % lost, a tenth doubled, 0.2 ± 0.1 s": LineFaults(0.05, 0.1, 0.1, 0.05),
}


@dataclass(frozen=True)
class Tried:
    ok: bool
    seconds: float


async def _theirs(url: str, mission: tuple[Item, ...]) -> None:
    async with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as mavsdk:
        await mavsdk.add_any_connection(url.replace("udp://", "udpin://"))
        system = await mavsdk.first_autopilot(timeout_s=30.0)
        if system is None:
            raise TimeoutError
        await asyncio.wait_for(MissionRawAsync(system).upload_mission(_converted(mission)), 120)


def _converted(mission: tuple[Item, ...]) -> list[Any]:
    return [
        MissionItem(
            *(n, i.frame, i.command, int(n == 0), 1),
            *(i.param1, i.param2, i.param3, i.param4, i.x, i.y, i.z, 0),
        )
        for n, i in enumerate(mission)
    ]


def _ours(url: str, mission: tuple[Item, ...]) -> None:
    with Link(parse(url)) as link:
        link.run(Upload(link.wait_for_vehicle(30), mission))


def tried(name: str, flavour: Flavour, line: LineFaults, seed: int) -> Tried:
    mission = items(flavour, WAYPOINTS, 50.0)
    with (
        Proxy(line, seed) as proxy,
        VehicleServer(VehicleOptions(flavour), proxy.vehicle_address, seed=seed) as server,
    ):
        started = time.monotonic()
        try:
            if name == "MAVSDK":
                asyncio.run(_theirs(proxy.url, mission))
            else:
                _ours(proxy.url, mission)
        except (MavsdkError, TimeoutError) as error:
            print(name, flavour, type(error).__name__, str(error)[:40], file=sys.stderr)
        held = server.vehicle.transfer.mission
        return Tried(not mission_differences(mission, held, flavour), time.monotonic() - started)


def main() -> None:
    lines = [
        "# Mission transfer: ours beside MAVSDK 4.1",
        "",
        f"Uploads of {WAYPOINTS} waypoints with a photo each over the same bad lines (both ways) to the "
        "simulated vehicle, which answers as the autopilots were measured to; three seeds each. How many got "
        "across, and the longest in seconds. Made by `python -m benchmarks.transfer`.",
        "",
        "| line | ArduPilot, ours | ArduPilot, MAVSDK | PX4, ours | PX4, MAVSDK |",
        "|---|---|---|---|---|",
    ]
    for words, line in LINES.items():
        cells = []
        for flavour in FLAVOURS:
            for name in ("ours", "MAVSDK"):
                found = [tried(name, flavour, line, seed) for seed in SEEDS]
                good = sum(one.ok for one in found)
                cells.append(f"{good} of {len(found)}, {max(one.seconds for one in found):.0f} s")
        lines.append(f"| {words} | {' | '.join(cells)} |")
        print(lines[-1], flush=True)
    (HERE / "transfer.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

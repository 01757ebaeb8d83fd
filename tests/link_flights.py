"""A vehicle, faults and our link, each in its own thread, over real sockets."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from daemon.link.address import parse
from daemon.link.live import Link
from daemon.link.tlog import LogWriter
from daemon.link.transfer import Patience
from daemon.link.upload import Mission, Result, Terms, upload
from daemon.link.vehicle_mission import mission_differences
from mission import encode
from mission.encode import Flavour, Item
from sim.faults import LineFaults, Proxy
from sim.faults.ends import End
from sim.vehicle import Faults, VehicleOptions, VehicleServer
from sim.vehicle.storage import kept
from tests.mission_plans import line, orbit, plan_of

OLD = plan_of(*orbit(2))
NEW = plan_of(*line(spacing=11.0), *orbit(1, radius=33.3))
OTHER = plan_of(*line(height=70))
#: Shorter than real ones, so that tests end.
BRISK = Terms(patience=Patience(0.4, 3.0), restore_s=60.0)


@dataclass
class Flight:
    """``sent``: every message of ours, as it went out."""

    flavour: Flavour
    proxy: Proxy
    server: VehicleServer
    link: Link
    folder: Path
    sent: list[Any] = field(default_factory=list)

    @property
    def old(self) -> tuple[Item, ...]:
        return encode.items(OLD, self.flavour)

    @property
    def new(self) -> Mission:
        return Mission("new.plan", self.flavour, encode.items(NEW, self.flavour))

    def holds(self, items: tuple[Item, ...]) -> bool:
        return mission_differences(items, self.server.vehicle.transfer.mission, self.flavour) == []

    def upload(self, terms: Terms = BRISK, word: Callable[[], bool] = lambda: True) -> Result:
        return upload(self.link, self.new, word, self.folder / "kept", terms)


@contextmanager
def flight(
    flavour: Flavour,
    folder: Path,
    line_faults: LineFaults | None = None,
    faults: Faults | None = None,
    seed: int = 0,
    end: End | None = None,
    log: LogWriter | None = None,
    **options: Any,
) -> Iterator[Flight]:
    """The vehicle holds :data:`OLD` and was heard."""
    other = encode.items(OTHER, flavour)
    sent: list[Any] = []
    with (
        Proxy(line_faults or LineFaults(), seed, end, other) as proxy,
        VehicleServer(
            VehicleOptions(flavour, **options), proxy.vehicle_address, faults=faults, seed=seed
        ) as server,
    ):
        vehicle = server.vehicle
        home = vehicle.telemetry.home_item()
        stored = [kept(flavour, n, item, home) for n, item in enumerate(encode.items(OLD, flavour))]
        vehicle.transfer.stored[0] = stored
        with Link(parse(proxy.url), log=log, sent=sent.append) as link:
            link.wait_for_vehicle(30)
            yield Flight(flavour, proxy, server, link, folder, sent)


def until(true: Callable[[], bool], seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it took too long"
        time.sleep(0.02)

"""Can the link keep up? 200 messages a second and 2 photos a second, recorded, in a process of its own.

`python -m benchmarks.link_load [--seconds 60]` writes benchmarks/link_load.md: the CPU share of the link and
by how much its thread was ever late. On a busy machine it measures the others: run it under `nice -n -15`.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import tempfile
import time
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path

from daemon.link.address import parse
from daemon.link.live import Link
from daemon.link.tlog import LogWriter
from sim.faults.ends import free_port
from sim.vehicle import VehicleOptions, VehicleServer

#: Together 200 a second.
RATES_HZ = {
    "ATTITUDE": 50.0,
    "GLOBAL_POSITION_INT": 50.0,
    "GIMBAL_DEVICE_ATTITUDE_STATUS": 50.0,
    "GPS_RAW_INT": 50.0,
}
PHOTO_S = 0.5
#: What the link's thread may be late by.
LATE_MS = 50.0


def _vehicle(port: int, stop: Event) -> None:
    with VehicleServer(VehicleOptions("px4"), ("127.0.0.1", port)) as server:
        while not stop.wait(PHOTO_S):
            for name, rate in RATES_HZ.items():
                if server.vehicle.telemetry.rates_hz.get(name) != rate:
                    server.vehicle.telemetry.want(name, rate)
            server.vehicle.pilot.shoot()


@dataclass(frozen=True)
class Load:
    """``share``: of a core. ``late_ms``: the most by which the thread was late. ``machine``: its
    load average, over a minute."""

    seconds: float
    messages: int
    photos: int
    lost: int
    share: float
    late_ms: float
    machine: float


def measure(seconds: float) -> Load:
    port, stop = free_port(), multiprocessing.Event()
    process = multiprocessing.Process(target=_vehicle, args=(port, stop))
    process.start()
    try:
        with (
            tempfile.TemporaryDirectory() as folder,
            LogWriter(Path(folder) / "x.tlog") as log,
            Link(parse(f"udp://127.0.0.1:{port}"), log=log) as link,
        ):
            link.wait_for_vehicle(60)
            time.sleep(3)  # streams are being asked for
            first, cpu, wall = link.state, time.process_time(), time.monotonic()
            time.sleep(seconds)
            passed, last = time.monotonic() - wall, link.state
            kind = "CAMERA_TRIGGER"
            return Load(
                *(passed, last.quality.received - first.quality.received),
                *(last.counts.get(kind, 0) - first.counts.get(kind, 0), last.quality.lost),
                *((time.process_time() - cpu) / passed, 1e3 * link.health.worst_late_s, os.getloadavg()[0]),
            )
    finally:
        stop.set()
        process.join()


def report(load: Load) -> str:
    figures = f"{load.messages / load.seconds:.0f} messages/s and {load.photos / load.seconds:.1f} photos/s"
    return "\n".join(
        (
            "# The link under load",
            "",
            f"{figures} over {load.seconds:.0f} s from a simulated PX4 over UDP, read, decoded and recorded. "
            "Made by `python -m benchmarks.link_load`.",
            "",
            "| | measured | may be |",
            "|---|---|---|",
            f"| most by which the link's thread was late | {load.late_ms:.1f} ms | {LATE_MS:.0f} ms |",
            f"| share of one core | {100 * load.share:.1f} % | 100 % |",
            f"| messages lost | {load.lost} | |",
            "",
            f"Load of the machine ({os.cpu_count()} cores) in that minute: {load.machine:.1f}; "
            f"nice {os.nice(0)}.",
            "",
        )
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    got = parser.parse_args()
    load = measure(got.seconds)
    (got.out / "link_load.md").write_text(report(load), encoding="utf-8")
    print(report(load))
    sys.exit(0 if load.late_ms <= LATE_MS else 1)


if __name__ == "__main__":
    main()

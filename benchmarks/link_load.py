"""Can the link keep up? 200 messages a second and 2 photos a second, recorded, in a process of its own.

`python -m benchmarks.link_load [--seconds 60]` prints the CPU share of the link and by how much its thread
was ever late; run it on an idle core, or it measures the others.
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
import time
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


def _vehicle(port: int, stop: Event) -> None:
    with VehicleServer(VehicleOptions("px4"), ("127.0.0.1", port)) as server:
        while not stop.wait(PHOTO_S):
            for name, rate in RATES_HZ.items():
                if server.vehicle.telemetry.rates_hz.get(name) != rate:
                    server.vehicle.telemetry.want(name, rate)
            server.vehicle.pilot.shoot()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    seconds = parser.parse_args().seconds
    port, stop = free_port(), multiprocessing.Event()
    process = multiprocessing.Process(target=_vehicle, args=(port, stop))
    process.start()
    with (
        tempfile.TemporaryDirectory() as folder,
        LogWriter(Path(folder) / "x.tlog") as log,
        Link(parse(f"udp://127.0.0.1:{port}"), log=log) as link,
    ):
        link.wait_for_vehicle(60)
        time.sleep(3)  # streams are being asked for
        first, cpu, wall = link.state.quality.received, time.process_time(), time.monotonic()
        time.sleep(seconds)
        passed = time.monotonic() - wall
        come = link.state.quality.received - first
        share = (time.process_time() - cpu) / passed
        print(
            f"{come / passed:.0f} messages/s, {link.state.quality.lost} lost, {100 * share:.1f} % of a core"
        )
        print(f"the thread was late by at most {1e3 * link.health.worst_late_s:.1f} ms")
    stop.set()
    process.join()


if __name__ == "__main__":
    main()

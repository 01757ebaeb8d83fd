"""How soon is a daemon that was killed back?

`python -m benchmarks.restarts --kills 20` keeps `fieldcal run --again` running as the service's unit does: a
supervisor of a few lines starts it again, as it was started, after the pause of the unit (RestartSec).
It is killed with `kill -9` again and again, and what is measured is the time until another program sees
its liveliness token on the live status, and until it says READY=1. No systemd takes part. Writes
benchmarks/restarts.md. On a busy machine it measures the others: run it under `nice -n -15`.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import re
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.memory import photos_of
from benchmarks.processes import cpu_s, kill_9, wait_for
from benchmarks.told_flight import ToldFlight
from daemon.live.fleet import Fleet
from daemon.live.settings import Settings
from sim.faults.ends import free_port

HERE = Path(__file__).parent
UNIT = HERE.parent / "systemd" / "fieldcal.service"
VEHICLE = "restarts"
#: What the service promises.
MOST_S = 5.0
LONGEST_S = 120.0
PHOTOS, EVERY_S, FROM_S = 150, 2.0, 3.0


@dataclass(frozen=True)
class Back:
    """Seconds from the kill until a viewer who comes then sees the token, and to READY=1; ``cpu_s``: the
    daemon's computing time by then."""

    alive_s: float
    ready_s: float
    cpu_s: float


def restart_s() -> float:
    """RestartSec of the unit."""
    (found,) = re.findall(r"^RestartSec=([\d.]+)$", UNIT.read_text(), re.MULTILINE)
    return float(found)


class Supervised:
    """The daemon, and what it says to its supervisor."""

    def __init__(self, home: Path, link_port: int) -> None:
        self.home, self.card = home, home / "card"
        self.card.mkdir()
        self.live = f"tcp/127.0.0.1:{free_port()}"
        self._place = home / "notify"
        self._said = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._said.bind(str(self._place))
        self._said.setblocking(False)
        config = home / "fieldcal.toml"
        config.write_text(
            f'photos = "{self.card}"\nlink = "udp://127.0.0.1:{link_port}"\nvehicle = "{VEHICLE}"\n'
            f'listen = ["{self.live}"]\nidle = 0\nquiet = true\n'
        )
        self._words = [sys.executable, "-m", "daemon.cli", "run", "--config", str(config), "--again"]
        self.process = self.start()

    def start(self) -> subprocess.Popen[bytes]:
        names = {name: str(self.home / name.lower()) for name in ("FIELDCAL_SESSIONS", "FIELDCAL_STORE")}
        folders = {name: str(self.home / name.lower()) for name in ("XDG_STATE_HOME", "XDG_DATA_HOME")}
        with (self.home / "said.txt").open("ab") as said:
            self.process = subprocess.Popen(
                self._words,
                env={**os.environ, **names, **folders, "NOTIFY_SOCKET": str(self._place)},
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=said,
            )
        return self.process

    def ready(self) -> bool:
        """Whether it has said so since the last call."""
        found = False
        with contextlib.suppress(BlockingIOError):
            while True:
                found |= self._said.recv(4096).startswith(b"READY=1")
        return found

    def back(self, since_s: float) -> Back:
        """As soon as it is there for both.

        Raises:
            TimeoutError: it does not come.
        """
        host, _, port = self.live.removeprefix("tcp/").partition(":")
        times: dict[str, float] = {}

        def both() -> bool:
            now_s = time.monotonic() - since_s
            if "ready" not in times and self.ready():
                times["ready"] = now_s
            if "alive" not in times:
                with contextlib.suppress(OSError), socket.create_connection((host, int(port)), 1.0):
                    with Fleet(Settings(connect=(self.live,)), VEHICLE) as fleet:
                        wait_for(lambda: any(v.alive for v in fleet.vehicles()), LONGEST_S)
                    times["alive"] = time.monotonic() - since_s
            return len(times) == 2

        wait_for(both, LONGEST_S)
        return Back(times["alive"], times["ready"], cpu_s(self.process.pid))

    def killed(self) -> float:
        """Killed and waited for; when."""
        at_s = time.monotonic()
        kill_9(self.process.pid)
        self.process.wait()
        self.ready()
        return at_s


def measure(kills: int, pause_s: float, seed: int = 1) -> list[Back]:
    rng, found = random.Random(seed), []
    with tempfile.TemporaryDirectory() as scratch:
        home = Path(scratch)
        (home / "made").mkdir()
        photos = photos_of(home / "made", PHOTOS, PHOTOS * EVERY_S / 3600)
        port = free_port()
        daemon = Supervised(home, port)
        at_s = [FROM_S + EVERY_S * n for n in range(PHOTOS)]
        try:
            with ToldFlight(photos, at_s, port, daemon.card):
                daemon.back(time.monotonic())
                for _ in range(kills):
                    time.sleep(rng.uniform(0.5, 4.0))
                    killed_s = daemon.killed()
                    time.sleep(max(0.0, killed_s + pause_s - time.monotonic()))
                    daemon.start()
                    found.append(daemon.back(killed_s))
        finally:
            daemon.killed()
    return found


def report(found: Sequence[Back], pause_s: float) -> str:
    lines = [
        "# A daemon that was killed comes back",
        "",
        f"`fieldcal run --again` with a vehicle's messages, photos and the live status, killed {len(found)} "
        f"times with `kill -9` and started again {pause_s:g} s later (RestartSec of the service's unit) by a "
        "supervisor of a few lines, which stands for systemd: systemd itself takes no part. Made by "
        "`python -m benchmarks.restarts`.",
        "",
        "| from the kill, s | median | longest | may be |",
        "|---|---|---|---|",
    ]
    for name, values in (
        ("seen alive on the live status by another program", [one.alive_s for one in found]),
        ("READY=1 to the supervisor", [one.ready_s for one in found]),
    ):
        lines.append(f"| {name} | {statistics.median(values):.1f} | {max(values):.1f} | {MOST_S:g} |")
    spent = statistics.median(one.cpu_s for one in found)
    lines += [
        "",
        f"Of that {pause_s:g} s are the pause, and {spent:.1f} s are computing by the time that it is ready. "
        f"Load of the machine ({os.cpu_count()} cores) in the last minute: {os.getloadavg()[0]:.1f}; "
        f"nice {os.nice(0)}.",
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--out", type=Path, default=HERE)
    got = parser.parse_args()
    pause_s = restart_s()
    found = measure(got.kills, pause_s)
    text = report(found, pause_s)
    (got.out / "restarts.md").write_text(text, encoding="utf-8")
    print(text)
    sys.exit(0 if max(max(one.alive_s, one.ready_s) for one in found) <= MOST_S else 1)


if __name__ == "__main__":
    main()

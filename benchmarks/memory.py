"""Does `fieldcal run` stay small over a long flight?

`python -m benchmarks.memory --photos 3000 --hours 2 --speed 24` tells it of a flight of two hours with 3,000
small photos, faster than life, and looks at the memory of its two processes meanwhile. Writes
benchmarks/memory.md.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from benchmarks.processes import cpu_s, kill_9, resident_mb, session, wait_for, worker
from benchmarks.told_flight import ToldFlight
from calib.photos.photo import GimbalAngles, Photo
from calib.photos.read import read_photo
from daemon.session.reader import SessionReader
from sim.faults.ends import free_port
from sim.photo_writer import PhotoTags, write_photo

#: Large enough to be read as a photo, small enough that nothing in it takes long.
SIZE = (160, 120)
LOOK_S = 2.0
#: What the daemon may take; a companion computer has 2 to 8 GB.
MOST_MB = 400.0
START = datetime(2026, 5, 31, 9, 0, 0)
#: The flight goes to and fro over a field, one photo every so many metres.
STEP_M, LINE = 8.0, 60


@dataclass(frozen=True)
class Look:
    """``flown_h`` in the flight's time. Memory in MiB; ``child_mb``: of the process that aligns (0: none)."""

    flown_h: float
    photos: int
    triggers: int
    daemon_mb: float
    child_mb: float


def photos_of(folder: Path, count: int, hours: float) -> list[Photo]:
    """Noise with the tags of a survey."""
    rng, found = np.random.default_rng(1), []
    level = GimbalAngles(0.0, -90.0, 0.0)
    for n in range(count):
        line, along = divmod(n, LINE)
        east_m, north_m = STEP_M * line, STEP_M * (along if line % 2 == 0 else LINE - 1 - along)
        path = folder / f"DJI_{n + 1:05d}.JPG"
        # Intervals are never quite alike.
        at = START + timedelta(hours=hours * n / count, seconds=float(rng.uniform(-0.3, 0.3)))
        place = (47.0 + north_m / 111_000, 8.5 + east_m / 75_700, 490.0, 60.0)
        image = rng.integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
        write_photo(path, image, PhotoTags(at, *place, gimbal=level, flight=level), quality=60)
        found.append(read_photo(path))
    return found


def watch(count: int, hours: float, speed: float) -> tuple[list[Look], float]:
    """What was seen of the flight, and the daemon's computing time in s."""
    with tempfile.TemporaryDirectory() as scratch:
        home = Path(scratch)
        (home / "made").mkdir()
        (home / "card").mkdir()
        photos = photos_of(home / "made", count, hours)
        port, every_s = free_port(), 3600 * hours / speed / count
        words = ["--photos", str(home / "card"), "--link", f"udp://127.0.0.1:{port}", "--idle", "0"]
        with (home / "said.txt").open("wb") as said:
            process = subprocess.Popen(
                [sys.executable, "-m", "daemon.cli", "run", *words, "--no-live", "--quiet"],
                cwd=home,
                env={
                    **os.environ,
                    "FIELDCAL_SESSIONS": str(home / "sessions"),
                    "FIELDCAL_STORE": str(home / "store"),
                    "OPENBLAS_NUM_THREADS": "1",
                    "OMP_NUM_THREADS": "1",
                },
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=said,
                start_new_session=True,
            )
        try:
            wait_for(lambda: [*home.glob("sessions/[!.]*/link.tlog")], 60)
            at_s = [5.0 + every_s * n for n in range(count)]
            with ToldFlight(photos, at_s, port, home / "card", telemetry_s=0.02) as told:
                looks = _looks(process, told, home, count, hours, every_s)
            spent_s = cpu_s(process.pid)
            if process.poll() is not None:
                raise RuntimeError((home / "said.txt").read_text())
            process.send_signal(signal.SIGTERM)
            return looks, spent_s
        finally:
            for pid in session(process.pid):
                kill_9(pid)
            process.wait()


def _looks(
    process: subprocess.Popen[bytes], told: ToldFlight, home: Path, count: int, hours: float, every_s: float
) -> list[Look]:
    """Until all is recorded that will be."""
    looks: list[Look] = []
    ended_s: float | None = None
    (folder,) = home.glob("sessions/[!.]*")
    while process.poll() is None:
        time.sleep(LOOK_S)
        child = worker(process.pid)
        with SessionReader.open(folder) as record:
            counts = record.counts()
        looks.append(
            Look(
                hours * told.triggered / count,
                *(counts.photos, counts.triggers, resident_mb(process.pid)),
                0.0 if child is None else resident_mb(child),
            )
        )
        if told.written == count and ended_s is None:
            ended_s = time.monotonic()
        # A busy computer may lose a message; what is under way is waited for.
        done = counts.photos == count and counts.triggers == count
        if ended_s is not None and (done or time.monotonic() - ended_s > 60 + 100 * every_s):
            return looks
    return looks


def report(looks: Sequence[Look], hours: float, speed: float, spent_s: float) -> str:
    last, most = looks[-1], max(look.daemon_mb for look in looks)
    later = [look for look in looks if look.photos >= last.photos / 3]
    kb = 1024 * np.polyfit([x.photos for x in later], [x.daemon_mb for x in later], 1)[0]
    flight = f"A flight of {hours:g} hours with {last.photos} photos of {SIZE[0]} x {SIZE[1]} px"
    daemon = f"at most {most:.0f} MiB (may take: {MOST_MB:.0f}) and grows by {kb:.1f} KiB a photo"
    lines = [
        "# Memory of a long flight",
        "",
        f"{flight}, told of {speed:g} times faster than life over a socket, beside place and attitude. "
        "Memory in use (RSS). Made by `python -m benchmarks.memory`.",
        "",
        f"**The daemon takes {daemon} over the last two thirds; {last.triggers} triggers and {last.photos} "
        "photos are recorded.** The process that aligns takes at most "
        f"{max(look.child_mb for look in looks):.0f} MiB (its photos are noise: nothing can be aligned). "
        f"{spent_s:.0f} CPU-s in the daemon.",
        "",
        "| flown, h | photos | triggers | daemon MiB | alignment MiB |",
        "|---|---|---|---|---|",
    ]
    for share in np.linspace(0.0, 1.0, 13):
        look = looks[round(float(share) * (len(looks) - 1))]
        cells = (f"{look.flown_h:.2f}", look.photos, look.triggers, f"{look.daemon_mb:.0f}")
        lines.append(f"| {' | '.join(map(str, cells))} | {look.child_mb:.0f} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photos", type=int, default=3000)
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--speed", type=float, default=24.0)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    got = parser.parse_args()
    looks, spent_s = watch(got.photos, got.hours, got.speed)
    text = report(looks, got.hours, got.speed, spent_s)
    (got.out / "memory.md").write_text(text, encoding="utf-8")
    print(text)
    whole = looks[-1].photos == got.photos and looks[-1].triggers >= 0.999 * got.photos
    sys.exit(0 if whole and max(look.daemon_mb for look in looks) <= MOST_MB else 1)


if __name__ == "__main__":
    main()

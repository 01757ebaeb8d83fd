"""`kill -9` at random instants: is anything lost that was told, and is the verdict the same?

`python -m benchmarks.kills --kills 100` flies flights of eight small photos (640 x 480 px) beside a vehicle's
messages, kills `fieldcal run` or its alignment child ten times in each, goes on with `--resume`, and holds
record and verdict against what was told over zenoh before each kill and against a flight that nobody killed.
Rows go to benchmarks/kills.jsonl, flight by flight; begun again it goes on. Writes benchmarks/kills.md.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import resource
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.processes import cpu_s, kill_9, session, wait_for, worker
from benchmarks.resumed import read_rows, run_rows
from benchmarks.told_flight import ToldFlight
from calib.errors import FieldcalError
from calib.photos.photo import Photo
from calib.photos.read import read_photo
from daemon.live.fleet import Fleet
from daemon.live.schemas import Capture, Verdict
from daemon.live.settings import Settings
from daemon.session.reader import SessionReader
from sim.faults.ends import free_port
from sim.survey import write_survey

#: Of one flight, and which photos of the survey it has: six straight down, two oblique.
A_FLIGHT = 10
CHOSEN = (0, 1, 4, 5, 8, 9, 12, 16)
SIZE = (640, 480)
VEHICLE = "kills"
WORLD, REPORT = "fieldcal-kills", "report.json"
#: Photos are triggered so far apart, from so long after the start (s).
EVERY_S, FROM_S = 2.0, 2.0
#: A kill comes within so long after the process is there.
LATEST_S = 5.0
LONGEST_S = 240.0


@dataclass
class Kill:
    """``phase``, ``triggers``, ``photos``: as told until then. ``back_s``: from the next start to a word."""

    what: str
    after_s: float
    phase: str = ""
    triggers: int = 0
    photos: int = 0
    back_s: float = 0.0
    lost: list[str] = field(default_factory=list)


@dataclass
class Killed:
    """One flight. ``same``: the report is that of the flight without kills. ``missing``: triggers that the
    vehicle told of while nobody listened."""

    seed: int
    kills: list[Kill]
    verdict: str
    same: bool
    doubled: int
    missing: int
    cpu_s: float
    wall_s: float


@dataclass(frozen=True)
class World:
    """The photos, rendered once, and the report of the flight that nobody killed."""

    folder: Path
    photos: tuple[Photo, ...]
    report: Mapping[str, Any]


def world() -> World:
    """Made where there is none yet, in the folder for temporary files."""
    folder = Path(tempfile.gettempdir()) / WORLD
    done = folder / REPORT
    if not (folder / "survey" / "truth.json").exists():
        folder.mkdir(exist_ok=True)
        write_survey("demo", folder / "survey", 3, size=SIZE, workers=1)
    if not done.exists():
        with Flight(folder, _chosen(folder), "calm") as flight:
            flight.run_out()
            done.write_text(json.dumps(flight.report()))
    return World(folder, _chosen(folder), json.loads(done.read_text()))


def _chosen(folder: Path) -> tuple[Photo, ...]:
    files = sorted((folder / "survey").glob("*.JPG"))
    return tuple(read_photo(files[n]) for n in CHOSEN)


class Flight:
    """A vehicle that tells, a folder that fills, and `fieldcal run`, started as often as it is killed."""

    def __init__(self, folder: Path, photos: Sequence[Photo], name: str) -> None:
        self._scratch = tempfile.TemporaryDirectory(dir=folder, prefix=f"{name}-")
        self.home = Path(self._scratch.name)
        self.card = self.home / "card"
        self.card.mkdir()
        self._photos = photos
        self._port, self._live = free_port(), f"tcp/127.0.0.1:{_quiet_port()}"
        self._before_s, self._orphans_s = _children_s(), 0.0
        at_s = [FROM_S + EVERY_S * n for n in range(len(photos))]
        self.told = ToldFlight(photos, at_s, self._port, self.card)
        self.triggers = self.photos = 0
        self.verdicts: list[str] = []

    def __enter__(self) -> Flight:
        return self

    def __exit__(self, *_: object) -> None:
        self.told.close()
        self._scratch.cleanup()

    @property
    def cpu_s(self) -> float:
        """Of all that was started; of the one that aligns when its daemon was killed what was seen of it."""
        return _children_s() - self._before_s + self._orphans_s

    @property
    def folder(self) -> Path:
        (found,) = [f for f in (self.home / "sessions").iterdir() if not f.name.startswith(".")]
        return found

    @contextmanager
    def running(self) -> Iterator[subprocess.Popen[bytes]]:
        """Begun, or gone on with; everything of it is killed at the end."""
        here = (
            ("--photos", str(self.card), "--link", f"udp://127.0.0.1:{self._port}", "--vehicle", VEHICLE)
            if not self._recorded
            else ("--resume",)
        )
        words = [*here, "--count", str(len(self._photos)), "--idle", "0", "--quiet", "--listen", self._live]
        environment = {
            **os.environ,
            "FIELDCAL_SESSIONS": str(self.home / "sessions"),
            "FIELDCAL_STORE": str(self.home / "store"),
            "XDG_STATE_HOME": str(self.home / "state"),
            "XDG_DATA_HOME": str(self.home / "data"),
            "OPENBLAS_NUM_THREADS": "1",
            "OMP_NUM_THREADS": "1",
        }
        with (self.home / "said.txt").open("ab") as said:
            process = subprocess.Popen(
                [sys.executable, "-m", "daemon.cli", "run", *words],
                cwd=self.home,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=said,
                start_new_session=True,
            )
        try:
            yield process
        finally:
            for pid in session(process.pid):
                if pid != process.pid:
                    self._orphans_s += cpu_s(pid)
                kill_9(pid)
            process.wait()
            # The child notices by itself that its parent is dead; it was killed, too.
            wait_for(lambda: not session(process.pid), 20)

    @property
    def _recorded(self) -> bool:
        """Whether there is a record to go on with."""
        try:
            with SessionReader.open(self.folder):
                return True
        except (ValueError, OSError, FieldcalError):
            return False

    @contextmanager
    def watched(self, process: subprocess.Popen[bytes]) -> Iterator[Fleet]:
        """A viewer, as soon as there is somebody to look at."""
        host, _, port = self._live.removeprefix("tcp/").partition(":")

        def listens() -> bool:
            if process.poll() is not None:
                return True
            with contextlib.suppress(OSError), socket.create_connection((host, int(port)), 1.0):
                return True
            return False

        wait_for(listens, 60)
        with Fleet(Settings(connect=(self._live,)), VEHICLE) as fleet:
            yield fleet

    def look(self, fleet: Fleet) -> str:
        """Take in what was told; the phase, "" where nobody says anything."""
        for vehicle in fleet.vehicles():
            found = {topic: heard.message for topic, heard in vehicle.heard.items()}
            capture, verdict, status = found.get("capture"), found.get("verdict"), found.get("status")
            if isinstance(capture, Capture):
                self.triggers = max(self.triggers, capture.triggers or 0)
                self.photos = max(self.photos, capture.photos)
            if isinstance(verdict, Verdict) and verdict.at.isoformat() not in self.verdicts:
                self.verdicts.append(verdict.at.isoformat())
            return str(getattr(status, "phase", ""))
        return ""

    def lost(self) -> list[str]:
        """What was told and is not in the record."""
        if not self._recorded:
            return ["the record"] if self.photos or self.triggers or self.verdicts else []
        with SessionReader.open(self.folder) as record:
            record.verify()
            counts = record.counts()
            there = {row.recorded.isoformat() for row in record.verdicts()}
        found = []
        if counts.triggers < self.triggers:
            found.append(f"{counts.triggers} of {self.triggers} triggers")
        if counts.photos < self.photos:
            found.append(f"{counts.photos} of {self.photos} photos")
        found += [f"verdict of {at}" for at in self.verdicts if at not in there]
        return found

    def doubled(self) -> int:
        """Triggers and photos that are in the record twice."""
        with SessionReader.open(self.folder) as record:
            indices = [row.value.image_index for row in record.triggers()]
            files = [row.value.path for row in record.photos()]
        return len(indices) - len(set(indices)) + len(files) - len(set(files))

    def missing(self) -> int:
        with SessionReader.open(self.folder) as record:
            return len(self._photos) - record.counts().triggers

    def last_word(self) -> str:
        """What the program said last."""
        lines = (self.home / "said.txt").read_text(errors="replace").strip().splitlines()
        return lines[-1].replace(str(self.home), "") if lines else ""

    def run_out(self) -> int:
        """Until it ends by itself: its exit code."""
        with self.running() as process:
            return process.wait(LONGEST_S)

    def report(self) -> dict[str, Any]:
        """What the flight found, without times and places of files."""
        text = (self.folder / "report.json").read_text(encoding="utf-8").replace(str(self.home), "")
        return {key: value for key, value in json.loads(text).items() if key not in ("timing", "exports")}


def _quiet_port() -> int:
    """A TCP port that no connection gets by chance while the program is down: below those given out."""
    for port in random.sample(range(20_000, 32_000), 100):
        with socket.socket() as one, contextlib.suppress(OSError):
            one.bind(("127.0.0.1", port))
            return port
    raise OSError("no TCP port is free")


def _children_s() -> float:
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


def fly(seed: int) -> Killed:
    """One flight with :data:`A_FLIGHT` kills, and its end."""
    rng, there, began_s = random.Random(seed), world(), time.monotonic()
    kills: list[Kill] = []
    with Flight(there.folder, there.photos, f"flight-{seed}") as flight:
        while len(kills) < A_FLIGHT:
            started_s = time.monotonic()
            with flight.running() as process, flight.watched(process) as fleet:
                back_s = _until_told(flight, fleet, process, started_s)
                if kills:
                    kills[-1].back_s = back_s
                while len(kills) < A_FLIGHT and process.poll() is None:
                    kill = Kill("daemon" if rng.random() < 0.6 else "child", LATEST_S * rng.random() ** 2)
                    if not _survived(flight, fleet, process, kill):
                        break
                    kills.append(kill)
                    if kill.what == "daemon":
                        break
                over = process.poll()
            if kills:
                kills[-1].lost += flight.lost()
            if over is not None:
                break
        code = flight.run_out() if over is None else over
        same = code in (0, 3, 4) and flight.report() == there.report
        ended = code in (0, 3, 4)
        verdict = str(flight.report()["verdict"]) if ended else f"exit code {code}: {flight.last_word()}"
        return Killed(
            *(seed, kills, verdict, same, flight.doubled(), flight.missing()),
            *(flight.cpu_s, time.monotonic() - began_s),
        )


def _until_told(flight: Flight, fleet: Fleet, process: subprocess.Popen[bytes], started_s: float) -> float:
    """Seconds from the start of the program to its first word."""
    deadline = time.monotonic() + 60
    while not flight.look(fleet) and process.poll() is None and time.monotonic() < deadline:
        fleet.ask(0.1)
    return time.monotonic() - started_s


def _survived(flight: Flight, fleet: Fleet, process: subprocess.Popen[bytes], kill: Kill) -> bool:
    """Wait for the kill's moment and kill; False where the flight was over before."""
    until = time.monotonic() + kill.after_s
    while time.monotonic() < until:
        kill.phase = flight.look(fleet) or kill.phase
        if process.poll() is not None:
            return False
        time.sleep(0.02)
    pid: int | None = process.pid
    if kill.what == "child":
        while (pid := worker(process.pid)) is None:
            if process.poll() is not None:
                return False
            time.sleep(0.02)
    kill.phase = flight.look(fleet) or kill.phase
    kill.triggers, kill.photos = flight.triggers, flight.photos
    if pid is not None:
        kill_9(pid)
    return True


def report(flights: Sequence[Killed]) -> str:
    kills = [kill for flight in flights for kill in flight.kills]
    back = sorted(kill.back_s for kill in kills if kill.back_s)
    lost = [(flight.seed, what) for flight in flights for kill in flight.kills for what in kill.lost]
    lines = [
        "# kill -9",
        "",
        f"{len(kills)} kills in {len(flights)} flights of {len(CHOSEN)} photos ({SIZE[0]} x {SIZE[1]} px), a "
        "vehicle's messages and photos coming all the while; each flight gone on with `--resume` until its "
        "verdict. Told: triggers, photos and verdicts as a viewer had them over zenoh before the kill. "
        "Made by `python -m benchmarks.kills`.",
        "",
        f"**Told and lost: {len(lost)}. Twice in the record: {sum(f.doubled for f in flights)}. "
        f"Same report as without kills: {sum(f.same for f in flights)} of {len(flights)}.**",
        "",
        "| killed | kills | while waiting | collecting | concluding | before the first word |",
        "|---|---|---|---|---|---|",
    ]
    for what in ("daemon", "child"):
        some = [kill for kill in kills if kill.what == what]
        phases = [sum(k.phase == p for k in some) for p in ("waiting", "collecting", "concluding", "")]
        lines.append(f"| {what} | {len(some)} | {' | '.join(map(str, phases))} |")
    cpu = sum(flight.cpu_s for flight in flights) / max(len(kills), 1)
    wall = sum(flight.wall_s for flight in flights) / max(len(kills), 1)
    if back:
        lines += [
            "",
            f"From the start of the program to its first word over zenoh: median "
            f"{back[len(back) // 2]:.1f} s, longest {back[-1]:.1f} s.",
        ]
    lines += [
        f"Triggers told while nobody listened: {sum(f.missing for f in flights)}. "
        f"{cpu:.1f} CPU-s and {wall:.0f} s a kill.",
        "",
        *(f"* flight {seed}: lost {what}" for seed, what in lost),
        *(f"* flight {f.seed}: {f.verdict}, another report" for f in flights if not f.same),
    ]
    return "\n".join(lines).rstrip() + "\n"


def _made(row: dict[str, Any]) -> Killed:
    return Killed(**{**row, "kills": [Kill(**kill) for kill in row["kills"]]})


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    got = parser.parse_args()
    raw = got.out / "kills.jsonl"
    known = {flight.seed: flight for flight in read_rows(raw, _made)}
    count = -(-got.kills // A_FLIGHT)
    (Path(tempfile.gettempdir()) / WORLD / REPORT).unlink(missing_ok=True)
    world()
    # A flight that ends before its ten kills leaves the rest to further ones.
    while True:
        flights = run_rows(count, raw, got.workers, fly, asdict, known)
        known = {flight.seed: flight for flight in flights}
        done = sum(len(flight.kills) for flight in flights)
        if done >= got.kills:
            break
        count += -(-(got.kills - done) // A_FLIGHT)
    (got.out / "kills.md").write_text(report(flights), encoding="utf-8")
    print(report(flights))
    wrong = any(f.doubled or not f.same or any(k.lost for k in f.kills) for f in flights)
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()

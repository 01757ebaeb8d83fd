"""``python -m sim.demo``: a drone that nobody flew, a lens that is known, a verdict before it lands.

A simulated vehicle flies over invented farmland, a simulated camera takes its photos, and fieldcal does
its job beside them, as a crew would use it: plan, upload, run. The run says REFLY while the drone flies,
uploads the extra pass, and says TRUST once that is flown. What it found is compared with the true lens.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from threading import Thread
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from calib.errors import FieldcalError, OutputError
from calib.findings import Verdict
from calib.frames import LocalFrame
from calib.output import REPORT_HTML, REPORT_JSON
from calib.reference import Reference
from calib.reference_file import write_reference_file
from calib.wording import VERDICT_WORDS
from mission import encode
from mission.encode import FLAVOURS, Flavour
from sim.cameras import PHANTOM_3
from sim.demo_map import Flown, Spot, drawn
from sim.demo_pilot import Pilot
from sim.faults.ends import free_port
from sim.options import SurveyOptions
from sim.survey import identity_of
from sim.truth import lens_reference
from sim.vehicle import VehicleOptions, VehicleServer

HOME = LocalFrame(47.0, 8.5, 430.0)
#: Metres around home, and the flight over them: 18 photos straight down from 60 m.
AREA_M, HEIGHT_M = 22.0, 60.0
CAMERA = "dji-phantom-3-professional"
#: How much faster than in life the drone flies while it takes photos, and home with nothing to wait for.
SPEED_UP, HOMEWARD = 3.0, 10.0
#: The way home goes on in real time for so long, so that a slow computer, too, tells before the landing.
PATIENCE_S = 60.0
MISSION, LENS, FLIGHT = "nadir.plan", "true-lens.json", "flight"
#: A flight that takes longer has gone wrong.
LONGEST_S = 1800.0
#: A camera that takes longer to make its ground is not coming.
READY_S = 300.0
#: Photos that look further aside than this are drawn as such.
OBLIQUE_PITCH_DEG = -80.0
#: What a run of this demonstration leaves in its folder, and clears away at the next.
OWN = ("tether", "flight", "nadir-only", "with-pass", "sessions", "kept-missions", "camera.log")
SO_FAR, FLY_IT, REPORT = "So far ", "Fly it when you are ready", "Report: "


@dataclass(frozen=True)
class Step:
    """One flight of the demonstration, and the verdict that the photos until then deserve."""

    name: str
    title: str
    expected: Verdict


STEPS = (
    Step("nadir-only", "photos straight down", Verdict.REFLY),
    Step("with-pass", "the same and the pass that fieldcal asked for", Verdict.TRUST),
)


@dataclass
class Told:
    """What ``fieldcal run`` has said: ``early`` is its last verdict while the drone was in the air.

    ``reports``: how many final verdicts it has given; ``fly_it``: it waits for the extra pass.
    """

    lines: list[str] = field(default_factory=list)
    early: str | None = None
    reports: int = 0
    fly_it: bool = False


class Demo:
    """The demonstration in ``out``: one console, one vehicle, commands run as a user would run them."""

    def __init__(
        self,
        out: Path,
        size: tuple[int, int],
        console: Console,
        flavour: Flavour = "ardupilot",
        area_m: float = AREA_M,
    ) -> None:
        self.out, self.size, self.console = out, size, console
        self.flavour, self.area_m = flavour, area_m
        self.tether = out / "tether"
        self.ports = [free_port() for _ in range(3)]
        self.environment = {
            **os.environ,
            "FIELDCAL_SESSIONS": str(out / "sessions"),
            "FIELDCAL_STORE": str(out / "store"),
            "PYTHONUNBUFFERED": "1",
        }

    @property
    def link(self) -> str:
        return f"udp://127.0.0.1:{self.ports[0]}"

    def command(self, *words: str) -> list[str]:
        return [sys.executable, "-m", "daemon.cli", *words]

    def do(self, *words: str, allowed: tuple[int, ...] = (0,)) -> str:
        """Run a command to its end, say it, and give what it wrote.

        Raises:
            FieldcalError: it ended otherwise than it should.
        """
        self.say_command(words)
        ran = subprocess.run(
            self.command(*words), env=self.environment, capture_output=True, text=True, check=False
        )
        if ran.returncode not in allowed:
            raise FieldcalError(f"fieldcal {words[0]} failed: {(ran.stderr or ran.stdout).strip()}")
        return ran.stdout

    def say_command(self, words: tuple[str, ...]) -> None:
        shown = " ".join(os.path.relpath(w) if Path(w).is_absolute() else w for w in words)
        self.console.print(Text(f"$ fieldcal {shown}", style="bold"), soft_wrap=True)

    def say(self, text: str) -> None:
        self.console.print(Text(f"  {text}"), soft_wrap=True)

    # -- the parts -------------------------------------------------------------------------------

    def plan(self) -> None:
        """The survey's plan."""
        words: tuple[str, ...] = (
            "plan",
            "nadir",
            "--area",
            f"{HOME.latitude_deg},{HOME.longitude_deg},{self.area_m:g}",
        )
        words += ("--camera", CAMERA, "--height", f"{HEIGHT_M:g}", "--launch")
        words += (f"{HOME.latitude_deg},{HOME.longitude_deg}", "--forward-overlap", "75")
        words += ("--side-overlap", "60", "--camera-interval", "1", "--autopilot", self.flavour)
        words += ("--out", str(self.out / MISSION))
        plan = json.loads(self.do(*words, "--json", "-"))
        expected = plan["predicted"]
        self.say(
            f"{plan['photos']} photos, {plan['duration_s']:.0f} s. To expect: {expected['verdict']}. "
            f"{expected['reason']}"
        )

    def upload(self) -> None:
        words = ("upload", str(self.out / MISSION), "--to", self.link, "--yes")
        said = self.do(*words)
        self.say(next(line for line in said.splitlines() if line.startswith("The vehicle holds")))

    def stations(self) -> list[Spot]:
        """Where the newest mission takes its photos: the extra pass, once the run has planned one."""
        found = sorted((self.out / "sessions").glob("*/refly/pass.plan"))
        read = encode.read(found[-1] if found else self.out / MISSION)
        return [(station.east_m, station.north_m) for station in read.stations]

    @contextmanager
    def camera(self) -> Iterator[None]:
        """The simulated camera beside the vehicle; its truth is written when it ends."""
        words: tuple[str, ...] = (
            "sim",
            "camera",
            "--out",
            str(self.tether),
            "--link",
            f"udp://127.0.0.1:{self.ports[1]}",
        )
        words += ("--size", f"{self.size[0]}x{self.size[1]}", "--site-m", "240")
        self.say_command(words)
        with (self.out / "camera.log").open("w", encoding="utf-8") as log:
            process = subprocess.Popen(
                self.command(*words),
                env=self.environment,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            try:
                yield
            finally:
                process.send_signal(signal.SIGINT)
                try:
                    process.wait(60)
                except subprocess.TimeoutExpired:
                    process.kill()

    def wait_for_camera(self) -> None:
        until = time.monotonic() + READY_S
        while "ready" not in (said := (self.out / "camera.log").read_text(encoding="utf-8")):
            if time.monotonic() > until:
                raise FieldcalError(f"The simulated camera is not ready: {said.strip()[-300:]}")
            time.sleep(0.2)

    def fly(self, server: VehicleServer) -> bool:
        """``fieldcal run`` beside the drone, from before the take-off to the last verdict.

        Whether every verdict was the one expected.
        """
        forward = f"127.0.0.1:{self.ports[2]}"
        words: tuple[str, ...] = ("run", "--photos", str(self.tether), "--link", self.link)
        words += ("--forward", forward, "--reference", str(self.out / LENS), "--offer-refly", "--yes")
        words += ("--out", str(self.out / FLIGHT))
        self.say_command(words)
        process = subprocess.Popen(
            self.command(*words),
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            encoding="utf-8",
        )
        told = Told()
        reader = Thread(target=_listen, args=(process, told, server), daemon=True)
        reader.start()
        try:
            with Pilot(self.ports[2]) as pilot:
                for step in STEPS:
                    self.console.rule(step.title)
                    told.early, told.fly_it = None, False
                    self._leg(step, told, pilot, server, process)
                    if not self.judged(step, told) or (step is not STEPS[-1] and not told.fly_it):
                        return False
        finally:
            if process.poll() is None:
                process.kill()
            process.wait()
            reader.join(10)
        return True

    def _leg(
        self, step: Step, told: Told, pilot: Pilot, server: VehicleServer, process: subprocess.Popen[str]
    ) -> None:
        """One flight, from the take-off until the run waits for another, or has ended."""
        stations = self.stations()
        before, reports = len(server.vehicle.photos), told.reports
        pilot.take_off()
        self.say("The pilot has armed and started the mission; fieldcal never does.")
        server.speed_up = SPEED_UP
        calm_s = None
        until = time.monotonic() + LONGEST_S
        with self._board() as show:
            while process.poll() is None and not told.fly_it:
                if server.vehicle.done:
                    server.speed_up = 1.0
                elif len(server.vehicle.photos) >= before + len(stations):
                    calm_s = calm_s or time.monotonic()
                    waited = told.early is not None or time.monotonic() - calm_s > PATIENCE_S
                    server.speed_up = HOMEWARD if waited else 1.0
                if told.reports > reports:
                    self.keep(step)
                    reports = told.reports
                self._pass_on(told)
                show(self._map(stations, server))
                if time.monotonic() > until:
                    raise FieldcalError(f"The flight has not ended after {LONGEST_S / 60:.0f} minutes.")
                time.sleep(0.2)
        self._pass_on(told)
        self.keep(step)

    def _pass_on(self, told: Told) -> None:
        while told.lines:
            self.say(told.lines.pop(0))

    def keep(self, step: Step) -> None:
        """What the run has reported so far, in the step's own folder: its next verdict takes its place."""
        for name in (REPORT_HTML, REPORT_JSON):
            if (self.out / FLIGHT / name).is_file():
                (self.out / step.name).mkdir(exist_ok=True)
                shutil.copy(self.out / FLIGHT / name, self.out / step.name / name)

    @contextmanager
    def _board(self) -> Iterator[Any]:
        """The map under the words, where there is a terminal."""
        if not self.console.is_terminal:
            yield lambda _: None
            return
        with Live(console=self.console, transient=True, refresh_per_second=5) as live:
            yield lambda text: live.update(Group(Text(""), Text(text, style="cyan")))

    def _map(self, planned: list[Spot], server: VehicleServer) -> str:
        vehicle = server.vehicle
        photos = list(vehicle.photos)
        taken = [p.at_m[:2] for p in photos if p.pitch_deg <= OBLIQUE_PITCH_DEG]
        oblique = [p.at_m[:2] for p in photos if p.pitch_deg > OBLIQUE_PITCH_DEG]
        east, north, up = vehicle.body.at_m
        state = "on the ground" if not vehicle.pilot.armed else f"{up:.0f} m up"
        there = len(list(self.tether.glob("*.JPG")))
        words = f"{state}, {len(photos)} photos taken, {there} in the folder"
        return f"{drawn(Flown(planned, taken, oblique, (east, north)))}\n{words}"

    def judged(self, step: Step, told: Told) -> bool:
        """Tell what came of a flight; whether it is as expected."""
        report = self.out / step.name / "report.json"
        if not report.is_file():
            self.console.print(f"[red]{step.title}: no verdict.[/red] " + " ".join(told.lines[-3:]))
            return False
        found = json.loads(report.read_text(encoding="utf-8"))
        verdict = found["verdict"]
        self.say(f"{VERDICT_WORDS[Verdict(verdict)]}: {found['headline']}")
        right = bool(verdict == step.expected.value)
        mark = "[green]as it should be[/green]" if right else f"[red]expected {step.expected.value}[/red]"
        early = "" if told.early is None else f" ({told.early} before it landed)"
        self.console.print(f"{step.title}: {verdict}{early}, {mark}")
        return right


def _listen(process: subprocess.Popen[str], told: Told, server: VehicleServer) -> None:
    """Take in what a run says, without its verdicts: those stand in the reports."""
    assert process.stdout is not None
    verdict = False
    for line in process.stdout:
        text = line.strip()
        verdict = verdict or text.startswith(tuple(VERDICT_WORDS.values()))
        if text.startswith(SO_FAR) and server.vehicle.pilot.flying:
            told.early = text.removeprefix(SO_FAR).split(":")[0]
        if text and not verdict:
            told.lines.append(text)
        if verdict and text.startswith(REPORT):
            verdict = False
            told.reports += 1
        told.fly_it = told.fly_it or text.startswith(FLY_IT)


def reference_of(size: tuple[int, int]) -> Reference:
    """The true lens as the reference that a calibration on site would have given."""
    camera = PHANTOM_3.at(*size)
    return lens_reference("demo-truth", camera, identity_of(PHANTOM_3, camera, False, SurveyOptions()))


def prepared(out: Path) -> None:
    """An empty place for this run; of earlier runs only their own files go.

    Raises:
        OutputError: it cannot be written to.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name in OWN:
            path = out / name
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"The demonstration cannot write to {out}: {error.strerror}.") from error


def compare(true_f_px: float, out: Path, console: Console) -> None:
    """Print the true focal length against those found."""
    console.rule("True lens against found")
    console.print(f"{'true':>12}: f = {true_f_px:8.2f} px")
    for step in STEPS:
        report = out / step.name / "report.json"
        if not report.is_file():
            continue
        calibration = json.loads(report.read_text(encoding="utf-8"))["calibration"]
        f, sigma = calibration["f_px"], calibration["sigma"]["f_px"]
        off = 100 * (f / true_f_px - 1)
        spread = "unknown" if sigma is None else f"{sigma:.2f} px"
        console.print(f"{step.name:>12}: f = {f:8.2f} px, sigma {spread}: {off:+.3f} % off the truth")


def show(out: Path, console: Console) -> None:
    """Name the reports; open the last one where there is a screen."""
    pages = [page for step in STEPS for page in sorted((out / step.name).glob("*.html"))]
    for page in pages:
        console.print(f"Report: {page}", soft_wrap=True)
    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    opener = shutil.which("xdg-open")
    if pages and screen and opener:
        subprocess.Popen(
            [opener, str(pages[-1])],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )


def flown(demo: Demo) -> bool:
    """The whole of it; whether every verdict was the one expected."""
    demo.plan()
    with demo.camera():
        confirmed = demo.flavour == "ardupilot"
        options = VehicleOptions(demo.flavour, HOME, boot_utc_s=time.time(), camera_component=confirmed)
        with VehicleServer(
            options, ("127.0.0.1", demo.ports[0]), camera=("127.0.0.1", demo.ports[1])
        ) as server:
            demo.upload()
            demo.wait_for_camera()
            return demo.fly(server)


def main(arguments: list[str] | None = None) -> int:
    """Exit code 0 only if every verdict is the expected one."""
    parser = argparse.ArgumentParser(prog="python -m sim.demo", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("demo-out"), help="folder for photos and reports")
    parser.add_argument("--width", type=int, default=1200, help="width of the photos in px (default: 1200)")
    parser.add_argument("--autopilot", choices=FLAVOURS, default="ardupilot", help="whose vehicle it is")
    chosen = parser.parse_args(arguments)
    if not 320 <= chosen.width <= 4000:
        parser.error("--width must be from 320 to 4000")
    size = (chosen.width // 4 * 4, chosen.width // 4 * 3)
    # Started in the background it would ignore Ctrl-C, and so would the camera that is ended by it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    console = Console()
    out: Path = chosen.out.absolute()
    prepared(out)
    reference = reference_of(size)
    write_reference_file(reference, out / LENS)
    right = flown(Demo(out, size, console, chosen.autopilot))
    if reference.brown is not None:
        compare(reference.brown.f_px, out, console)
    show(chosen.out, console)
    return 0 if right else 1


if __name__ == "__main__":
    try:
        sys.exit(main())
    except FieldcalError as problem:
        print(problem, file=sys.stderr)
        sys.exit(problem.exit_code)

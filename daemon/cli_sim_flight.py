"""``fieldcal sim vehicle`` and ``camera``: a drone that is not there, for any ground station and tether."""

from __future__ import annotations

import contextlib
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from calib.errors import InputError, OutputError
from calib.files import output_errors, output_folder
from calib.frames import LocalFrame
from calib.reference_file import write_reference_file
from calib.wording import path_text
from daemon.output import console
from daemon.progress import Report, progress_line
from sim.cameras import CAMERAS, find_camera
from sim.truth import TRUTH_FILE, SurveyTruth, true_reference
from sim.worlds import KINDS

if TYPE_CHECKING:
    from daemon.link.live import Link
    from sim.tether.camera import Camera, Count
    from sim.vehicle import Wind

LARGEST_SEED = 2**31 - 1
#: The true lens as a reference for `fieldcal check`.
LENS_FILE = "true-lens.json"
_NOT_INSTALLED = "needs a part that is not installed: pip install 'fieldcal[flight]'."


def vehicle(
    autopilot: Annotated[
        Literal["ardupilot", "px4"], typer.Option(help="Whose behaviour it shows.")
    ] = "ardupilot",
    to: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Where it sends its messages (UDP).")
    ] = "127.0.0.1:14550",
    camera_at: Annotated[
        str | None,
        typer.Option(
            "--camera", metavar="HOST:PORT", help="Where `fieldcal sim camera` listens, without faults."
        ),
    ] = None,
    home: Annotated[
        str | None, typer.Option(metavar="LAT,LON[,ALT]", help="Where it stands, degrees and m.")
    ] = None,
    speed_up: Annotated[float, typer.Option(min=0.1, max=100, metavar="N", help="Times real time.")] = 1.0,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Of its faults.")] = 0,
    drop: Annotated[float, typer.Option(min=0, max=1, metavar="SHARE", help="Share of messages lost.")] = 0.0,
    repeat: Annotated[
        float, typer.Option(min=0, max=1, metavar="SHARE", help="Share of messages sent twice.")
    ] = 0.0,
    delay: Annotated[
        float, typer.Option(min=0, max=60, metavar="S", help="Every message is late by this.")
    ] = 0.0,
    miss_photos: Annotated[
        float, typer.Option(min=0, max=1, metavar="SHARE", help="Share of triggers without photo.")
    ] = 0.0,
    camera_component: Annotated[
        bool, typer.Option("--camera-component", help="A camera that confirms photos.")
    ] = False,
    wind: Annotated[
        str | None, typer.Option(metavar="SPEED[,FROM]", help="Wind, m/s, from so many degrees (270).")
    ] = None,
    gusts: Annotated[
        float, typer.Option(min=0, max=15, metavar="M_S", help="Size of the gusts on it, m/s.")
    ] = 0.0,
    gps_noise: Annotated[
        float, typer.Option(min=0, max=50, metavar="M", help="GPS: error of single fixes, m.")
    ] = 0.0,
    gps_drift: Annotated[
        float, typer.Option(min=0, max=50, metavar="M", help="GPS: error that wanders over minutes, m.")
    ] = 0.0,
    gps_jumps: Annotated[
        float | None,
        typer.Option(min=5, metavar="S", help="GPS: a jump of some metres about every so many seconds."),
    ] = None,
    power_cycle: Annotated[
        list[float] | None,
        typer.Option(metavar="S", help="The autopilot starts anew after so long in the air (repeatable)."),
    ] = None,
) -> None:
    """A simulated vehicle that can be armed and flown by any ground station, until Ctrl-C."""
    try:
        from sim.vehicle import Faults, Gnss, VehicleOptions, VehicleServer
    except ModuleNotFoundError as error:
        raise InputError(f"The simulated vehicle {_NOT_INSTALLED}") from error

    place = VehicleOptions().home if home is None else _home(home)
    if any(after_s < 0 for after_s in power_cycle or ()):
        raise InputError("--power-cycle: the vehicle is in the air for 0 seconds or more.")
    options = VehicleOptions(
        *(autopilot, place),
        boot_utc_s=time.time(),
        camera_component=camera_component,
        wind=_wind(wind, gusts),
        gnss=Gnss(gps_noise, gps_drift, gps_jumps),
    )
    faults = Faults(
        *(drop, repeat, delay), miss_photo_share=miss_photos, power_cycles_s=tuple(power_cycle or ())
    )
    beside = None if camera_at is None else _host_port(camera_at, "--camera")
    server = VehicleServer(
        options, _host_port(to, "--to"), speed_up=speed_up, faults=faults, seed=seed, camera=beside
    )
    times = "" if speed_up == 1 else f", {speed_up:g} times real time"
    console().print(f"A simulated {autopilot} vehicle sends to {to} (UDP){times}. End it with Ctrl-C.")
    server.run()


def _host_port(text: str, option: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isascii() or not port.isdigit() or not 0 < int(port) < 65536:
        raise InputError(f"{option} {text!r} is not HOST:PORT, for example 127.0.0.1:14550.")
    try:
        # As a number, so that answers from there are known by it.
        return socket.gethostbyname(host), int(port)
    except OSError as error:
        raise InputError(f"{option}: no host is named {host}.") from error


def _wind(text: str | None, gusts_m_s: float) -> Wind:
    from sim.vehicle import Wind

    try:
        numbers = [float(part) for part in (text or "0").split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, 2) or not 0 <= numbers[0] <= 20 or not abs(numbers[-1]) <= 360:
        raise InputError(f"--wind {text!r} is not SPEED or SPEED,FROM: 0 to 20 m/s, from 0 to 360 degrees.")
    return Wind(numbers[0], numbers[1] if len(numbers) == 2 else Wind().from_deg, gusts_m_s)


def _home(text: str) -> LocalFrame:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3) or not (abs(numbers[0]) <= 90 and abs(numbers[1]) <= 180):
        raise InputError(f"--home {text!r} is not LAT,LON or LAT,LON,ALT in degrees and m.")
    return LocalFrame(numbers[0], numbers[1], numbers[2] if len(numbers) == 3 else 0.0)


def camera(
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="A new or empty folder for the photos.", readable=False)
    ],
    link: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Where the vehicle is: udp, tcp or serial.")
    ] = "udp://127.0.0.1:14551",
    size: Annotated[
        str | None, typer.Option(metavar="WxH|full", help="Size of the photos in px (default: reduced).")
    ] = None,
    lens: Annotated[
        str, typer.Option(metavar="NAME", help=f"Which camera: {', '.join(CAMERAS)}.")
    ] = "phantom-3",
    world: Annotated[
        str, typer.Option(metavar="KIND", help="What lies around home: rolling, flat, levee, valley...")
    ] = "rolling",
    seed: Annotated[
        int, typer.Option(min=0, max=LARGEST_SEED, help="Another seed: other ground, other errors.")
    ] = 1,
    site_m: Annotated[
        float, typer.Option(min=50, max=2000, help="Extent of the ground; beyond, it is mirrored.")
    ] = 300.0,
    clock_offset: Annotated[
        float, typer.Option(metavar="S", help="The camera's clock is ahead by so many seconds.")
    ] = 0.0,
    clock_drift: Annotated[
        float, typer.Option(metavar="PPM", min=-10_000, max=10_000, help="... and gains so much.")
    ] = 0.0,
    whole_seconds: Annotated[
        bool, typer.Option("--whole-seconds", help="Its times have no fractions.")
    ] = False,
    miss_photos: Annotated[
        float, typer.Option(min=0, max=1, metavar="SHARE", help="Share of triggers without a photo.")
    ] = 0.0,
    gps: Annotated[bool, typer.Option("--gps/--no-gps", help="Positions in the photos, or none.")] = True,
    gps_sigma_m: Annotated[float, typer.Option(min=0, max=100, help="Size of their errors.")] = 2.5,
    tags: Annotated[
        Literal["mavlink", "dji"], typer.Option(help="Plain EXIF, or DJI's tags with gimbal angles.")
    ] = "mavlink",
    offer: Annotated[
        Literal["mftp", "http"] | None,
        typer.Option(help="Tell of each photo over MAVLink, and give it over MAVLink or HTTP."),
    ] = None,
    once: Annotated[
        bool, typer.Option("--once", help="End when the vehicle has landed and all photos are there.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress and no words.")] = False,
) -> int:
    """A simulated camera: takes the photos of a vehicle, simulated or an autopilot's simulator."""
    model = find_camera(lens)
    pixels = model.size_of(size)
    if world not in KINDS or world == "dem":
        kinds = ", ".join(kind for kind in KINDS if kind != "dem")
        raise InputError(f"There is no world of the kind {world!r}: choose one of {kinds}.")
    if once and offer is not None:
        raise InputError("--once and --offer do not go together: photos on offer are given until Ctrl-C.")
    if abs(clock_offset) > 10 * 365 * 86_400:
        raise InputError(f"--clock-offset {clock_offset:g} s is more than ten years.")
    try:
        from daemon.link.address import parse
        from daemon.link.live import Link
        from daemon.link.transport import open_transport
        from sim.tether.camera import Camera
        from sim.tether.offering import Offering
        from sim.tether.studio import CameraClock, StudioOptions
    except ModuleNotFoundError as error:
        raise InputError(f"The simulated camera {_NOT_INSTALLED}") from error

    options = StudioOptions(
        *(pixels, model, world, seed, site_m),
        clock=CameraClock(clock_offset, clock_drift, whole_seconds),
        dji_tags=tags == "dji",
        gps=gps,
        gps_sigma_m=gps_sigma_m,
    )
    with output_errors(out):
        if out.is_dir() and any(out.iterdir()):
            raise OutputError(f"The folder {out} is not empty; the camera needs a folder of its own.")
    with contextlib.ExitStack() as stack:
        stack.enter_context(output_folder(out))
        offering = None if offer is None else stack.enter_context(Offering(out, offer))
        open_line = open_transport if offering is None else offering.open_line
        line = stack.enter_context(Link(parse(link), open_line=open_line))
        say = f"Waiting for a vehicle on {line.address}; photos of {pixels[0]} x {pixels[1]} px go to"
        say = f"{say} {path_text(out)}. Ctrl-C ends it."
        hidden = quiet or sys.stderr is None or not sys.stderr.isatty()
        with progress_line(hidden, "waiting for a vehicle") as report, output_errors(out):
            told = _teller(report, line)
            taking = Camera(line, options, out, miss_share=miss_photos, tell=told, offering=offering)
            with taking:
                _work(taking, once, quiet, say)
    if taking.truth is not None:
        write_reference_file(true_reference(taking.truth, "true-lens"), out / LENS_FILE)
    if not quiet:
        _tell_end(taking, taking.truth, out)
    return 0


def _work(taking: Camera, once: bool, quiet: bool, say: str) -> None:
    """Until Ctrl-C; what was triggered until then is made, unless there is another Ctrl-C."""
    with contextlib.suppress(KeyboardInterrupt):
        with contextlib.suppress(KeyboardInterrupt):
            said = quiet
            if not quiet:
                console().print(say, soft_wrap=True)
            while not (once and taking.landed):
                taking.step()
                if not said and taking.ground_ready:
                    said = True
                    console().print("The ground is made; the camera is ready.")
        left = taking.count.due - taking.count.written
        if left and not quiet:
            console().print(f"{left} photos are still to be made; Ctrl-C leaves them out.")
        taking.finish()


def _teller(report: Report, line: Link) -> Callable[[Count], None]:
    told: list[str | None] = [None]

    def tell(count: Count) -> None:
        fault = line.health.fault
        if fault is not None and fault != told[0]:
            print(f"fieldcal: {fault[:1].upper()}{fault[1:]} Trying again.", file=sys.stderr)
        told[0] = fault
        if not line.connected:
            report("waiting for a vehicle", 0, 0)
            return
        behind = f", {count.behind_s:.0f} s behind" if count.behind_s >= 1 else ""
        report(f"photos{behind}", count.written, count.due)

    return tell


def _tell_end(taking: Camera, truth: SurveyTruth | None, out: Path) -> None:
    say, shutter, count = console(), taking.shutter, taking.count
    photos = 0 if truth is None else len(truth.photos)
    say.print(f"{photos} photos of {count.triggers} triggers in {path_text(out)}.", soft_wrap=True)
    reasons = (
        (shutter.missed, "missed on purpose"),
        (shutter.failed, "called failed by the vehicle"),
        (shutter.blind, "without a word about where they were taken"),
        (len(shutter.filter.lost()), "never heard of"),
        (count.due - photos, "not made before the end"),
    )
    for number, reason in reasons:
        if number:
            say.print(f"  {number} {reason}")
    if truth is None:
        return
    if count.worst_s:
        say.print(f"The slowest was there {count.worst_s:.1f} s after its trigger.")
    if count.interpolated:
        say.print(f"{count.interpolated} poses are interpolated from the vehicle's messages.")
    say.print(f"True lens: f {truth.camera.f_px:.2f} px. The rest is in {TRUTH_FILE}.")

"""``fieldcal run``: photos as they come, a verdict while they do, told to whoever watches."""

from __future__ import annotations

import signal
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.align.stream import Solver
from calib.errors import FieldcalError, InputError
from calib.files import check_file_writable, check_writable, write_text_atomic
from calib.output import REPORT_HTML, write_outputs
from calib.references import load_reference
from calib.report_json import report_json
from calib.wording import VERDICT_WORDS, printable
from daemon.again import earlier, leave_files, unended
from daemon.capture.tagging import Kind, tag_photos
from daemon.cli_upload import TO_HELP, forward_to
from daemon.config_file import ConfigFileOption
from daemon.flight import STARTED, Flight, Options
from daemon.live.answers import Answers, answers_of
from daemon.live.commands import Commands, daemon_token, default_token_file
from daemon.live.schemas import Capture, Log, Message, Progress, Verdict
from daemon.live.settings import CONFIG_VARIABLE, Settings
from daemon.live.topics import vehicle_name
from daemon.notify import Notifier
from daemon.output import console, write_stdout
from daemon.progress import Report, progress_line
from daemon.session.library import begin, finish, resume, unfinished
from daemon.session.store import Session
from daemon.terminal import print_summary

if TYPE_CHECKING:
    from daemon.flight_link import FlightLink
    from daemon.link.live import Link
    from daemon.link.replay import Replay
    from daemon.live.bus import Bus

MISSING = "The live status needs zenoh, which is not installed: pip install 'fieldcal[flight]'"
LINK_HELP = f"{TO_HELP.rstrip('.')}, or a recorded FLIGHT.tlog."
ConnectOption = Annotated[
    list[str] | None,
    typer.Option("--connect", metavar="ENDPOINT", help="Find others there, as tcp/192.168.1.5:7447."),
]
ListenOption = Annotated[
    list[str] | None,
    typer.Option("--listen", metavar="ENDPOINT", help="Let others come here, as tcp/0.0.0.0:7447."),
]
ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--zenoh", metavar="FILE", envvar=CONFIG_VARIABLE, help="zenoh's own configuration (router, TLS)."
    ),
]


def run_command(
    photos: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Folder in which the photos arrive.", readable=False)
    ] = None,
    resume_last: Annotated[
        bool, typer.Option("--resume", help="Go on with the newest flight that is unfinished.")
    ] = False,
    session_name: Annotated[
        str | None, typer.Option("--session", metavar="NAME", help="Go on with this flight.")
    ] = None,
    reference: Annotated[
        str | None, typer.Option(metavar="NAME|FILE", help="Hold the calibration against this reference.")
    ] = None,
    idle: Annotated[
        float, typer.Option(metavar="SECONDS", min=0, help="No photo for so long: conclude (0: when told).")
    ] = 120.0,
    count: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Conclude when so many photos are there.")
    ] = None,
    label: Annotated[str, typer.Option(metavar="TEXT", help="Name of the flight.")] = "flight",
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Put report and exports here, too.", readable=False)
    ] = None,
    json_to: Annotated[
        str | None,
        typer.Option("--json", metavar="FILE|-", help="Also write report.json, or to stdout."),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Only the verdict; no progress.")] = False,
    vehicle: Annotated[
        str | None, typer.Option(metavar="NAME", help="Name for the live status (this computer's).")
    ] = None,
    live: Annotated[bool, typer.Option("--live/--no-live", help="Tell the live status, or nobody.")] = True,
    connect: ConnectOption = None,
    listen: ListenOption = None,
    zenoh_config: ConfigOption = None,
    link: Annotated[str | None, typer.Option("--link", metavar="ADDRESS", help=LINK_HELP)] = None,
    forward: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Pass the link on to a ground station (UDP).")
    ] = None,
    geotag: Annotated[
        Kind | None, typer.Option(help="Write the positions from the link into copies or XMP files.")
    ] = None,
    same: Annotated[
        list[str] | None,
        typer.Option("--same", metavar="FILE=N", help="This file is the vehicle's Nth photo."),
    ] = None,
    allow_commands: Annotated[
        bool, typer.Option("--allow-commands", help="Take commands with the token (off unless given).")
    ] = False,
    token_file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Where the token is.", readable=False)
    ] = None,
    again: Annotated[
        bool, typer.Option("--again", help="The flight begun in this folder, or the next: no photo twice.")
    ] = False,
    _config: ConfigFileOption = None,
) -> int:
    """Take photos as they arrive; the verdict at the end. Exit code 0 TRUST, 3 REFLY, 4 CANNOT TELL."""
    if again:
        if photos is None or resume_last or session_name is not None:
            raise InputError("--again goes with --photos FOLDER, and without --resume and --session.")
        session_name = unended(photos)
    anchors = tuple(map(_anchor, same or ()))
    going_on = resume_last or session_name is not None
    if photos is None and not going_on:
        raise InputError("No source of photos was given; name the folder they arrive in: --photos FOLDER.")
    if photos is not None and not going_on and not photos.is_dir():
        raise InputError(f"There is no folder {photos}; make it, or check whether the card is mounted.")
    if json_to is not None and json_to != "-":
        check_file_writable(Path(json_to))
    if out is not None:
        check_writable(out)
    if reference is not None:
        load_reference(reference)
    talkative = not quiet and json_to != "-"
    hidden = quiet or sys.stderr is None or not sys.stderr.isatty()
    with ExitStack() as stack:
        session = stack.enter_context(resume(session_name)) if going_on else None
        options = _options(session, photos, reference, vehicle, idle, count, link, anchors)
        if options.link is None and (forward is not None or geotag is not None or anchors):
            raise InputError("--forward, --geotag and --same need the vehicle: add --link ADDRESS.")
        if again:
            options = replace(options, passed_over=earlier(options.folder))
        notifier = stack.enter_context(Notifier())
        line = stack.enter_context(progress_line(hidden, "waiting for photos"))
        bus: Bus | None = None
        flight: Flight | None = None

        def tell(message: Message) -> None:
            notifier.tell(message)
            _show(message, line, talkative)
            if bus is not None:
                bus.tell(message)

        def conclude_now() -> str:
            if flight is not None:
                flight.finish()
            return "No more photos are waited for: the final verdict is being worked out."

        if live:
            commands = None
            if allow_commands:
                token = daemon_token(token_file or default_token_file())
                commands = Commands(options.vehicle, token, {"finish": conclude_now})
            settings = Settings(tuple(connect or ()), tuple(listen or ()), zenoh_config)
            bus = _bus(options.vehicle, settings, answers_of(lambda: session), commands)
            if bus is not None:
                stack.enter_context(bus)
        source = None if options.link is None else _source(options.link, forward)
        if source is not None:
            stack.callback(source.close)
        # Only now, so that what is refused leaves no empty flight behind.
        session = session or stack.enter_context(begin(label))
        told = None if source is None else stack.enter_context(_follow(source, session))
        solver = Solver()
        stack.callback(solver.close)
        if talkative:
            print(f"Flight {session.folder.name}: photos from {printable(str(options.folder))}.")
            print("Ctrl-C: no more photos, give the verdict. Twice: leave; `fieldcal run --resume` goes on.")
            if options.link is not None:
                print(f"The vehicle is listened to on {printable(options.link)}.")
        flight = Flight(session, options, solver, tell, link=told)
        with _interrupts(flight.finish):
            while not flight.over:
                flight.step()
        try:
            if again:
                leave_files(session, options.folder)
            result = flight.conclude()
        except FieldcalError as error:
            if again:
                finish(session)  # Without a verdict; its photos are not tried again and again.
            if bus is not None:
                bus.tell(Log(vehicle=options.vehicle, at=datetime.now(UTC), level="error", text=str(error)))
            raise
        result = replace(result, exports=write_outputs(result, session.folder))
        if out is not None:
            write_outputs(result, out)
        if geotag is not None:
            folder = session.folder / geotag.value
            tell(
                Log(
                    vehicle=options.vehicle,
                    at=datetime.now(UTC),
                    level="info",
                    text=tag_photos(session, folder, geotag).sentence(folder),
                )
            )
        finish(session)
        flight.ended()
        report_in = out or session.folder
    if json_to == "-":
        write_stdout(report_json(result))
    elif json_to is not None:
        write_text_atomic(Path(json_to), report_json(result))
    if quiet and json_to != "-":
        print(f"{VERDICT_WORDS[result.verdict]}: {printable(result.headline)}")
    elif not quiet:
        print_summary(result, console(json_to == "-"), report_in / REPORT_HTML)
    return result.verdict.exit_code


def _bus(vehicle: str, settings: Settings, answers: Answers, commands: Commands | None) -> Bus | None:
    """The bus; zenoh is loaded only for those who want it.

    Where nobody asked for anything, a computer on which it cannot start does without (None).
    """
    asked_for = settings != Settings() or commands is not None
    try:
        from daemon.live.bus import Bus

        return Bus(vehicle, settings, answers, commands)
    except (ImportError, InputError) as error:
        if asked_for:
            raise InputError(f"{MISSING}." if isinstance(error, ImportError) else str(error)) from error
        print(f"fieldcal: no live status: {error}", file=sys.stderr)
        return None


def _options(
    session: Session | None,
    photos: Path | None,
    reference: str | None,
    vehicle: str | None,
    idle: float,
    count: int | None,
    link: str | None,
    anchors: tuple[tuple[int, str], ...],
) -> Options:
    """What was asked for, and for a flight that goes on what was asked for then."""
    then: dict[str, Any] = {}
    if session is not None:
        if not unfinished(session).resumable:
            name = session.folder.name
            raise InputError(f"Flight {name} is finished; `fieldcal sessions show {name}` tells its verdict.")
        then = next((dict(e.value.data) for e in reversed(session.events(STARTED))), {})
    folder = photos or (Path(then["folder"]) if then.get("folder") else None)
    if folder is None:
        raise InputError("This flight has no folder of photos; name it: --photos FOLDER.")
    name = vehicle or then.get("vehicle") or socket.gethostname()
    return Options(
        vehicle=vehicle_name(name),
        folder=folder,
        reference=reference or then.get("reference"),
        idle_s=idle,
        count=count,
        link=link or then.get("link"),
        anchors=anchors,
    )


def _anchor(text: str) -> tuple[int, str]:
    name, _, number = text.rpartition("=")
    if not name or not number.isascii() or not number.isdigit() or int(number) < 1:
        raise InputError(f"--same {text!r} is not FILE=N, for example DSC00001.JPG=1.")
    return int(number), Path(name).name


def _source(address: str, forward: str | None) -> Link | Replay:
    """Loaded only for those who want it: it needs a library that others may not have."""
    from daemon.flight_link import open_source

    return open_source(address, forward_to(forward))


def _follow(source: Link | Replay, session: Session) -> FlightLink:
    from daemon.flight_link import FlightLink

    return FlightLink(source, session)


@contextmanager
def _interrupts(first: Callable[[], None]) -> Iterator[None]:
    """The first Ctrl-C calls ``first``; further ones interrupt as always."""
    usual = signal.getsignal(signal.SIGINT)

    def once(number: int, frame: FrameType | None) -> None:
        del number, frame
        signal.signal(signal.SIGINT, usual)
        first()

    signal.signal(signal.SIGINT, once)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)


def _show(message: Message, line: Report, talkative: bool) -> None:
    """One message in the terminal: the progress line moves, words and verdicts so far are printed."""
    if isinstance(message, Progress):
        line(message.stage, message.done, message.of or 0)
    elif isinstance(message, Capture) and message.photos == 0:
        line("waiting for photos", 0, 0)
    elif isinstance(message, Log) and talkative:
        print(printable(message.text), flush=True)
    elif isinstance(message, Verdict) and talkative and not message.final:
        print(so_far(message), flush=True)


def so_far(verdict: Verdict) -> str:
    """A provisional verdict in a line."""
    known = []
    if verdict.sigma_f_percent is not None:
        known.append(f"focal length known to {verdict.sigma_f_percent:.2g} %")
    if verdict.dome_percent is not None:
        known.append(f"dome {verdict.dome_percent:.2g} % of the height")
    words = verdict.verdict.replace("_", " ")
    return f"So far {words}: {verdict.photos} photos, {', '.join(known)}." if known else f"So far {words}."

"""``fieldcal run``: photos as they come, a verdict while they do, told to whoever watches."""

from __future__ import annotations

import socket
import sys
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.align.stream import Solver
from calib.errors import InputError
from calib.files import check_file_writable, check_writable, output_errors
from calib.references import load_reference
from calib.wording import printable
from daemon.again import earlier, unended
from daemon.capture.tagging import Kind
from daemon.capture.tether import Tether, gphoto2_program
from daemon.cli_upload import TO_HELP, forward_to
from daemon.config_file import ConfigFileOption
from daemon.flight import STARTED, Flight, Options, Source
from daemon.link.address import Kind as LinkKind
from daemon.link.address import parse
from daemon.live.answers import Answers, answers_of
from daemon.live.commands import Commands, daemon_token, default_token_file
from daemon.live.schemas import Message
from daemon.live.settings import CONFIG_VARIABLE, Settings
from daemon.live.topics import vehicle_name
from daemon.notify import Notifier
from daemon.run_rounds import Rounds, Wishes
from daemon.run_screen import Screen
from daemon.session.library import begin, resume, unfinished
from daemon.session.store import Session
from mission.site_file import read_site_file

if TYPE_CHECKING:
    from daemon.capture.fetch import Fetcher
    from daemon.flight_link import FlightLink
    from daemon.link.live import Link
    from daemon.link.replay import Replay
    from daemon.live.bus import Bus

MISSING = "The live status needs zenoh, which is not installed: pip install 'fieldcal[flight]'"
#: For a flight that goes on without its vehicle.
NO_LINK = "none"
#: In the flight's folder: photos that we bring ourselves.
PHOTOS = "photos"
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
        Path | None,
        typer.Option(
            metavar="FOLDER|mavlink|gphoto2",
            help="Folder in which the photos arrive; or fetched from the vehicle's camera, or over USB.",
            readable=False,
        ),
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
    site: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Site file: limits that an extra pass keeps.")
    ] = None,
    offer_refly: Annotated[
        bool, typer.Option("--offer-refly", help="Offer to upload the extra pass that the verdict asks for.")
    ] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="Upload the extra pass without asking: your word in advance.")
    ] = False,
    allow_commands: Annotated[
        bool, typer.Option("--allow-commands", help="Take commands with the token (off unless given).")
    ] = False,
    token_file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Where the token is.", readable=False)
    ] = None,
    again: Annotated[
        bool, typer.Option("--again", help="The flight begun with these photos, or the next: no photo twice.")
    ] = False,
    _config: ConfigFileOption = None,
) -> int:
    """Take photos as they arrive; the verdict at the end. Exit code 0 TRUST, 3 REFLY, 4 CANNOT TELL."""
    source = _source_of(photos)
    photos = photos if source in (None, "folder") else None
    if again:
        if source is None or resume_last or session_name is not None:
            raise InputError("--again goes with --photos, and without --resume and --session.")
        session_name = unended(photos, source)
    anchors = tuple(map(_anchor, same or ()))
    going_on = resume_last or session_name is not None
    if source is None and not going_on:
        raise InputError("No source of photos was given; name the folder they arrive in: --photos FOLDER.")
    if photos is not None and not going_on and not photos.is_dir():
        raise InputError(f"There is no folder {photos}; make it, or check whether the card is mounted.")
    if json_to is not None and json_to != "-":
        check_file_writable(Path(json_to))
    if out is not None:
        check_writable(out)
    if reference is not None:
        load_reference(reference)
    if site is not None:
        read_site_file(site)
    hidden = quiet or sys.stderr is None or not sys.stderr.isatty()
    screen = Screen(talkative=not quiet and json_to != "-", hidden=hidden)
    if offer_refly and not yes and (sys.stdin is None or not sys.stdin.isatty() or not screen.talkative):
        raise InputError("Nobody is there to ask before the extra pass is uploaded: add --yes, or no offer.")
    wishes = Wishes(out, json_to, quiet, geotag, site, offer_refly, yes)
    with ExitStack() as stack:
        session = stack.enter_context(resume(session_name)) if going_on else None
        options = _options(session, photos, source, reference, vehicle, idle, count, link, anchors)
        if options.link is None and (forward is not None or offer_refly):
            raise InputError("--forward and --offer-refly need the vehicle: add --link ADDRESS.")
        told_before = session is not None and session.counts().triggers > 0
        if options.link is None and not told_before and (geotag is not None or anchors):
            raise InputError("--geotag and --same need what the vehicle tells: add --link ADDRESS.")
        if again and options.source == "folder":
            options = replace(options, passed_over=earlier(options.folder))
        notifier = stack.enter_context(Notifier())
        bus: Bus | None = None
        flight: Flight | None = None

        def tell(message: Message) -> None:
            notifier.tell(message)
            screen.show(message)
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
        line = _line(options.link, forward, recorded=link is None)
        if line is not None:
            stack.callback(line.close)
        if options.source == "gphoto2":
            gphoto2_program()
        # Only now, so that what is refused leaves no empty flight behind.
        session = session or stack.enter_context(begin(label))
        told = None if line is None else stack.enter_context(_follow(line, session))
        if options.source != "folder":
            options = replace(options, folder=session.folder / PHOTOS)
        if again:
            wishes = replace(wishes, again=options.folder)
        bringer = _bringer(options, told)
        if bringer is not None:
            stack.enter_context(bringer)
        solver = Solver()
        stack.callback(solver.close)
        if screen.talkative:
            print(f"Flight {session.folder.name}: photos from {_from_words(options)}.")
            print("Ctrl-C: no more photos, give the verdict. Twice: leave; `fieldcal run --resume` goes on.")
            if line is not None and options.link is not None:
                print(f"The vehicle is listened to on {printable(options.link)}.")
        flight = Flight(session, options, solver, tell, link=told, bringer=bringer)
        rounds = Rounds(flight, session, told, screen, wishes, options.vehicle, tell, notifier.busy)
        return rounds.run().exit_code


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
    source: Source | None,
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
    source = source or then.get("source", "folder")
    folder = photos or (Path(then["folder"]) if then.get("folder") else None)
    if source != "folder":
        folder = Path(PHOTOS)  # In the flight's own folder.
    if folder is None:
        raise InputError("This flight has no folder of photos; name it: --photos FOLDER.")
    name = vehicle or then.get("vehicle") or socket.gethostname()
    address = None if link == NO_LINK else link or then.get("link")
    if source == "mavlink" and link != NO_LINK and (address is None or parse(address).kind is LinkKind.LOG):
        raise InputError("--photos mavlink fetches from the vehicle's camera: add --link ADDRESS.")
    return Options(
        vehicle=vehicle_name(name),
        folder=folder,
        source=source,
        reference=reference or then.get("reference"),
        idle_s=idle,
        count=count,
        link=address,
        anchors=anchors,
    )


def _anchor(text: str) -> tuple[int, str]:
    name, _, number = text.rpartition("=")
    if not name or not number.isascii() or not number.isdigit() or int(number) < 1:
        raise InputError(f"--same {text!r} is not FILE=N, for example DSC00001.JPG=1.")
    return int(number), Path(name).name


def _source_of(photos: Path | None) -> Source | None:
    """A folder that is called like a source is named by its full path."""
    if photos is None:
        return None
    named: dict[str, Source] = {"mavlink": "mavlink", "gphoto2": "gphoto2"}
    return named.get(str(photos), "folder")


def _from_words(options: Options) -> str:
    words = {"mavlink": "the vehicle's camera", "gphoto2": "the camera on this computer (gphoto2)"}
    folder = printable(str(options.folder))
    return folder if options.source == "folder" else f"{words[options.source]}, into {folder}"


def _bringer(options: Options, told: FlightLink | None) -> Fetcher | Tether | None:
    """Who fills the folder; None: somebody else, or nobody any more (a flight without its vehicle)."""
    if options.source == "folder":
        return None
    with output_errors(options.folder):
        options.folder.mkdir(exist_ok=True)
    if options.source == "gphoto2":
        return Tether(options.folder, gphoto2_program())
    return None if told is None else told.fetcher(options.folder)


def _line(address: str | None, forward: str | None, recorded: bool) -> Link | Replay | None:
    """Loaded only for those who want it: it needs a library that others may not have.

    ``recorded``: the address is that of an earlier run, whose vehicle may be far away by now.
    """
    if address is None:
        return None
    try:
        from daemon.flight_link import open_source

        return open_source(address, forward_to(forward))
    except InputError as error:
        if not recorded:
            raise
        print(f"fieldcal: going on without the vehicle: {error}", file=sys.stderr)
        return None


def _follow(source: Link | Replay, session: Session) -> FlightLink:
    from daemon.flight_link import FlightLink

    return FlightLink(source, session)

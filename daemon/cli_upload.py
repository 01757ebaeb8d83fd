"""``fieldcal upload``: a mission file onto a vehicle, on the operator's word."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from calib.errors import FieldcalError, InputError
from calib.wording import path_text, printable
from daemon.output import console, table
from daemon.progress import late_line, progress_line
from daemon.session.library import sessions_folder
from mission.rule import Finding

if TYPE_CHECKING:
    from daemon.link.forward import Forward
    from daemon.link.live import Link
    from daemon.link.upload import Result
    from daemon.mission_file import Loaded
    from mission.feasibility import Place

TO_HELP = "The vehicle: udp://:14550, udpout://HOST:14550, tcp://HOST:5760, serial:///dev/ttyACM0:57600."


class UploadError(FieldcalError):
    """The mission is not on the vehicle."""


def upload(
    mission: Annotated[
        Path, typer.Argument(metavar="MISSION", help="A .plan or .waypoints file, or a mission kept before.")
    ],
    to: Annotated[str, typer.Option("--to", metavar="ADDRESS", help=TO_HELP)],
    yes: Annotated[bool, typer.Option("--yes", help="Upload without asking.")] = False,
    holding: Annotated[
        bool, typer.Option("--holding", help="Also to a vehicle that holds in the air (for an extra pass).")
    ] = False,
    no_fence: Annotated[
        bool, typer.Option("--no-fence", help="Leave the vehicle's fence, though the file has one.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Upload a mission that breaks a hard rule.")] = False,
    backup: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Where the vehicle's old mission is kept.")
    ] = None,
    forward: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Pass the link on to a ground station (UDP).")
    ] = None,
    record: Annotated[
        Path | None, typer.Option(metavar="FILE.tlog", help="Record everything on the link.")
    ] = None,
    wait: Annotated[
        float, typer.Option(min=1, max=3600, metavar="S", help="How long to wait for the vehicle.")
    ] = 15.0,
) -> None:
    """Upload a mission to a disarmed vehicle; its old one is kept, and comes back if anything fails.

    Nothing is armed, started or changed in its mode. The mission is read back and compared.
    """
    from daemon.link.address import parse
    from daemon.link.live import Link
    from daemon.link.tlog import LogWriter
    from daemon.link.upload import Outcome, cut_off, flavour_of
    from daemon.mission_file import load

    address = parse(to)
    if not mission.exists():
        raise InputError(f"There is no file {mission}.")
    out, keep_in = console(), backup or backup_folder()
    hidden = sys.stderr is None or not sys.stderr.isatty()
    with ExitStack() as stack:
        log = None if record is None else stack.enter_context(LogWriter(record))
        link = stack.enter_context(Link(address, log=log, forward=forward_to(forward)))
        with progress_line(hidden, "waiting for the vehicle"):
            link.wait_for_vehicle(wait)
            link.wait(lambda: _place(link) is not None, 3.0)
        loaded = load(mission, flavour_of(link.state), not no_fence)
        earlier = cut_off(keep_in)
        if earlier is not None and earlier != mission.absolute():
            out.print("An upload before this one was cut off. What the vehicle held before it is kept in")
            out.print(path_text(earlier), soft_wrap=True)
        _show(out, link, loaded, force)
        result = _transact(link, loaded, yes, holding, keep_in, hidden)
    if result.outcome is not Outcome.UPLOADED:
        for difference in result.differences[:5]:
            out.print(f"  {difference}")
        if result.outcome is Outcome.REFUSED:
            out.print(result.message)
            raise typer.Exit(FieldcalError.exit_code)
        kept = f" It is kept in {result.kept}." if result.kept else ""
        raise UploadError(f"{result.message}{kept}")
    out.print(result.message)
    if result.kept is not None:
        out.print(f"The old mission is kept in {path_text(result.kept)}", soft_wrap=True)


def forward_to(text: str | None) -> Forward | None:
    """A ground station at HOST:PORT.

    Raises:
        InputError: not such an address, or no such host.
    """
    from daemon.link.address import parse
    from daemon.link.forward import Forward

    if text is None:
        return None
    address = parse(text if "://" in text else f"udpout://{text}")
    try:
        return Forward(address.place, address.number)
    except OSError as error:
        raise InputError(f"--forward {text}: {(error.strerror or str(error)).lower()}.") from error


def backup_folder() -> Path:
    """Beside the recorded flights."""
    return sessions_folder().parent / "kept-missions"


def _transact(link: Link, loaded: Loaded, yes: bool, holding: bool, kept: Path, hidden: bool) -> Result:
    from daemon.link.upload import Terms
    from daemon.link.upload import upload as transaction

    with late_line(partial(progress_line, hidden)) as report:
        terms = Terms(holding=holding)
        return transaction(link, loaded.mission, lambda: yes or _ask(link), kept, terms, report)


def _ask(link: Link) -> bool:
    if sys.stdin is None or not sys.stdin.isatty():
        raise InputError("Nobody is there to ask: look at the findings, then add --yes.")
    return typer.confirm(f"Upload to {_name(link)}?", default=False)


def _show(out: Console, link: Link, loaded: Loaded, force: bool) -> None:
    from daemon.link.upload import flavour_of
    from mission.feasibility import check_file

    name = _name(link)
    out.print(f"{name[0].upper()}{name[1:]} on {link.address}: {_doing(link)}.")
    count = loaded.mission.count
    fence = "" if loaded.mission.fence is None else " and a fence"
    out.print(f"{printable(loaded.mission.name)}: {count} items, {len(loaded.plan.stations)} photos{fence}.")
    findings = check_file(loaded.plan, flavour_of(link.state), _place(link))
    rows = table("", "", "")
    rows.show_header = False
    for finding in sorted(findings, key=lambda f: (f.ok, not f.hard)):
        rows.add_row(_sign(finding), finding.rule, finding.message)
    out.print(rows)
    for note in loaded.plan.notes:
        out.print(f"Note: {printable(note)}")
    broken = [f for f in findings if f.hard and not f.ok]
    if broken and not force:
        raise InputError(
            f"The mission was not uploaded: {broken[0].message} (--force uploads it all the same.)"
        )


def _sign(finding: Finding) -> str:
    return "✓" if finding.ok else "✗" if finding.hard else "!"


def _name(link: Link) -> str:
    """ "the ArduPilot vehicle 1"."""
    from daemon.link.upload import flavour_of
    from mission.feasibility import NAMES

    return f"the {NAMES[flavour_of(link.state)]} vehicle {link.state.system_id}"


def _doing(link: Link) -> str:
    from daemon.link.events import Heartbeat

    beat = link.state.last(Heartbeat)
    if beat is None:
        return "not heard"
    return f"{'armed' if beat.armed else 'disarmed'}, mode {beat.mode}"


def _place(link: Link) -> Place | None:
    from daemon.link.events import Position
    from mission.feasibility import Place

    at = link.state.last(Position)
    return None if at is None else Place(at.latitude_deg, at.longitude_deg)

"""``fieldcal doctor``: is everything ready for a flight? In plain words."""

from __future__ import annotations

import sys
import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from calib.errors import FieldcalError
from daemon.output import JsonOption, console, table, write_json
from daemon.progress import progress_line
from daemon.session.library import sessions_folder

if TYPE_CHECKING:
    from daemon.doctor import Check

SCHEMA = "fieldcal.doctor/1"
_SIGNS = {"good": "✓", "note": "!", "bad": "✗"}


def doctor(
    link: Annotated[
        str | None,
        typer.Option(
            "--link",
            metavar="ADDRESS",
            help="Look at a vehicle as well: udp://:14550, tcp://HOST:5760, serial:///dev/ttyACM0:57600.",
        ),
    ] = None,
    seconds: Annotated[float, typer.Option(min=2, max=600, metavar="S", help="How long to listen.")] = 8.0,
    wait: Annotated[
        float, typer.Option(min=1, max=3600, metavar="S", help="How long to wait for the vehicle.")
    ] = 15.0,
    json_to: JsonOption = None,
) -> None:
    """Look at this computer, and at a vehicle's link, streams, clock and camera settings.

    Nothing is changed on the vehicle. Ends with 2 where something is bad.
    """
    from daemon import doctor as checks

    hidden = sys.stderr is None or not sys.stderr.isatty()
    found = checks.computer(sessions_folder(), time.time())
    if link is not None:
        found += _vehicle(link, seconds, wait, hidden)
    bad = sum(check.level is checks.Level.BAD for check in found)
    if json_to is not None:
        write_json({"schema": SCHEMA, "bad": bad, "checks": [asdict(check) for check in found]}, json_to)
    else:
        out = console()
        rows = table("", "", "")
        rows.show_header = False
        for check in found:
            rows.add_row(_SIGNS[check.level], check.topic, check.sentence)
        out.print(rows)
        out.print("Everything is ready." if not bad else f"{bad} thing{'s' if bad > 1 else ''} to put right.")
    if bad:
        raise typer.Exit(FieldcalError.exit_code)


def _vehicle(text: str, seconds: float, wait: float, hidden: bool) -> list[Check]:
    from daemon.doctor import ARDUPILOT_PARAMETERS, PX4_PARAMETERS, Check, Level, vehicle
    from daemon.link.address import parse
    from daemon.link.events import Autopilot
    from daemon.link.live import Link, NoVehicleError
    from daemon.link.transfer import AskMessage, ReadParameters

    with Link(parse(text)) as link, progress_line(hidden, "waiting for the vehicle") as line:
        try:
            system_id = link.wait_for_vehicle(wait)
        except NoVehicleError as error:
            return [Check(Level.BAD, "link", str(error))]
        end = time.monotonic() + seconds
        names = ARDUPILOT_PARAMETERS if link.state.autopilot is Autopilot.ARDUPILOT else PX4_PARAMETERS
        link.run(AskMessage(system_id, "AUTOPILOT_VERSION"))
        link.run(ReadParameters(system_id, names))
        while (left := end - time.monotonic()) > 0:
            line("listening", round(seconds - left), round(seconds))
            time.sleep(min(left, 0.2))
        return vehicle(link.state, link.health, link.streams, link.now_s())

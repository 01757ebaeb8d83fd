"""``fieldcal status``: what the daemons of this computer or network are doing, live."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Group, RenderableType
from rich.live import Live
from rich.text import Text

from calib.errors import InputError
from calib.wording import printable
from daemon.cli_run import MISSING, ConfigOption, ConnectOption, ListenOption
from daemon.live.commands import default_token_file, read_token
from daemon.live.schemas import Capture, Link, Progress, Status, Verdict
from daemon.live.settings import Settings
from daemon.output import console, table, write_json
from daemon.run_screen import so_far

if TYPE_CHECKING:
    from daemon.live.fleet import Fleet, Vehicle

SCHEMA = "fieldcal.fleet/1"
_REFRESH_S, _OTHERS_S = 0.5, 0.5
_STYLES = {"TRUST": "bold green", "REFLY": "bold red", "CANNOT_TELL": "bold yellow"}


def status(
    vehicle: Annotated[
        str | None, typer.Argument(metavar="VEHICLE", help="Only this one, and everything about it.")
    ] = None,
    watch: Annotated[bool, typer.Option("--watch", help="Go on until Ctrl-C.")] = False,
    json_to: Annotated[
        str | None,
        typer.Option("--json", metavar="FILE|-", help="Write JSON (-: to stdout, nothing else)."),
    ] = None,
    wait: Annotated[
        float, typer.Option(metavar="SECONDS", min=0.1, help="How long to wait for somebody to answer.")
    ] = 3.0,
    finish: Annotated[
        bool, typer.Option("--finish", help="Tell VEHICLE that no more photos come (needs its token).")
    ] = False,
    token_file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Where the vehicle's token is.", readable=False)
    ] = None,
    connect: ConnectOption = None,
    listen: ListenOption = None,
    zenoh_config: ConfigOption = None,
) -> None:
    """Show what every vehicle's fieldcal does, from any machine."""
    if finish and vehicle is None:
        raise InputError("Say which vehicle is to finish: `fieldcal status VEHICLE --finish`.")
    try:
        from daemon.live.fleet import Fleet
    except ImportError as error:
        raise InputError(f"{MISSING}.") from error
    settings = Settings(tuple(connect or ()), tuple(listen or ()), zenoh_config)
    with Fleet(settings, vehicle or "*") as fleet:
        fleet.wait(wait, _complete)
        if vehicle is None and fleet.vehicles():
            fleet.wait(_OTHERS_S, lambda _: False)  # Others are learnt of from the first.
        found = fleet.vehicles()
        if finish:
            assert vehicle is not None
            token = read_token(token_file or default_token_file())
            console().print(printable(fleet.command(vehicle, "finish", token)))
            return
        if watch:
            _watch(fleet, vehicle)
            return
    if json_to is not None:
        write_json(fleet_json(found), json_to)
    if not found:
        who = vehicle or "Nobody"
        raise InputError(
            f"{who} {'does not answer' if vehicle else 'answers'}; is `fieldcal run` at work, and does "
            "--connect name its address where it is on another machine?"
        )
    if json_to is None:
        console().print(view(found, vehicle is not None))


def _complete(found: tuple[Vehicle, ...]) -> bool:
    return bool(found) and all(v.alive and "status" in v.heard for v in found)


def _watch(fleet: Fleet, vehicle: str | None) -> None:
    with Live(console=console(), auto_refresh=False, screen=False) as shown:
        while True:
            found = fleet.vehicles()
            waiting = Text("Waiting for somebody to answer. Ctrl-C ends this.", style="dim")
            shown.update(view(found, vehicle is not None) if found else waiting, refresh=True)
            if not found:
                fleet.ask(_REFRESH_S)
            time.sleep(_REFRESH_S)


def view(found: tuple[Vehicle, ...], in_detail: bool = False) -> RenderableType:
    """The fleet as a table, one line each; ``in_detail`` with the findings and the last words of each."""
    rows = table("vehicle", "state", "photos", "aligned", "verdict", "sigma f", "heard", numbers=("photos",))
    for vehicle in found:
        rows.add_row(*_row(vehicle))
    parts: list[RenderableType] = [rows]
    for vehicle in found:
        verdict = _of(vehicle, Verdict)
        known = _of(vehicle, Status)
        capture = _of(vehicle, Capture)
        notes = [
            *(known.degraded if known else []),
            *([capture.warning] if capture and capture.warning else []),
        ]
        for note in dict.fromkeys(notes):
            parts.append(Text(f"{vehicle.name}: {printable(note)}", style="yellow"))
        if not in_detail:
            continue
        if verdict is not None:
            parts.append(Text(""))
            parts.append(Text(printable(verdict.headline) if verdict.final else so_far(verdict)))
            parts += [
                Text(f"  {finding.state:<8}{finding.rule}: {printable(finding.message)}", style="dim")
                for finding in verdict.findings
                if finding.state != "pass"
            ]
            if verdict.what_to_fly:
                parts.append(Text(printable(verdict.what_to_fly)))
        if vehicle.log:
            parts.append(Text(""))
            parts += [
                Text(f"  {line.at:%H:%M:%S} {printable(line.text)}", style="dim") for line in vehicle.log[-8:]
            ]
    return Group(*parts)


def _row(vehicle: Vehicle) -> tuple[str | Text, ...]:
    known, capture = _of(vehicle, Status), _of(vehicle, Capture)
    progress, verdict, link = _of(vehicle, Progress), _of(vehicle, Verdict), _of(vehicle, Link)
    state = known.phase if known else "?"
    if not vehicle.alive:
        state = "gone" if state != "ended" else "ended"
    elif progress is not None and state in ("collecting", "concluding") and progress.stage:
        state = f"{state}, {printable(progress.stage)}"
    if link is not None and link.connected is False:
        state += ", no link"
    heard = vehicle.heard.get("status")
    words: str | Text = "-"
    sigma = "-"
    if verdict is not None:
        words = Text(verdict.verdict.replace("_", " "), style=_STYLES[verdict.verdict])
        if not verdict.final:
            words.append(" so far", style="dim")
        if verdict.sigma_f_percent is not None:
            sigma = f"{verdict.sigma_f_percent:.2g} %"
    return (
        vehicle.name,
        state,
        str(capture.photos) if capture else "-",
        str(verdict.photos) if verdict else "-",
        words,
        sigma,
        f"{heard.age_s:.0f} s ago{', old' if heard.stale else ''}" if heard else "never",
    )


def _of(vehicle: Vehicle, kind: type[Any]) -> Any:
    return next((h.message for h in vehicle.heard.values() if type(h.message) is kind), None)


def fleet_json(found: tuple[Vehicle, ...]) -> dict[str, Any]:
    """The fleet as ``fieldcal.fleet/1``: every message as it came, with its age in s."""
    return {
        "schema": SCHEMA,
        "vehicles": [
            {
                "vehicle": v.name,
                "alive": v.alive,
                "topics": {
                    name: {
                        "age_s": round(heard.age_s, 3),
                        "stale": heard.stale,
                        "message": heard.message.model_dump(mode="json", by_alias=True),
                    }
                    for name, heard in sorted(v.heard.items())
                },
            }
            for v in found
        ],
    }

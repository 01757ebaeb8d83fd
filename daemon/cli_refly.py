"""``fieldcal refly``: from a check to the shortest extra pass that cures the calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from calib.errors import InputError
from calib.files import check_file_writable
from calib.findings import Verdict
from calib.flown_file import NETWORK_FILE, FlownCheck, read_network
from daemon.output import JsonOption, console, write_json
from daemon.pass_book import remember
from daemon.refly_output import no_pass_json, print_refly, refly_json
from daemon.session.library import find
from mission.encode import SUFFIXES, write
from mission.limits import hard_violations
from mission.refly import Refly, refly
from mission.refly_sheet import write_refly_sheet
from mission.refly_site import flown_site
from mission.refly_words import why_no_pass
from mission.site_file import checked, overlaid, read_site_file

SHEET = ".html"


def refly_command(
    check: Annotated[
        str,
        typer.Argument(
            metavar="SESSION|CHECK_OUTPUT",
            help="The folder of a check's results (fieldcal-out), or a recorded flight.",
        ),
    ],
    site: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Site file (TOML): launch point, fence, limits, aircraft."),
    ] = None,
    out: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help=f"Write the pass, once or several times: {', '.join(SUFFIXES)}; {SHEET}: the sheet.",
        ),
    ] = None,
    json_target: JsonOption = None,
    launch: Annotated[
        str | None, typer.Option(metavar="LAT,LON", help="Launch point (default: below the first photo).")
    ] = None,
    ceiling: Annotated[
        float | None, typer.Option(metavar="M", help="Highest above the launch point.")
    ] = None,
    battery: Annotated[
        float | None, typer.Option(metavar="MIN", help="Minutes that the battery still has (default 20).")
    ] = None,
    gimbal: Annotated[
        str | None, typer.Option(metavar="LOWEST,HIGHEST", help="The gimbal's pitch range (default -90,0).")
    ] = None,
    mechanical_shutter: Annotated[
        bool | None,
        typer.Option(
            "--mechanical-shutter/--rolling-shutter",
            help="Whether the camera exposes all rows at once (default: by its model, or not known).",
        ),
    ] = None,
    autopilot: Annotated[
        Literal["ardupilot", "px4"], typer.Option(help="Whose mission items .plan and .waypoints get.")
    ] = "ardupilot",
    force: Annotated[bool, typer.Option("--force", help="Write a pass that breaks a hard limit.")] = False,
) -> int:
    """Find the shortest extra pass that cures a survey's calibration, and say why."""
    outputs = out or []
    for path in outputs:
        if path.suffix.lower() not in (*SUFFIXES, SHEET):
            endings = ", ".join([*SUFFIXES, SHEET])
            raise InputError(f"{path.name}: there is no format with that ending; there are {endings}.")
        check_file_writable(path)
    if json_target is not None and json_target != "-":
        check_file_writable(Path(json_target))
    options = checked(
        {
            "launch": _numbers(launch, "--launch"),
            "ceiling_m": ceiling,
            "mechanical_shutter": mechanical_shutter,
            "vehicle": {"endurance_s": None if battery is None else 60 * battery}
            | dict(
                zip(
                    ("gimbal_lowest_deg", "gimbal_highest_deg"),
                    _numbers(gimbal, "--gimbal") or [],
                    strict=False,
                )
            ),
        },
        "the command line",
        {
            "launch": "option --launch",
            "ceiling_m": "option --ceiling",
            "vehicle.endurance_s": "option --battery",
            "vehicle.gimbal_lowest_deg": "option --gimbal",
            "vehicle.gimbal_highest_deg": "option --gimbal",
        },
    )
    keys = options if site is None else overlaid(read_site_file(site), options)
    network = _network_of(check)
    known = read_network(network)
    if known.origin_wgs84 is None:
        return _nothing(known, json_target)
    return _deliver(
        refly(flown_site(known, keys, keys.name or "refly")),
        network.parent,
        outputs,
        json_target,
        autopilot,
        force,
    )


def _network_of(given: str) -> Path:
    """The network's file: of a folder of results, of a recorded flight, or itself."""
    path = Path(given)
    if path.name == NETWORK_FILE and path.is_file():
        return path
    folder = path if path.is_dir() else find(given)
    if not (folder / NETWORK_FILE).is_file():
        raise InputError(
            f"There is no {NETWORK_FILE} in {folder}: run fieldcal check on the photos first, and give the "
            "folder of its results."
        )
    return folder / NETWORK_FILE


def _nothing(known: FlownCheck, json_target: str | None) -> int:
    """Without places no stations: say so, in the same form."""
    fault = f" {known.geotag_fault}" if known.geotag_fault else ""
    why = why_no_pass(known, strong=False) or (
        f"The photos' positions do not say where the survey lies, so no stations can be given.{fault} Fly a "
        "circle by hand as the report says under What to fly."
    )
    if json_target is not None:
        write_json(no_pass_json(known, why), json_target)
    if json_target != "-":
        console().print(why)
    return 0 if known.verdict is Verdict.TRUST else Verdict.CANNOT_TELL.exit_code


def _deliver(
    found: Refly,
    folder: Path,
    outputs: list[Path],
    json_target: str | None,
    autopilot: Literal["ardupilot", "px4"],
    force: bool,
) -> int:
    broken = hard_violations(found.findings)
    written: list[Path] = []
    losses: list[str] = []
    for path in outputs:
        if path.suffix.lower() == SHEET:
            write_refly_sheet(found, path)
        elif found.plan is None or (broken and not force):
            continue
        else:
            fence = None if found.flown.site.fence.is_empty else found.flown.site.fence
            losses += write(found.plan, path, fence=fence, flavour=autopilot)
        written.append(path)
    # What was only looked at is not flown.
    if (written or json_target is not None) and (fault := remember(found, folder)) is not None:
        losses.append(fault)
    if json_target is not None:
        write_json(refly_json(found), json_target)
    if json_target != "-":
        print_refly(found, console(), written, list(dict.fromkeys(losses)))
    if broken and not force:
        more = f" ({len(broken) - 1} more)" if len(broken) > 1 else ""
        raise InputError(
            f"The pass is not written: {broken[0].message}{more} --force writes it all the same."
        )
    if found.cures or found.check.verdict is Verdict.TRUST:
        return 0
    return Verdict.CANNOT_TELL.exit_code


def _numbers(text: str | None, option: str) -> list[float] | None:
    if text is None:
        return None
    try:
        first, second = (float(word) for word in text.split(","))
    except ValueError:
        raise InputError(f"{option} takes two numbers with a comma between them, not {text!r}.") from None
    return [first, second]

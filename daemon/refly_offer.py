"""The extra pass after a verdict that asks for one: found, written into the flight's folder, offered.

Nothing is armed, started or changed in its mode: the pass is uploaded on the operator's word, to a
vehicle that is disarmed or holds, as one transaction (:mod:`daemon.link.upload`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from calib.errors import FieldcalError, InputError
from calib.files import output_errors
from calib.flown_file import NETWORK_FILE, read_network
from daemon.pass_book import FLIGHT_FOLDER, remember
from daemon.progress import Report, late_line
from daemon.session.rows import ClockName, Event, Plan, Stamp
from daemon.session.store import Session
from mission import encode
from mission.encode import Flavour
from mission.limits import hard_violations
from mission.refly import Refly, refly
from mission.refly_sheet import write_refly_sheet
from mission.refly_site import FlownSite, flown_site
from mission.refly_words import why_no_pass
from mission.site_file import checked, overlaid, read_site_file

if TYPE_CHECKING:
    from daemon.flight_link import FlightLink

MISSION, SHEET = "pass.plan", "pass.html"
#: The same pass for other programs and aircraft.
_ALSO = ("pass.waypoints", "pass.kmz", "pass.csv")
UPLOADED = "refly.uploaded"
#: For so long a vehicle that flies is waited for, to hold or to land.
PATIENCE_S = 900.0


@dataclass(frozen=True)
class Pass:
    """``photos``: 0 where there is nothing to fly, or nothing that may be flown; ``text``: why, or what.
    ``mission``: the file for the vehicle."""

    text: str
    photos: int = 0
    mission: Path | None = None


Search = Callable[[FlownSite], Refly]


def find_pass(
    session: Session,
    site: Path | None,
    launch: tuple[float, float] | None,
    flavour: Flavour,
    search: Search = refly,
) -> Pass:
    """The pass that cures the block of the newest check, its files in the flight's folder.

    What stands against it is said in its text: the verdict is there all the same.

    Args:
        site: a site file with limits. launch: where the vehicle starts, degrees; before the site's own.
        search: :func:`mission.refly.refly`, perhaps in another process.
    """
    try:
        return _find_pass(session, site, launch, flavour, search)
    except FieldcalError as error:
        return Pass(f"No extra pass was planned: {error}")


def _find_pass(
    session: Session, site: Path | None, launch: tuple[float, float] | None, flavour: Flavour, search: Search
) -> Pass:
    if not (session.folder / NETWORK_FILE).is_file():
        return Pass("The check left no network to plan an extra pass from.")
    known = read_network(session.folder / NETWORK_FILE)
    if known.origin_wgs84 is None:
        why = why_no_pass(known, strong=False)
        return Pass(why or "The photos have no positions: fly the circle of the report by hand.")
    options = checked({} if launch is None else {"launch": list(launch)}, "the vehicle's home position")
    keys = options if site is None else overlaid(read_site_file(site), options)
    found = search(flown_site(known, keys, keys.name or FLIGHT_FOLDER))
    if found.plan is None or found.found is None:
        return Pass(found.reason)
    folder = session.folder / FLIGHT_FOLDER
    with output_errors(folder):
        folder.mkdir(exist_ok=True)
    write_refly_sheet(found, folder / SHEET)
    broken = hard_violations(found.findings)
    if broken:
        return Pass(f"{found.reason} It may not be flown: {broken[0].message}")
    _write(found, folder, flavour)
    mission = folder / MISSION
    session.add_plan(Plan(f"{FLIGHT_FOLDER}/{MISSION}", mission.read_bytes()))
    fault = remember(found, folder)
    text = f"{found.reason} It is in {folder}." + ("" if fault is None else f" {fault}")
    return Pass(text, len(found.found.stations), mission)


def _write(found: Refly, folder: Path, flavour: Flavour) -> None:
    assert found.plan is not None  # only such a pass is written
    fence = None if found.flown.site.fence.is_empty else found.flown.site.fence
    for name in (MISSION, *_ALSO):
        try:
            encode.write(found.plan, folder / name, fence=fence, flavour=flavour)
        except InputError:
            if name == MISSION:
                raise
            # This format cannot say it; what an earlier pass left must not stay.
            (folder / name).unlink(missing_ok=True)


def offer(
    told: FlightLink,
    session: Session,
    found: Pass,
    word: Callable[[], bool],
    keep_in: Path,
    say: Callable[[str], None],
    busy: Callable[[str], AbstractContextManager[Report]],
    patience_s: float = PATIENCE_S,
    meanwhile: Callable[[], None] | None = None,
) -> bool:
    """Upload the pass if the operator says so; whether the vehicle holds it.

    Args:
        word: the operator's explicit word, asked when the vehicle may be written to.
        busy: opens a progress line.
        meanwhile: called now and then while something is waited for (None: the link is listened to).

    Raises:
        FieldcalError: the vehicle's old mission cannot be kept, or the record not be written.
    """
    from daemon.link.live import Link
    from daemon.link.upload import NotAllowedError, Outcome, Terms, flavour_of, upload, why_not
    from daemon.mission_file import load
    from mission.feasibility import check_file

    link = told.source
    if not isinstance(link, Link) or found.mission is None:
        return False
    look = told.poll if meanwhile is None else meanwhile
    reason, end = None, time.monotonic() + patience_s
    while (why := why_not(link.state, link.now_s(), holding=True)) is not None:
        if why != reason:
            say(f"The extra pass waits: {why}")
            reason = why
        if time.monotonic() > end:
            say("The extra pass was not uploaded: the vehicle was waited for long enough.")
            return False
        look()
        time.sleep(0.2)
    try:
        mission = load(found.mission, flavour_of(link.state))
        findings = [f for f in check_file(mission.plan, flavour_of(link.state), told.place) if not f.ok]
        broken = [f for f in findings if f.hard]
        if broken:
            say(f"The extra pass was not uploaded: {broken[0].message}")
            return False
        for finding in findings:
            say(f"Note: {finding.message}")
        with late_line(busy) as line:

            def progress(stage: str, done: int, total: int) -> None:
                line(stage, done, total)
                look()

            result = upload(link, mission.mission, word, keep_in, Terms(holding=True), progress)
    except NotAllowedError as error:
        say(f"The extra pass was not uploaded: {error}")
        return False
    kept = "" if result.kept is None else f" The old mission is kept in {result.kept}."
    say(f"{result.message}{kept}")
    if result.outcome is not Outcome.UPLOADED:
        return False
    session.add_event(
        Event(
            UPLOADED, Stamp(link.now_s(), ClockName.UTC), {"file": found.mission.name, "photos": found.photos}
        )
    )
    return True

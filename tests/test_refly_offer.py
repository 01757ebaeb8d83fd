"""The extra pass of a flight: found, written, offered to a simulated vehicle over real sockets."""

from __future__ import annotations

import pickle
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

pytest.importorskip("pymavlink", reason="pip install fieldcal[flight]")

from benchmarks.refly_optimality import flown
from calib.errors import AlignmentError, InputError
from calib.findings import Verdict
from calib.flown_file import NETWORK_FILE, FlownCheck, network_bytes
from calib.frames import LocalFrame
from daemon.aside import in_process, in_thread
from daemon.flight import Flight, Options
from daemon.flight_link import FlightLink, open_source
from daemon.link.vehicle_mission import mission_differences
from daemon.live import schemas
from daemon.live.schemas import Message
from daemon.mission_file import load
from daemon.pass_book import FLIGHT_FOLDER
from daemon.refly_offer import MISSION, SHEET, UPLOADED, Pass, find_pass, offer
from daemon.run_screen import Screen
from daemon.session.library import finish, reopen, unfinished
from daemon.session.store import Session
from mission import encode
from mission.encode import Flavour
from mission.refly import Refly, refly
from mission.refly_site import FlownSite
from sim.faults import LineFaults, Proxy
from sim.vehicle import VehicleOptions, VehicleServer
from sim.vehicle.pilot import Mode
from tests.aside_work import refuse, wait_for_file
from tests.link_flights import until
from tests.test_flight import Scripted


@pytest.fixture(scope="module")
def check() -> FlownCheck:
    return flown(2, 60.0, 110.0, (4, 7), 5000).check


@pytest.fixture
def session(check: FlownCheck, tmp_path: Path) -> Iterator[Session]:
    with Session.create(tmp_path / "record") as made:
        (made.folder / NETWORK_FILE).write_bytes(network_bytes(check))
        yield made


def launch_of(check: FlownCheck) -> tuple[float, float]:
    assert check.origin_wgs84 is not None
    return check.origin_wgs84[0], check.origin_wgs84[1]


@dataclass
class Bench:
    told: FlightLink
    server: VehicleServer
    found: Pass
    session: Session
    said: list[str] = field(default_factory=list)
    asked: int = 0

    def offer(self, yes: bool = True, patience_s: float = 0.6) -> bool:
        def word() -> bool:
            self.asked += 1
            return yes

        busy = Screen(talkative=True, hidden=True).busy
        kept = self.session.folder / "kept"
        return offer(self.told, self.session, self.found, word, kept, self.said.append, busy, patience_s)

    def holds_it(self, flavour: Flavour) -> bool:
        assert self.found.mission is not None
        items = load(self.found.mission, flavour).mission.items
        return mission_differences(items, self.server.vehicle.transfer.mission, flavour) == []


def sent(site: FlownSite) -> Refly:
    """Searched as in a process of its own: there and back as bytes."""
    found: Refly = pickle.loads(pickle.dumps(refly(pickle.loads(pickle.dumps(site)))))
    return found


@contextmanager
def bench(flavour: Flavour, check: FlownCheck, session: Session, north_deg: float = 0.0) -> Iterator[Bench]:
    latitude, longitude = launch_of(check)
    home = LocalFrame(latitude + north_deg, longitude, 10.0)
    with (
        Proxy(LineFaults()) as proxy,
        VehicleServer(VehicleOptions(flavour, home), proxy.vehicle_address) as server,
        FlightLink(open_source(proxy.url), session) as told,
    ):

        def known() -> bool:
            told.poll()
            return told.place is not None and told.launch is not None

        until(known, 120)
        yield Bench(told, server, find_pass(session, None, told.launch, told.flavour, sent), session)


@pytest.mark.parametrize("flavour", encode.FLAVOURS)
def test_the_pass_is_uploaded_on_the_word(flavour: Flavour, check: FlownCheck, session: Session) -> None:
    with bench(flavour, check, session) as here:
        assert here.found.photos > 2
        assert not here.offer(yes=False)
        assert here.server.vehicle.transfer.mission == []
        assert here.offer()
        assert here.holds_it(flavour)
        assert here.asked == 2
        assert not here.server.vehicle.pilot.armed
        assert here.server.vehicle.pilot.mode is Mode.MANUAL
    assert "read back and compared" in here.said[-1]
    (uploaded,) = session.events(UPLOADED)
    assert uploaded.value.data == {"file": MISSION, "photos": here.found.photos}
    files = {path.name for path in (session.folder / FLIGHT_FOLDER).iterdir()}
    assert {MISSION, SHEET, "pass.waypoints", "pass.kmz"} <= files
    assert session.plans()[-1].value.content == (session.folder / FLIGHT_FOLDER / MISSION).read_bytes()


def test_a_vehicle_that_flies_is_waited_for(check: FlownCheck, session: Session) -> None:
    with bench("ardupilot", check, session) as here:
        pilot = here.server.vehicle.pilot
        assert pilot.arm(True)
        until(lambda: here.told.poll() is None and here.told.flying, 120)
        assert not here.offer()
        assert here.asked == 0
        assert "does not hold" in here.said[0]
        assert "waited for long enough" in here.said[-1]
        assert here.server.vehicle.transfer.mission == []
        pilot.set_mode(Mode.HOLD)
        assert here.offer(patience_s=10.0)
        assert here.holds_it("ardupilot")
        assert pilot.armed
        assert pilot.mode is Mode.HOLD


def test_what_does_not_fit_the_vehicle_is_said_or_refused(check: FlownCheck, session: Session) -> None:
    with bench("px4", check, session) as here:
        at = here.told.launch
        assert at is not None
        here.found = find_pass(session, None, (at[0] + 0.001, at[1]), "px4")
        assert not here.offer(yes=False)
        assert any("from the planned launch point" in text for text in here.said)
        here.found = find_pass(session, None, at, "ardupilot")
        assert not here.offer()
        assert "was not uploaded" in here.said[-1]
        assert here.asked == 1
        assert here.server.vehicle.transfer.mission == []


def test_a_reason_where_there_is_no_pass(check: FlownCheck, session: Session, tmp_path: Path) -> None:
    launch = launch_of(check)
    low = tmp_path / "low.toml"
    low.write_text("ceiling_m = 6.0\n")
    assert find_pass(session, low, launch, "px4").photos == 0
    assert "No extra pass was planned" in find_pass(session, None, (10.0, 10.0), "px4").text
    trusted = replace(check, verdict=Verdict.TRUST)
    (session.folder / NETWORK_FILE).write_bytes(network_bytes(trusted))
    nothing = find_pass(session, None, launch, "px4")
    assert (nothing.photos, nothing.mission) == (0, None)
    lost = replace(check, origin_wgs84=None)
    (session.folder / NETWORK_FILE).write_bytes(network_bytes(lost))
    assert find_pass(session, None, launch, "px4").photos == 0
    (session.folder / NETWORK_FILE).unlink()
    assert "no network" in find_pass(session, None, launch, "px4").text
    assert not (session.folder / FLIGHT_FOLDER / MISSION).exists()


def test_a_flight_that_is_reopened_can_be_gone_on_with(session: Session) -> None:
    finish(session)
    assert unfinished(session).ended
    reopen(session)
    assert not unfinished(session).ended
    finish(session)
    assert unfinished(session).ended


def test_the_flight_goes_on_being_told_while_a_pass_is_searched(tmp_path: Path) -> None:
    """The search ends only when a photo that the vehicle took meanwhile, and its climb, were told."""
    seen, told = tmp_path / "seen", list[Message]()
    with (
        Proxy(LineFaults()) as proxy,
        VehicleServer(VehicleOptions("px4"), proxy.vehicle_address) as server,
        Session.create(tmp_path / "record") as session,
        FlightLink(open_source(proxy.url), session) as line,
    ):
        (tmp_path / "card").mkdir()
        flight = Flight(session, Options("v", tmp_path / "card"), Scripted(), told.append, link=line)  # type: ignore[arg-type]
        until(lambda: flight.idle() is None and line.place is not None, 120)
        pilot = server.vehicle.pilot
        assert pilot.arm(True)
        assert pilot.take_off(30.0)
        pilot.shoot()
        began = len(told)

        def meanwhile() -> None:
            flight.idle()
            fresh = told[began:]
            heights = {m.height_m for m in fresh if isinstance(m, schemas.Link)}
            shot = any(isinstance(m, schemas.Capture) and m.triggers for m in fresh)
            if shot and len(heights) >= 4:
                seen.touch()

        assert in_process(wait_for_file, (seen,), meanwhile, 90.0)
        assert in_thread(lambda: wait_for_file(seen), meanwhile)


def test_what_goes_wrong_in_a_process_of_its_own_is_said_here() -> None:
    def nothing() -> None:
        """Nobody waits for anything."""

    with pytest.raises(InputError, match="no folder"):
        in_process(refuse, ("There is no folder.",), nothing, 60.0)
    with pytest.raises(AlignmentError, match="longer than 0"):
        in_process(time.sleep, (60.0,), nothing, 0.0)
    with pytest.raises(InputError, match="no folder"):
        in_thread(lambda: refuse("There is no folder."), nothing)

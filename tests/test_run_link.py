"""Link and photo flight together: a vehicle flies, photos come, triggers and pairs are recorded."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pymavlink", reason="pip install fieldcal[flight]")

from benchmarks.processes import wait_for
from calib.align.stream import Solve
from calib.errors import AlignmentError
from calib.photos.photo import Photo
from daemon.capture.trigger_book import places_of
from daemon.flight import Flight, Options
from daemon.flight_link import FlightLink, open_source
from daemon.live.schemas import Capture, Link, Log, Message, Status
from daemon.session.reader import SessionReader
from daemon.session.store import Session
from mission import encode
from mission.encode import Flavour
from sim.faults import LineFaults
from sim.faults.ends import free_port
from sim.photo_flight import Card, PhotoFlight, photo_flight
from tests.mission_plans import line, orbit, plan_of
from tests.test_flight import Scripted
from tests.test_run_cli import the_session, working
from tests.test_sim_camera import wait_until_ready

#: The flight's clock runs faster than the wall's, as the vehicle's does.
FAST = 10.0
SPEED_UP = 12.0
PLAN = plan_of(*line(60.0, 10.0, 25.0), *orbit(6, radius=20.0, height=25.0), speed_m_s=6.0)


class Run:
    """`fieldcal run --link` without alignment and terminal."""

    def __init__(self, session: Session, folder: Path, address: str, **options: object) -> None:
        self.told: list[Message] = []
        self.solver = Scripted()
        self.session = session

        def clock() -> float:
            return FAST * time.monotonic()

        self.link = FlightLink(open_source(address), session, clock)
        given = Options("v", folder, link=address, **options)  # type: ignore[arg-type]
        self.flight = Flight(session, given, self.solver, self.told.append, clock, self.link)  # type: ignore[arg-type]

    def until(self, true: Callable[[], bool], seconds: float = 180.0) -> None:
        end = time.monotonic() + seconds
        while not true():
            assert time.monotonic() < end, "it took too long"
            self.flight.step()

    def conclude(self) -> tuple[Photo, ...]:
        """The photos that the final alignment was given."""
        with pytest.raises(AlignmentError):
            self.flight.conclude()
        last = self.solver.requests[-1]
        assert isinstance(last, Solve)
        assert last.final
        return last.photos

    def last(self, kind: type[Message]) -> Message:
        return next(m for m in reversed(self.told) if isinstance(m, kind))

    def said(self) -> list[str]:
        return [m.text for m in self.told if isinstance(m, Log)]


def right_pairs(session: SessionReader, card: Card) -> int:
    """Sure pairs of the newest pairing, all of which belong together."""
    recorded = session.pairing()
    assert recorded is not None
    triggers = {row.seq: row.value for row in session.triggers()}
    photos = {row.seq: row.value for row in session.photos()}
    first = 1 if card.server.vehicle.options.flavour == "ardupilot" else 0
    sure = [pair for pair in recorded.value.pairs if pair.sure]
    for pair in sure:
        index = triggers[pair.trigger].image_index
        assert index is not None
        assert card.number(photos[pair.photo].path) == index - first
    return len(sure)


def heard(run: Run, flown: PhotoFlight) -> set[int]:
    """Numbers of the photos that were told of, each once: all, unless a busy machine lost messages."""
    told = [row.value.image_index for row in run.session.triggers()]
    truth = [photo.index for photo in flown.server.vehicle.photos]
    assert flown.server.vehicle.done
    assert len(told) == run.link.book.count >= 10
    if run.link.source.state.quality.lost == 0:
        assert told == truth
    assert len(truth) == 13
    assert set(told) <= set(truth)
    return {index for index in told if index is not None}


def positions_hold(photos: tuple[Photo, ...], flown: PhotoFlight) -> int:
    """Photos with a position, each within three of its sigmas; those told in a cut are known worse."""
    placed = [photo for photo in photos if photo.position is not None]
    for photo in placed:
        position = photo.position
        assert position is not None
        assert position.sigma_horizontal_m is not None
        assert position.sigma_vertical_m is not None
        horizontal, vertical = flown.place_error(flown.card.number(photo.path), position)
        assert horizontal < 3 * position.sigma_horizontal_m < 12
        assert vertical < 3 * position.sigma_vertical_m < 15
    return len(placed)


@pytest.mark.parametrize("flavour", encode.FLAVOURS)
def test_triggers_pairs_and_positions_are_those_of_the_flight(flavour: Flavour, tmp_path: Path) -> None:
    folder = tmp_path / "card"
    with (
        photo_flight(flavour, folder, PLAN) as flown,
        Session.create(tmp_path / "record") as session,
    ):
        run = Run(session, folder, flown.proxy.url)
        with run.link:
            run.until(lambda: run.link.source.state.parameters != {} or flavour == "px4")
            flown.take_off(SPEED_UP)
            run.until(lambda: run.flight.over)
            used = run.conclude()
        truth, told = flown.server.vehicle.photos, len(heard(run, flown))
        assert right_pairs(session, flown.card) == told
        assert positions_hold(used, flown) == told
        assert len(used) == len(truth)
        for photo in used:
            true = truth[flown.card.number(photo.path)]
            if photo.gimbal is None:
                assert told < len(truth)
                continue
            assert photo.gimbal.pitch_deg == pytest.approx(true.pitch_deg, abs=3.0)
        capture, link = run.last(Capture), run.last(Link)
        assert isinstance(capture, Capture)
        assert isinstance(link, Link)
        assert (capture.triggers, capture.photos, capture.sure) == (told, 13, told)
        assert (capture.warning is None) == (told == 13)
        assert (link.autopilot, link.armed) == (flavour, False)
        assert "The vehicle is in the air." in run.said()
        assert set(places_of(session)) == set(range(1, told + 1))


def test_a_link_that_is_cut_does_not_stop_the_flight(tmp_path: Path) -> None:
    """What was told during the cut is lost but for the last photo, and said; photos and pairs go on."""
    folder = tmp_path / "card"
    with (
        photo_flight("ardupilot", folder, PLAN) as flown,
        Session.create(tmp_path / "record") as session,
    ):
        run = Run(session, folder, flown.proxy.url)
        with run.link:
            run.until(lambda: run.link.source.state.parameters != {})
            flown.take_off(SPEED_UP)
            run.until(lambda: len(flown.server.vehicle.photos) >= 3)
            flown.proxy.open = False
            before = len(flown.server.vehicle.photos)
            run.until(lambda: len(flown.server.vehicle.photos) >= before + 2)
            flown.server.speed_up = 0.05  # until the link has noticed
            run.until(lambda: run.link.degraded != ())
            status = [m.degraded for m in run.told if isinstance(m, Status)][-1]
            assert "not heard" in status[0]
            assert not run.flight.over
            flown.proxy.open = True
            flown.server.speed_up = SPEED_UP
            run.until(lambda: run.link.degraded == ())
            assert any(text.startswith("The vehicle is heard again") for text in run.said())
            run.until(lambda: run.flight.over)
            used = run.conclude()
        told = {row.value.image_index for row in session.triggers()}
        truth = flown.server.vehicle.photos
        lost = {photo.index for photo in truth} - told
        assert 1 <= len(lost) <= 7
        assert set(run.link.book.lost) == lost
        assert len(used) == len(truth)
        assert right_pairs(session, flown.card) == len(told)
        assert positions_hold(used, flown) == len(told)
        capture = run.last(Capture)
        assert isinstance(capture, Capture)
        assert f"Triggers not heard: {len(lost)}" in (capture.warning or "")


@pytest.mark.parametrize("flavour", encode.FLAVOURS)
def test_a_change_of_batteries_is_one_flight_more_in_the_same_record(
    flavour: Flavour, tmp_path: Path
) -> None:
    """Boot clock and photo numbers begin anew, the files' numbers and the camera's clock go on."""
    folder = tmp_path / "card"
    with (
        photo_flight(flavour, folder, PLAN) as flown,
        Session.create(tmp_path / "record") as session,
    ):
        run = Run(session, folder, flown.proxy.url)
        state = run.link.source
        with run.link:
            run.until(lambda: state.state.counts != {})
            flown.take_off(SPEED_UP)
            run.until(lambda: flown.server.vehicle.done and run.link.landed)
            began_s, first_number = flown.server.vehicle.options.boot_utc_s, flown.card.first
            truth = [(began_s, photo) for photo in flown.change_battery(60.0)]
            run.until(lambda: state.state.boots == 2)
            counted = run.link.book.count
            run.until(lambda: state.state.connected(state.now_s()))
            flown.take_off(SPEED_UP)
            run.until(lambda: flown.server.vehicle.done and run.flight.over)
            used = run.conclude()
        assert state.state.boots == 2
        began_s = flown.server.vehicle.options.boot_utc_s
        truth += [(began_s, photo) for photo in flown.server.vehicle.photos]
        told = [photo.utc_s for photo in run.link.book.photos()]
        assert None not in told
        numbers = [
            next(
                k for k, (since_s, photo) in enumerate(truth) if abs(since_s + photo.boot_s - (at or 0)) < 0.5
            )
            for at in told
        ]
        assert numbers == sorted(set(numbers))
        assert sum(number < 13 for number in numbers) == counted
        assert len(truth) == 26
        lost = state.state.quality.lost
        assert len(numbers) == 26 or lost
        recorded = session.pairing()
        assert recorded is not None
        seqs = [row.seq for row in session.triggers()]
        files = {row.seq: row.value.path for row in session.photos()}
        sure = [pair for pair in recorded.value.pairs if pair.sure]
        assert len(sure) == len(numbers)
        for pair in sure:
            number = int(files[pair.photo].stem[3:]) - first_number
            assert number == numbers[seqs.index(pair.trigger)]
        home = flown.server.vehicle.options.home
        placed = [photo for photo in used if photo.position is not None]
        assert len(placed) == len(numbers)
        for photo in placed:
            position = photo.position
            assert position is not None
            assert position.sigma_horizontal_m is not None
            where = (position.latitude_deg, position.longitude_deg, position.altitude_m or 0.0)
            east, north, _ = home.enu(*(np.array([value]) for value in where))[0]
            true = truth[int(photo.path.stem[3:]) - first_number][1].at_m
            assert np.hypot(east - true[0], north - true[1]) < 3 * position.sigma_horizontal_m < 9


def test_files_that_never_came_are_missed(tmp_path: Path) -> None:
    folder = tmp_path / "card"
    with (
        photo_flight(
            "px4", folder, PLAN, card=lambda server: Card(folder, server, skip=frozenset({4, 8}))
        ) as flown,
        Session.create(tmp_path / "record") as session,
    ):
        run = Run(session, folder, flown.proxy.url, idle_s=60.0)
        with run.link:
            run.until(lambda: run.link.source.state.parameters != {} or run.link.source.state.counts != {})
            flown.take_off(SPEED_UP)
            run.until(lambda: run.flight.over)
            used = run.conclude()
        told = heard(run, flown)
        missing = sum(index in told for index in (4, 8))
        assert len(used) == 11
        assert right_pairs(session, flown.card) == len(told) - missing
        capture = run.last(Capture)
        assert isinstance(capture, Capture)
        assert f"Triggers without photo: {missing} of {len(told)}" in (capture.warning or "")


@pytest.mark.parametrize("flavour", encode.FLAVOURS)
def test_a_recorded_flight_gives_what_the_flight_gave(flavour: Flavour, tmp_path: Path) -> None:
    """Photos read from the card after the flight, with the log that was recorded then."""
    folder = tmp_path / "card"
    with (
        photo_flight(flavour, folder, PLAN) as flown,
        Session.create(tmp_path / "record") as session,
        Session.create(tmp_path / "later") as later,
    ):
        run = Run(session, folder, flown.proxy.url)
        with run.link:
            run.until(lambda: run.link.source.state.parameters != {} or flavour == "px4")
            flown.take_off(SPEED_UP)
            run.until(lambda: flown.server.vehicle.done and run.link.landed)
        again = Run(later, folder, str(tmp_path / "record" / "link.tlog"))
        with again.link:
            again.until(lambda: again.flight.over)
            used = again.conclude()
        told = len(heard(run, flown))
        assert positions_hold(used, flown) == told
        assert [row.value for row in later.triggers()] == [row.value for row in session.triggers()]
        assert right_pairs(later, flown.card) == told
        assert any(f"read to its end: {told} triggers" in text for text in again.said())


def sure_pairs(home: Path) -> int:
    with SessionReader.open(the_session(home)) as session:
        found = session.pairing()
        return 0 if found is None else sum(pair.sure for pair in found.value.pairs)


def test_kill_9_loses_no_trigger_that_was_recorded_and_doubles_none(tmp_path: Path) -> None:
    folder = tmp_path / "card"

    def record() -> SessionReader:
        return SessionReader.open(the_session(tmp_path))

    def triggers() -> int:
        try:
            with record() as session:
                return session.counts().triggers
        except (ValueError, OSError):
            return 0

    with photo_flight("ardupilot", folder, PLAN) as flown:
        run = ("run", "--photos", folder, "--link", flown.proxy.url, "--no-live", "--quiet", "--idle", "0")
        with working(tmp_path, *run) as process:
            wait_for(lambda: flown.server.vehicle.telemetry.rates_hz.get("ATTITUDE"), 180)
            flown.take_off(SPEED_UP)
            wait_for(lambda: triggers() >= 4, 180)
            os.kill(process.pid, signal.SIGKILL)
            process.wait(20)
            flown.server.speed_up = 0.02
        with record() as session:
            acknowledged = [row.value for row in session.triggers()]
        with working(tmp_path, "run", "--resume", "--no-live", "--quiet", "--idle", "0"):
            log = the_session(tmp_path) / "link.tlog"
            size = log.stat().st_size
            wait_for(lambda: log.stat().st_size > size + 3000, 180)
            flown.server.speed_up = SPEED_UP
            wait_for(lambda: flown.server.vehicle.done, 180)
            # On a starved machine the vehicle's clock stutters, and not every pair is sure.
            wait_for(lambda: sure_pairs(tmp_path) >= triggers() - 2, 180)
        truth = {photo.index for photo in flown.server.vehicle.photos}
        with record() as session:
            told = [row.value.image_index for row in session.triggers()]
            assert [row.value for row in session.triggers()][: len(acknowledged)] == acknowledged
            assert len(told) == len(set(told))
            assert set(told) <= truth
            assert len(truth - set(told)) <= 3  # taken between kill and resumption
            assert len(told) - 2 <= right_pairs(session, flown.card) <= len(told)
            assert set(places_of(session)) == set(range(1, len(told) + 1))


def test_photos_are_fetched_from_the_camera_through_kill_9(tmp_path: Path) -> None:
    """Vehicle, camera and `fieldcal run --photos mavlink`, each of its own, over sockets with a bad line."""
    beside = free_port()
    offers = ("--offer", "mftp", "--size", "200x150", "--site-m", "100", "--clock-offset", "3600", "--no-gps")
    words = ("sim", "camera", "--link", f"udp://127.0.0.1:{beside}", "--out", tmp_path / "camera", *offers)
    run = ("run", "--photos", "mavlink", "--no-live", "--quiet", "--idle", "0")

    def names(folder: Path) -> list[str]:
        return sorted(path.name for path in folder.glob("*.JPG"))

    def fetched(least: int) -> bool:
        return len([*tmp_path.glob("sessions/[!.]*/photos/*.JPG")]) >= least

    def logged() -> int:
        return sum(path.stat().st_size for path in tmp_path.glob("sessions/[!.]*/link.tlog"))

    bad = LineFaults(drop_share=0.01, repeat_share=0.05)
    with (
        working(tmp_path, *words) as camera,
        photo_flight("px4", tmp_path / "card", PLAN, line_faults=bad, beside=("127.0.0.1", beside)) as flown,
    ):
        server = flown.server
        wait_until_ready(camera)
        with working(tmp_path, *run, "--link", flown.proxy.url) as process:
            wait_for(lambda: logged() > 3000, 180)
            flown.take_off(SPEED_UP)
            wait_for(lambda: fetched(4), 180)
            os.kill(process.pid, signal.SIGKILL)
            process.wait(20)
            server.speed_up = 0.02
        with working(tmp_path, "run", "--resume", "--no-live", "--quiet", "--idle", "0"):
            size = logged()
            wait_for(lambda: logged() > size + 3000, 180)
            server.speed_up = SPEED_UP
            wait_for(lambda: server.vehicle.done, 180)
            there, here = tmp_path / "camera", the_session(tmp_path) / "photos"
            # What was taken while nobody listened, or was lost on the line, nobody told of.
            wait_for(lambda: len(names(here)) >= len(names(there)) - 4 and fetched(9), 180)
            wait_for(lambda: sure_pairs(tmp_path) >= len(names(here)) - 1, 180)
    assert not [*here.glob("tmp*")]
    for name in names(here):
        number, _, own = name.partition("-")
        assert (here / name).read_bytes() == (there / own).read_bytes()
        assert int(number) > 0
    # The log holds what was said, not the photos.
    assert logged() < 3e6
    with SessionReader.open(the_session(tmp_path)) as session:
        recorded = session.pairing()
        assert recorded is not None
        keys = {row.seq: row.value.key for row in session.triggers()}
        files = {row.seq: row.value.path.name for row in session.photos()}
        for pair in recorded.value.pairs:
            assert keys[pair.trigger] == f"photo {int(files[pair.photo].partition('-')[0])}"
        assert sum(pair.sure for pair in recorded.value.pairs) >= 8

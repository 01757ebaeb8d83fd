"""What the link tells of photos: recorded, restored, placed, paired, written into tags; no sockets."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.align.stream import Solve
from calib.camera import FloatArray
from calib.errors import AlignmentError
from calib.frames import LocalFrame, rotation_cam_from_world
from calib.photos.photo import CameraIdentity, GimbalAngles, Photo, Position
from calib.photos.read import read_photo
from daemon import flight as flight_module
from daemon.capture.geotag import Geotag
from daemon.capture.matching import Arrived, Matching, completed, parted
from daemon.capture.recent import Recent
from daemon.capture.records import Pairing
from daemon.capture.tagging import Kind, tag_photos
from daemon.capture.trigger_book import TriggerBook
from daemon.link import events as ev
from daemon.link.airborne import Airborne
from daemon.link.attitude import angles_of, between, earth_angles, quaternion_of
from daemon.link.clock import TimeBase
from daemon.session.rows import PhotoFile
from daemon.session.store import Session
from sim.photo_flight import bare_photo
from tests.test_capture_geotag import exiftool, photo_file
from tests.test_flight import Scene

UTC_S = 1_780_000_000.0
HOME = LocalFrame(47.0, 8.5, 430.0)
#: UTC is known from the first second on.
BASE = TimeBase().with_system_time(1.0, UTC_S + 1.0)
FEEDBACK, TRIGGER, CAPTURED, _ = ev.PhotoSource


def circle(boot_s: float) -> tuple[FloatArray, float]:
    """Where a vehicle flies: 20 m around home at 8 m/s; east, north, up, and its heading in degrees."""
    turn = 0.4 * boot_s
    return np.array([20 * math.sin(turn), 20 * math.cos(turn), 40.0]), math.degrees(turn) + 90


def position(boot_s: float) -> ev.Position:
    at, yaw = circle(boot_s)
    latitude, longitude, altitude = HOME.geodetic(at[None])[0]
    return ev.Position(boot_s, float(latitude), float(longitude), float(altitude), 40.0, (0, 0, 0), yaw % 360)


def attitude(boot_s: float) -> ev.Attitude:
    return ev.Attitude(boot_s, ev.Angles(12.0, -3.0, circle(boot_s)[1] % 360))


def body_gimbal(boot_s: float) -> ev.GimbalAttitude:
    """A mount that looks straight down and tells it from the leaning body, 0.1 degrees beside it."""
    roll, pitch = 12.0, -3.0
    down = ev.Angles(0.0, -90.0, circle(boot_s)[1] % 360)
    w, x, y, z = quaternion_of(ev.Angles(roll, pitch, down.yaw_deg))
    inverse = np.array([w, -x, -y, -z])
    a, b, c, d = inverse
    e, f, g, h = quaternion_of(down)
    body = (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )
    found = ev.GimbalAttitude(boot_s, _angles(body), ev.AngleFrame.BODY)
    back = earth_angles(found, ev.Angles(roll, pitch, down.yaw_deg))
    assert back is not None
    assert back.pitch_deg < -89.9
    return found


def _angles(q: tuple[float, ...]) -> ev.Angles:
    found = angles_of(q)
    assert found is not None
    return found


def surroundings(until_s: float, step_s: float = 0.2, gimbal: bool = True) -> Recent:
    recent = Recent()
    recent.add(ev.GnssFix(3, 14, 1.2, 2.0))
    for boot_s in np.arange(1.0, until_s, step_s).tolist():
        recent.add(attitude(boot_s))
        recent.add(attitude(boot_s + step_s / 2))
        if gimbal:
            recent.add(body_gimbal(boot_s + 0.03))
        recent.add(position(boot_s))
    return recent


@given(st.floats(4.0, 11.0), st.sampled_from([0.02, 0.1]))
@settings(max_examples=25, deadline=None)
def test_an_exposure_is_placed_and_looks_where_it_did(boot_s: float, sigma_s: float) -> None:
    recent = surroundings(12.0)
    assert recent.covers(boot_s)
    tag = recent.at(boot_s, sigma_s)
    assert tag is not None
    place = tag.position
    at = HOME.enu(*(np.array([v]) for v in (place.latitude_deg, place.longitude_deg, place.altitude_m or 0)))
    assert np.linalg.norm(at[0] - circle(boot_s)[0]) < 0.1
    assert place.height_above_launch_m == pytest.approx(40.0, abs=0.05)
    expected = math.hypot(1.2, 8 * sigma_s)
    assert place.sigma_horizontal_m == pytest.approx(expected, rel=0.05)
    assert tag.gimbal is not None
    assert tag.aircraft is not None
    # Straight down the heading of the image is what counts; angles may say it in several ways.
    wanted = rotation_cam_from_world(GimbalAngles(circle(boot_s)[1], -90.0, 0.0))
    turn = rotation_cam_from_world(tag.gimbal) @ wanted.T
    assert math.degrees(math.acos(min(1.0, (np.trace(turn) - 1) / 2))) < 2.5
    assert tag.aircraft.roll_deg == pytest.approx(12.0, abs=0.1)


def test_rtk_is_believed_and_a_plain_receiver_only_to_a_metre() -> None:
    for fix, claim_m, expected_m in ((3, 0.3, 1.0), (6, 0.02, 0.02), (3, None, 1.5)):
        recent = Recent()
        recent.add(ev.GnssFix(fix, 20, claim_m, claim_m))
        for step in range(10):
            recent.add(replace(position(3.0), vehicle_boot_s=3.0 + 0.2 * step))
        tag = recent.at(4.0, 0.0)
        assert tag is not None
        assert tag.position.sigma_horizontal_m == pytest.approx(expected_m, abs=0.035)


def test_a_hole_in_the_track_gives_nothing_and_other_frames_no_angles() -> None:
    recent = surroundings(6.0, gimbal=False)
    recent.add(ev.GimbalAttitude(5.0, ev.Angles(0, -90, 0), ev.AngleFrame.UNSURE))
    for boot_s in (10.0, 10.2, 10.4):
        recent.add(position(boot_s))
    assert recent.at(8.0, 0.1) is None
    tag = recent.at(5.0, 0.1)
    assert tag is not None
    assert tag.gimbal is None
    recent.add(ev.VehicleRestarted(2))
    assert recent.at(5.0, 0.1) is None
    assert not recent.covers(5.0)


def test_between_two_attitudes_is_the_shortest_way() -> None:
    one, other = ev.Angles(0.0, -20.0, 350.0), ev.Angles(0.0, -20.0, 10.0)
    middle = between(one, other, 0.5)
    assert abs((middle.yaw_deg + 180) % 360 - 180) < 0.01
    # The same attitude in two ways of saying it.
    over = between(ev.Angles(180.0, -89.0, 190.0), ev.Angles(0.0, -89.0, 10.0), 0.5)
    assert over.pitch_deg < -88.9


def test_in_the_air_is_armed_and_off_the_ground() -> None:
    def beat(armed: bool) -> ev.Heartbeat:
        return ev.Heartbeat(ev.Autopilot.PX4, armed, "mission", True, False)

    state = Airborne()
    for event, up, landed in (
        (ev.LandedState(False), False, False),  # late, from a flight before
        (beat(True), False, False),
        (ev.LandedState(True), False, False),
        (ev.LandedState(False), True, False),
        (replace(position(1.0), height_m=0.2), True, False),
        (ev.LandedState(True), False, False),
        (beat(False), False, True),
    ):
        state = state.add(event)
        assert (state.in_air, state.landed) == (up, landed)
    silent = Airborne().add(beat(True)).add(position(1.0))
    assert silent.in_air
    assert silent.add(beat(False)).landed


def report(number: int, boot_s: float, source: ev.PhotoSource = FEEDBACK) -> ev.PhotoReport:
    told = source is not TRIGGER
    return ev.PhotoReport(
        *(source, 1, 0, number, boot_s if source is not FEEDBACK else None),
        UTC_S + boot_s if told else None,
        latitude_deg=47.0 if told else None,
        longitude_deg=8.5 if told else None,
        altitude_msl_m=470.0 if told else None,
        confirmed=True if source is CAPTURED else None,
    )


@pytest.mark.parametrize("seed", range(6))
def test_a_book_is_restored_as_it_was(seed: int, tmp_path: Path) -> None:
    """Reports that repeat, skip and come late, a restart in between; nothing heard again is new."""
    rng = random.Random(seed)
    heard: list[tuple[float, ev.PhotoReport | None]] = []
    for start, base_s in ((0, 10.0), (1, 500.0)):
        sources = (TRIGGER, CAPTURED) if seed % 2 else (FEEDBACK,)
        for number in range(20):
            for source in sources:
                for _ in range(rng.choice((0, 1, 1, 2))):
                    late_s = rng.choice((0.0, 0.1, 3.0))
                    moment_s = base_s + 2.0 * number
                    heard.append((moment_s + late_s, report(number, moment_s, source)))
        heard.sort(key=lambda one: one[0])
        if start == 0:
            heard.append((400.0, None))
    with Session.create(tmp_path / "record") as session:
        book = TriggerBook(session)
        for at_s, told in heard:
            if told is None:
                book.restarted(at_s)
            else:
                book.hear(told, at_s, BASE)
            book.place(surroundings(3.0), BASE, at_s)
        assert session.counts().triggers == book.count
        again = TriggerBook(session)
        assert again.photos() == book.photos()
        assert (again.places, again.seqs, again.lost) == (book.places, book.seqs, book.lost)
        before = session.counts()
        for at_s, told in heard[-10:]:
            if told is not None:
                assert not again.hear(told, at_s + 100.0, BASE)
        assert session.counts() == before


def photo(name: str, **facts: object) -> Photo:
    return Photo(Path("/card") / name, CameraIdentity("A", "B", None, 64, 48), **facts)  # type: ignore[arg-type]


TAG = Geotag(Position(47.0, 8.5, 470.0, 40.0, 1.5, 2.0), GimbalAngles(10.0, -90.0, 0.0))


def test_what_a_photo_says_itself_stays() -> None:
    own = Position(46.0, 8.0, 500.0, None, 0.02, 0.03)
    tags = {f"/card/{name}": TAG for name in "abc"}
    with_own, without, unknown = completed([photo("a", position=own), photo("b"), photo("d")], tags)
    assert (with_own.position, with_own.gimbal) == (own, TAG.gimbal)
    assert (without.position, without.gimbal) == (TAG.position, TAG.gimbal)
    assert unknown == photo("d")
    # Most have their own: the few without get angles, and no position of another receiver.
    rtk = [photo(name, position=own) for name in "abd"]
    assert completed([*rtk, photo("c")], tags)[-1] == photo("c", gimbal=TAG.gimbal)


def flown(session: Session, folder: Path, clock_s: float = 3600.4) -> tuple[TriggerBook, dict[Path, Arrived]]:
    """Twelve photos at changing intervals, their files on a card with a clock of its own."""
    book, card = TriggerBook(session), {}
    folder.mkdir(parents=True, exist_ok=True)
    moments = np.cumsum([1.9, 2.0, 2.4, 1.5, 3.1, 2.2, 1.7, 2.6, 1.9, 3.4, 2.1, 2.8])
    for number, boot_s in enumerate((moments + 1.0).tolist(), start=1):
        book.hear(report(number, boot_s), boot_s, BASE)
        book.place(surroundings(boot_s + 1.0), BASE, boot_s)
        moment = datetime.fromtimestamp(UTC_S + boot_s + clock_s, UTC)
        path = bare_photo(folder / f"DSC{number:05d}.JPG", moment, number, whole_seconds=False)
        row = session.add_photo(PhotoFile(path, f"{number:064x}", path.stat().st_size))
        card[path] = Arrived(read_photo(path), row.seq)
    return book, card


def test_pairs_are_recorded_and_gone_on_with(tmp_path: Path) -> None:
    now = 0.0

    def clock() -> float:
        return now

    with Session.create(tmp_path / "record") as session:
        book, card = flown(session, tmp_path / "card")
        first, rest = dict(list(card.items())[:9]), card
        matching = Matching(session, book, clock=clock)
        assert not matching.look({})
        now += 10.0
        assert matching.look(first)
        assert len(matching.pairing.sure_pairs) == 9
        assert not matching.look(first)
        again = Matching(session, TriggerBook(session), clock=clock)
        assert again.tags() == matching.tags()
        assert len(again.tags()) == 9
        now += 10.0
        assert again.look({path: rest[path] for path in list(rest)[9:]})
        recorded = session.pairing()
        assert recorded is not None
        assert {(p.photo, p.data["photo"]) for p in recorded.value.pairs} == {(n, n) for n in range(1, 13)}
        assert parted(again.pairing, book.count, 0) is None
        assert parted(again.pairing, book.count, 2) == "Triggers not heard: 2."
        assert parted(Pairing((), (), (), None), 3, 1) is None


@pytest.mark.parametrize("kind", Kind)
def test_tags_are_written_for_photos_without_position(kind: Kind, tmp_path: Path) -> None:
    with Session.create(tmp_path / "record") as session:
        book, card = flown(session, tmp_path / "card" / "100SONY")
        (tmp_path / "card" / "101SONY").mkdir()
        own = photo_file(tmp_path / "card" / "101SONY" / "DSC00001.JPG", dji_xmp=False)
        session.add_photo(PhotoFile(own, "f" * 64, own.stat().st_size))
        gone = next(iter(card))
        Matching(session, book).look(card, at_once=True)
        gone.unlink()
        before = {path: path.read_bytes() for path in card if path != gone}
        done = tag_photos(session, tmp_path / "out", kind)
        assert (done.written, done.own, done.away, done.unsure) == (11, 1, 1, 0)
        assert done.sentence(Path("out")) == (
            "Photos that got a position, in out: 11; with a position of their own, left alone: 1; "
            "that cannot be read any more: 1."
        )
        assert {path: path.read_bytes() for path in before} == before
        for number, path in enumerate(card, start=1):
            if path == gone:
                continue
            suffix = ".xmp" if kind is Kind.SIDECARS else ".JPG"
            target = (tmp_path / "out" / "100SONY" / path.name).with_suffix(suffix)
            values, place = exiftool(target), book.places[number].position
            assert float(str(values["XMP-exif:GPSLatitude"])) == pytest.approx(place.latitude_deg, abs=1e-7)
            assert float(str(values["XMP-drone-dji:GimbalPitchDegree"])) < -89.5
            if kind is Kind.COPIES:
                assert float(str(values["Composite:GPSLongitude"])) == pytest.approx(
                    place.longitude_deg, abs=1e-7
                )
                assert read_photo(target).position is not None


def test_a_card_read_at_home_gets_the_places_of_the_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No link any more; what was recorded is enough."""
    monkeypatch.setattr(flight_module.time, "sleep", lambda _: None)
    with Session.create(tmp_path / "record") as session:
        flown(session, tmp_path / "card")
        home = Scene(tmp_path / "card", session)
        home.run(6)
        with pytest.raises(AlignmentError):
            home.flight.conclude()
        last = home.solver.requests[-1]
        assert isinstance(last, Solve)
        assert len(last.photos) == 12
        assert all(photo.position is not None and photo.gimbal is not None for photo in last.photos)
        assert "12 of 12 files are surely among them." in " ".join(home.said())

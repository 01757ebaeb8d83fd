"""The link's pure parts: addresses, sequence numbers, streams, logs, the list of what may be said."""

from __future__ import annotations

import random
from itertools import pairwise
from pathlib import Path

import pytest

pytest.importorskip("pymavlink", reason="pip install fieldcal[flight]")

from hypothesis import given, settings
from hypothesis import strategies as st

from calib.errors import FormatError, InputError
from daemon.link import allowed, wire
from daemon.link import events as ev
from daemon.link.address import Address, Kind, parse
from daemon.link.decode import Context, decode
from daemon.link.events import Autopilot
from daemon.link.message import Message
from daemon.link.quality import Numbers, Quality
from daemon.link.replay import Replay
from daemon.link.state import LinkState
from daemon.link.streams import WANTED, Streams
from daemon.link.tlog import LogWriter, read_log
from daemon.link.transfer import Download, Exchange, Patience, Upload
from daemon.link.transfer import Kind as Part
from daemon.link.wire import Packer, Splitter, mavlink
from mission import encode
from mission.encode import Flavour
from sim.vehicle import Vehicle, VehicleOptions
from tests.link_flights import NEW


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("udp://:14550", Address(Kind.UDP_IN, "0.0.0.0", 14550)),
        ("udp://127.0.0.1:14551", Address(Kind.UDP_IN, "127.0.0.1", 14551)),
        ("udpin://", Address(Kind.UDP_IN, "0.0.0.0", 14550)),
        ("udpout://drone:14555", Address(Kind.UDP_OUT, "drone", 14555)),
        ("TCP://10.0.0.2", Address(Kind.TCP, "10.0.0.2", 5760)),
        ("tcp://[::1]:5763", Address(Kind.TCP, "::1", 5763)),
        ("serial:///dev/ttyACM0:115200", Address(Kind.SERIAL, "/dev/ttyACM0", 115200)),
        ("serial:///dev/serial/by-id/usb-x:y", None),
        ("/dev/ttyUSB0", Address(Kind.SERIAL, "/dev/ttyUSB0", 57600)),
        ("COM7", Address(Kind.SERIAL, "COM7", 57600)),
        ("flight.tlog", Address(Kind.LOG, "flight.tlog")),
        ("udp://:0", None),
        ("udp://:70000", None),
        ("tcp://:5760", None),
        ("http://x", None),
        ("14550", None),
        ("", None),
    ],
)
def test_addresses(text: str, address: Address | None) -> None:
    if address is None:
        with pytest.raises(InputError):
            parse(text)
    else:
        assert parse(text) == address
        assert parse(str(address)) == address


@given(st.integers(0, 2**32), st.floats(0, 0.4), st.floats(0, 0.4), st.integers(0, 5))
@settings(max_examples=60, deadline=None)
def test_loss_is_counted_whatever_the_order(seed: int, drop: float, repeat: float, shuffle: int) -> None:
    """Lost + come = sent, though messages come late or twice."""
    rng = random.Random(seed)
    come = [n for n in range(400) if n in (0, 399) or rng.random() >= drop]
    heard = [n for n in come for _ in range(2 if rng.random() < repeat else 1)]
    middle = heard[1:-1]
    order = sorted(range(len(middle)), key=lambda place: place + rng.uniform(0, shuffle))
    heard = [heard[0], *(middle[place] for place in order), heard[-1]]
    numbers = Numbers(heard[0] % 256)
    for n in heard[1:]:
        numbers = numbers.add(n % 256)
    assert numbers.received == len(come)
    assert numbers.lost == 400 - len(come)
    assert numbers.repeated == len(heard) - len(come)


def test_the_share_of_loss_is_of_late() -> None:
    quality = Quality()
    assert quality.loss_share is None
    for n in range(1000):
        at_s = n / 10
        if at_s < 50 and n % 2:  # half is lost in the first 50 s
            continue
        quality = quality.hear(1, n % 256, at_s)
        if at_s == 40:
            assert quality.loss_share == pytest.approx(0.5, abs=0.05)
    assert quality.loss_share == 0
    assert quality.lost == 250
    assert quality.age_s(5.0) is None
    assert quality.beat(3.0).age_s(5.0) == 2.0


def test_streams_are_asked_for_until_they_come_and_after_a_restart() -> None:
    streams, counts, asked, now = Streams(), dict[str, int](), list[tuple[float, str]](), 0.0
    deaf = {"ATTITUDE", "EKF_STATUS_REPORT"}  # the first question for one is lost, the other never answered
    running = set[str]()
    for step in range(6000):
        now = step / 50
        for name in running:
            counts[name] = int(now * WANTED[Autopilot.ARDUPILOT][name]) + 1
        streams, ask = streams.next(Autopilot.ARDUPILOT, counts, 1 if now < 60 else 2, now)
        if ask is not None:
            name = ask[0]
            asked.append((now, name))
            if name not in deaf:
                running.add(name)
            elif name == "ATTITUDE":
                deaf.discard(name)
    early = [name for at, name in asked if at < 60]
    assert set(early) == set(WANTED[Autopilot.ARDUPILOT])
    assert early.count("ATTITUDE") == 2
    assert 3 <= early.count("EKF_STATUS_REPORT") <= 6
    assert all(early.count(name) == 1 for name in set(early) - {"ATTITUDE", "EKF_STATUS_REPORT"})
    late = [name for at, name in asked if at >= 60]
    assert set(late) == set(WANTED[Autopilot.ARDUPILOT])
    assert streams.missing(counts) == ("EKF_STATUS_REPORT",)
    gaps = [b[0] - a[0] for a, b in pairwise(asked)]
    assert min(gaps) >= 0.05 - 1e-9


def test_only_harmless_messages_may_be_said() -> None:
    """Every message and every command that MAVLink has is held against the list."""
    harmless = {"MAV_CMD_SET_MESSAGE_INTERVAL", "MAV_CMD_REQUEST_MESSAGE"}
    for number, entry in mavlink.enums["MAV_CMD"].items():
        message = wire.command(1, number)
        if entry.name in harmless:
            assert allowed.check(message) is message
        else:
            with pytest.raises(allowed.ForbiddenError):
                allowed.check(message)
    for name in ("SET_MODE", "COMMAND_INT", "PARAM_SET", "MISSION_SET_CURRENT", "RC_CHANNELS_OVERRIDE"):
        kind = mavlink.mavlink_map[wire.number_of(name)]
        message = kind(*[0] * len(kind.fieldnames)) if name != "PARAM_SET" else kind(1, 1, b"X", 0.0, 9)
        with pytest.raises(allowed.ForbiddenError):
            allowed.check(message)
    for operation in range(256):
        message = wire.file_transfer(1, 100, bytes([0, 0, 0, operation]))
        if operation in (1, 2, 4, 5):  # close, close all, open for reading, read
            assert allowed.check(message) is message
        else:
            with pytest.raises(allowed.ForbiddenError):
                allowed.check(message)
    for current, fine in ((0, True), (1, True), (2, False), (3, False)):
        item = mavlink.MAVLink_mission_item_int_message(1, 1, 0, 3, 16, current, 1, 0, 0, 0, 0, 0, 0, 0, 0)
        if fine:
            allowed.check(item)
        else:
            with pytest.raises(allowed.ForbiddenError):
                allowed.check(item)


def test_pieces_garbage_and_unknown_messages() -> None:
    packer = Packer(1, 1)
    beat = mavlink.MAVLink_heartbeat_message(2, 3, 1, 0, 3, 3)
    data = b"".join(packer.pack(beat) for _ in range(3))
    unknown = bytearray(packer.pack(beat))
    unknown[7:10] = (60000).to_bytes(3, "little")
    whole = b"\x00garbage" + data + bytes(unknown)
    at_once = Splitter()
    frames = at_once.feed(whole)
    assert [f.sequence for f in frames] == [0, 1, 2, 3]
    assert [f.message is None for f in frames] == [False, False, False, True]
    assert at_once.garbage_bytes == 8
    in_pieces = Splitter()
    assert [f.raw for byte in whole for f in in_pieces.feed(bytes([byte]))] == [f.raw for f in frames]


def _log(path: Path, flavour: Flavour = "ardupilot", seconds: int = 30) -> int:
    """A log of a standing vehicle; the number of frames."""
    vehicle, packer = Vehicle(VehicleOptions(flavour)), Packer(1, 1)
    for name in ("ATTITUDE", "GLOBAL_POSITION_INT", "SYSTEM_TIME"):
        vehicle.telemetry.want(name, 5.0)
    count = 0
    with LogWriter(path) as log:
        for step in range(seconds * 10):
            for message in vehicle.step(0.1):
                log.write(1_780_000_000_000_000 + step * 100_000, packer.pack(message))
                count += 1
    return count


def test_a_log_is_read_by_pymavlink_and_by_us(tmp_path: Path) -> None:
    from pymavlink import mavutil

    path = tmp_path / "flight.tlog"
    count = _log(path)
    assert sum(1 for _ in read_log(path)) == count
    theirs = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    times = []
    while (message := theirs.recv_match()) is not None:
        times.append(message._timestamp)
    assert len(times) == count
    assert times[0] == pytest.approx(1_780_000_000.0)


def test_replays_are_equal_and_fast(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    _log(path, seconds=60)
    one, other = Replay(path), Replay(path)
    heard = list(one.events())
    assert heard == list(other.events())
    assert one.state == other.state
    assert one.state.system_id == 1
    assert one.now_s() == pytest.approx(1_780_000_059.9)
    assert [h.at_s for h in heard] == sorted(h.at_s for h in heard)


@given(st.integers(0, 2**32), st.integers(1, 40))
@settings(max_examples=25, deadline=None)
def test_a_damaged_log_gives_what_is_whole(
    tmp_path_factory: pytest.TempPathFactory, seed: int, cut: int
) -> None:
    path = tmp_path_factory.mktemp("log") / "flight.tlog"
    count = _log(path, seconds=5)
    data = bytearray(path.read_bytes())
    place = random.Random(seed).randrange(200, len(data) - 200)
    data[place : place + 5] = b"\xfd\xfe\x00\xff\xfd"
    path.write_bytes(data[:-cut])
    found = sum(1 for _ in read_log(path))
    assert count - 12 <= found <= count - 1


def test_no_log_at_all(tmp_path: Path) -> None:
    path = tmp_path / "x.tlog"
    path.write_bytes(b"JFIF" * 1000)
    with pytest.raises(FormatError, match="no MAVLink"):
        list(Replay(path).events())
    with pytest.raises(InputError, match="Cannot read"):
        list(Replay(tmp_path / "none.tlog").events())


def test_a_full_disk_is_said_and_stops_nothing() -> None:
    with LogWriter(Path("/dev/full")) as log:
        log.write(1_780_000_000_000_000, b"x")
        assert log.fault is not None
        assert "no space left" in log.fault
        assert log.left_out == 1


def test_px4_sends_whole_parameters_as_bits() -> None:
    fields = {"param_id": "TRIG_MODE", "param_value": 5.605193857299268e-45, "param_type": 6}
    message = Message("PARAM_VALUE", fields)
    assert decode(message, Context(Autopilot.PX4)) == ev.Parameter("TRIG_MODE", 4.0)
    plain = Message("PARAM_VALUE", {"param_id": "MNT1_TYPE", "param_value": 1.0, "param_type": 2})
    assert decode(plain, Context(Autopilot.ARDUPILOT)) == ev.Parameter("MNT1_TYPE", 1.0)


def test_a_restart_begins_the_clocks_anew() -> None:
    """Late messages are no restart, however late and however many: newer ones come among them."""
    packer, state, events = Packer(1, 1), LinkState(), list[ev.Event]()

    def hear(message: object, at_s: float) -> None:
        nonlocal state
        for frame in Splitter().feed(packer.pack(message)):
            state, found = state.hear(frame, at_s)
            events.extend(found)

    hear(mavlink.MAVLink_heartbeat_message(2, 3, 1, 0, 3, 3), 1000.0)

    def read(boot_s: float, at_s: float, started_s: float = 1_780_000_000.0) -> None:
        utc_us, boot_ms = round((started_s + boot_s) * 1e6), round(boot_s * 1e3)
        hear(mavlink.MAVLink_system_time_message(utc_us, boot_ms), at_s)

    shuffled = random.Random(1).sample(range(900, 1300), 400)
    for place, tenths in enumerate(shuffled):  # 40 s of messages, held up and let go at once
        read(tenths / 10, 1000.0 + (0.002 if place % 40 else 0.6) * place)  # and read with halts
    read(130.0, 1300.0)
    assert state.boots == 1
    assert state.time_base.boot_of_utc(1_780_000_131.0) == pytest.approx(131.0)
    for boot_s in (2.0 + 0.2 * n for n in range(12)):
        read(boot_s, 1310.0 + boot_s, 1_780_000_130.0)
    assert state.boots == 2
    assert [e for e in events if isinstance(e, ev.VehicleRestarted)] == [ev.VehicleRestarted(2)]
    assert state.time_base.boot_of_utc(1_780_000_134.0) == pytest.approx(4.0)


@pytest.mark.parametrize("dated", [True, False])
@pytest.mark.parametrize(("started_again", "boots"), [(True, 2), (False, 1)])
def test_a_restart_in_a_long_silence_is_one_though_the_clock_reads_more(
    dated: bool, started_again: bool, boots: int
) -> None:
    """Up for 20 s, not heard for 60, and then up for 40: its clock went on, but it was switched off."""
    packer, state = Packer(1, 1), LinkState()

    def hear(message: object, at_s: float) -> None:
        nonlocal state
        for frame in Splitter().feed(packer.pack(message)):
            state, _ = state.hear(frame, at_s)

    def told(boot_s: float, at_s: float, started_s: float) -> None:
        if dated:
            utc_us = round((1_780_000_000.0 + started_s + boot_s) * 1e6)
            hear(mavlink.MAVLink_system_time_message(utc_us, round(boot_s * 1e3)), at_s)
        hear(mavlink.MAVLink_attitude_message(round(boot_s * 1e3), 0, 0, 0, 0, 0, 0), at_s)

    hear(mavlink.MAVLink_heartbeat_message(2, 3, 1, 0, 3, 3), 1000.0)
    for n in range(20):
        told(float(n), 1000.0 + n, 0.0)
    # Undated it must be told from a vehicle that was heard all the time by its clock alone.
    first_s, started_s = (40.0, 39.0) if started_again else (40.0 if dated else 79.0, 0.0)
    for n in range(20):
        told(first_s + 0.2 * n, 1079.0 + 0.2 * n, started_s)
    assert state.boots == boots


@pytest.mark.parametrize("flavour", encode.FLAVOURS)
@pytest.mark.parametrize("seed", range(6))
def test_transfers_survive_a_bad_line(flavour: Flavour, seed: int) -> None:
    """A tenth lost and a fifth doubled, late by up to 0.3 s: up and down, in link time."""
    vehicle = Vehicle(VehicleOptions(flavour))
    items = encode.items(NEW, flavour)
    up = Upload(1, items, patience=Patience(0.8, 30.0))
    _carry_out(up, vehicle, random.Random(seed))
    down = Download(1, patience=Patience(0.8, 30.0))
    _carry_out(down, vehicle, random.Random(seed + 100))
    assert down.ok
    # An answer that is lost at the end leaves the result open; what the vehicle holds counts.
    assert up.result in (0, None)
    assert encode.compare(items, down.items, flavour) == []


def _carry_out(exchange: Exchange, vehicle: Vehicle, rng: random.Random) -> None:
    ours, theirs = Packer(), Packer(1, 1)
    to_vehicle, to_us = list[tuple[float, bytes]](), list[tuple[float, bytes]]()

    def post(box: list[tuple[float, bytes]], raw: bytes, now: float) -> None:
        for _ in range(2 if rng.random() < 0.2 else 1):
            if rng.random() > 0.1:
                box.append((now + rng.uniform(0, 0.3), raw))

    def take(box: list[tuple[float, bytes]], now: float) -> list[bytes]:
        due = sorted(one for one in box if one[0] <= now)
        box[:] = [one for one in box if one[0] > now]
        return [raw for _, raw in due]

    now, parser = 0.0, mavlink.MAVLink(None)
    for message in exchange.start(now):
        post(to_vehicle, ours.pack(message), now)
    while not exchange.over:
        now += 0.02
        assert now < 600
        answers = vehicle.step(0.02)
        for raw in take(to_vehicle, now):
            for message in parser.parse_buffer(raw):
                answers += vehicle.receive(message)
        for message in answers:
            post(to_us, theirs.pack(message), now)
        said = exchange.tick(now)
        for raw in take(to_us, now):
            for frame in Splitter().feed(raw):
                assert frame.message is not None
                said += exchange.receive(frame.message, now)
        for message in said:
            post(to_vehicle, ours.pack(allowed.check(message)), now)


def test_an_answer_to_another_station_is_none_to_us() -> None:
    up = Upload(1, encode.items(NEW, "px4"))
    up.start(0.0)
    request = {"target_system": 255, "target_component": 190, "seq": 0, "mission_type": 0}
    assert up.receive(Message("MISSION_REQUEST_INT", request), 0.1) == []
    ack = {"target_system": 255, "target_component": 190, "type": 5, "mission_type": 0}
    up.receive(Message("MISSION_ACK", ack), 0.1)
    fence = {"target_system": 245, "target_component": 191, "type": 5, "mission_type": Part.FENCE}
    up.receive(Message("MISSION_ACK", fence), 0.1)
    assert not up.over

"""The link over real sockets and a serial line: both flavours, cuts, forwarding, log and replay."""

from __future__ import annotations

import socket
from itertools import pairwise
from pathlib import Path

import pytest

pytest.importorskip("pymavlink", reason="pip install fieldcal[flight]")

from calib.errors import InputError
from daemon.link import events as ev
from daemon.link.address import parse
from daemon.link.forward import Forward
from daemon.link.live import Link, NoVehicleError
from daemon.link.replay import Replay
from daemon.link.streams import WANTED
from daemon.link.tlog import LogWriter, read_log
from daemon.link.transfer import AskMessage, Download, ReadParameters
from daemon.link.upload import mission_differences
from daemon.link.wire import Packer, Splitter, mavlink
from mission import encode
from mission.encode import Flavour
from sim.faults import LineFaults, Proxy
from sim.faults.ends import SerialEnd, TcpEnd, UdpEnd, free_port
from sim.vehicle import VehicleOptions, VehicleServer
from tests.link_flights import flight, until


@pytest.mark.parametrize("flavour", encode.FLAVOURS)
def test_everything_is_heard_recorded_and_replayed(flavour: Flavour, tmp_path: Path) -> None:
    """The replay of the log comes to the same events and the same state as the link did."""
    path = tmp_path / "flight.tlog"
    with LogWriter(path) as log, flight(flavour, tmp_path, log=log) as f:
        asked = {name for name in WANTED[f.link.state.autopilot] if name != "CAMERA_FEEDBACK"}
        sent = asked - {"ESTIMATOR_STATUS"}  # the simulated PX4 has none
        until(lambda: sent <= set(f.link.state.counts))
        f.link.run(AskMessage(1, "AUTOPILOT_VERSION"))
        wanted = ("MNT1_TYPE", "NONE_SUCH") if flavour == "ardupilot" else ("TRIG_MODE", "NONE_SUCH")
        f.link.run(ReadParameters(1, wanted))
        until(lambda: f.link.state.time_base.boot_of_local(f.link.now_s()) is not None)
        f.link.close()
        live = list(f.link.events())
        state = f.link.state
        boot_s, bound_s = state.time_base.boot_of_local(f.link.now_s()) or (0.0, 9.0)
        assert abs(boot_s - f.server.vehicle.boot_s) < 0.2
        assert bound_s < 0.1
    assert state.autopilot == flavour
    assert state.last(ev.Firmware) == ev.Firmware("4.6.3" if flavour == "ardupilot" else "1.16.0")
    assert state.parameters == ({"MNT1_TYPE": 1.0} if flavour == "ardupilot" else {"TRIG_MODE": 4.0})
    assert state.quality.lost == 0
    assert state.unknown == frozenset()
    replay = Replay(path)
    assert list(replay.events()) == live
    assert replay.state == state
    ours = [frame for _, frame in read_log(path) if frame.system_id == 245]
    assert {frame.component_id for frame in ours} == {191}
    beats = [at for at, frame in read_log(path) if frame.system_id == 245 and frame.raw[7] == 0]
    assert all(b - a < 1_600_000 for a, b in pairwise(beats))


@pytest.mark.parametrize("end", [UdpEnd, TcpEnd, SerialEnd])
def test_every_kind_of_line(end: type[UdpEnd] | type[TcpEnd] | type[SerialEnd], tmp_path: Path) -> None:
    with flight("ardupilot", tmp_path, end=end()) as f:
        down = Download(1)
        f.link.run(down)
        assert down.ok
        assert mission_differences(f.old, down.items, "ardupilot") == []
        assert f.link.health.open


def test_a_cut_connection_is_opened_again(tmp_path: Path) -> None:
    end = TcpEnd()
    with flight("px4", tmp_path, end=end) as f:
        for count in (1, 2):
            end.hang_up()
            until(lambda: f.link.health.reopened == count)  # noqa: B023 called at once
            heard = f.link.state.quality.heartbeat_s
            until(lambda: f.link.state.quality.heartbeat_s != heard)  # noqa: B023 called at once
        assert f.link.health.fault is None
        down = Download(1)
        f.link.run(down)
        assert down.ok


def test_nobody_there_is_said_and_tried_again() -> None:
    with socket.create_server(("127.0.0.1", 0)) as one:
        port = one.getsockname()[1]
    with Link(parse(f"tcp://127.0.0.1:{port}")) as link:
        with pytest.raises(NoVehicleError, match="connection refused"):
            link.wait_for_vehicle(0.3)
        with socket.create_server(("127.0.0.1", port)):
            until(lambda: link.health.open and link.health.fault is None)


def test_what_cannot_work_is_said_at_once(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(InputError, match="is taken by another program"):
            Link(parse(f"udp://127.0.0.1:{taken.getsockname()[1]}"))
    with pytest.raises(InputError, match=r"write udpout://192\.0\.2\.1:14550"):
        Link(parse("udp://192.0.2.1:14550"))
    with pytest.raises(InputError, match="recorded flight"):
        Link(parse(str(tmp_path / "x.tlog")))


def test_a_silent_vehicle_is_gone_and_comes_back(tmp_path: Path) -> None:
    with flight("ardupilot", tmp_path) as f:
        f.proxy.open = False
        until(lambda: not f.link.connected)
        assert (f.link.state.quality.age_s(f.link.now_s()) or 0) > 3
        f.proxy.open = True
        until(lambda: f.link.connected)


def test_loss_is_measured(tmp_path: Path) -> None:
    with flight("ardupilot", tmp_path, LineFaults(drop_share=0.2, repeat_share=0.2), seed=3) as f:
        until(lambda: f.link.state.quality.received > 250)
        quality = f.link.state.quality
        assert 0.1 < quality.lost / (quality.lost + quality.received) < 0.3
        assert 0.1 < (quality.loss_share or 0) < 0.3
        assert 0.05 < quality.repeated / quality.received < 0.35


def test_a_ground_station_behind_us(tmp_path: Path) -> None:
    """Byte for byte both ways: a station reads the mission through our link, and its heartbeat is noticed."""
    del tmp_path
    port = free_port()
    with (
        Proxy(LineFaults()) as proxy,
        VehicleServer(VehicleOptions("px4"), proxy.vehicle_address),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station,
    ):
        station.bind(("127.0.0.1", port))
        station.settimeout(5)
        with Link(parse(proxy.url), forward=Forward("127.0.0.1", port)) as link:
            link.wait_for_vehicle(30)
            packer, splitter = Packer(255, 190), Splitter()
            _, peer = station.recvfrom(65536)
            beat = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3)
            ask = mavlink.MAVLink_mission_request_list_message(1, 1, 0)
            answer = None
            for _ in range(500):
                station.sendto(packer.pack(beat) + packer.pack(ask), peer)
                frames = splitter.feed(station.recv(65536))
                messages = [f.message for f in frames if f.message is not None and f.system_id == 1]
                answer = next((m for m in messages if m.name == "MISSION_COUNT"), None)
                if answer is not None:
                    break
            assert answer is not None
            assert answer.integer("target_system") == 255
            until(lambda: 255 in link.state.stations)
            assert link.state.system_id == 1


def test_a_real_client_library_flies_through_our_link(tmp_path: Path) -> None:
    """MAVSDK as the ground station behind the link reads the vehicle's mission."""
    pytest.importorskip("mavsdk", reason="pip install fieldcal[flight]")
    import asyncio

    from tests.vehicle_client import client, from_mavsdk_items

    port = free_port()

    async def read() -> list[encode.Item]:
        async with client(f"udpin://127.0.0.1:{port}") as theirs:
            return from_mavsdk_items(await asyncio.wait_for(theirs.mission.download_mission(), 30))

    with flight("ardupilot", tmp_path) as first:
        first.link.close()
        with Link(parse(first.proxy.url), forward=Forward("127.0.0.1", port)) as link:
            link.wait_for_vehicle(30)
            items = asyncio.run(read())
    assert mission_differences(first.old, items, "ardupilot") == []


def test_the_link_is_never_late_under_load(tmp_path: Path) -> None:
    """200 messages a second and a log: no step of the thread takes as long as two frames of a film."""
    with LogWriter(tmp_path / "x.tlog") as log, flight("px4", tmp_path, log=log) as f:
        for name in ("ATTITUDE", "GLOBAL_POSITION_INT", "SYS_STATUS", "GPS_RAW_INT"):
            f.server.vehicle.telemetry.want(name, 50.0)
        before = f.link.state.quality.received
        until(lambda: f.link.state.quality.received > before + 600)
        assert f.link.state.quality.lost == 0
        assert f.link.health.worst_late_s < 1.0  # a crowded machine; benchmarks/link.py measures
        assert log.left_out == 0

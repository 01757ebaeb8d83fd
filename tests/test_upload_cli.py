"""`fieldcal upload`, `doctor` and `sim vehicle` as people run them."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("pymavlink", reason="pip install fieldcal[flight]")

from daemon.cli import run
from daemon.doctor import vehicle
from daemon.link.clock import TimeBase
from daemon.link.events import Autopilot, Heartbeat
from daemon.link.live import LinkHealth
from daemon.link.state import LinkState
from daemon.link.streams import Streams
from daemon.link.tlog import read_log
from daemon.link.vehicle_mission import mission_differences
from mission import encode
from mission.encode import Flavour
from sim.faults.ends import free_port
from sim.vehicle import VehicleOptions, VehicleServer
from tests.mission_plans import line, orbit, plan_of

PLAN = plan_of(*line(), *orbit(3))


@pytest.fixture(autouse=True)
def own_sessions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FIELDCAL_SESSIONS", str(tmp_path / "sessions"))


def _mission(folder: Path, flavour: Flavour, suffix: str = ".plan") -> Path:
    path = folder / f"site{suffix}"
    encode.write(PLAN, path, flavour=flavour)
    return path


@pytest.mark.parametrize(
    ("flavour", "suffix"), [("ardupilot", ".plan"), ("ardupilot", ".waypoints"), ("px4", ".plan")]
)
def test_upload(flavour: Flavour, suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port, log = free_port(), tmp_path / "link.tlog"
    path = _mission(tmp_path, flavour, suffix)
    with VehicleServer(VehicleOptions(flavour), ("127.0.0.1", port)) as server:
        where = ["--to", f"udp://127.0.0.1:{port}", "--wait", "30"]
        assert run(["upload", str(path), *where, "--yes", "--record", str(log)]) == 0
        held = server.vehicle.transfer.mission
        assert mission_differences(encode.items(PLAN, flavour), held, flavour) == []
        out = capsys.readouterr().out
        assert "read back and compared" in out
        assert "✓  photos" in out
        kept = next((tmp_path / "kept-missions").glob("*.json"))
        assert str(kept) in out
        # The old one (none at all) is brought back with what was kept.
        assert run(["upload", str(kept), *where, "--yes", "--force"]) == 0
        assert len(server.vehicle.transfer.mission) <= 1
    assert any(frame.raw[7] == 73 for _, frame in read_log(log))


def test_upload_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each in one sentence, exit code 2, and the vehicle is left alone."""
    port = free_port()
    right, wrong = _mission(tmp_path, "ardupilot"), tmp_path / "px4.plan"
    encode.write(PLAN, wrong, flavour="px4")
    (tmp_path / "junk.plan").write_text("{}")
    cases = [
        ([str(right)], "add --yes"),
        ([str(wrong), "--yes"], "plan it again with --autopilot ardupilot"),
        ([str(tmp_path / "junk.plan"), "--yes"], "not a QGroundControl plan"),
        ([str(tmp_path / "none.plan"), "--yes"], "There is no file"),
        ([str(tmp_path), "--yes"], "is no mission that a vehicle takes"),
        ([str(right), "--yes", "--to", "flight.tlog"], "recorded flight"),
        ([str(right), "--yes", "--to", "nonsense"], "is no address of a vehicle"),
        ([str(right), "--yes", "--forward", "x:y:z"], "has no host and port"),
        ([str(right), "--yes", "--record", "/nowhere/x.tlog"], "no such folder"),
    ]
    with VehicleServer(VehicleOptions("ardupilot"), ("127.0.0.1", port)) as server:
        for arguments, words in cases:
            to = [] if "--to" in arguments else ["--to", f"udp://127.0.0.1:{port}"]
            assert run(["upload", *arguments, *to, "--wait", "30"]) == 2
            error = capsys.readouterr().err
            assert words in error
            assert error.count("\n") == 1
        server.vehicle.pilot.arm(True)
        assert run(["upload", str(right), "--to", f"udp://127.0.0.1:{port}", "--wait", "30", "--yes"]) == 2
        assert "land and disarm it first" in capsys.readouterr().err
        assert server.vehicle.transfer.mission == []
    assert run(["upload", str(right), "--to", f"udp://127.0.0.1:{port}", "--wait", "1", "--yes"]) == 2
    assert "No vehicle was heard" in capsys.readouterr().err


@pytest.mark.parametrize(("answer", "code"), [("y", 0), ("", 2)])
def test_the_operator_is_asked(answer: str, code: int, tmp_path: Path) -> None:
    """At a terminal; no is the answer of who only presses return."""
    port, path = free_port(), _mission(tmp_path, "px4")
    with VehicleServer(VehicleOptions("px4"), ("127.0.0.1", port)) as server:
        here, there = pty.openpty()
        command = [sys.executable, "-m", "daemon.cli", "upload", str(path), "--to", f"udp://127.0.0.1:{port}"]
        with subprocess.Popen([*command, "--wait", "60"], stdin=there, stdout=there, stderr=there) as process:
            os.close(there)
            text = b""
            while b"[y/N]" not in text:
                text += os.read(here, 4096)
            os.write(here, f"{answer}\n".encode())
            while process.poll() is None:
                try:
                    text += os.read(here, 4096)
                except OSError:  # the other side is closed
                    break
            assert process.wait(60) == code, text.decode()
        os.close(here)
        assert len(server.vehicle.transfer.mission) == (len(encode.items(PLAN, "px4")) if code == 0 else 0)
    assert ("read back and compared" in text.decode()) is (code == 0)


@pytest.mark.parametrize("flavour", encode.FLAVOURS)
def test_doctor(flavour: Flavour, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port, report = free_port(), tmp_path / "doctor.json"
    options = VehicleOptions(flavour, boot_utc_s=time.time())
    with VehicleServer(options, ("127.0.0.1", port)):
        run(
            [
                "doctor",
                "--link",
                f"udp://127.0.0.1:{port}",
                "--wait",
                "30",
                "--seconds",
                "6",
                "--json",
                str(report),
            ]
        )
    found = {check["topic"]: check for check in json.loads(report.read_text())["checks"]}
    good = {topic for topic, check in found.items() if check["level"] == "good"}
    assert {"vehicle", "link", "time base", "satellites", "date", "camera", "gimbal", "rights"} <= good
    assert ("4.6.3" if flavour == "ardupilot" else "1.16.0") in found["vehicle"]["sentence"]
    assert capsys.readouterr().out == ""


def test_doctor_finds_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No camera set up, a gimbal that stops early, one obeyed station, and a clock of another year."""
    del tmp_path
    port = free_port()
    wrong = (("CAM1_TYPE", 0.0), ("MNT1_PITCH_MIN", -45.0), ("SYSID_ENFORCE", 1.0))
    with VehicleServer(VehicleOptions("ardupilot", parameters=wrong), ("127.0.0.1", port)):
        assert run(["doctor", "--link", f"udp://127.0.0.1:{port}", "--wait", "30", "--seconds", "6"]) == 2
    out = " ".join(capsys.readouterr().out.split())
    for words in (
        "No camera is set up",
        "stops at -45",
        "one ground station only",
        "satellite time: set it",
        "to put right",
    ):
        assert words in out
    assert run(["doctor", "--link", f"udp://127.0.0.1:{port}", "--wait", "1"]) == 2
    assert "No vehicle was heard" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, None),
        ({"MNT_RANGE_PITCH": 90.0}, "stops at -45 degrees"),  # as it comes; a PX4 flew so
        ({"MNT_RANGE_PITCH": 90.0, "MNT_MODE_OUT": 2.0}, None),  # of servos only
        ({"TRIG_MODE": 1.0}, "no photos by distance"),  # a PX4 took the first and last of each line so
        ({"TRIG_MODE": 3.0}, "all the time"),
    ],
)
def test_doctor_looks_at_px4s_camera_and_gimbal(settings: dict[str, float], words: str | None) -> None:
    beat = Heartbeat(Autopilot.PX4, False, "hold", False, True)
    usual = {"TRIG_MODE": 4.0, "MNT_MODE_IN": 4.0, "MNT_MODE_OUT": 0.0, "MNT_RANGE_PITCH": 180.0}
    state = LinkState(latest={Heartbeat: beat}, parameters={**usual, **settings})
    said = [c for c in vehicle(state, LinkHealth(), Streams(), 0.0) if c.topic in ("camera", "gimbal")]
    assert sum(c.level != "good" for c in said) == (words is not None)
    assert words is None or words in " ".join(c.sentence for c in said)


@pytest.mark.parametrize("found", [{"SYSID_ENFORCE": 1.0}, {"MAV_OPTIONS": 1.0}, {"MAV_OPTIONS": 2.0}])
def test_doctor_knows_the_one_station_of_either_version(found: dict[str, float]) -> None:
    """ArduPilot 4.7 has no SYSID_ENFORCE any more: it is a bit of MAV_OPTIONS (measured)."""
    beat = Heartbeat(Autopilot.ARDUPILOT, False, "stabilize", False, False)
    state = LinkState(latest={Heartbeat: beat}, parameters=found)
    said = [check for check in vehicle(state, LinkHealth(), Streams(), 0.0) if check.topic == "rights"]
    assert len(said) == (found != {"MAV_OPTIONS": 2.0})
    assert all(next(iter(found)) in check.sentence for check in said)


def test_doctor_names_a_clock_that_runs_otherwise() -> None:
    """An autopilot's simulator at twice real time answers, and knows the date (measured)."""
    base = TimeBase()
    for second in range(12):
        base = base.with_timesync(100.0 + second, 2.0 * second, 100.001 + second)
        base = base.with_system_time(2.0 * second, 1.8e9 + 2.0 * second)
    said = {
        check.topic: check for check in vehicle(LinkState(time_base=base), LinkHealth(), Streams(), 112.0)
    }
    assert "does not run like this computer's" in said["time base"].sentence
    assert "knows the date" in said["date"].sentence
    silent = {check.topic: check for check in vehicle(LinkState(), LinkHealth(), Streams(), 112.0)}
    assert "does not answer" in silent["time base"].sentence
    assert "does not know the date yet" in silent["date"].sentence


def test_sim_vehicle(tmp_path: Path) -> None:
    """As a process of its own, ended by Ctrl-C; a bad option is one sentence."""
    del tmp_path
    port = free_port()
    command = [
        sys.executable,
        "-m",
        "daemon.cli",
        "sim",
        "vehicle",
        "--autopilot",
        "px4",
        "--to",
        f"127.0.0.1:{port}",
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert "simulated px4 vehicle" in process.stdout.readline()
            said = run(["doctor", "--link", f"udp://127.0.0.1:{port}", "--wait", "60", "--seconds", "3"])
            assert said in (0, 2)
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 130
        finally:
            process.kill()
    assert run(["sim", "vehicle", "--to", "x"]) == 2
    assert run(["sim", "vehicle", "--home", "91,8"]) == 2

"""`fieldcal sim camera` as a process beside simulated vehicles, and its parts for themselves."""

from __future__ import annotations

import asyncio
import math
import random
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pymavlink", reason="pip install fieldcal[flight]")
pytest.importorskip("mavsdk", reason="pip install fieldcal[flight]")

from calib.frames import LocalFrame, rotation_cam_from_world
from calib.photos.photo import GimbalAngles, Photo
from calib.photos.read import read_photo
from daemon.cli import run
from daemon.link import events as ev
from daemon.link.clock import TimeBase
from mission import encode
from mission.encode import Flavour
from sim.faults.ends import free_port
from sim.tether.shutter import Shutter
from sim.truth import SurveyTruth, read_truth
from sim.vehicle import PhotoTaken, VehicleOptions, VehicleServer
from tests.check_process import ended, started
from tests.mission_plans import LAUNCH, line, orbit, plan_of
from tests.vehicle_client import client

PLAN = plan_of(*line(60.0, 10.0, 40.0), *orbit(4, radius=25.0, height=30.0), speed_m_s=5.0)
SIZE = ("--size", "200x150")
#: MAVLink states places in 1e-7 degrees, 11 mm; heights in mm.
PLACE_M, TURN_DEG = 0.012, 0.03


def camera(port: int, out: Path, *words: str) -> list[str]:
    link = f"udp://127.0.0.1:{port}"
    given = ["--link", link, "--out", str(out), "--site-m", "100", *SIZE, *words]
    return [sys.executable, "-m", "daemon.cli", "sim", "camera", *given]


def wait_until_ready(process: subprocess.Popen[bytes]) -> None:
    """It says so on stdout, once it knows where home is and has made the ground."""
    assert process.stdout is not None
    for said in process.stdout:
        if b"ready" in said:
            return
    raise AssertionError("the camera ended before it was ready")


async def fly(
    server: VehicleServer,
    port: int,
    flavour: Flavour,
    *,
    speed_up: float = 20.0,
    until: Callable[[], bool] | None = None,
) -> None:
    """Upload, arm, start, and wait until it stands on the ground again (or ``until``)."""
    async with client(f"udpin://127.0.0.1:{port}") as one:
        await one.upload(encode.items(PLAN, flavour))
        assert await one.command(400, 1) == 0
        assert await one.command(300) == 0
        server.speed_up = speed_up
        await one.until(until or (lambda: server.vehicle.done), 60)


class Foreign(VehicleServer):
    """A simulator that tells no true poses, as those of the autopilots."""

    def _poses(self) -> list[Any]:
        return []


def utc_s(seen: Photo) -> float:
    assert seen.time is not None
    return seen.time.replace(tzinfo=UTC).timestamp()


def apart(truth: SurveyTruth, photos: list[PhotoTaken]) -> tuple[float, float]:
    """Largest differences of places (m) and directions (degrees) of the photos rendered and taken."""
    frame = LocalFrame(*truth.origin_wgs84)
    places = frame.enu(*LAUNCH.geodetic(np.array([photo.at_m for photo in photos])).T)
    far_m = float(np.linalg.norm(places - truth.centres_m, axis=1).max())
    turns = []
    for photo, rotation in zip(photos, truth.rotations_cam_from_world, strict=True):
        looked = rotation_cam_from_world(GimbalAngles(photo.yaw_deg, photo.pitch_deg, 0.0))
        cosine = (np.trace(looked @ rotation.T) - 1) / 2
        turns.append(math.degrees(math.acos(min(1.0, max(-1.0, float(cosine))))))
    return far_m, max(turns)


def nearest(truth: SurveyTruth, photos: list[PhotoTaken]) -> list[PhotoTaken]:
    """The vehicle's photo at the place of each rendered one: a busy machine may lose a datagram or two."""
    frame = LocalFrame(*truth.origin_wgs84)
    places = frame.enu(*LAUNCH.geodetic(np.array([photo.at_m for photo in photos])).T)
    return [photos[int(np.linalg.norm(places - centre, axis=1).argmin())] for centre in truth.centres_m]


@pytest.mark.parametrize("flavour", encode.FLAVOURS)
def test_the_photos_of_a_flight(tmp_path: Path, flavour: Flavour) -> None:
    out, ground, beside = tmp_path / "tether", free_port(), free_port()
    options = VehicleOptions(flavour, LAUNCH, camera_component=flavour == "ardupilot")
    with (
        started(tmp_path, camera(beside, out, "--once", "--no-gps")) as process,
        VehicleServer(options, ("127.0.0.1", ground), camera=("127.0.0.1", beside)) as server,
    ):
        wait_until_ready(process)
        asyncio.run(fly(server, ground, flavour))
        ran = ended(process)
    assert (ran.code, ran.err) == (0, "")
    taken, truth = server.vehicle.photos, read_truth(out)
    made = len(truth.photos)
    assert len(taken) >= 10
    assert len(taken) - 2 <= made <= len(taken)  # A busy machine may lose a datagram or two.
    whole = made == len(taken) and "interpolated" not in ran.out
    assert (f"{len(taken)} photos of {len(taken)} triggers" in ran.out) or not whole
    assert [*truth.photos] == sorted(path.name for path in out.glob("*"))[:made]
    shown = taken if whole else nearest(truth, taken)
    assert [photo.index for photo in shown] == sorted({photo.index for photo in shown})
    far_m, turned_deg = apart(truth, shown)
    assert far_m < (PLACE_M if whole else 2.0)
    assert turned_deg < (TURN_DEG if whole else 15.0)
    for name, photo in zip(truth.photos, shown, strict=True):
        seen = read_photo(out / name)
        assert seen.position is None
        assert utc_s(seen) == pytest.approx(options.boot_utc_s + photo.boot_s, abs=0.25 if whole else 2.0)
    # The vehicle stood on the ground, and the ground is where the photos show it.
    assert truth.heights is not None
    home = LocalFrame(*truth.origin_wgs84).enu(*(np.array([v]) for v in (47.0, 8.5, 430.0)))[0]
    assert np.abs(home[:2]).max() < 0.01
    assert abs(home[2]) < 2.5


def test_an_autopilot_s_simulator_and_a_camera_with_faults(tmp_path: Path) -> None:
    out, ground, beside = tmp_path / "tether", free_port(), free_port()
    faults = ["--clock-offset", "-3600", "--clock-drift", "5000", "--whole-seconds", "--miss-photos", "0.4"]
    words = ["--once", "--tags", "dji", "--gps-sigma-m", "0", *faults]
    with (
        started(tmp_path, camera(beside, out, *words)) as process,
        Foreign(
            VehicleOptions("ardupilot", LAUNCH), ("127.0.0.1", ground), camera=("127.0.0.1", beside)
        ) as server,
    ):
        wait_until_ready(process)
        asyncio.run(fly(server, ground, "ardupilot"))
        ran = ended(process)
    assert (ran.code, ran.err) == (0, "")
    truth = read_truth(out)
    start_s = server.vehicle.options.boot_utc_s
    photos = [read_photo(out / name) for name in truth.photos]
    missed = len(server.vehicle.photos) - len(photos)
    assert 0 < missed < len(server.vehicle.photos) - 2
    said = re.search(r"(\d+) missed on purpose", ran.out)
    assert said is not None
    assert missed - 2 <= int(said[1]) <= missed  # A busy machine may lose a datagram or two.
    assert f"{len(photos) + missed} poses are interpolated" not in ran.out
    assert f"{len(photos)} poses are interpolated" in ran.out
    # Which of the vehicle's photos they are is known by their times.
    first_s = utc_s(photos[0]) + 3600 - start_s
    taken = []
    for photo in photos:
        assert photo.time_resolution_s == 1.0
        since_s = utc_s(photo) + 3600 - start_s
        boot_s = first_s + (since_s - first_s) / 1.005
        taken.append(min(server.vehicle.photos, key=lambda p: abs(p.boot_s - boot_s - 0.5)))
        assert abs(taken[-1].boot_s - boot_s) < 1.5
        assert photo.gimbal is not None
        assert photo.position is not None
    assert len({photo.index for photo in taken}) == len(taken)
    far_m, turned_deg = apart(truth, taken)
    assert far_m < PLACE_M  # told in the photo's message
    assert turned_deg < 4.0  # between messages at 5 Hz; braking, it leans by 14 degrees within 0.2 s


def test_ctrl_c_ends_it_with_the_truth_of_what_was_taken(tmp_path: Path) -> None:
    out, ground, beside = tmp_path / "tether", free_port(), free_port()
    with (
        started(tmp_path, camera(beside, out)) as process,
        VehicleServer(
            VehicleOptions("px4", LAUNCH), ("127.0.0.1", ground), camera=("127.0.0.1", beside)
        ) as server,
    ):
        wait_until_ready(process)
        asyncio.run(fly(server, ground, "px4", until=lambda: len([*out.glob("*.JPG")]) >= 3))
        process.send_signal(signal.SIGINT)
        ran = ended(process)
    assert (ran.code, ran.err) == (0, "")
    truth = read_truth(out)
    assert [*truth.photos] == sorted(path.name for path in out.glob("*.JPG"))
    assert not [*out.glob(".*")]
    assert 3 <= len(truth.photos) <= len(server.vehicle.photos)
    taken = nearest(truth, server.vehicle.photos)
    assert [photo.index for photo in taken] == sorted({photo.index for photo in taken})
    far_m, turned_deg = apart(truth, taken)
    assert far_m < PLACE_M
    assert turned_deg < TURN_DEG


def test_nobody_flies(tmp_path: Path) -> None:
    out = tmp_path / "tether"
    with started(tmp_path, camera(free_port(), out)) as process:
        assert process.stdout is not None
        assert b"Waiting for a vehicle" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        ran = ended(process)
    assert (ran.code, ran.err) == (0, "")
    assert "0 photos of 0 triggers" in ran.out
    assert [*out.iterdir()] == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--size", "200x200"], "another shape"),
        (["--lens", "box"], "no camera named box"),
        (["--world", "moon"], "choose one of rolling"),
        (["--link", "flight.tlog"], "recorded flight"),
        (["--link", "udp://198.51.100.7"], "not this computer"),
        (["--clock-offset", "1e12"], "more than ten years"),
    ],
)
def test_refusals(tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str) -> None:
    out = tmp_path / "tether"
    assert run(["sim", "camera", "--out", str(out), *words]) == 2
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1
    assert not out.exists()


def test_a_folder_with_something_in_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "IMG_0001.JPG").touch()
    assert run(["sim", "camera", "--out", str(tmp_path)]) == 2
    assert "not empty" in capsys.readouterr().err


def photo(number: int, at_s: float, source: ev.PhotoSource = ev.PhotoSource.TRIGGER) -> ev.PhotoReport:
    return ev.PhotoReport(source, 1, 0, number, at_s, None)


def flown(shutter: Shutter, from_s: float, to_s: float, gimbal: ev.AngleFrame | None) -> None:
    """Eastwards at 5 m/s, nose up by 10 degrees, turning from north by 9 degrees a second."""
    for tick in range(round(from_s * 5), round(to_s * 5) + 1):
        at_s = tick / 5
        place = LAUNCH.geodetic(np.array([[5.0 * at_s, 0.0, 50.0]]))[0].tolist()
        shutter.hear(ev.Position(at_s, *place, 50.0, (5.0, 0.0, 0.0), None), at_s)
        shutter.hear(ev.Attitude(at_s, ev.Angles(0.0, 10.0, 9.0 * at_s)), at_s)
        if gimbal is not None:
            shutter.hear(ev.GimbalAttitude(at_s, ev.Angles(0.0, -50.0, 0.0), gimbal), at_s)


BASE = TimeBase().with_system_time(0.0, 1e9)


@pytest.mark.parametrize(
    ("gimbal", "yaw_deg", "pitch_deg"),
    [
        (ev.AngleFrame.EARTH, 0.0, -50.0),
        (ev.AngleFrame.LEVEL, 9.0 * 4.1, -50.0),
        (ev.AngleFrame.BODY, 9.0 * 4.1, -40.0),
        (ev.AngleFrame.UNSURE, 9.0 * 4.1, -40.0),
        (None, 9.0 * 4.1, -80.0),  # no gimbal: looks down from the vehicle
    ],
)
def test_the_pose_between_messages(gimbal: ev.AngleFrame | None, yaw_deg: float, pitch_deg: float) -> None:
    shutter = Shutter(random.Random(0))
    flown(shutter, 0.0, 4.0, gimbal)
    shutter.hear(photo(0, 4.1), 4.1)
    assert shutter.exposures(BASE, 4.15) == []  # what comes after the photo is not known yet
    flown(shutter, 4.2, 5.0, gimbal)
    (one,) = shutter.exposures(BASE, 5.0)
    assert one.utc_s == pytest.approx(1e9 + 4.1, abs=0.01)
    where = LAUNCH.enu(
        *(np.array([v]) for v in (one.pose.latitude_deg, one.pose.longitude_deg, one.pose.altitude_m))
    )
    assert where[0] == pytest.approx([20.5, 0.0, 50.0], abs=0.01)
    looked = rotation_cam_from_world(GimbalAngles(yaw_deg, pitch_deg, 0.0))
    assert one.pose.rotation_cam_from_world == pytest.approx(looked, abs=1e-6)
    assert not one.pose.told


def test_photos_are_counted_once_and_reasons_told() -> None:
    shutter = Shutter(random.Random(0))
    flown(shutter, 0.0, 10.0, ev.AngleFrame.EARTH)
    for number, at_s in enumerate(
        (2.0, 4.0, 6.0)
    ):  # PX4: two messages for each, and the second of them again
        shutter.hear(photo(number, at_s), at_s)
        for _ in range(2):
            shutter.hear(photo(number, at_s, ev.PhotoSource.CAPTURED), at_s)
    shutter.hear(replace(photo(3, 8.0, ev.PhotoSource.CAPTURED), confirmed=False), 8.0)
    assert [one.trigger.number for one in shutter.exposures(BASE, 10.0)] == [1, 2, 3]
    assert shutter.failed == 1
    shutter.hear(photo(4, 30.0), 10.1)  # long after everything that was told of the vehicle
    assert shutter.exposures(BASE, 11.0) == []
    assert shutter.blind == 0
    assert shutter.exposures(BASE, 14.0) == []
    assert shutter.blind == 1
    shutter.hear(photo(5, 31.0), 14.0)
    shutter.hear(ev.VehicleRestarted(2), 14.1)
    assert (shutter.blind, shutter.waiting) == (2, 0)

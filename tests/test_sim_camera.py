"""`fieldcal sim camera` as a process beside simulated vehicles, and its parts for themselves."""

from __future__ import annotations

import asyncio
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pymavlink", reason="pip install fieldcal[flight]")
pytest.importorskip("mavsdk", reason="pip install fieldcal[flight]")

from calib.frames import LocalFrame, rotation_cam_from_world
from calib.photos.photo import GimbalAngles
from mission import encode
from mission.encode import Flavour
from sim.truth import SurveyTruth, read_truth
from sim.vehicle import PhotoTaken, VehicleOptions, VehicleServer
from tests.check_process import ended, started
from tests.mission_plans import LAUNCH, line, orbit, plan_of
from tests.mission_server import free_port
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


async def fly(server: VehicleServer, port: int, flavour: Flavour, speed_up: float) -> None:
    """Upload, arm, start, and wait until it stands on the ground again."""
    async with client(f"udpin://127.0.0.1:{port}") as one:
        await one.upload(encode.items(PLAN, flavour))
        assert await one.command(400, 1) == 0
        assert await one.command(300) == 0
        server.speed_up = speed_up
        await one.until(lambda: server.vehicle.done, 60)


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


@pytest.mark.parametrize("flavour", encode.FLAVOURS)
def test_the_photos_of_a_flight(tmp_path: Path, flavour: Flavour) -> None:
    out, ground, beside = tmp_path / "tether", free_port(), free_port()
    options = VehicleOptions(flavour, LAUNCH, camera_component=flavour == "ardupilot")
    with (
        started(tmp_path, camera(beside, out, "--once", "--clock-offset", "100", "--no-gps")) as process,
        VehicleServer(options, ("127.0.0.1", ground), camera=("127.0.0.1", beside)) as server,
    ):
        wait_until_ready(process)
        asyncio.run(fly(server, ground, flavour, 20.0))
        ran = ended(process)
    assert ran.code == 0, ran.err
    taken = server.vehicle.photos
    assert f"{len(taken)} photos of {len(taken)} triggers" in ran.out
    assert "interpolated" not in ran.out
    truth = read_truth(out)
    assert [*truth.photos] == sorted(path.name for path in out.glob("*.JPG"))
    far_m, turned_deg = apart(truth, taken)
    assert far_m < PLACE_M
    assert turned_deg < TURN_DEG

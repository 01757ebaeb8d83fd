"""The whole loop beside an autopilot's own simulator: upload, photos, REFLY, the extra pass, TRUST.

``FIELDCAL_ARDUCOPTER`` names ArduPilot's simulator (``arducopter``), ``FIELDCAL_PX4`` PX4's (``px4``, in the
folder of a build for ``px4_sitl_default``); skipped without.
"""

from __future__ import annotations

import json
import os
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

pytest.importorskip("pymavlink", reason="pip install fieldcal[flight]")

from benchmarks.processes import wait_for
from calib.reference_file import write_reference_file
from daemon.mission_file import load
from daemon.session.reader import SessionReader
from mission.encode import compare
from sim.demo import CAMERA, FLY_IT, LENS, reference_of
from sim.truth import read_truth
from tests.real_vehicle import HOME, RealVehicle, arducopter, px4
from tests.test_run_cli import fieldcal, the_session, working
from tests.test_sim_camera import wait_until_ready

SIZE = (640, 480)
SPEED_UP = 4.0
#: A flight takes two minutes of the vehicle's time, and twice that on a machine that is busy.
FLIGHT_S = 600.0
#: DO_SET_ROI_SYSID: not taken in a mission.
REFUSED = 198
#: The good items of a refused mission stay on ArduPilot; PX4 takes all or none.
LEFT = {"ardupilot": "back", "px4": "still there"}
SIMULATORS = {"ardupilot": ("FIELDCAL_ARDUCOPTER", arducopter), "px4": ("FIELDCAL_PX4", px4)}


@pytest.fixture
def speed_up() -> float:
    return SPEED_UP


@pytest.fixture(params=["ardupilot", "px4"])
def vehicle(request: pytest.FixtureRequest, tmp_path: Path, speed_up: float) -> Iterator[RealVehicle]:
    variable, started = SIMULATORS[request.param]
    binary = os.environ.get(variable)
    if not binary:
        pytest.skip(f"{variable} is not set: no simulator of this autopilot here")
    with started(binary, tmp_path / "vehicle", speed_up) as found:
        yield found


def planned(home: Path, vehicle: RealVehicle) -> Path:
    """A dozen photos straight down from 60 m, inside a fence."""
    here, mission = f"{HOME.latitude_deg},{HOME.longitude_deg}", home / "nadir.plan"
    words = ["--area", f"{here},10", "--camera", CAMERA, "--height", "60", "--launch", here]
    words += ["--forward-overlap", "75", "--side-overlap", "60", "--camera-interval", "1"]
    words += ["--keep-in", f"{here},300"]
    done = fieldcal(home, "plan", "nadir", *words, "--autopilot", vehicle.flavour, "--out", mission)
    assert done.returncode == 0, done.stderr
    return mission


def holds(vehicle: RealVehicle, mission: Path) -> None:
    """The vehicle holds that mission, as another program reads it."""
    sent = load(mission, vehicle.flavour).mission.items
    assert compare(sent, vehicle.pilot.holds(), vehicle.flavour) == []


def upload(home: Path, vehicle: RealVehicle, mission: Path) -> subprocess.CompletedProcess[str]:
    return fieldcal(home, "upload", mission, "--to", vehicle.link, "--yes", "--wait", "30")


def refused(home: Path, vehicle: RealVehicle, mission: Path) -> None:
    """A mission with an item that the autopilot refuses leaves the one that was there."""
    file = json.loads(mission.read_text())
    items = file["mission"]["items"]
    items[2]["params"][6] += 10.0  # ArduPilot has taken this when it refuses that
    items[4] |= {"command": REFUSED, "params": [1, 0, 0, 0, 0, 0, 0], "frame": 2}
    bad = home / "refused.plan"
    bad.write_text(json.dumps(file))
    done = upload(home, vehicle, bad)
    assert done.returncode == 2
    assert f"The old mission is {LEFT[vehicle.flavour]}, read back and compared." in done.stderr
    holds(vehicle, mission)


class Told:
    """What a command says, line by line, as it says it."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.lines: list[str] = []
        self._process = process
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.lines.append(line.decode().strip())

    def count(self, words: str) -> int:
        return sum(words in line for line in self.lines)

    def wait(self, words: str) -> None:
        def there() -> bool:
            assert self._process.poll() is None or self.count(words), "\n".join(self.lines)
            return self.count(words) > 0

        wait_for(there, FLIGHT_S)


@contextmanager
def photographed(home: Path, vehicle: RealVehicle) -> Iterator[Path]:
    """Rendered photos of whatever the vehicle triggers."""
    size = f"{SIZE[0]}x{SIZE[1]}"
    words = ("sim", "camera", "--link", vehicle.camera, "--size", size, "--site-m", "240")
    with working(home, *words, "--out", home / "tether") as camera:
        wait_until_ready(camera)
        yield home / "tether"
        camera.send_signal(2)
        assert camera.wait(60) == 0


def test_refly_then_trust(vehicle: RealVehicle, tmp_path: Path) -> None:
    """Photos as triggers as pairs, none wrong; REFLY, the pass uploaded and read back; flown, TRUST."""
    mission = planned(tmp_path, vehicle)
    done = upload(tmp_path, vehicle, mission)
    assert done.returncode == 0, done.stdout + done.stderr
    holds(vehicle, mission)
    refused(tmp_path, vehicle, mission)
    lens = reference_of(SIZE)
    write_reference_file(lens, tmp_path / LENS)
    with photographed(tmp_path, vehicle) as photos:
        words = ("run", "--photos", photos, "--link", vehicle.link, "--reference", tmp_path / LENS)
        words += ("--offer-refly", "--yes", "--no-live", "--json", tmp_path / "report.json")
        with working(tmp_path, *words) as process:
            told = Told(process)
            told.wait("The vehicle is heard")
            vehicle.pilot.take_off()
            told.wait(FLY_IT)
            assert told.count("REFLY")
            first = list(vehicle.pilot.photos)
            holds(vehicle, the_session(tmp_path) / "refly" / "pass.plan")
            assert not vehicle.pilot.armed
            vehicle.pilot.take_off()
            assert process.wait(FLIGHT_S) == 0, "\n".join(told.lines)
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["verdict"] == "TRUST"
    assert lens.brown is not None
    assert report["calibration"]["f_px"] == pytest.approx(lens.brown.f_px, rel=1e-3)
    assert len(first) == len(load(mission, vehicle.flavour).plan.stations)
    pairs_are_right(tmp_path, vehicle.pilot.photos, photos)


def test_a_pass_is_uploaded_in_the_air(vehicle: RealVehicle, tmp_path: Path) -> None:
    """The vehicle holds after its last photo, gets the pass, restarts, and takes every photo of it."""
    mission = planned(tmp_path, vehicle)
    done = upload(tmp_path, vehicle, mission)
    assert done.returncode == 0, done.stdout + done.stderr
    nadir = len(load(mission, vehicle.flavour).plan.stations)
    write_reference_file(reference_of(SIZE), tmp_path / LENS)
    with photographed(tmp_path, vehicle) as photos:
        words = ("run", "--photos", photos, "--link", vehicle.link, "--reference", tmp_path / LENS)
        words += ("--offer-refly", "--yes", "--no-live", "--count", str(nadir))
        with working(tmp_path, *words) as process:
            told = Told(process)
            told.wait("The vehicle is heard")
            vehicle.pilot.take_off()
            wait_for(lambda: len(vehicle.pilot.photos) >= nadir, FLIGHT_S)
            time.sleep(2.0)  # Copter's gimbal leaves its aim at once with AUTO
            vehicle.pilot.hold()
            told.wait(FLY_IT)
            assert vehicle.pilot.armed
            # PX4 begins a new mission at its beginning.
            assert told.count("restart the mission") == (vehicle.flavour == "ardupilot")
            new = the_session(tmp_path) / "refly" / "pass.plan"
            holds(vehicle, new)
            vehicle.pilot.restart()
            assert process.wait(FLIGHT_S) == 0, "\n".join(told.lines)
    extra = len(load(new, vehicle.flavour).plan.stations)
    assert len(vehicle.pilot.photos) == nadir + extra
    pairs_are_right(tmp_path, vehicle.pilot.photos, photos)


@pytest.mark.parametrize("vehicle", ["px4"], indirect=True)
@pytest.mark.parametrize("speed_up", [1.0])
def test_killed_and_switched_off_in_the_air(vehicle: RealVehicle, tmp_path: Path) -> None:
    """Killed and gone on, the vehicle switched off and on: what was told while nobody listened is missing and
    said, all else is paired, and right. Nothing is uploaded to a vehicle that flies its mission."""
    mission = planned(tmp_path, vehicle)
    assert upload(tmp_path, vehicle, mission).returncode == 0
    write_reference_file(reference_of(SIZE), tmp_path / LENS)
    taken = vehicle.pilot.photos
    with photographed(tmp_path, vehicle) as photos:
        words = (
            "run",
            "--photos",
            photos,
            "--link",
            vehicle.link,
            "--reference",
            tmp_path / LENS,
            "--no-live",
        )
        with working(tmp_path, *words) as process:
            told = Told(process)
            told.wait("The vehicle is heard")
            vehicle.pilot.take_off()
            wait_for(lambda: len(taken) >= 2, FLIGHT_S)
            process.kill()
            process.wait()
        unheard = len(taken)
        done = upload(tmp_path, vehicle, mission)
        assert done.returncode == 2
        assert "The vehicle is armed (its mode is mission)" in done.stderr
        with working(tmp_path, "run", "--resume", *words[1:], "--json", tmp_path / "report.json") as process:
            told = Told(process)
            told.wait("The vehicle is heard")
            unheard = len(taken) - unheard
            wait_for(lambda: len(taken) >= 7, FLIGHT_S)
            time.sleep(1.0)
            first = len(taken)
            assert vehicle.power_cycle is not None
            vehicle.power_cycle()
            holds(vehicle, mission)
            vehicle.pilot.take_off()
            told.wait("The vehicle has started anew")
            assert process.wait(FLIGHT_S) in (0, 3, 4), "\n".join(told.lines)
    again = len(load(mission, vehicle.flavour).plan.stations)
    assert len(list(photos.glob("*.JPG"))) == first + again
    with SessionReader.open(the_session(tmp_path)) as session:
        recorded = session.pairing()
        triggers = {row.seq: row.value for row in session.triggers()}
        names = {row.seq: Path(row.value.path).name for row in session.photos()}
    assert recorded is not None
    files = sorted(names.values())
    assert first + again - unheard - 1 <= len(triggers) <= first + again
    sure = [pair for pair in recorded.value.pairs if pair.sure]
    assert len(sure) == len(triggers)
    order = []
    for pair in sorted(sure, key=lambda pair: pair.trigger):
        index, order = triggers[pair.trigger].image_index, [*order, files.index(names[pair.photo])]
        assert index is not None
        assert order[-1] in (index, index + first)
    assert order == sorted(set(order))


def pairs_are_right(home: Path, told: list[int], photos: Path) -> None:
    """As many photos and sure pairs as triggers; each photo with the trigger that it was rendered for."""
    files = sorted(photos.glob("*.JPG"))
    assert told == list(range(told[0], told[0] + len(files)))
    with SessionReader.open(the_session(home)) as session:
        recorded = session.pairing()
        triggers = {row.seq: row.value for row in session.triggers()}
        names = {row.seq: Path(row.value.path).name for row in session.photos()}
    assert recorded is not None
    assert len(triggers) == len(names) == len(files)
    sure = [pair for pair in recorded.value.pairs if pair.sure]
    assert len(sure) == len(files)
    for pair in sure:
        index = triggers[pair.trigger].image_index
        assert index is not None
        assert names[pair.photo] == files[index - told[0]].name
    assert len(read_truth(photos).photos) == len(files)

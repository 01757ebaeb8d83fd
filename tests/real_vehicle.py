"""An autopilot's own simulator as a process, and its pilot, who does what fieldcal never does: arm, start."""

from __future__ import annotations

import importlib
import os
import random
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Self

from benchmarks.processes import session, wait_for
from calib.frames import LocalFrame
from mission.encode import Flavour, Item

_mavutil: Any = importlib.import_module("pymavlink.mavutil")
HOME = LocalFrame(47.0, 8.5, 430.0)
SET_MODE, ARM, START, SET_CURRENT, ASK_RATE = 176, 400, 300, 224, 511
#: Copter does not arm in AUTO, in which it still is where its last mission ended.
LOITER, GUIDED = 5, 4
#: PX4's main and sub mode.
PX4_MISSION, PX4_HOLD = (4, 4), (4, 3)
#: Its ground station's link is at this port and the number of the instance.
_PX4_GROUND = 18570
#: For a gimbal, and for a display of the simulation.
_PX4_UNUSED = (13030, 19450)
_OFF_S = 5.0
_GROUND_STATION = 255
#: A vehicle whose sensors are calibrated, with a camera and a servo mount, which its simulator does not
#: have by itself.
ARDUCOPTER_PARAMETERS = """
FRAME_CLASS 1
BATT_MONITOR 4
COMPASS_OFS_X 5
COMPASS_OFS_Y 13
COMPASS_OFS_Z -18
COMPASS_OFS2_X 5
COMPASS_OFS2_Y 13
COMPASS_OFS2_Z -18
COMPASS_OFS3_X 5
COMPASS_OFS3_Y 13
COMPASS_OFS3_Z -18
INS_ACCOFFS_X 0.001
INS_ACCOFFS_Y 0.001
INS_ACCOFFS_Z 0.001
INS_ACCSCAL_X 1.001
INS_ACCSCAL_Y 1.001
INS_ACCSCAL_Z 1.001
INS_ACC2OFFS_X 0.001
INS_ACC2OFFS_Y 0.001
INS_ACC2OFFS_Z 0.001
INS_ACC2SCAL_X 1.001
INS_ACC2SCAL_Y 1.001
INS_ACC2SCAL_Z 1.001
CAM1_TYPE 1
SERVO9_FUNCTION 10
MNT1_TYPE 1
MNT1_PITCH_MIN -90
SERVO10_FUNCTION 8
SERVO11_FUNCTION 7
SERVO12_FUNCTION 6
"""

#: Photos by command and distance, told over MAVLink; a servo mount that holds itself level.
PX4_PARAMETERS = {"TRIG_MODE": "4", "TRIG_INTERFACE": "3", "MNT_MODE_IN": "4", "MNT_MODE_OUT": "0"}
PX4_PARAMETERS |= {"MNT_RANGE_PITCH": "180"}


@dataclass(frozen=True)
class RealVehicle:
    """``link`` and ``camera``: addresses for fieldcal and for the camera beside it. ``power_cycle``: off, on,
    and ready to be armed where it first stood (PX4)."""

    flavour: Flavour
    link: str
    camera: str
    pilot: Pilot
    power_cycle: Callable[[], None] | None = None


@contextmanager
def arducopter(binary: str, folder: Path, speed_up: float) -> Iterator[RealVehicle]:
    """ArduPilot's simulated quadcopter, ready to be armed, with a memory of its own in ``folder``."""
    folder.mkdir()
    (folder / "vehicle.parm").write_text(ARDUCOPTER_PARAMETERS.lstrip())
    base = _free_ports(0, 2, 3)
    others = _free_ports(0, 1, 2, 3)
    words = [binary, "--model", "quad", "--wipe", "--speedup", f"{speed_up:g}"]
    words += ["--home", f"{HOME.latitude_deg},{HOME.longitude_deg},{HOME.altitude_m},0"]
    words += ["--defaults", "vehicle.parm", "--base-port", str(base), "--rc-in-port", str(others)]
    words += ["--sim-port-in", str(others + 1), "--sim-port-out", str(others + 2)]
    words += ["--irlock-port", str(others + 3)]
    with _running(words, folder), CopterPilot(f"tcp:127.0.0.1:{base}") as pilot:
        pilot.wait_until_ready()
        link, camera = (f"tcp://127.0.0.1:{base + n}" for n in (2, 3))
        yield RealVehicle("ardupilot", link, camera, pilot)


@contextmanager
def px4(binary: str, folder: Path, speed_up: float) -> Iterator[RealVehicle]:
    """PX4's simulated quadcopter (SIH), ready to be armed, with a memory of its own in ``folder``.

    fieldcal and the pilot have links as ground stations have them, the camera a companion computer's.
    """
    folder.mkdir()
    binary, instance = str(Path(binary).resolve()), _free_instance()
    link, camera = (_free_ports(0, 1) for _ in range(2))
    with _running(px4_words(binary, instance), folder, px4_environment(speed_up)) as anew:
        px4_links(binary, folder, instance, link, camera)
        with Px4Pilot(f"udpout:127.0.0.1:{_PX4_GROUND + instance}", instance + 1) as pilot:
            pilot.wait_until_ready()

            def power_cycle() -> None:
                anew()
                pilot.newest.clear()
                pilot.photos.clear()
                px4_links(binary, folder, instance, link, camera)
                pilot.wait_until_ready()

            yield RealVehicle("px4", f"udp://:{link}", f"udp://:{camera}", pilot, power_cycle)


def px4_links(binary: str, folder: Path, instance: int, link: int, camera: int) -> None:
    """Once it is up: two more links, each from the port above, for two that nobody listens to; it has six."""
    log = folder / "vehicle.log"
    wait_for(lambda: b"Startup script returned" in log.read_bytes(), 60.0)
    words = [["stop", "-u", str(port + instance)] for port in _PX4_UNUSED]
    for port, mode in ((link, []), (camera, ["-m", "onboard"])):
        words.append(["start", "-x", "-u", str(port + 1), "-o", str(port), "-r", "4000000", "-f", *mode])
    for given in words:
        client = str(Path(binary).with_name("px4-mavlink"))
        subprocess.run([client, "--instance", str(instance), *given], check=True, capture_output=True)


def px4_words(binary: str, instance: int) -> list[str]:
    """Started in the folder that is its memory."""
    return [binary, "-d", "-i", str(instance), str(Path(binary).parent.parent / "etc")]


def px4_environment(speed_up: float) -> dict[str, str]:
    given = {"PX4_SIMULATOR": "sihsim", "PX4_SIM_MODEL": "sihsim_quadx", "PX4_SYS_AUTOSTART": "10040"}
    given |= {"PX4_SIM_SPEED_FACTOR": f"{speed_up:g}"}
    places = {"LAT": HOME.latitude_deg, "LON": HOME.longitude_deg, "ALT": HOME.altitude_m}
    given |= {f"PX4_HOME_{name}": f"{value:g}" for name, value in places.items()}
    given |= {f"PX4_PARAM_{name}": value for name, value in PX4_PARAMETERS.items()}
    return {**os.environ, **given}


def _free_instance() -> int:
    """A number that no PX4 on this computer has."""
    while True:
        number = random.randrange(10, 200)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            try:
                one.bind(("", _PX4_GROUND + number))
            except OSError:
                continue
        return number


@contextmanager
def _running(
    words: list[str], folder: Path, environment: dict[str, str] | None = None
) -> Iterator[Callable[[], None]]:
    """A simulator; what is given ends it at once and starts it anew."""

    def begun() -> subprocess.Popen[bytes]:
        with (folder / "vehicle.log").open("wb") as log:
            return subprocess.Popen(
                words,
                cwd=folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def end() -> None:
        for pid in session(process.pid):
            os.kill(pid, signal.SIGKILL)
        process.wait()

    def anew() -> None:
        nonlocal process
        end()
        time.sleep(_OFF_S)
        process = begun()

    process = begun()
    try:
        yield anew
    finally:
        end()


def _free_ports(*offsets: int) -> int:
    """The lowest of some ports that nobody uses, for TCP and UDP."""
    while True:
        base = random.randrange(20_000, 30_000)
        try:
            for offset in offsets:
                for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
                    with socket.socket(socket.AF_INET, kind) as one:
                        one.bind(("127.0.0.1", base + offset))
        except OSError:
            continue
        return base


@dataclass
class Pilot:
    """A ground station in a few lines. ``newest``: last message of each kind; ``photos``: numbers told of."""

    address: str
    system_id: int = 1
    newest: dict[str, Any] = field(default_factory=dict)
    photos: list[int] = field(default_factory=list)
    said: list[str] = field(default_factory=list)
    #: The message that tells of a photo, and its number there.
    PHOTO: ClassVar[tuple[str, str]] = ("", "")

    def __enter__(self) -> Self:
        self._link = _mavutil.mavlink_connection(self.address, source_system=_GROUND_STATION, retries=60)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="pilot", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join(5)
        self._link.close()

    def _listen(self) -> None:
        beat_s = 0.0
        while not self._over.is_set():
            if time.monotonic() - beat_s > 1.0:
                beat_s = time.monotonic()
                self._link.mav.heartbeat_send(6, 8, 0, 0, 0)  # a ground station
            heard = self._link.recv_match(blocking=True, timeout=0.5)
            if heard is None or (heard.get_srcSystem(), heard.get_srcComponent()) != (self.system_id, 1):
                continue
            kind = heard.get_type()
            number = getattr(heard, self.PHOTO[1]) if kind == self.PHOTO[0] else None
            if number is not None and number not in self.photos:
                self.photos.append(number)
            elif kind == "STATUSTEXT":
                self.said.append(heard.text)
            self.newest[kind] = heard

    @property
    def armed(self) -> bool:
        return bool(self.newest["HEARTBEAT"].base_mode & 128)

    def wait_until_ready(self, timeout_s: float = 180.0) -> None:
        """The estimator knows where the vehicle is, and all checks before arming are passed."""
        wait_for(lambda: "HEARTBEAT" in self.newest, timeout_s)
        self._ask()
        wait_for(self._ready, timeout_s)

    def _ask(self) -> None:
        """For what has to be known to be ready."""
        raise NotImplementedError

    def _ready(self) -> bool:
        raise NotImplementedError

    def take_off(self) -> None:
        """Arm and start the mission."""
        raise NotImplementedError

    def hold(self) -> None:
        """Stay in the air."""
        raise NotImplementedError

    def restart(self) -> None:
        """The mission from its beginning, in the air."""
        raise NotImplementedError

    def command(self, number: int, *params: float, timeout_s: float = 30.0) -> int:
        """MAV_RESULT."""
        self.newest.pop("COMMAND_ACK", None)
        given = [*params, *[0.0] * 7][:7]
        end = time.monotonic() + timeout_s
        while time.monotonic() < end:
            self._link.mav.command_long_send(self.system_id, 1, number, 0, *given)
            answer = self._answer("COMMAND_ACK", lambda heard: heard.command == number)
            if answer is not None:
                return int(answer.result)
        raise AssertionError(f"The vehicle does not answer command {number}.")

    def holds(self) -> list[Item]:
        """The mission on board, as this program reads it."""
        mav, us = self._link.mav, self.system_id
        count = self._asked(lambda: mav.mission_request_list_send(us, 1, 0), "MISSION_COUNT", lambda _: True)
        found = []
        for number in range(count.count):
            one = self._asked(
                lambda n=number: mav.mission_request_int_send(us, 1, n, 0),  # type: ignore[misc]
                "MISSION_ITEM_INT",
                lambda heard, n=number: heard.seq == n,  # type: ignore[misc]
            )
            params = (one.param1, one.param2, one.param3, one.param4)
            found.append(Item(one.command, one.frame, *params, one.x, one.y, one.z, bool(one.autocontinue)))
        mav.mission_ack_send(us, 1, 0, 0)
        return found

    def _asked(self, ask: Callable[[], None], kind: str, fits: Callable[[Any], bool]) -> Any:
        for _ in range(20):
            self.newest.pop(kind, None)
            ask()
            answer = self._answer(kind, fits)
            if answer is not None:
                return answer
        raise AssertionError(f"The vehicle does not answer with {kind}.")

    def _answer(self, kind: str, fits: Callable[[Any], bool], patience_s: float = 2.0) -> Any | None:
        end = time.monotonic() + patience_s
        while time.monotonic() < end:
            heard = self.newest.get(kind)
            if heard is not None and fits(heard):
                return heard
            time.sleep(0.01)
        return None


class CopterPilot(Pilot):
    PHOTO = ("CAMERA_FEEDBACK", "img_idx")

    def _ask(self) -> None:
        for message in (1, 193, 242):  # SYS_STATUS, EKF_STATUS_REPORT, HOME_POSITION
            self.command(ASK_RATE, message, 1e6)

    def _ready(self) -> bool:
        estimator, status = self.newest.get("EKF_STATUS_REPORT"), self.newest.get("SYS_STATUS")
        if estimator is None or status is None or "HOME_POSITION" not in self.newest:
            return False
        places = 1 << 4 | 1 << 9  # absolute position, known and predicted
        return estimator.flags & places == places and bool(status.onboard_control_sensors_health & 1 << 28)

    def take_off(self) -> None:
        assert self.command(SET_MODE, 1, LOITER) == 0, self.said[-5:]
        assert self.command(ARM, 1) == 0, self.said[-5:]
        assert self.command(START) == 0, self.said[-5:]

    def hold(self) -> None:
        """LOITER would sink: the simulated stick is down."""
        assert self.command(SET_MODE, 1, GUIDED) == 0, self.said[-5:]

    def restart(self) -> None:
        assert self.command(SET_CURRENT, 1, 1) == 0, self.said[-5:]
        assert self.command(START) == 0, self.said[-5:]


class Px4Pilot(Pilot):
    PHOTO = ("CAMERA_IMAGE_CAPTURED", "image_index")

    def _ask(self) -> None:
        """A ground station's link has it all."""

    def _ready(self) -> bool:
        status = self.newest.get("SYS_STATUS")
        ready = status is not None and bool(status.onboard_control_sensors_health & 1 << 28)
        return ready and "HOME_POSITION" in self.newest

    def take_off(self) -> None:
        assert self.command(SET_MODE, 1, *PX4_MISSION) == 0, self.said[-5:]
        assert self.command(ARM, 1) == 0, self.said[-5:]

    def hold(self) -> None:
        assert self.command(SET_MODE, 1, *PX4_HOLD) == 0, self.said[-5:]

    def restart(self) -> None:
        """An uploaded mission is begun at its beginning."""
        assert self.command(SET_MODE, 1, *PX4_MISSION) == 0, self.said[-5:]

"""The systemd unit, its configuration, and `fieldcal run` as a service: a real socket, flight by flight."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import typer

from benchmarks.processes import wait_for
from calib.errors import FormatError
from calib.findings import Verdict
from calib.photos.photo import Photo
from daemon import refly_offer, run_rounds
from daemon.cli_run import run_command
from daemon.config_file import read_options
from daemon.live.schemas import Capture, Status
from daemon.notify import Notifier
from daemon.refly_offer import Pass
from daemon.run_screen import Screen
from sim.survey import SurveyTruth
from tests.check_process import ended, started

ROOT = Path(__file__).parents[1]
UNIT, EXAMPLE = ROOT / "systemd" / "fieldcal.service", ROOT / "systemd" / "fieldcal.toml"
Site = tuple[tuple[Photo, ...], SurveyTruth]
CAPTURE = Capture(vehicle="one", photos=3, waiting=0)
STATUS = Status(vehicle="one", phase="collecting", session="s", since=datetime.now(UTC), degraded=[])

needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed"
)


class Manager:
    """The service manager's end: hears everything as it comes."""

    def __init__(self, place: str) -> None:
        self.heard: list[str] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(place)
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def __enter__(self) -> Manager:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._socket.close()

    def _listen(self) -> None:
        while data := self._socket.recv(4096):
            self.heard.append(data.decode())

    def until(self, text: str, timeout_s: float = 120) -> list[str]:
        """What was heard up to and with the first that holds ``text``; it is heard no more then."""
        wait_for(lambda: any(text in said for said in self.heard), timeout_s)
        end = next(place for place, said in enumerate(self.heard) if text in said) + 1
        found, self.heard[:end] = self.heard[:end], []
        return found

    def new(self) -> list[str]:
        time.sleep(0.05)
        found, self.heard[:] = self.heard[:], []
        return found


@needs_systemd
def test_the_unit_is_hardened() -> None:
    words = ["systemd-analyze", "security", "--offline=true", "--threshold=20", str(UNIT)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    level = re.search(r"Overall exposure level for fieldcal.service: ([0-9.]+)", done.stdout)
    assert level is not None
    assert 0 < float(level[1]) <= 2.0


@needs_systemd
def test_the_unit_is_valid(tmp_path: Path) -> None:
    unit = tmp_path / UNIT.name
    content = UNIT.read_text()
    assert content.count("/opt/fieldcal/bin/fieldcal") == 1
    # The program is not there, where this is tried.
    unit.write_text(content.replace("/opt/fieldcal/bin/fieldcal", sys.executable))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(unit)], capture_output=True, text=True, check=False
    )
    about_it = [line for line in done.stderr.splitlines() if "fieldcal" in line]
    assert (done.returncode, about_it) == (0, [])


def parameters() -> list[object]:
    app = typer.Typer(add_completion=False)
    app.command()(run_command)
    return list(typer.main.get_command(app).params)


def test_the_example_is_valid_and_names_every_option(tmp_path: Path) -> None:
    known = parameters()
    options = read_options(EXAMPLE, known)
    assert options == {"photos": "/var/lib/fieldcal/photos", "idle": 120, "label": "flight", "live": True}
    text = EXAMPLE.read_text()
    for parameter in known:
        for name in parameter.opts:  # type: ignore[attr-defined]
            if name not in ("--config", "--help"):
                assert re.search(rf"\b{name.removeprefix('--')} = ", text), name
    everything = tmp_path / "all.toml"
    everything.write_text(re.sub(r"^# (?=[a-z-]+ = )", "", text, flags=re.MULTILINE))
    assert read_options(everything, known)["token_file"] == "/etc/fieldcal/token"


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("idle = '5'", "idle has to be a number, not '5'"),
        ("count = 1.5", "count has to be a whole number"),
        ("quiet = 1", "quiet has to be true or false"),
        ("listen = 'tcp/0.0.0.0:1'", "listen has to be a list of texts"),
        ("idel = 5", "did you mean idle?"),
        ("[run]\nidle = 5", "there is no setting named run"),
        ("config = 'other.toml'", "there is no setting named config"),
        ("idle 5", "is not TOML"),
    ],
)
def test_a_wrong_configuration_is_refused(tmp_path: Path, line: str, said: str) -> None:
    path = tmp_path / "fieldcal.toml"
    path.write_text(line)
    with pytest.raises(FormatError, match=re.escape(said)):
        read_options(path, parameters())


@pytest.mark.parametrize("abstract", [False, True])
def test_what_systemd_is_told(tmp_path: Path, abstract: bool) -> None:
    name = f"@fieldcal-test-{os.getpid()}" if abstract else str(tmp_path / "notify")
    now = [100.0]
    environment = {"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "8000000", "WATCHDOG_PID": str(os.getpid())}
    with Manager("\0" + name[1:] if abstract else name) as end:
        with Notifier(environment, lambda: now[0]) as notifier:
            assert end.new() == []
            notifier.tell(CAPTURE)
            assert end.new() == ["READY=1", "WATCHDOG=1", "STATUS=waiting, 3 photos"]
            now[0] += 1.9
            notifier.tell(CAPTURE)
            assert end.new() == []
            now[0] += 0.2
            notifier.tell(STATUS)
            assert end.new() == ["WATCHDOG=1", "STATUS=collecting, 3 photos"]
        assert end.new() == ["STOPPING=1"]


def test_without_systemd_and_with_a_deaf_one(tmp_path: Path) -> None:
    with Notifier({}) as notifier:
        notifier.tell(CAPTURE)
    with Notifier({"NOTIFY_SOCKET": str(tmp_path / "gone")}) as notifier:
        notifier.tell(CAPTURE)
    another = {"NOTIFY_SOCKET": str(tmp_path / "n"), "WATCHDOG_USEC": "1", "WATCHDOG_PID": "1"}
    with Manager(str(tmp_path / "n")) as end, Notifier(another) as notifier:
        notifier.tell(CAPTURE)
        assert "WATCHDOG=1" not in end.new()


def test_long_work_gives_signs_of_life_but_not_for_ever(tmp_path: Path) -> None:
    environment = {"NOTIFY_SOCKET": str(tmp_path / "n"), "WATCHDOG_USEC": "80000"}

    def beating() -> bool:
        return any(thread.name == "signs of life" for thread in threading.enumerate())

    with Manager(str(tmp_path / "n")) as end, Notifier(environment) as notifier:
        with notifier.busy(60.0):
            for _ in range(4):
                assert end.until("WATCHDOG=1", 30) == ["WATCHDOG=1"]
        assert not beating()
        end.new()
        with notifier.busy(0.1):
            wait_for(lambda: not beating(), 30)
            heard = end.new()
            assert set(heard) == {"WATCHDOG=1"}
            assert len(heard) <= 6
    with Notifier({}) as notifier, notifier.busy(60.0):
        assert not beating()


def test_the_search_for_a_pass_gives_signs_of_life(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However long it takes; and so does the offer to a vehicle that is waited for."""
    environment = {"NOTIFY_SOCKET": str(tmp_path / "n"), "WATCHDOG_USEC": "80000"}
    screen = Screen(talkative=False, hidden=True)
    result = SimpleNamespace(verdict=Verdict.REFLY)
    with Manager(str(tmp_path / "n")) as end, Notifier(environment) as notifier:

        def long(*_: object, **__: object) -> Pass:
            for _ in range(3):
                end.until("WATCHDOG=1", 30)
            return Pass("found", 3)

        monkeypatch.setattr(refly_offer, "find_pass", long)
        monkeypatch.setattr(refly_offer, "offer", long)
        wishes = run_rounds.Wishes(offer_refly=True, yes=True)
        flight = SimpleNamespace(idle=lambda: None, at_work=lambda _: None)
        parts: list[Any] = [flight, None, None, screen, wishes, "one", notifier.tell, notifier.busy]
        assert run_rounds.Rounds(*parts)._extra_pass(result) == Pass("found", 3)  # type: ignore[arg-type]
        parts[2] = SimpleNamespace(launch=None, flavour="px4")
        assert run_rounds.Rounds(*parts)._uploaded(Pass("found", 3))


def test_flight_after_flight_as_a_service(site: Site, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    config = tmp_path / "fieldcal.toml"
    config.write_text(f'photos = "{folder}"\nlive = false\nidle = 0\ncount = 999\n')
    words = [sys.executable, "-m", "daemon.cli", "run", "--config", str(config), "--again"]
    place = tmp_path / "notify"
    more = {
        "NOTIFY_SOCKET": str(place),
        "WATCHDOG_USEC": "2000000",
        "FIELDCAL_SESSIONS": str(tmp_path / "sessions"),
        "PYTHONUNBUFFERED": "1",
    }
    first, second = (0, 1, 5, 6, 12, 15), (2, 3, 4, 7, 13, 16)
    with Manager(str(place)) as end:
        with started(tmp_path, words, **more) as process:
            told = end.until("STATUS=waiting, 0 photos")
            assert told[0] == "READY=1"
            # A main loop that hangs gives no sign of life, and one that goes on does.
            process.send_signal(signal.SIGSTOP)
            time.sleep(0.3)
            end.new()
            time.sleep(1.5)
            assert end.new() == []
            process.send_signal(signal.SIGCONT)
            end.until("WATCHDOG=1")
            for number in first[:3]:
                shutil.copy(site[0][number].path, folder)
            end.until("STATUS=collecting, 3 photos")
            # Stopped in the middle of a flight, as for a reboot: it goes on.
            process.send_signal(signal.SIGTERM)
            assert ended(process).code == 143
            end.until("STOPPING=1")
        for number in first[3:]:
            shutil.copy(site[0][number].path, folder)
        count = ["--count", "6"]
        with started(tmp_path, [*words, *count], **more) as process:
            ran = ended(process, 240)
        assert ran.code in (0, 3, 4), ran.err
        assert any(", 6 photos" in text for text in end.until("STOPPING=1"))
        assert len([*(tmp_path / "sessions").iterdir()]) == 1
        # The next run passes them over.
        with started(tmp_path, [*words, *count], **more) as process:
            end.until("STATUS=waiting, 0 photos")
            time.sleep(2.5)
            assert process.poll() is None
            assert not any("photos" in text and " 0 photos" not in text for text in end.new())
            for number in second:
                shutil.copy(site[0][number].path, folder)
            ran = ended(process, 240)
        assert ran.code in (0, 3, 4), ran.err
    reports = sorted((tmp_path / "sessions").glob("*/report.json"))
    assert len(reports) == 2
    for report, chosen in zip(reports, (first, second), strict=True):
        assert json.loads(report.read_text())["alignment"]["photos"] == len(chosen)
        placed = (report.parent / "exports" / "geo.txt").read_text()
        named = {index for index in (*first, *second) if site[0][index].path.name in placed}
        assert named
        assert named <= set(chosen)

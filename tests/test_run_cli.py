"""`fieldcal run` as a real process: photos that arrive, kill -9 at any instant, the check's own verdict."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
from check_process import ended, environment, started

from benchmarks.processes import session, wait_for, worker
from calib.photos.photo import Photo
from daemon.session.reader import SessionReader
from sim.survey import SurveyTruth

Site = tuple[tuple[Photo, ...], SurveyTruth]
CHOSEN = (0, 1, 5, 6, 9, 12, 15, 18)
KILLS = 4


def arguments(*words: str | Path) -> list[str]:
    return [sys.executable, "-m", "daemon.cli", *map(str, words)]


def folders(home: Path) -> dict[str, str]:
    return {"FIELDCAL_SESSIONS": str(home / "sessions"), "XDG_DATA_HOME": str(home / "data")}


def working(home: Path, *words: str | Path) -> AbstractContextManager[subprocess.Popen[bytes]]:
    return started(home, arguments(*words), **folders(home))


def fieldcal(home: Path, *words: str | Path) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        arguments(*words),
        cwd=home,
        env=environment(home, **folders(home)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert "Traceback" not in done.stderr, done.stderr
    return done


def what_counts(path: Path) -> dict[str, Any]:
    """A report without what may differ: how long it took and where the files are."""
    report: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return {key: value for key, value in report.items() if key not in ("timing", "exports")}


@pytest.fixture(scope="module")
def photos(site: Site) -> list[Path]:
    return [site[0][i].path for i in CHOSEN]


@pytest.fixture(scope="module")
def checked(photos: list[Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], int]:
    """A folder with all photos, and what `fieldcal check` says of it."""
    home = tmp_path_factory.mktemp("checked")
    folder = home / "card"
    folder.mkdir()
    for photo in photos:
        shutil.copy(photo, folder)
    done = fieldcal(home, "check", folder, "--quiet")
    assert done.returncode in (0, 3, 4), done.stderr
    return folder, what_counts(home / "fieldcal-out" / "report.json"), done.returncode


Checked = tuple[Path, dict[str, Any], int]


def moved(report: dict[str, Any], old: Path, new: Path) -> dict[str, Any]:
    moved_report: dict[str, Any] = json.loads(json.dumps(report).replace(str(old), str(new)))
    return moved_report


def the_session(home: Path) -> Path:
    (folder,) = [f for f in (home / "sessions").iterdir() if not f.name.startswith(".")]
    return folder


def recorded(home: Path) -> int:
    try:
        with SessionReader.open(the_session(home)) as record:
            return record.counts().photos
    except (ValueError, OSError):
        return 0


def test_photos_in_any_order_end_in_the_verdict_of_the_check(
    photos: list[Path], checked: Checked, tmp_path: Path
) -> None:
    folder = tmp_path / "hot"
    folder.mkdir()
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    run = ("run", "--photos", folder, "--listen", endpoint, "--vehicle", "P3P one", "--idle", "0")
    with working(tmp_path, *run, "--allow-commands") as process:
        for photo in reversed(photos):
            shutil.copy(photo, folder)
        wait_for(lambda: (tmp_path / "sessions").exists() and recorded(tmp_path) == len(photos), 120)
        seen = fieldcal(tmp_path, "status", "--connect", endpoint, "--json", "-")
        (vehicle,) = json.loads(seen.stdout)["vehicles"]
        assert vehicle["vehicle"] == "p3p-one"
        assert vehicle["alive"]
        assert vehicle["topics"]["capture"]["message"]["photos"] == len(photos)
        assert process.poll() is None
        told = fieldcal(tmp_path, "status", "p3p-one", "--connect", endpoint, "--finish")
        assert "final verdict" in told.stdout, told.stderr
        ended_as = ended(process, 240)
        out, err = ended_as.out, ended_as.err
    assert process.returncode == checked[2], err
    assert err == ""
    record = the_session(tmp_path)
    assert what_counts(record / "report.json") == moved(checked[1], checked[0], folder)
    assert f"Report: {record}/report.html" in out.replace("\n", "")
    shown = fieldcal(tmp_path, "sessions", "show", record.name)
    assert "finished" in shown.stdout
    assert "Unfinished" not in shown.stdout
    nobody = fieldcal(tmp_path, "status", "--connect", endpoint, "--wait", "0.5")
    assert nobody.returncode == 2
    assert "Nobody answers" in nobody.stderr


def _work_for_a_while(
    home: Path, process: subprocess.Popen[bytes], rng: random.Random, at_least: int
) -> None:
    wait_for(lambda: (home / "sessions").exists() and recorded(home) >= at_least, 120)
    wait_for(lambda: worker(process.pid) or process.poll() is not None, 120)
    time.sleep(rng.random() * 1.5)


def _gone(process: subprocess.Popen[bytes]) -> None:
    """The child notices soon that its parent is dead."""
    wait_for(lambda: not session(process.pid), 60)


@pytest.mark.parametrize("seed", [0])
def test_kill_9_of_daemon_and_child_changes_nothing(checked: Checked, tmp_path: Path, seed: int) -> None:
    """The daemon at random instants of its work, the alignment child in the last run."""
    rng, folder = random.Random(seed), checked[0]
    first = ("run", "--photos", folder, "--no-live", "--count", len(CHOSEN), "--quiet")
    again = ("run", "--resume", "--no-live", "--count", len(CHOSEN), "--quiet")
    acknowledged = 0
    for kill in range(KILLS):
        command = [str(word) for word in (first if kill == 0 else again)]
        with working(tmp_path, *command) as process:
            _work_for_a_while(tmp_path, process, rng, at_least=min(kill + 1, 4))
            os.kill(process.pid, signal.SIGKILL)
            process.wait(60)
            _gone(process)
        now = recorded(tmp_path)
        assert now >= acknowledged, f"kill {kill} lost photos"
        acknowledged = now
    with working(tmp_path, *[str(word) for word in again]) as process:
        pid = wait_for(lambda: worker(process.pid) or process.poll() is not None, 120)
        if pid is not True:
            time.sleep(rng.random())
            os.kill(pid, signal.SIGKILL)
        ended_as = ended(process, 240)
        out, err = ended_as.out, ended_as.err
    assert process.returncode == checked[2], err
    assert "Traceback" not in err
    assert what_counts(the_session(tmp_path) / "report.json") == checked[1]
    assert checked[1]["headline"] in out
    with SessionReader.open(the_session(tmp_path)) as record:
        record.verify()
        assert record.counts().photos == len(CHOSEN)
        newest = record.latest_verdict()
        assert newest is not None
        assert newest.value.final


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("run",), "No source of photos was given"),
        (("run", "--photos", "nowhere"), "There is no folder nowhere"),
        (("run", "--resume"), "There is no unfinished flight"),
        (("run", "--photos", ".", "--reference", "nonsense"), "nonsense"),
        (("run", "--photos", ".", "--listen", "nonsense"), "not valid"),
        (("run", "--photos", ".", "--out", "a-file"), "a-file"),
        (("status", "--finish"), "which vehicle"),
        (("status", "--connect", "tcp/127.0.0.1:1", "--wait", "0.2"), "Nobody answers"),
    ],
)
def test_what_cannot_be_done_is_refused_in_a_sentence(
    tmp_path: Path, words: tuple[str, ...], sentence: str
) -> None:
    (tmp_path / "a-file").write_text("")
    done = fieldcal(tmp_path, *words)
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert sentence in done.stderr


def test_an_empty_folder_gives_no_verdict_but_a_flight_to_go_on_with(tmp_path: Path) -> None:
    (tmp_path / "hot").mkdir()
    with working(tmp_path, "run", "--photos", "hot", "--no-live") as process:
        wait_for(lambda: (tmp_path / "sessions").exists() and list((tmp_path / "sessions").iterdir()), 60)
        time.sleep(1)
        process.send_signal(signal.SIGINT)
        err = ended(process, 60).err
    assert process.returncode == 2
    assert "There are no photos in" in err
    listed = fieldcal(tmp_path, "sessions", "list")
    assert "unfinished" in listed.stdout

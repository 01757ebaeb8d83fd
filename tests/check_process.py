"""`fieldcal check` as a real process, for the tests of the command."""

from __future__ import annotations

import ctypes
import hashlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.processes import session
from calib.photos.photo import Processing
from calib.reference import Reference
from calib.reference_file import write_reference_file
from sim.survey import SurveyOptions, SurveyTruth

#: A model that the bundled references do not know.
MODEL = "SIM20X"
OPTIONS = SurveyOptions(apart=True, model=MODEL)
_CAP_DAC_OVERRIDE, _CAP_DAC_READ_SEARCH, _PR_CAPBSET_DROP = 1, 2, 24


@dataclass(frozen=True)
class Ran:
    """How a command ended."""

    code: int
    out: str
    err: str

    @property
    def sentence(self) -> str:
        """The one line on stderr; fails where there is more or less."""
        lines = self.err.splitlines()
        assert len(lines) == 1, self.err
        assert lines[0].startswith("fieldcal: "), self.err
        assert lines[0].endswith((".", "?")), self.err
        return lines[0].removeprefix("fieldcal: ")


def environment(home: Path, **more: str) -> dict[str, str]:
    """The tests' own store and state below ``home``, and plain defaults for everything else."""
    kept = {key: value for key, value in os.environ.items() if key not in ("NO_COLOR", "FORCE_COLOR")}
    return {
        **kept,
        "FIELDCAL_STORE": str(home / "store"),
        "XDG_STATE_HOME": str(home / "state"),
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        "COLUMNS": "80",
        **more,
    }


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "daemon.cli", "check", *map(str, arguments)]


def check(home: Path, *arguments: str | Path, timeout_s: float = 300, **options: Any) -> Ran:
    """Run ``fieldcal check`` in ``home``; ``options`` go to subprocess, ``env`` on top of the tests' own."""
    more = options.pop("env", {})
    options.setdefault("stdin", subprocess.DEVNULL)
    options.setdefault("stdout", subprocess.PIPE)
    done = subprocess.run(
        command(*arguments),
        cwd=home,
        env=environment(home, **more),
        stderr=subprocess.PIPE,
        check=False,
        timeout=timeout_s,
        **options,
    )
    out = (done.stdout or b"").decode("utf-8")
    err = done.stderr.decode("utf-8")
    assert "Traceback" not in err, err
    assert "Traceback" not in out, out
    return Ran(done.returncode, out, err)


@contextmanager
def started(home: Path, words: Sequence[str], **more: str) -> Iterator[subprocess.Popen[bytes]]:
    """A command at work in ``home``, leader of a process group and session of its own, killed at the end.

    ``more``: environment on top of the tests' own.
    """
    process = subprocess.Popen(
        words,
        cwd=home,
        env=environment(home, **more),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        for pid in session(process.pid):
            os.kill(pid, signal.SIGKILL)
        process.communicate()


def running(home: Path, *arguments: str | Path) -> AbstractContextManager[subprocess.Popen[bytes]]:
    """`fieldcal check` at work."""
    return started(home, command(*arguments))


def ended(process: subprocess.Popen[bytes], timeout_s: float = 120) -> Ran:
    out, err = process.communicate(timeout=timeout_s)
    return Ran(process.returncode, out.decode(), err.decode())


def without_superpowers() -> None:
    """In a child before its program starts: file permissions hold for root as well (Linux)."""
    libc = ctypes.CDLL(None)
    for capability in (_CAP_DAC_OVERRIDE, _CAP_DAC_READ_SEARCH):
        libc.prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0)


def state_of(folder: Path) -> dict[str, tuple[object, ...]]:
    """Everything below a folder: kind, permissions, size, time of change and content.

    The folder's own time of change is left out: a file that came and went may move it.
    """
    state: dict[str, tuple[object, ...]] = {}
    for path in sorted([folder, *folder.rglob("*")]):
        status = path.lstat()
        content = (
            hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() and not path.is_symlink() else ""
        )
        changed = status.st_mtime_ns if path != folder else 0
        state[str(path.relative_to(folder))] = (status.st_mode, status.st_size, changed, content)
    return state


@contextmanager
def untouched(*folders: Path) -> Iterator[None]:
    """Fails if anything below the folders is changed, made or removed inside."""
    before = [state_of(folder) for folder in folders]
    yield
    assert [state_of(folder) for folder in folders] == before


def true_lens(truth: SurveyTruth, path: Path, **changes: Any) -> Path:
    """The survey's lens as a reference file."""
    facts: dict[str, Any] = {
        "name": "true-lens",
        "make": "DJI",
        "model": MODEL,
        "width": truth.camera.width,
        "height": truth.camera.height,
        "processing": Processing.RAW,
        "source": "the simulator",
        "brown": truth.camera,
        "serial": OPTIONS.serial,
        "exif_models": (MODEL,),
    }
    write_reference_file(Reference(**{**facts, **changes}), path)
    return path


@dataclass(frozen=True)
class Survey:
    folder: Path
    truth: SurveyTruth

    @property
    def nadir(self) -> list[Path]:
        return sorted((self.folder / "nadir").iterdir())

    @property
    def convergent(self) -> list[Path]:
        return sorted((self.folder / "convergent").iterdir())


def report_of(home: Path, out: str = "fieldcal-out") -> dict[str, Any]:
    report: dict[str, Any] = json.loads((home / out / "report.json").read_text(encoding="utf-8"))
    return report


def left_out(report: dict[str, Any]) -> dict[str, str]:
    return {Path(item["path"]).name: item["reason"] for item in report["alignment"]["left_out"]}


def findings(report: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {finding["rule"]: finding for finding in report["findings"]}


def names(paths: Sequence[Path]) -> list[str]:
    return [path.name for path in paths]

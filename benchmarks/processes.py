"""Processes of a command that runs in a session of its own: found, watched, killed one by one (Linux)."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")
_PAGE_BYTES, _TICKS = os.sysconf("SC_PAGE_SIZE"), os.sysconf("SC_CLK_TCK")


def session(leader: int) -> list[int]:
    """Processes of the session that ``leader`` began, without zombies."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            fields = _stat(int(entry.name))
            if fields is not None and int(fields[3]) == leader and fields[0] != "Z":
                found.append(int(entry.name))
    return found


def worker(leader: int) -> int | None:
    """The process that aligns, once it is there."""
    for pid in session(leader):
        try:
            words = Path(f"/proc/{pid}/cmdline").read_bytes()
        except OSError:
            continue
        if b"spawn_main" in words:
            return pid
    return None


def kill_9(pid: int) -> None:
    """Unless it has ended."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def cpu_s(pid: int) -> float:
    """Computing time so far; 0 for a process that has ended."""
    fields = _stat(pid)
    return 0.0 if fields is None else (int(fields[11]) + int(fields[12])) / _TICKS


def resident_mb(pid: int) -> float:
    """Memory in use (RSS), MiB; 0 for a process that has ended."""
    fields = _stat(pid)
    return 0.0 if fields is None else int(fields[21]) * _PAGE_BYTES / 2**20


def wait_for(what: Callable[[], T], timeout_s: float = 60) -> T:
    """The first true answer of ``what``.

    Raises:
        TimeoutError: there was none in time.
    """
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        found = what()
        if found:
            return found
        time.sleep(0.02)
    raise TimeoutError


def _stat(pid: int) -> list[str] | None:
    """From the process's state on, proc(5)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None  # It ended meanwhile.

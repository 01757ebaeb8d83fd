"""What a whole process and its children take."""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Cost:
    """CPU and wall seconds, peak memory of the largest process in MB, exit code."""

    cpu_s: float
    wall_s: float
    peak_mb: float
    code: int


def measure(command: Sequence[str], env: dict[str, str] | None = None) -> Cost:
    """Run ``command`` with its output thrown away."""
    started = time.monotonic()
    with tempfile.TemporaryFile() as sink:
        process = subprocess.Popen(command, stdout=sink, stderr=sink, env=env)
        _, status, usage = os.wait4(process.pid, 0)
    return Cost(
        usage.ru_utime + usage.ru_stime,
        time.monotonic() - started,
        usage.ru_maxrss / 1024,
        os.waitstatus_to_exitcode(status),
    )

"""Work for a process of its own, in a module that loads fast."""

from __future__ import annotations

import time
from pathlib import Path

from calib.errors import InputError


def wait_for_file(path: Path) -> bool:
    """Whether it came within a minute."""
    end = time.monotonic() + 60
    while not path.exists() and time.monotonic() < end:
        time.sleep(0.02)
    return path.exists()


def refuse(words: str) -> None:
    raise InputError(words)

"""Photos from a camera on this computer's USB port, brought by the program gphoto2.

http://www.gphoto.org/doc/manual/ref-gphoto2-cli.html. It waits for the shutter, whoever releases it, and
downloads each photo under a temporary name first; the card keeps its copy. It ends when the camera goes away
or another program holds it, and is started again.
"""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO

from calib.errors import InputError
from daemon.capture.bringer import Bringer

MISSING = (
    "--photos gphoto2 needs the program gphoto2, which is not installed: sudo apt install gphoto2, or name "
    "the folder in which the photos arrive."
)
#: Date and time go before the camera's own name: cameras that keep nothing begin at capt0000 each time.
NAMES = "%Y%m%d-%H%M%S-%f.%C"
ARGUMENTS = ("--capture-tethered", "--keep", "--skip-existing", f"--filename={NAMES}")
_WAIT_S, _MOST_WAIT_S = 2.0, 20.0
#: Who ran so long has a camera.
_GOOD_S = 5.0
_END_S = 5.0
_ERROR = re.compile(rb"\*\*\* Error(?: \((-?\d+): '(.*)'\)|: (.*?)) \*\*\*")
#: libgphoto2's codes for a camera that somebody else holds.
_TAKEN = {b"-53", b"-60"}
_PR_SET_PDEATHSIG = 1
_prctl: Callable[..., int] | None = getattr(ctypes.CDLL(None), "prctl", None)


def gphoto2_program() -> str:
    """Its path.

    Raises:
        InputError: it is not installed.
    """
    found = shutil.which("gphoto2")
    if found is None:
        raise InputError(MISSING)
    return found


class Tether(Bringer):
    """Runs gphoto2 (``program``) in ``folder``; looked after by :meth:`poll`.

    Args:
        clock: seconds on a clock that never steps.
    """

    def __init__(self, folder: Path, program: str, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(clock())
        self._program, self._folder, self._clock = program, folder, clock
        self._child: subprocess.Popen[bytes] | None = None
        self._said: IO[bytes] | None = None
        self._began_s, self._due_s, self._wait_s = 0.0, -1e9, _WAIT_S
        for leftover in folder.glob("tmpfile??????"):  # Of a download that was killed.
            leftover.unlink()

    def close(self) -> None:
        """Ctrl-C for gphoto2, and the end if it does not listen. Again does no harm."""
        child, self._child = self._child, None
        if child is not None:
            child.send_signal(signal.SIGINT)
            try:
                child.wait(_END_S)
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()
        if self._said is not None:
            self._said.close()
            self._said = None

    def poll(self) -> None:
        """Start gphoto2, or look how it does."""
        now = self._clock()
        if self._child is None:
            if now >= self._due_s:
                self._start(now)
            return
        if self._child.poll() is None:
            if self._fault is not None and now - self._began_s > _GOOD_S:
                self._fault, self._wait_s = None, _WAIT_S
                self._news.append(("info", "The camera is there again."))
            return
        reason = self._reason()
        self.close()
        if now - self._began_s > _GOOD_S:
            self._wait_s = _WAIT_S
        self._due_s, self._wait_s = now + self._wait_s, min(2 * self._wait_s, _MOST_WAIT_S)
        self._failed(f"No photos come from the camera: {reason}.")

    def _start(self, now_s: float) -> None:
        self._began_s = now_s
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 closed with the child
        try:
            self._child = subprocess.Popen(
                [self._program, *ARGUMENTS],
                cwd=self._folder,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._said,
                env={**os.environ, "LC_ALL": "C", "LANGUAGE": ""},
                start_new_session=True,  # Ctrl-C is for us: we end it when we are done.
                preexec_fn=_ends_with_us,
            )
        except OSError as error:
            self.close()
            self._due_s = now_s + _MOST_WAIT_S
            self._failed(f"{self._program} cannot be started: {(error.strerror or str(error)).lower()}.")

    def _reason(self) -> str:
        assert self._said is not None
        self._said.seek(0)
        errors = _ERROR.findall(self._said.read()[-65536:])
        if not errors:
            return "gphoto2 ended without a word"
        number, text, plain = errors[-1]
        reason = (text or plain).decode(errors="replace").strip().rstrip(".")
        reason = f"{reason[:1].lower()}{reason[1:]}"
        if number in _TAKEN:
            reason += " (another program holds it: unmount it in the file manager)"
        return f"gphoto2 says: {reason}"


def _ends_with_us() -> None:
    """Runs in the child: whoever is killed must not leave the camera held by an orphan."""
    if _prctl is not None:
        _prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)

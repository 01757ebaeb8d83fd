"""Alignment while photos still come, in a child process that may die at any instant.

The child keeps what photos and pairs cost once (:class:`~calib.align.engine.Memory`). A provisional
block goes on from the one before it; the final one is grown anew from all photos in their final
order, so that it is the one that `fieldcal check` finds, to the last bit.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess

from calib.align.child import (
    IN_ALIGNMENT,
    Outcome,
    end,
    error_of,
    explain,
    measured,
    settle_in,
    start_quietly,
)
from calib.align.engine import Aligner, Memory, Progress, Settings
from calib.camera import FloatArray
from calib.errors import AlignmentError
from calib.field import Lens
from calib.photos.photo import Photo

#: One piece of work may kill the child so many times.
_ATTEMPTS = 3
#: The pause before a child that died is started again grows from this, in seconds.
_PAUSE_S = 0.5
_REPORT_EVERY_S = 0.05


@dataclass(frozen=True)
class Read:
    """Read these photos ahead of the next solution."""

    photos: tuple[Photo, ...]


@dataclass(frozen=True)
class Solve:
    """Solve the block of these photos; for a ``final`` one they come in the order of the check.

    ``reference``: the total mapping to hold the dome against, with its covariance (35, 35).
    """

    photos: tuple[Photo, ...]
    final: bool
    reference: Lens | None = None
    reference_covariance: FloatArray | None = None


Request = Read | Solve


@dataclass(frozen=True)
class Progressed:
    stage: str
    done: int
    total: int


@dataclass(frozen=True)
class Finished:
    """A request is done. ``outcome``: of a :class:`Solve` that was not called off.

    ``error``: why it failed, which the next request need not. ``cpu_s``: what it cost the child that
    finished it.
    """

    request: Request
    outcome: Outcome | None = None
    error: Exception | None = None
    cpu_s: float = 0.0


@dataclass(frozen=True)
class Restarted:
    """The child died and was started again with the same request."""

    deaths: int


Happening = Progressed | Finished | Restarted


class Stream:
    """The work itself, in this process."""

    def __init__(self, settings: Settings, progress: Progress) -> None:
        self._settings, self._progress = settings, progress
        self._memory = Memory()
        self._aligner: Aligner | None = None
        self._held: list[Photo] = []

    def read(self, photos: Sequence[Photo]) -> None:
        """Find the features of photos, which a later solution then has."""
        Aligner(self._settings, self._progress, self._memory).add_all(photos)

    def solve(self, job: Solve) -> Outcome:
        """A solution of the photos.

        Raises:
            AlignmentError: the photos cannot be joined.
        """
        aligner = Aligner(self._settings, self._progress, self._memory) if job.final else self._going_on(job)
        if job.final:
            aligner.add_all(job.photos)
        aligned = aligner.solve()
        return measured(
            aligned.solution,
            aligned.calibrated,
            job.reference,
            job.reference_covariance,
            lambda: self._progress("comparing models", 0, 0),
        )

    def _going_on(self, job: Solve) -> Aligner:
        """The aligner of the provisional solution before, where all of its photos are wanted still,
        with the same positions and angles."""
        wanted = {id_of(photo): photo for photo in job.photos}
        if self._aligner is None or not all(wanted.get(id_of(photo)) == photo for photo in self._held):
            self._aligner, self._held = Aligner(self._settings, self._progress, self._memory), []
        held = set(map(id_of, self._held))
        new = [photo for photo in job.photos if id_of(photo) not in held]
        # What a solution that was called off has added stays added, and only that counts as held.
        self.read(new)
        for photo in new:
            self._aligner.add(photo)
            self._held.append(photo)
        return self._aligner


def id_of(photo: Photo) -> tuple[str, str]:
    """Tells photos apart, also a file from another that replaced it."""
    return str(photo.path), photo.fingerprint


class _CalledOff(Exception):
    pass


def _child(settings: Settings, memory_limit_bytes: int | None, pipe: Connection) -> None:
    settle_in(memory_limit_bytes)
    last, may_stop = 0.0, False

    def progress(stage: str, done: int, total: int) -> None:
        nonlocal last
        if may_stop and pipe.poll():
            raise _CalledOff
        now = time.monotonic()
        if now - last > _REPORT_EVERY_S or done == total:
            last = now
            pipe.send(("progress", (stage, done, total)))

    stream = Stream(settings, progress)
    try:
        while True:
            request = pipe.recv()
            if request is None:  # Called off when it was done already.
                continue
            may_stop = isinstance(request, Solve) and not request.final
            before_s, outcome = time.process_time(), None
            try:
                if isinstance(request, Read):
                    stream.read(request.photos)
                else:
                    outcome = stream.solve(request)
                answer: tuple[str, object] = ("done", (outcome, time.process_time() - before_s))
            except _CalledOff:
                answer = ("done", (None, time.process_time() - before_s))
            except (BrokenPipeError, EOFError):
                raise
            except Exception as error:  # noqa: BLE001 the top of the process: told, not retried
                answer = explain(error)
            pipe.send(answer)
    except (BrokenPipeError, ConnectionResetError, EOFError):
        os._exit(0)  # The parent is gone, and nobody is left to tell.


class Solver:
    """The child and one request at a time; a child that dies is started again.

    Args:
        settings: as for the check.
        memory_limit_bytes: address space the child may take (None: no limit).
    """

    def __init__(self, settings: Settings | None = None, memory_limit_bytes: int | None = None) -> None:
        self._settings, self._limit = settings or Settings(), memory_limit_bytes
        self._process: SpawnProcess | None = None
        self._pipe: Connection | None = None
        self._request: Request | None = None
        self._called_off = False
        self._deaths = 0
        self._start_at_s = 0.0

    @property
    def busy(self) -> bool:
        """Whether a request is under way."""
        return self._request is not None

    @property
    def pid(self) -> int | None:
        """The child, while there is one."""
        return None if self._process is None else self._process.pid

    def submit(self, request: Request) -> None:
        """Begin a request; :meth:`poll` tells of it.

        Raises:
            RuntimeError: one is under way.
        """
        if self._request is not None:
            raise RuntimeError("one request at a time")
        self._request, self._called_off, self._deaths = request, False, 0
        self._hand_over()

    def call_off(self) -> None:
        """Have a provisional solution that is under way end soon, without an outcome."""
        if isinstance(self._request, Solve) and not self._request.final and not self._called_off:
            self._called_off = True
            self._send(None)

    def poll(self, timeout_s: float = 0.0) -> Happening | None:
        """What happened, or None; waits at most ``timeout_s``."""
        if self._request is None:
            return None
        if self._pipe is None:
            wait_s = self._start_at_s - time.monotonic()
            if wait_s > timeout_s:
                time.sleep(timeout_s)
                return None
            time.sleep(max(wait_s, 0.0))
            self._hand_over()
            return Restarted(self._deaths)
        try:
            if not self._pipe.poll(timeout_s):
                return None
            kind, content = self._pipe.recv()
        except (EOFError, OSError):  # OSError: it died in the middle of a message
            return self._died()
        if kind == "progress":
            return Progressed(*content)
        if kind == "memory":
            return self._died()
        if kind == "done":
            return self._finish(content[0], None, content[1])
        return self._finish(None, error_of(kind, content, IN_ALIGNMENT))

    def close(self) -> None:
        """End the child."""
        self._drop()
        self._request = None

    def _finish(self, outcome: Outcome | None, error: Exception | None, cpu_s: float = 0.0) -> Finished:
        assert self._request is not None
        finished = Finished(self._request, outcome, error, cpu_s)
        self._request = None
        return finished

    def _died(self) -> Happening | None:
        self._drop()
        self._deaths += 1
        if self._called_off:
            return self._finish(None, None)
        if self._deaths >= _ATTEMPTS:
            return self._finish(
                None,
                AlignmentError(
                    f"The alignment process died {self._deaths} times; the machine is probably short of "
                    "memory. Close other programs or give fewer photos."
                ),
            )
        self._start_at_s = time.monotonic() + _PAUSE_S * 2 ** (self._deaths - 1)
        return None

    def _hand_over(self) -> None:
        if self._pipe is None:
            here, there = multiprocessing.get_context("spawn").Pipe()
            self._process = start_quietly(_child, (self._settings, self._limit, there))
            there.close()
            self._pipe = here
        self._send(self._request)

    def _send(self, message: Request | None) -> None:
        """A child that is dead already is found out by the next :meth:`poll`."""
        if self._pipe is not None:
            try:
                self._pipe.send(message)
            except OSError:
                return

    def _drop(self) -> None:
        if self._pipe is not None:
            self._pipe.close()
        if self._process is not None:
            end(self._process)
        self._pipe = self._process = None

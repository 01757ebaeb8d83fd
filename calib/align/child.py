"""The heavy work in a process of its own: a crash or a memory limit there costs a retry, no more."""

from __future__ import annotations

import multiprocessing
import os
import resource
import signal
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib.align.dome import predict_dome
from calib.align.engine import Aligner, Progress, Settings
from calib.align.flatness import Flatness, measure_flatness
from calib.align.held import Held, held_block
from calib.align.network import measure_network
from calib.align.selfcal import Calibrated
from calib.align.uncertainty import estimate
from calib.camera import FloatArray
from calib.errors import AlignmentError, FieldcalError
from calib.field import LENS_NAMES, Lens
from calib.flown import FlownNetwork, flown_network
from calib.photos.photo import Photo
from calib.solution import Dome, Estimate, Network, Solution

#: Where a defect of the child came up.
IN_ALIGNMENT = "the alignment process"
#: Threads inside numerical libraries gain nothing on blocks of this size and fight each other.
_SINGLE_THREADED = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Job:
    """What the child is to do.

    ``reference``: the total mapping to hold the dome against, with its covariance (35, 35).
    ``wall``: the photos show a flat wall, whose flatness is to be measured. ``fixed``: hold the lens at
    the reference, which must then be there.
    """

    photos: tuple[Photo, ...]
    reference: Lens | None
    settings: Settings = field(default_factory=Settings)
    time_limit_s: float = 3600.0
    memory_limit_bytes: int | None = None
    reference_covariance: FloatArray | None = None
    wall: bool = False
    fixed: bool = False


@dataclass(frozen=True)
class Outcome:
    """What came out."""

    solution: Solution
    estimate: Estimate
    network: Network
    dome: Dome
    flown: FlownNetwork
    flatness: Flatness | None = None
    held: Held | None = None


def work(job: Job, progress: Progress) -> Outcome:
    """Align, self-calibrate and measure the uncertainty, in this process.

    Raises:
        AlignmentError: the photos cannot be joined.
    """
    aligner = Aligner(job.settings, progress)
    aligner.add_all(job.photos)
    aligned = aligner.solve()

    def tick() -> None:
        progress("comparing models", 0, 0)

    outcome = measured(aligned.solution, aligned.calibrated, job.reference, job.reference_covariance, tick)
    if job.fixed and job.reference is not None:
        progress("holding the lens", 0, 0)
        known = job.reference_covariance
        covariance = np.zeros((len(LENS_NAMES), len(LENS_NAMES))) if known is None else known
        height_m = outcome.dome.flying_height_m
        held = held_block(aligned.calibrated, outcome.estimate, job.reference, covariance, height_m, tick)
        outcome = replace(outcome, held=held)
    if not job.wall:
        return outcome
    progress("measuring the wall", 0, 0)
    flatness = measure_flatness(aligned.calibrated, outcome.estimate, job.settings.seed)
    return replace(outcome, flatness=flatness)


def measured(
    solution: Solution,
    calibrated: Calibrated,
    reference: Lens | None,
    reference_covariance: FloatArray | None = None,
    tick: Callable[[], None] | None = None,
) -> Outcome:
    """Uncertainty, network and dome of a solved block: all that the verdict rests on.

    Args:
        reference: total mapping to hold the dome against, with its covariance (35, 35).
    """
    honest = estimate(calibrated, tick)
    network = measure_network(
        solution.rotations_cam_from_world,
        solution.centres_m,
        solution.points_m,
        solution.observations,
        honest.brown.f_px,
    )
    height = float(np.median(network.height_agl_m))
    dome = predict_dome(calibrated, honest.lens_covariance, reference, height, tick, reference_covariance)
    flown = flown_network(calibrated, honest.correlation_factor)
    return Outcome(solution, honest, network, dome, flown)


def _child(job: Job, pipe: Connection) -> None:
    settle_in(job.memory_limit_bytes)
    last = 0.0

    def progress(stage: str, done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last > 0.05 or done == total:
            last = now
            pipe.send(("progress", (stage, done, total)))

    try:
        pipe.send(("done", work(job, progress)))
    except BrokenPipeError:
        os._exit(1)  # The parent is gone, and nobody is left to tell.
    except Exception as error:  # noqa: BLE001 the top of the process: a defect is told, not retried
        pipe.send(explain(error))


def short_of_memory(error: Exception) -> bool:
    """Python, OpenCV and the thread library each say it in their own way."""
    if isinstance(error, cv2.error):
        return error.code == cv2.Error.StsNoMem
    return isinstance(error, MemoryError) or "can't start new thread" in str(error)


def run_job(job: Job, progress: Progress, attempts: int = 2) -> Outcome:
    """Run ``job`` in a child process; once more if the child dies.

    Raises:
        AlignmentError: the photos cannot be joined, time or memory ran out, or the child died twice.
    """
    for attempt in range(attempts):
        outcome = _run_once(job, progress)
        if outcome is not None:
            return outcome
        progress("starting again", attempt + 1, attempts)
    raise AlignmentError(
        f"The alignment process died {attempts} times; the machine is probably short of memory. "
        "Close other programs or give fewer photos."
    )


def start_quietly(target: Callable[..., None], arguments: tuple[Any, ...]) -> SpawnProcess | None:
    """Start ``target`` in a process of its own whose numerical libraries use one thread each.

    Ctrl-C does not reach it while it starts; ``target`` begins with :func:`settle_in`. None: it died
    before it had its orders.
    """
    process = multiprocessing.get_context("spawn").Process(target=target, args=arguments, daemon=True)
    before = {name: os.environ.get(name) for name in _SINGLE_THREADED}
    os.environ.update(_SINGLE_THREADED)
    # Ctrl-C reaches the whole process group; a child that is still loading would answer it with a
    # traceback. Blocked signals stay blocked across its start. (The tracker would unblock them.)
    resource_tracker.ensure_running()
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    except BrokenPipeError:
        return None
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
    return process


def end(process: SpawnProcess) -> None:
    """End a child, by force if need be."""
    process.terminate()
    process.join(5)
    if process.is_alive():
        process.kill()
        process.join()


def settle_in(memory_limit_bytes: int | None) -> None:
    """What a child does first: leave Ctrl-C to its parent, keep quiet, know its limits."""
    # Ctrl-C goes to the parent, which ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # What is to be said goes through the pipe; libraries chatter on stderr (libjpeg on damaged photos).
    with Path(os.devnull).open("wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    if memory_limit_bytes is not None:
        resource.setrlimit(resource.RLIMIT_AS, (memory_limit_bytes, memory_limit_bytes))


def explain(error: Exception) -> tuple[str, Any]:
    """What a child says about an error at the top of its work: kind and content of the message."""
    if isinstance(error, FieldcalError):
        return "error", (type(error), str(error))
    if short_of_memory(error):
        return "memory", None
    return "defect", (type(error).__name__, traceback.format_exc())


def error_of(kind: str, content: Any, where: str) -> Exception:
    """What :func:`explain` told, as an error again; ``where`` a defect came up, in words. Not of "memory"."""
    if kind == "defect":
        name, trace = content
        return RuntimeError(f"{name} in {where}:\n{trace}")
    error_type, message = content
    error: Exception = error_type(message)
    return error


def _run_once(job: Job, progress: Progress) -> Outcome | None:
    """One attempt; None when the child died without a word."""
    here, there = multiprocessing.get_context("spawn").Pipe(duplex=False)
    process = start_quietly(_child, (job, there))
    if process is None:
        here.close()
        return None
    there.close()
    deadline = time.monotonic() + job.time_limit_s
    try:
        while True:
            if time.monotonic() > deadline:
                raise AlignmentError(
                    f"The alignment did not finish within {job.time_limit_s:.0f} s; give fewer photos."
                )
            if not here.poll(0.2):
                continue
            try:
                kind, content = here.recv()
            except (EOFError, OSError):  # OSError: it died in the middle of a message
                return None
            if kind == "progress":
                progress(*content)
            elif kind == "done":
                outcome: Outcome = content
                return outcome
            elif kind == "memory":
                return None
            else:
                raise error_of(kind, content, IN_ALIGNMENT)
    finally:
        here.close()
        end(process)

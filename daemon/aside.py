"""Long work that leaves the main loop free to listen and to tell."""

from __future__ import annotations

import multiprocessing
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from calib.align.child import end, error_of, explain, settle_in, start_quietly
from calib.errors import AlignmentError

T = TypeVar("T")
#: Between two turns of the main loop.
TURN_S = 0.1


def in_thread(work: Callable[[], T], meanwhile: Callable[[], None]) -> T:
    """``work()`` in a thread, for what mostly writes or waits; raises what it raises.

    Interrupted, the work is left to itself.
    """
    found: list[T] = []
    failed: list[BaseException] = []

    def run() -> None:
        try:
            found.append(work())
        except BaseException as error:  # noqa: BLE001 handed to whoever waits
            failed.append(error)

    thread = threading.Thread(target=run, name="aside", daemon=True)
    thread.start()
    while thread.is_alive():
        meanwhile()
        thread.join(TURN_S)
    if failed:
        raise failed[0]
    return found[0]


def in_process(
    work: Callable[..., T], arguments: tuple[object, ...], meanwhile: Callable[[], None], longest_s: float
) -> T:
    """``work(*arguments)`` in a process of its own, for what computes; raises what it raises.

    Raises:
        AlignmentError: the process died, or took longer than ``longest_s``.
    """
    here, there = multiprocessing.get_context("spawn").Pipe()
    process = start_quietly(_child, (work, arguments, there))
    there.close()
    until_s = time.monotonic() + longest_s
    try:
        while not here.poll(TURN_S):
            meanwhile()
            if time.monotonic() > until_s:
                raise AlignmentError(f"The computation took longer than {longest_s:g} s and was ended.")
        kind, content = here.recv()
    except (EOFError, OSError) as error:
        raise AlignmentError(
            "The process of a computation died; the machine is probably short of memory."
        ) from error
    finally:
        here.close()
        if process is not None:
            end(process)
    if kind == "done":
        answer: T = content
        return answer
    if kind == "memory":
        raise AlignmentError("A computation ran out of memory.")
    raise error_of(kind, content, "a process of its own")


def _child(work: Callable[..., Any], arguments: tuple[object, ...], pipe: Connection) -> None:
    settle_in(None)
    try:
        answer: tuple[str, Any] = ("done", work(*arguments))
    except Exception as error:  # noqa: BLE001 the top of the process: told to the parent
        answer = explain(error)
    pipe.send(answer)

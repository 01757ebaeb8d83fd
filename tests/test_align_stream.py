"""Photos into the alignment as they come: the final block is the check's own, whatever happened before."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable

import numpy as np
import pytest

from calib.align.child import Job, Outcome, work
from calib.align.engine import Settings
from calib.align.stream import Finished, Happening, Progressed, Read, Restarted, Solve, Solver, Stream
from calib.errors import AlignmentError
from calib.photos.photo import Photo
from sim.survey import SurveyTruth

Site = tuple[tuple[Photo, ...], SurveyTruth]
CHOSEN = (0, 1, 5, 6, 9, 12, 15, 18)
SETTINGS = Settings(workers=1)


def silent(stage: str, done: int, total: int) -> None:
    del stage, done, total


def photos_of(site: Site) -> tuple[Photo, ...]:
    return tuple(site[0][i] for i in CHOSEN)


@pytest.fixture(scope="module")
def at_once(site: Site) -> Outcome:
    """What the check computes."""
    return work(Job(photos_of(site), None, SETTINGS), silent)


def same(one: Outcome | None, other: Outcome) -> None:
    """To the last bit."""
    assert one is not None
    assert [p.path for p in one.solution.photos] == [p.path for p in other.solution.photos]
    assert np.array_equal(one.solution.lens.vector, other.solution.lens.vector)
    assert np.array_equal(one.solution.centres_m, other.solution.centres_m)
    assert np.array_equal(one.estimate.covariance, other.estimate.covariance)
    assert one.dome == other.dome


def run(solver: Solver, request: Read | Solve, during: Callable[[Happening], None] | None = None) -> Finished:
    solver.submit(request)
    deadline = time.monotonic() + 240
    while time.monotonic() < deadline:
        happening = solver.poll(0.1)
        if isinstance(happening, Finished):
            return happening
        if during is not None and happening is not None:
            during(happening)
    raise TimeoutError


def test_any_order_of_arrival_ends_in_the_same_block(site: Site, at_once: Outcome) -> None:
    photos = photos_of(site)
    stages: list[str] = []
    stream = Stream(SETTINGS, lambda *report: stages.append(report[0]))
    arrived = [photos[i] for i in (5, 0, 3, 1, 7, 2)]
    stream.read(arrived)
    provisional = stream.solve(Solve(tuple(arrived), final=False))
    assert 4 <= len(provisional.solution.photos) <= 6
    assert provisional.estimate.sigma_f_px > 0
    stages.clear()
    same(stream.solve(Solve(photos, final=True)), at_once)
    assert "matching" in stages


def test_a_photo_that_is_sorted_out_later_leaves_no_trace(site: Site) -> None:
    photos = photos_of(site)
    stream = Stream(SETTINGS, silent)
    stream.solve(Solve(photos[:5], final=False))
    without = stream.solve(Solve(photos[1:5], final=False))
    assert photos[0].path not in [p.path for p in without.solution.photos]


def test_a_child_killed_at_any_stage_starts_again(site: Site, at_once: Outcome) -> None:
    photos, solver = photos_of(site), Solver(SETTINGS)
    seen: list[str] = []
    restarts: list[Restarted] = []

    def during(happening: Happening) -> None:
        if isinstance(happening, Restarted):
            restarts.append(happening)
        elif isinstance(happening, Progressed):
            seen.append(happening.stage)
            kills = {"joining photos": 1, "self-calibration": 2}
            if kills.get(happening.stage) == len(restarts) + 1 and solver.pid is not None:
                os.kill(solver.pid, signal.SIGKILL)

    try:
        assert run(solver, Read(photos[:4])).error is None
        same(run(solver, Solve(photos, final=True), during).outcome, at_once)
        assert [r.deaths for r in restarts] == [1, 2]
        assert not solver.busy
    finally:
        solver.close()


def test_provisional_work_is_called_off_and_errors_do_not_end_the_child(site: Site) -> None:
    photos, solver = photos_of(site), Solver(SETTINGS)
    try:
        failed = run(solver, Solve(photos[:2], final=False))
        assert isinstance(failed.error, AlignmentError)
        pid = solver.pid
        begun: list[str] = []

        def stop(happening: Happening) -> None:
            if isinstance(happening, Progressed):
                begun.append(happening.stage)
                solver.call_off()

        off = run(solver, Solve(photos, final=False), stop)
        assert (off.outcome, off.error) == (None, None)
        assert "self-calibration" not in begun
        solver.call_off()  # Nothing is under way: no harm.
        assert run(solver, Read(photos[:1])).error is None
        assert solver.pid == pid
    finally:
        solver.close()
    assert solver.pid is None


def test_a_child_that_always_dies_is_given_up(site: Site) -> None:
    solver = Solver(SETTINGS, memory_limit_bytes=300_000_000)
    try:
        finished = run(solver, Solve(photos_of(site), final=True))
        assert isinstance(finished.error, AlignmentError)
        assert "short of memory" in str(finished.error)
    finally:
        solver.close()

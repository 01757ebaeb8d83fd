"""The child process: what may happen to it, and what the parent makes of it."""

from __future__ import annotations

import multiprocessing
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.align import child
from calib.align.child import Job, run_job
from calib.align.engine import Settings
from calib.errors import AlignmentError
from calib.field import Lens
from calib.photos.photo import Photo
from sim.survey import SurveyTruth

Site = tuple[tuple[Photo, ...], SurveyTruth]
FEW = (0, 1, 5, 12)


def job_of(site: Site, photos: tuple[int, ...] = FEW, reference: Lens | None = None) -> Job:
    settings = Settings(workers=1, refine=False)
    return Job(tuple(site[0][i] for i in photos), reference, settings, time_limit_s=120.0)


def silent(stage: str, done: int, total: int) -> None:
    del stage, done, total


def running() -> list[int]:
    return [process.pid for process in multiprocessing.active_children() if process.pid is not None]


def gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


class Killer:
    """Kills the child at its first sign of life, ``times`` times; keeps what it was told."""

    def __init__(self, times: int) -> None:
        self.left, self.killed = times, list[int]()
        self.stages: list[str] = []

    def __call__(self, stage: str, done: int, total: int) -> None:
        del done, total
        self.stages.append(stage)
        if stage == "reading photos" and self.left:
            self.left -= 1
            (pid,) = running()
            self.killed.append(pid)
            os.kill(pid, signal.SIGKILL)


def test_child_that_is_killed_is_started_again(site: Site) -> None:
    killer = Killer(1)
    outcome = run_job(job_of(site, reference=Lens(site[1].camera)), killer)
    assert len(killer.killed) == 1
    assert killer.stages.count("starting again") == 1
    assert "self-calibration" in killer.stages
    assert len(outcome.solution.photos) == len(FEW)
    assert outcome.dome.amplitude_m is not None
    assert outcome.network.convergent == 1
    # Four photos of 640 px: f to a few percent, and the sigma says so.
    error = abs(outcome.estimate.brown.f_px - site[1].camera.f_px)
    assert error < 4 * outcome.estimate.sigma_f_px < 100
    assert running() == []


def test_child_that_dies_twice_is_reported(site: Site) -> None:
    killer = Killer(5)
    with pytest.raises(AlignmentError, match=r"died 2 times.*short of memory"):
        run_job(job_of(site), killer)
    assert len(killer.killed) == 2
    assert all(gone(pid) for pid in killer.killed)


def test_error_of_the_child_is_the_parents(site: Site) -> None:
    with pytest.raises(AlignmentError, match=r"^Only 2 readable photos: a calibration needs at least three"):
        run_job(job_of(site, (0, 1)), silent)
    assert running() == []


def test_defect_of_the_child_is_told_with_its_trace(site: Site) -> None:
    job = job_of(site)
    broken = replace(job, settings=replace(job.settings, workers=0))
    with pytest.raises(RuntimeError, match=r"(?s)^ValueError in the alignment process:.*Traceback"):
        run_job(broken, silent)


def test_time_limit(site: Site) -> None:
    job = replace(job_of(site), time_limit_s=0.5)
    with pytest.raises(AlignmentError, match="did not finish within"):
        run_job(job, silent)
    assert running() == []


@pytest.mark.parametrize("limit_mb", [150, 500])
def test_memory_limit(site: Site, limit_mb: int) -> None:
    job = replace(job_of(site), memory_limit_bytes=limit_mb * 1_000_000)
    with pytest.raises(AlignmentError, match="short of memory"):
        run_job(job, silent)


def test_interrupt_leaves_no_process_behind(site: Site) -> None:
    pids: list[int] = []

    def interrupt(stage: str, done: int, total: int) -> None:
        del stage, done, total
        pids.extend(running())
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_job(job_of(site), interrupt)
    assert len(pids) == 1
    assert gone(pids[0])
    assert running() == []
    # Ctrl-C works again afterwards.
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])


def test_environment_is_left_as_it_was(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    with pytest.raises(AlignmentError):
        run_job(job_of(site, (0,)), silent)
    assert os.environ["OPENBLAS_NUM_THREADS"] == "7"
    assert "MKL_NUM_THREADS" not in os.environ


def test_work_in_this_process_names_unreadable_photos(site: Site, tmp_path: Path) -> None:
    damaged = tmp_path / "DJI_0099.JPG"
    damaged.write_bytes(site[0][2].path.read_bytes()[:200])
    job = job_of(site)
    photos = (*job.photos, replace(site[0][2], path=damaged))
    outcome = child.work(replace(job, photos=photos), silent)
    assert [left.path for left in outcome.solution.left_out] == [damaged]
    assert outcome.solution.photos_used == 5
    assert len(outcome.solution.photos) == 4
    assert np.isfinite(outcome.dome.sigma_m)

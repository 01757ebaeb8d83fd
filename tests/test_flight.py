"""When a flight reads, tries and concludes, and what it tells meanwhile; the alignment scripted."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from calib.align.stream import Finished, Happening, Read, Request, Restarted, Solve
from calib.errors import AlignmentError
from daemon import flight as flight_module
from daemon.flight import FIRST, Flight, Options
from daemon.live.schemas import Capture, Log, Message, Status
from daemon.session.store import Session


class Scripted:
    """In the place of the child: finishes everything at the next poll, solutions with an error."""

    def __init__(self) -> None:
        self.requests: list[Request] = []
        self.now: Request | None = None
        self.ahead: list[Happening] = []
        self.error: Exception = AlignmentError("Too few overlap.")

    @property
    def busy(self) -> bool:
        return self.now is not None

    def submit(self, request: Request) -> None:
        assert self.now is None
        self.now = request
        self.requests.append(request)

    def call_off(self) -> None:
        pass

    def poll(self, timeout_s: float = 0.0) -> Happening | None:
        del timeout_s
        if self.ahead:
            return self.ahead.pop(0)
        request, self.now = self.now, None
        if request is None:
            return None
        return Finished(request, error=self.error if isinstance(request, Solve) else None)


class Scene:
    def __init__(self, folder: Path, session: Session, **options: object) -> None:
        self.now = 0.0
        self.told: list[Message] = []
        self.solver = Scripted()
        self.folder = folder
        given = Options("v", folder, **options)  # type: ignore[arg-type]
        self.flight = Flight(session, given, self.solver, self.told.append, lambda: self.now)  # type: ignore[arg-type]

    def run(self, steps: int) -> None:
        for _ in range(steps):
            self.now += 1.0
            self.flight.step()

    def photos(self, *numbers: int) -> None:
        for n in numbers:
            self.folder.mkdir(exist_ok=True)
            noise = np.random.default_rng(n).integers(0, 255, (48, 64, 3), dtype=np.uint8)
            content = io.BytesIO()
            Image.fromarray(noise).save(content, "JPEG")
            (self.folder / f"P_{n:04d}.JPG").write_bytes(content.getvalue())

    def said(self) -> list[str]:
        return [m.text for m in self.told if isinstance(m, Log)]


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flight_module.time, "sleep", lambda _: None)


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[Callable[..., Scene]]:
    with Session.create(tmp_path / "record") as session:
        yield lambda **options: Scene(tmp_path / "card", session, **options)


def test_photos_are_recorded_and_read_before_a_solution_is_tried(scene: Callable[..., Scene]) -> None:
    here = scene()
    here.photos(1, 2, 3)
    here.run(4)
    assert all(isinstance(r, Read) for r in here.solver.requests)
    here.photos(*range(4, FIRST + 1))
    here.run(8)
    *reads, solve = here.solver.requests
    assert sum(len(r.photos) for r in reads if isinstance(r, Read)) == FIRST
    assert isinstance(solve, Solve)
    assert not solve.final
    assert len(solve.photos) == FIRST
    assert "Not yet: Too few overlap." in here.said()
    here.run(5)
    assert here.solver.requests[-1] is solve  # Not again before more photos have come.
    states = [m.phase for m in here.told if isinstance(m, Status)]
    assert states[0] == "waiting"
    assert states[-1] == "collecting"
    captures = [m for m in here.told if isinstance(m, Capture)]
    assert captures[-1].photos == FIRST


def test_a_defect_of_the_child_is_no_news_for_the_pilot(scene: Callable[..., Scene]) -> None:
    here = scene()
    here.solver.error = RuntimeError("ValueError in the alignment process")
    here.photos(*range(FIRST))
    with pytest.raises(RuntimeError):
        here.run(12)


def test_it_is_over_when_told_when_enough_or_when_nothing_comes(
    scene: Callable[..., Scene], tmp_path: Path
) -> None:
    here = scene(idle_s=30.0, count=3)
    here.run(100)
    assert not here.flight.over  # Nothing has come at all: it waits.
    here.photos(1, 2)
    here.run(10)
    assert not here.flight.over
    here.photos(3)
    here.run(3)
    assert here.flight.over
    with Session.create(tmp_path / "other") as session:
        there = Scene(tmp_path / "card", session, idle_s=30.0)
        there.run(20)
        assert not there.flight.over
        there.run(20)
        assert there.flight.over
    with Session.create(tmp_path / "third") as session:
        told = Scene(tmp_path / "card", session, idle_s=0)
        told.run(50)
        assert not told.flight.over
        told.flight.finish()
        assert told.flight.over


def test_a_pulled_card_is_said_once_and_ends_nothing(scene: Callable[..., Scene], tmp_path: Path) -> None:
    here = scene(idle_s=10.0)
    here.photos(1)
    here.run(3)
    here.folder.rename(tmp_path / "away")
    here.run(60)
    assert not here.flight.over
    assert [text for text in here.said() if "put the card back" in text] == here.said()[-1:]
    degraded = [m.degraded for m in here.told if isinstance(m, Status)][-1]
    assert "put the card back" in degraded[0]
    (tmp_path / "away").rename(here.folder)
    here.run(2)
    assert here.said()[-1] == "The folder is there again."
    assert [m.degraded for m in here.told if isinstance(m, Status)][-1] == []


def test_a_restart_of_the_child_is_told_and_forgotten(scene: Callable[..., Scene]) -> None:
    here = scene()
    here.photos(1)
    here.run(1)
    here.solver.ahead.append(Restarted(1))
    here.run(1)
    assert any("died" in text for text in here.said())
    here.run(3)
    assert [m.degraded for m in here.told if isinstance(m, Status)][-1] == []


def test_what_was_recorded_is_there_the_second_time(scene: Callable[..., Scene], tmp_path: Path) -> None:
    here = scene()
    here.photos(1, 2, 3)
    here.run(4)
    with pytest.raises(AlignmentError):
        here.flight.conclude()
    record = tmp_path / "again"
    with Session.create(record) as session:
        for _ in range(2):  # The second run takes the same files up again: they are recorded once.
            there = Scene(tmp_path / "card", session)
            there.run(4)
            assert session.counts().photos == 3
        assert "3 photos are recorded already." in there.said()
        (tmp_path / "card" / "P_0001.JPG").rename(tmp_path / "P_0001.JPG")
        there.photos(4)
        with pytest.raises(AlignmentError):
            there.flight.conclude()
        assert any("P_0001.JPG" in text and "not in" in text for text in there.said())


@pytest.mark.parametrize("inside", [False, True])
def test_only_photos_that_are_gone_are_missed(tmp_path: Path, inside: bool) -> None:
    """Also where we bring the photos ourselves, into the flight's own folder."""
    with Session.create(tmp_path / "record") as session:
        here = Scene((session.folder if inside else tmp_path) / "photos", session)
        here.photos(*range(1, FIRST + 2))
        here.run(8)
        with pytest.raises(AlignmentError):
            here.flight.conclude()
        assert not any("recorded earlier" in text for text in here.said())
        (here.folder / "P_0003.JPG").unlink()
        with pytest.raises(AlignmentError):
            here.flight.conclude()
        assert any("1 of the photos recorded earlier" in text and "P_0003" in text for text in here.said())


def test_an_extra_pass_is_waited_for_until_its_photos_come(scene: Callable[..., Scene]) -> None:
    here = scene(idle_s=30.0, count=2)
    here.photos(1, 2)
    here.run(3)
    assert here.flight.over
    here.flight.go_on(2)
    here.run(100)
    assert not here.flight.over
    here.photos(3)
    here.run(10)
    assert not here.flight.over
    here.photos(4)
    here.run(3)
    assert here.flight.over

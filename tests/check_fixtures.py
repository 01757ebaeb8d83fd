"""Fixtures of the command's tests: rendered surveys, a card, a place to work in (a pytest plugin)."""

from __future__ import annotations

from pathlib import Path

import pytest
from check_process import OPTIONS, Survey

from sim.survey import write_survey


def _rendered(factory: pytest.TempPathFactory, seed: int, size: tuple[int, int]) -> Survey:
    folder = factory.mktemp(f"survey-{seed}-{size[0]}")
    return Survey(folder, write_survey("demo", folder, seed, size=size, options=OPTIONS, workers=1))


@pytest.fixture(scope="session")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Survey:
    """12 nadir and 8 convergent photos of 1000 x 750 px."""
    return _rendered(tmp_path_factory, 1, (1000, 750))


@pytest.fixture(scope="session")
def second_survey(tmp_path_factory: pytest.TempPathFactory) -> Survey:
    """The same camera on another flight over other ground."""
    return _rendered(tmp_path_factory, 2, (1000, 750))


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Survey:
    """The same flight in 400 x 300 px: four of its nadir photos are aligned in a few seconds."""
    return _rendered(tmp_path_factory, 1, (400, 300))


@pytest.fixture
def card(small: Survey, tmp_path: Path) -> Path:
    """A folder of its own with four good photos."""
    folder = tmp_path / "card"
    folder.mkdir()
    for path in small.nadir[:4]:
        (folder / path.name).write_bytes(path.read_bytes())
    return folder


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """Where the command is run; nothing is to be left there by a check that fails."""
    folder = tmp_path / "home"
    folder.mkdir()
    return folder

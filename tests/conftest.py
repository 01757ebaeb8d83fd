"""Set-up of all tests."""

from __future__ import annotations

import os

# Blocks of this size gain nothing from threads in BLAS, and processes running side by side lose a lot.
# It has to be said before numpy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
# pymavlink reads it on its first import and again later: said by one test's helper alone, the two differ.
os.environ.setdefault("MAVLINK20", "1")

import signal
from pathlib import Path

import pytest

from calib.photos.photo import Photo
from calib.photos.read import read_photo
from sim.survey import SurveyTruth, write_survey

# What a shell starts in the background ignores Ctrl-C, and so would the programs that tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

#: Files that take longest, longest first: workers that get these last leave the others idle.
LONGEST = (
    "test_demo",
    "test_check_real",
    "test_check_cli",
    "test_run_cli",
    "test_run_link",
    "test_align_stream",
    "test_refly_flown",
    "test_check_bad_input",
    "test_assess_cloud",
    "test_service",
    "test_held",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Whole files in the order of :data:`LONGEST`, the others after them as they come."""
    items.sort(key=lambda i: LONGEST.index(i.path.stem) if i.path.stem in LONGEST else len(LONGEST))


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real photo sets (environment variable FIELDCAL_DATA); skips where there is none."""
    folder = os.environ.get("FIELDCAL_DATA")
    if not folder:
        pytest.skip("FIELDCAL_DATA is not set: no real photo sets here")
    return Path(folder)


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> tuple[tuple[Photo, ...], SurveyTruth]:
    """Twelve nadir and eight convergent photos of 640 x 480 px, rendered once, in the order of truth."""
    folder = tmp_path_factory.mktemp("site")
    truth = write_survey("demo", folder, 3, size=(640, 480), workers=1)
    return tuple(read_photo(folder / name) for name in truth.photos), truth

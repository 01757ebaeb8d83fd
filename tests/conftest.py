"""Set-up of all tests."""

from __future__ import annotations

import os

# Blocks of this size gain nothing from threads in BLAS, and processes running side by side lose a lot.
# It has to be said before numpy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real photo sets (environment variable FIELDCAL_DATA); skips where there is none."""
    folder = os.environ.get("FIELDCAL_DATA")
    if not folder:
        pytest.skip("FIELDCAL_DATA is not set: no real photo sets here")
    return Path(folder)

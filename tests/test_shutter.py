"""Which cameras are known to have no rolling shutter."""

from __future__ import annotations

import pytest

from calib.photos.photo import CameraIdentity
from calib.shutter import shows_no_readout


@pytest.mark.parametrize(
    ("make", "model", "known"),
    [
        ("DJI", "FC6310", True),
        ("DJI", "FC6310R", True),
        ("DJI", "FC6360", True),
        ("DJI", "M3E", True),
        ("DJI", "ZenmuseP1", True),
        ("Canon", "Canon PowerShot S110", True),
        ("NIKON CORPORATION", "NIKON D5200", True),
        ("SONY", "ILCE-6000", True),
        ("DJI", "FC300X", False),
        ("DJI", "FC350", False),
        ("DJI", "FC63", False),
        ("DJI", "FC3170", False),
        ("DJI", "M3T", False),
        ("Hasselblad", "L1D-20c", False),
        ("GoPro", "HERO9 Black", False),
        ("Parrot", "Anafi", False),
        ("", "", False),
    ],
)
def test_mechanical_shutters_are_known(make: str, model: str, known: bool) -> None:
    camera = CameraIdentity(make, model, None, 4000, 3000)
    assert shows_no_readout(camera.name) == known
    assert shows_no_readout(f" {camera.name} ") == known

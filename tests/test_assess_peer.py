"""Beside CloudCompare on the same files, where it is installed."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.assess import cloudcompare, compare


@pytest.mark.skipif(cloudcompare() is None, reason="CloudCompare is not installed")
def test_registration_and_distances_agree_within_a_millimetre(tmp_path: Path) -> None:
    command = cloudcompare()
    assert command is not None
    peer = compare(command, tmp_path)
    assert peer.registration_m < 0.001
    assert peer.distance_m < 0.001
    assert abs(peer.mean_m[0] - peer.mean_m[1]) < 0.001
    assert abs(peer.std_m[0] - peer.std_m[1]) < 0.001
    # And both found something: the cloud was made with 5 cm of noise.
    assert 0.045 < peer.std_m[1] < 0.055

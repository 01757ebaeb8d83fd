"""How the photos look at the ground."""

from __future__ import annotations

import numpy as np
import pytest
from align_blocks import small

from calib.align.network import height_levels, measure_network
from calib.camera import FloatArray
from calib.solution import Network
from sim.network import SimBlock


def network_of(block: SimBlock) -> Network:
    return measure_network(
        block.rotations_cam_from_world,
        block.centres_m,
        block.points_m,
        block.observations,
        block.lens.brown.f_px,
    )


@pytest.mark.parametrize(
    ("name", "nadir", "convergent", "heights"),
    [("A1", 32, 0, [60]), ("A3", 32, 8, [60]), ("A4", 50, 8, [60, 80]), ("orbit", 0, 36, [60])],
)
def test_flights_are_recognised(name: str, nadir: int, convergent: int, heights: list[float]) -> None:
    network = network_of(small(name, 1, 300))
    assert (network.nadir, network.convergent) == (nadir, convergent)
    assert network.convergent_share == pytest.approx(convergent / (nadir + convergent))
    assert network.heights_agl_m == pytest.approx(heights, abs=3)
    assert len(network.tilt_deg) == len(network.height_agl_m) == nadir + convergent
    assert 60 / 2320 * 0.9 < network.gsd_m < 60 / 2320 * 2


def test_gently_oblique_flights_are_not_convergent() -> None:
    network = network_of(small("crosshatch", 1, 300, attitude_jitter_deg=0.5))
    assert network.convergent == 0
    assert np.median(network.tilt_deg) == pytest.approx(15, abs=1)


@pytest.mark.parametrize(
    ("heights", "levels"),
    [
        ([60.0, 61.0, 59.5], (60.0,)),
        ([60.0] * 10 + [80.0] * 10, (60.0, 80.0)),
        ([60.0] * 30 + [5.0], (60.0,)),
        ([40.0], (40.0,)),
    ],
)
def test_levels(heights: list[float], levels: tuple[float, ...]) -> None:
    values: FloatArray = np.array(heights)
    assert height_levels(values) == levels

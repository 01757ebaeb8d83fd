"""Several flights over one ground: the first is the same whether others follow or not."""

from __future__ import annotations

import numpy as np
import pytest

from calib.network_views import EVERY_VIEW, SIMULATED
from sim.flights import convergent, grid, jittered, phantom3
from sim.network import SimBlock, SimOptions
from sim.together import observe_together

OPTIONS = SimOptions(n_points=400, site_m=90.0, mismatch_rate=0.02, correlated_px=0.2)
SURVEY = jittered(grid(3, 4, 60.0, 90.0), 3, 1.0, 0.5, 1.5)
PASS = jittered(convergent(5, 35.0, 60.0), 4, 2.0, 2.0, 2.0)


def _views(block: SimBlock, photos: int) -> dict[tuple[int, float, float], tuple[float, float]]:
    """Pixels by photo and place of the point."""
    obs = block.observations
    places = np.round(block.points_m[obs.point], 6)
    return {
        (int(p), float(at[0]), float(at[1])): (float(px[0]), float(px[1]))
        for p, at, px in zip(obs.photo, places, obs.pixels, strict=True)
        if p < photos
    }


def test_a_later_flight_changes_nothing_in_the_first() -> None:
    alone = observe_together("a", [(0, SURVEY)], phantom3(), 3, OPTIONS, SIMULATED)
    both = observe_together("a", [(0, SURVEY), (1, PASS)], phantom3(), 3, OPTIONS, SIMULATED)
    k = len(SURVEY)
    assert np.array_equal(alone.gps_m, both.gps_m[:k])
    assert np.allclose(alone.gimbal_cam_from_world, both.gimbal_cam_from_world[:k], atol=1e-15)
    before, after = _views(alone, k), _views(both, k)
    assert before.items() <= after.items()
    # Some points that one photo alone saw are seen by the pass, too.
    assert len(before) < len(after) < 1.3 * len(before)
    other = observe_together("a", [(0, SURVEY), (2, PASS)], phantom3(), 3, OPTIONS, SIMULATED)
    assert not np.array_equal(other.gps_m[k:], both.gps_m[k:])


def test_views_from_aside_are_matched_less_often() -> None:
    every = observe_together("a", [(0, SURVEY), (1, PASS)], phantom3(), 3, OPTIONS, EVERY_VIEW)
    some = observe_together("a", [(0, SURVEY), (1, PASS)], phantom3(), 3, OPTIONS, SIMULATED)
    k = len(SURVEY)
    share = [np.sum(b.observations.photo >= k) for b in (some, every)]
    assert 0.4 < share[0] / share[1] < 0.95
    seen = every.true_pixels() - every.observations.pixels
    good = ~every.mismatched
    # 0.5 px and 0.2 px of correlated noise.
    assert np.sqrt(np.mean(seen[good] ** 2)) == pytest.approx(np.hypot(0.5, 0.2), rel=0.08)
    assert 0.01 < every.mismatched.mean() < 0.03

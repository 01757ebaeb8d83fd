"""Blocks from tracks alone, without a word about positions or angles."""

from __future__ import annotations

import numpy as np
import pytest
from align_blocks import small
from align_tracks_sim import nominal_lens, pairs_of, placed

from calib.align.features import Features
from calib.align.grow import Partial, build_block, lens_mask, resume_block
from calib.align.matching import PairMatches
from calib.align.tracks import build_tracks, select, thin
from calib.camera import FloatArray
from calib.solution import Observations
from sim.network import SimBlock


def block_of(block: SimBlock, seed: int = 0) -> Partial:
    photos = len(block.centres_m)
    found = build_block(block.observations, pairs_of(block), nominal_lens(block), photos, seed)
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("name", "options", "most_m", "most_deg", "f_share"),
    [
        # Straight down over flat ground f is known to a few percent at most.
        ("nadir_one_height", {"relief_m": 0.0}, 1.0, 1.0, 0.1),
        ("orbit", {"relief_m": 0.0}, 0.2, 0.2, 0.005),
        ("demo", {}, 0.3, 0.3, 0.005),
        ("demo", {"mismatch_rate": 0.05}, 0.4, 0.4, 0.005),
    ],
    ids=["nadir over flat ground", "oblique over flat ground", "mixed", "with mismatches"],
)
def test_all_photos_find_their_place(
    name: str, options: dict[str, float], most_m: float, most_deg: float, f_share: float
) -> None:
    block = small(name, 1, 300, **options)
    found = block_of(block)
    assert found.registered.all()
    _, away, angle = placed(block, found)
    assert away.max() < most_m
    assert angle.max() < most_deg
    assert abs(found.lens.brown.f_px / block.lens.brown.f_px - 1) < f_share
    assert np.isfinite(found.points[:, 0]).mean() > 0.97
    # The corners of the image too: nothing there is taken for a blunder because the lens bends it.
    corner = np.linalg.norm(block.observations.pixels - [2000, 1500], axis=1) > 2050
    assert corner.sum() > 30
    for part in (corner, ~corner):
        assert found.active[part & ~block.mismatched].mean() > 0.97
    if block.mismatched.any():
        off = np.linalg.norm(block.observations.pixels - block.true_pixels(), axis=1)
        gross = off > 25
        assert gross.sum() > 40
        assert found.active[gross].mean() < 0.2


def test_same_tracks_same_block() -> None:
    block = small("demo", 3, 200)
    first, second = block_of(block), block_of(block)
    assert first.lens.brown == second.lens.brown
    assert np.array_equal(first.centres, second.centres)
    assert np.array_equal(first.active, second.active)


def without(block: SimBlock, photos: int) -> tuple[Observations, FloatArray]:
    """Observations of the first ``photos`` photos, renumbered, and the points that are left."""
    sub, old = select(block.observations, block.observations.photo < photos)
    return sub, block.points_m[old]


def test_going_on_gives_what_starting_over_gives() -> None:
    block = small("demo", 2, 300)
    early, _ = without(block, 14)
    pairs = [p for p in pairs_of(block) if p.b < 14]
    first = build_block(early, pairs, nominal_lens(block), 14, 0)
    assert first is not None
    assert first.registered.sum() == 14
    on = resume_block(block.observations, first, 20, 0)
    assert on is not None
    assert on.registered.all()
    _, away, angle = placed(block, on)
    assert away.max() < 0.3
    assert angle.max() < 0.3
    fresh = block_of(block)
    assert abs(on.lens.brown.f_px / fresh.lens.brown.f_px - 1) < 0.001


def test_going_on_from_another_block_is_refused() -> None:
    block = small("demo", 2, 300)
    early, _ = without(block, 14)
    first = build_block(early, [p for p in pairs_of(block) if p.b < 14], nominal_lens(block), 14, 0)
    assert first is not None
    shuffled = np.random.default_rng(0).permutation(14)
    wrong = Partial(
        first.lens,
        first.registered,
        first.rotations[shuffled],
        first.centres[shuffled],
        first.points,
        first.active,
    )
    assert resume_block(block.observations, wrong, 20, 0) is None


def test_photos_that_fit_nowhere_are_left_out() -> None:
    """Two photos with tracks to the others, all of them wrong."""
    block = small("demo", 4, 300)
    seen = block.observations
    pixels = seen.pixels.copy()
    rng = np.random.default_rng(0)
    for photo in (3, 15):
        mine = np.flatnonzero(seen.photo == photo)
        pixels[mine] = pixels[rng.permutation(mine)]
    wrong = Observations(seen.photo, seen.point, pixels, seen.sigma_px)
    found = build_block(wrong, pairs_of(block), nominal_lens(block), 20, 0)
    assert found is not None
    assert np.array_equal(np.flatnonzero(~found.registered), [3, 15])
    assert placed(block, found)[1].max() < 1.5


def test_nothing_to_start_from() -> None:
    block = small("demo", 4, 100)
    rng = np.random.default_rng(0)
    noise = Observations(
        block.observations.photo,
        block.observations.point,
        rng.uniform([0, 0], [4000, 3000], block.observations.pixels.shape),
        block.observations.sigma_px,
    )
    found = build_block(noise, pairs_of(block), nominal_lens(block), 20, 0)
    assert found is None or found.registered.sum() < 5
    assert build_block(noise, [], nominal_lens(block), 20, 0) is None


def test_names_choose_parameters() -> None:
    assert lens_mask("f k1").sum() == 2
    assert lens_mask("f k1")[[0, 3]].all()
    assert not lens_mask("").any()


# -- tracks ----------------------------------------------------------------------------------------


def features_at(count: int, shift: float) -> Features:
    pixels = np.arange(2.0 * count).reshape(count, 2) + shift
    return Features(pixels, np.ones(count), np.zeros((count, 128), np.float32), np.arange(count))


def matches(a: int, b: int, *indices: tuple[int, int]) -> PairMatches:
    return PairMatches(a, b, np.array(indices, int).reshape(-1, 2), 100.0)


def test_matches_join_to_tracks() -> None:
    features = [features_at(5, 100.0 * i) for i in range(3)]
    pairs = [matches(0, 1, (0, 1), (2, 2)), matches(1, 2, (1, 3)), matches(0, 2, (4, 4))]
    obs = build_tracks(features, pairs, 0.7)
    assert obs.point.tolist() == [0, 0, 0, 1, 1, 2, 2]
    assert obs.photo.tolist() == [0, 1, 2, 0, 1, 0, 2]
    assert np.array_equal(
        obs.pixels[:3], [features[0].pixels[0], features[1].pixels[1], features[2].pixels[3]]
    )
    assert np.array_equal(obs.sigma_px, np.full(7, 0.7))


def test_contradicting_tracks_are_dropped_whole() -> None:
    features = [features_at(5, 0.0) for _ in range(3)]
    pairs = [matches(0, 1, (0, 0), (3, 3)), matches(1, 2, (0, 0)), matches(0, 2, (1, 0))]
    obs = build_tracks(features, pairs, 1.0)
    assert obs.photo.tolist() == [0, 1]
    assert np.array_equal(obs.pixels[0], features[0].pixels[3])


def test_no_matches_no_tracks() -> None:
    assert len(build_tracks([features_at(5, 0.0)] * 2, [], 1.0)) == 0


def test_selection_renumbers_and_drops_single_views() -> None:
    obs = Observations(
        np.array([0, 1, 0, 1, 2, 1, 2]),
        np.array([0, 0, 1, 1, 1, 2, 2]),
        np.arange(14.0).reshape(7, 2),
        np.ones(7),
    )
    sub, old = select(obs, np.array([1, 0, 1, 1, 0, 1, 1], bool))
    assert old.tolist() == [1, 2]
    assert sub.point.tolist() == [0, 0, 1, 1]
    assert sub.photo.tolist() == [0, 1, 1, 2]
    assert np.array_equal(sub.pixels, obs.pixels[[2, 3, 5, 6]])


def test_thinning_keeps_long_tracks_in_all_parts() -> None:
    block = small("demo", 1, 1500)
    seen = block.observations
    chosen = thin(seen, 20, 6, 3)
    length = np.bincount(seen.point)
    assert 0.1 < chosen.mean() < 0.7
    assert length[chosen].mean() > length.mean()
    sub, _ = select(seen, chosen[seen.point])
    size = np.array([4001, 3001])
    cells = [
        np.unique((o.pixels[o.photo == p] * 6 / size).astype(int), axis=0).shape[0]
        for o in (seen, sub)
        for p in range(20)
    ]
    # No cell that had points has lost them all.
    assert cells[20:] == cells[:20]
    assert thin(seen, 20, 6, 10_000).all()

"""Features, matches, tracks and refinement on rendered photos, against exact truth."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from align_scene import Scene, features_of
from scipy.spatial import cKDTree

from calib.align.features import COARSE_FEATURES, MAX_FEATURES, decode_gray, extract
from calib.align.matching import PairMatches, match_descriptors, match_pair
from calib.align.refine import refine, surface_normals
from calib.align.tracks import build_tracks, select
from calib.camera import FloatArray
from calib.errors import PhotoError
from calib.field import Lens
from calib.photos.photo import Photo
from calib.solution import IntArray, Observations
from sim.flights import phantom3, rotation_looking
from sim.render import lens_rays, render
from sim.survey import SurveyTruth
from sim.world import make_world

Site = tuple[tuple[Photo, ...], SurveyTruth]
SIDE = 640
#: Nadir north and south, and oblique from three sides.
CHOSEN = (0, 1, 5, 6, 7, 12, 15, 18)


def nearest(among: FloatArray, to: FloatArray) -> tuple[FloatArray, IntArray]:
    distance, index = cKDTree(among).query(to)
    return np.asarray(distance, float), np.asarray(index, np.intp)


# -- features --------------------------------------------------------------------------------------


def test_features_stay_in_place_when_the_image_is_turned(site: Site) -> None:
    gray, factor = decode_gray(site[0][1].path, None)
    assert factor == 1.0
    first = extract(gray, factor)
    second = extract(np.ascontiguousarray(gray[::-1, ::-1]), factor)
    back = [gray.shape[1], gray.shape[0]] - second.pixels
    distance, index = nearest(back, first.pixels)
    near = distance < 0.5
    assert near.mean() > 0.7
    # A quarter of a pixel is what OpenCV's plain upscaling costs.
    off = (back[index] - first.pixels)[near].mean(axis=0)
    assert np.abs(off).max() < 0.02


def test_features_of_reduced_images_are_in_full_pixels(site: Site) -> None:
    full = features_of(site[0][1])
    gray, factor = decode_gray(site[0][1].path, 400)
    assert gray.shape == (300, 400)
    assert factor == pytest.approx(400 / 640)
    half = extract(gray, factor)
    distance, index = nearest(full.pixels, half.pixels)
    near = distance < 1.0
    assert near.mean() > 0.5
    assert np.abs((full.pixels[index] - half.pixels)[near].mean(axis=0)).max() < 0.08


def test_features_are_spread_and_bounded(site: Site) -> None:
    features = features_of(site[0][1])
    assert 1000 < len(features) <= MAX_FEATURES
    assert len(features.coarse) <= COARSE_FEATURES
    assert np.allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=1e-5)
    assert ((features.pixels > 0) & (features.pixels < [640, 480])).all()
    cell = (features.pixels[features.coarse] / [640, 480] * 4).astype(int)
    assert np.bincount(cell[:, 1] * 4 + cell[:, 0], minlength=16).min() > 10


def test_dull_and_empty_images() -> None:
    assert len(extract(np.full((300, 400), 90, np.uint8), 1.0)) == 0
    gray = np.random.default_rng(0).normal(120, 12, (75, 100)).astype(np.float32)
    soft = cv2.GaussianBlur(cv2.resize(gray, (400, 300), interpolation=cv2.INTER_CUBIC), (0, 0), 2)
    dull = (120 + (soft - soft.mean()) / soft.std() * 6).astype(np.uint8)  # a grey haze
    assert np.ptp(np.percentile(dull, [1, 99])) < 60
    assert len(extract(dull, 1.0)) > 150


def test_undecodable_files_are_named(tmp_path: Path) -> None:
    bad = tmp_path / "IMG_1.JPG"
    bad.write_bytes(b"\xff\xd8\xff\xe0 no image")
    with pytest.raises(PhotoError, match=r"IMG_1\.JPG"):
        decode_gray(bad, None)
    bad.write_bytes(b"")
    with pytest.raises(PhotoError, match=r"IMG_1\.JPG"):
        decode_gray(bad, None)
    with pytest.raises(PhotoError, match=r"gone\.JPG"):
        decode_gray(tmp_path / "gone.JPG", None)


# -- matches ---------------------------------------------------------------------------------------


def match(site: Site, a: int, b: int) -> PairMatches | None:
    photos = site[0]
    return match_pair(a, b, features_of(photos[a]), features_of(photos[b]), SIDE, 0)


def miss_px(site: Site, pair: PairMatches) -> FloatArray:
    """Distance of every match in photo b from where the truth puts it."""
    scene, photos = Scene(site[1]), site[0]
    first = features_of(photos[pair.a]).pixels[pair.indices[:, 0]]
    second = features_of(photos[pair.b]).pixels[pair.indices[:, 1]]
    n = len(first)
    seen = scene.seen_px(np.full(n, pair.b), scene.ground_m(np.full(n, pair.a), first))
    distance: FloatArray = np.linalg.norm(seen - second, axis=1)
    return distance


@pytest.mark.parametrize(
    ("a", "b", "least"),
    [(0, 1, 300), (1, 5, 150), (1, 6, 150), (5, 12, 80), (12, 15, 80), (12, 18, 40)],
    ids=["in line", "upside down", "upside down 2", "nadir-oblique", "oblique", "oblique across"],
)
def test_matches_are_right(site: Site, a: int, b: int, least: int) -> None:
    pair = match(site, a, b)
    assert pair is not None
    assert len(pair.indices) > least
    miss = miss_px(site, pair)
    assert np.median(miss) < 0.6
    assert (miss < 4).mean() > 0.94
    assert len(np.unique(pair.indices[:, 0])) == len(np.unique(pair.indices[:, 1])) == len(pair.indices)
    assert pair.shift_px > 30


def test_image_turned_upside_down_is_matched(site: Site) -> None:
    gray, _ = decode_gray(site[0][1].path, None)
    turned = extract(np.ascontiguousarray(gray[::-1, ::-1]), 1.0)
    other = features_of(site[0][2])
    pair = match_pair(0, 1, turned, other, SIDE, 0)
    upright = match(site, 1, 2)
    assert pair is not None
    assert upright is not None
    assert 0.8 < len(pair.indices) / len(upright.indices) < 1.25


def test_photos_of_other_ground_do_not_match(site: Site) -> None:
    """Same kind of fields, other place: 3 x 8 pairs, none accepted."""
    camera = phantom3(640, 480)
    world = make_world(77, half_m=70.0, texel_m=0.16)
    rays = lens_rays(Lens(camera))
    turns = rotation_looking(np.array([0.0, 90.0, 180.0]), np.array([0.0, 5.0, 40.0]))
    places = np.array([[0.0, 0.0, 60.0], [-25.0, 10.0, 60.0], [0.0, 40.0, 60.0]])
    for index, (rotation, centre) in enumerate(zip(turns, places, strict=True)):
        image = render(world, rays, rotation, centre, seed=index)
        strange = extract(np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8), 1.0)
        assert len(strange) > 1000
        for photo in CHOSEN:
            assert match_pair(photo, 20, features_of(site[0][photo]), strange, SIDE, 0) is None


def test_photos_that_share_no_ground_do_not_match(site: Site) -> None:
    scene = Scene(site[1])
    nadir = range(12)
    apart = [(a, b) for a in nadir for b in nadir if a < b and scene.overlap(a, b) + scene.overlap(b, a) == 0]
    assert len(apart) >= 3
    assert all(match(site, a, b) is None for a, b in apart)


def test_matching_repeats_itself(site: Site) -> None:
    first, second = match(site, 5, 6), match(site, 5, 6)
    assert first is not None
    assert second is not None
    assert np.array_equal(first.indices, second.indices)


def test_descriptors_match_mutually_and_distinctly() -> None:
    rng = np.random.default_rng(0)
    base = rng.normal(size=(40, 128))
    base /= np.linalg.norm(base, axis=1, keepdims=True)
    order = rng.permutation(40)
    noisy = base[order] + rng.normal(0, 0.02, (40, 128))
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    found = match_descriptors(base.astype(np.float32), noisy.astype(np.float32))
    assert len(found) == 40
    assert np.array_equal(order[found[:, 1]], found[:, 0])
    # Two of a kind cannot be told apart.
    twins = np.concatenate([noisy, noisy]).astype(np.float32)
    assert len(match_descriptors(base.astype(np.float32), twins)) == 0
    assert match_descriptors(base[:1].astype(np.float32), twins).shape == (0, 2)


# -- refinement ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tied(site: Site) -> tuple[Observations, FloatArray]:
    """Tracks of ``CHOSEN`` photos (indices 0..7) from images reduced to 400 px, and their points."""
    photos = [site[0][i] for i in CHOSEN]
    features = [features_of(p, 400) for p in photos]
    pairs = [
        m
        for a in range(len(photos))
        for b in range(a + 1, len(photos))
        if (m := match_pair(a, b, features[a], features[b], SIDE, 0)) is not None
    ]
    obs = build_tracks(features, pairs, 0.8)
    scene, chosen = Scene(site[1]), np.array(CHOSEN)
    head = np.flatnonzero(np.diff(obs.point, prepend=-1))
    points = scene.ground_m(chosen[obs.photo[head]], obs.pixels[head])
    # Blunders are the adjustment's business.
    miss = np.linalg.norm(scene.seen_px(chosen[obs.photo], points[obs.point]) - obs.pixels, axis=1)
    bad = np.bincount(obs.point, miss > 3) > 0
    kept, old = select(obs, ~bad[obs.point])
    return kept, points[old]


def templates(obs: Observations, width: int, height: int) -> IntArray:
    """The observation of each track nearest to its image's centre: the one that stays."""
    away = np.linalg.norm(obs.pixels - [width / 2, height / 2], axis=1)
    order = np.lexsort((away, obs.point))
    chosen: IntArray = order[np.flatnonzero(np.diff(obs.point[order], prepend=-1))]
    return chosen


def test_refined_tie_points_are_where_truth_puts_them(
    site: Site, tied: tuple[Observations, FloatArray]
) -> None:
    photos, truth = site
    obs, points = tied
    chosen = np.array(CHOSEN)
    scene = Scene(truth)
    rotations, centres = truth.rotations_cam_from_world[chosen], truth.centres_m[chosen]
    told: list[int] = []
    refined = refine(
        [photos[i] for i in CHOSEN], scene.lens, rotations, centres, points, obs, tick=told.append
    )
    assert told == list(range(len(CHOSEN)))
    template = templates(obs, 640, 480)
    # Templates stay.
    assert np.array_equal(refined.observations.pixels[template], obs.pixels[template])
    moves = np.ones(len(obs), bool)
    moves[template] = False
    ok = refined.ok & moves
    assert ok.sum() > 0.8 * moves.sum() > 1000
    host = template[obs.point]
    true = scene.seen_px(
        chosen[obs.photo], scene.ground_m(chosen[obs.photo[template]], obs.pixels[template])[obs.point]
    )
    before, after = (obs.pixels - true)[ok], (refined.observations.pixels - true)[ok]

    def rms(error: FloatArray) -> float:
        return float(np.sqrt(np.mean(error**2)))

    assert 0.02 < rms(after) < 0.15
    assert rms(after) < 0.35 * rms(before)
    assert 1.4826 * np.median(np.abs(after)) < 0.06

    north = np.where(np.isin(chosen, (0, 1)), 1, np.where(np.isin(chosen, (5, 6, 7)), -1, 0))
    a, b = north[obs.photo[ok]], north[obs.photo[host[ok]]]
    groups = {
        "opposite headings": a * b == -1,
        "same heading": a * b == 1,
        "nadir and oblique": (a == 0) != (b == 0),
        "oblique": (a == 0) & (b == 0),
    }
    for name, group in groups.items():
        assert group.sum() > 200, name
        assert np.abs(after[group].mean(axis=0)).max() < 0.03, name
        assert np.abs(np.median(after[group], axis=0)).max() < 0.03, name
    # A systematic stretch of the image would be taken for focal length.
    out = (obs.pixels[ok] - [320, 240]) / np.linalg.norm(obs.pixels[ok] - [320, 240], axis=1, keepdims=True)
    assert abs(float(np.mean(np.sum(out * after, axis=1)))) < 0.01


def test_patches_without_a_counterpart_are_refused(site: Site, tied: tuple[Observations, FloatArray]) -> None:
    photos, truth = site
    obs, points = tied
    chosen = np.array(CHOSEN)
    wrong = obs.pixels.copy()
    rng = np.random.default_rng(0)
    template = templates(obs, 640, 480)
    moved = np.setdiff1d(rng.choice(len(obs), 200, replace=False), template)
    wrong[moved] += 25 * np.array([np.cos(3.0 * moved), np.sin(3.0 * moved)]).T
    moved = np.setdiff1d(moved, templates(Observations(obs.photo, obs.point, wrong, obs.sigma_px), 640, 480))
    refined = refine(
        [photos[i] for i in CHOSEN],
        Lens(truth.camera),
        truth.rotations_cam_from_world[chosen],
        truth.centres_m[chosen],
        points,
        Observations(obs.photo, obs.point, wrong, obs.sigma_px),
        memory_bytes=0,
    )
    assert len(moved) > 80
    assert refined.ok[moved].mean() < 0.05


def test_normals_of_a_slope() -> None:
    rng = np.random.default_rng(0)
    ground = rng.uniform(-50, 50, (300, 2))
    points = np.column_stack([ground, 0.2 * ground[:, 0] - 0.1 * ground[:, 1]])
    expected = np.array([-0.2, 0.1, 1.0]) / np.linalg.norm([-0.2, 0.1, 1.0])
    assert np.abs(np.abs(surface_normals(points) @ expected) - 1).max() < 1e-9

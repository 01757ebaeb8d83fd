"""Photos in, a block out: all at once, one by one, with and without geotags."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from align_scene import Scene

from calib.align.candidates import NEIGHBOURS, TRY_ALL, appearance, candidate_pairs, footprint_centres
from calib.align.engine import Aligned, Aligner, Settings
from calib.align.features import Features
from calib.brownfit import fit_brown, turned_rays
from calib.camera import FloatArray
from calib.errors import AlignmentError
from calib.frames import LocalFrame, gimbal_from_rotation
from calib.photos.photo import CameraIdentity, Photo, Position
from calib.similarity import fit_similarity
from sim.flights import Flight, convergent, grid
from sim.survey import SurveyTruth

Site = tuple[tuple[Photo, ...], SurveyTruth]
CHOSEN = (0, 1, 5, 6, 9, 12, 15, 18)
SETTINGS = Settings(workers=1)


@pytest.fixture(scope="module")
def progress() -> list[tuple[str, int, int]]:
    """What ``at_once`` was told on its way."""
    return []


@pytest.fixture(scope="module")
def at_once(site: Site, progress: list[tuple[str, int, int]]) -> Aligned:
    aligner = Aligner(SETTINGS, lambda *call: progress.append(call))
    aligner.add_all([site[0][i] for i in CHOSEN])
    return aligner.solve()


@pytest.fixture(scope="module")
def one_by_one(site: Site) -> tuple[Aligned, list[int]]:
    """The same photos while they come, with a solution asked for twice in between."""
    aligner = Aligner(SETTINGS)
    sizes = []
    for count, index in enumerate(CHOSEN, start=1):
        aligner.add(site[0][index])
        if count in (4, 6, len(CHOSEN)):
            aligned = aligner.solve()
            sizes.append(len(aligned.solution.photos))
    return aligned, sizes


def f_of(aligned: Aligned) -> tuple[float, float]:
    fitted, jacobian = fit_brown(aligned.solution.lens)
    return fitted.f_px, float(np.sqrt(jacobian[0] @ aligned.solution.covariance @ jacobian[0]))


def test_known_lens_and_poses_are_found(site: Site, at_once: Aligned) -> None:
    solution, truth = at_once.solution, site[1]
    assert len(solution.photos) == len(CHOSEN)
    assert solution.components == (len(CHOSEN),)
    assert solution.left_out == ()
    assert solution.converged
    f, sigma = f_of(at_once)
    assert abs(f / truth.camera.f_px - 1) < 2e-3
    assert abs(f - truth.camera.f_px) < 4 * sigma
    # Tie points to a twentieth of a pixel.
    assert 0.02 < solution.rms_px < 0.15
    true = truth.centres_m[list(CHOSEN)]
    move = fit_similarity(solution.centres_m, true)
    assert np.linalg.norm(move.apply(solution.centres_m) - true, axis=1).max() < 0.2
    # In metres and upright already, as far as geotags of 2.5 m say.
    assert move.scale == pytest.approx(1, abs=0.1)
    assert solution.georeference.trusted
    ground = move.apply(solution.points_m)
    assert np.median(np.abs(ground[:, 2])) < 2.5


def test_total_mapping_is_the_true_one(site: Site, at_once: Aligned) -> None:
    lens, true = at_once.solution.lens, site[1].camera
    u, v = np.meshgrid(np.linspace(20, 620, 16), np.linspace(20, 460, 12))
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1)
    rays = true.unproject(pixels)
    difference = (lens.project(rays) - pixels).reshape(-1)
    _, by_ray, _ = true.derivatives(rays)
    design = (by_ray @ turned_rays(rays)).reshape(-1, 3)
    rest = difference - design @ np.linalg.lstsq(design, difference, rcond=None)[0]
    assert np.abs(rest).max() < 1.0
    assert np.sqrt(np.mean(rest**2)) < 0.4


def test_points_lie_on_the_ground(site: Site, at_once: Aligned) -> None:
    solution, scene = at_once.solution, Scene(site[1])
    seen, chosen = solution.observations, np.array(CHOSEN)
    ground = scene.ground_m(chosen[seen.photo], seen.pixels)
    move = fit_similarity(solution.points_m[seen.point], ground)
    away = np.linalg.norm(move.apply(solution.points_m[seen.point]) - ground, axis=1)
    # A pixel is 16 cm on the ground.
    assert np.median(away) < 0.08


def test_one_by_one_comes_to_the_same(at_once: Aligned, one_by_one: tuple[Aligned, list[int]]) -> None:
    streamed, sizes = one_by_one
    assert sizes == [4, 6, 8]
    (f, sigma), (f_streamed, sigma_streamed) = f_of(at_once), f_of(streamed)
    assert abs(f_streamed - f) < 0.5 * sigma
    assert sigma_streamed == pytest.approx(sigma, rel=0.1)
    assert [p.path for p in streamed.solution.photos] == [p.path for p in at_once.solution.photos]
    assert len(streamed.solution.observations) == pytest.approx(len(at_once.solution.observations), rel=0.05)
    move = fit_similarity(streamed.solution.centres_m, at_once.solution.centres_m)
    moved = move.apply(streamed.solution.centres_m) - at_once.solution.centres_m
    assert np.abs(moved).max() < 0.1


def test_two_runs_agree_to_the_last_bit(site: Site, at_once: Aligned) -> None:
    aligner = Aligner(replace(SETTINGS, workers=2))  # threads do not change the order either
    aligner.add_all([site[0][i] for i in CHOSEN])
    again = aligner.solve().solution
    assert np.array_equal(again.lens.vector, at_once.solution.lens.vector)
    assert np.array_equal(again.points_m, at_once.solution.points_m)


def test_photos_without_any_tags_are_aligned_too(site: Site) -> None:
    chosen = [0, 1, 2, 4, 5, 12, 18]
    bare = [replace(site[0][i], position=None, gimbal=None) for i in chosen]
    aligner = Aligner(SETTINGS)
    aligner.add_all(bare)
    solution = aligner.solve().solution
    assert len(solution.photos) == 7
    assert not solution.georeference.trusted
    assert solution.georeference.fault is None
    true = site[1].centres_m[chosen]
    move = fit_similarity(solution.centres_m, true)
    assert np.linalg.norm(move.apply(solution.centres_m) - true, axis=1).max() < 0.15
    # Level by the ground: what is up stays up.
    assert move.rotation[2, 2] > 0.99


def test_too_few_and_unrelated_photos(site: Site, tmp_path: Path) -> None:
    aligner = Aligner(SETTINGS)
    aligner.add_all(site[0][:2])
    with pytest.raises(AlignmentError, match="Only 2 readable photos"):
        aligner.solve()
    # 0 and 3 and 8 do not overlap.
    aligner = Aligner(SETTINGS)
    aligner.add_all([site[0][i] for i in (0, 3, 8)])
    with pytest.raises(AlignmentError, match=r"could not be joined|No two photos"):
        aligner.solve()
    missing = replace(site[0][0], path=tmp_path / "gone.JPG")
    aligner = Aligner(SETTINGS)
    aligner.add_all([missing, site[0][0], site[0][1]])
    with pytest.raises(AlignmentError, match="Only 2 readable photos"):
        aligner.solve()


def test_progress_names_its_stages(at_once: Aligned, progress: list[tuple[str, int, int]]) -> None:
    del at_once
    stages = list(dict.fromkeys(stage for stage, _, _ in progress))
    assert stages == [
        "reading photos",
        "matching",
        "joining photos",
        "measuring tie points",
        "self-calibration",
    ]
    assert [c[1:] for c in progress if c[0] == "matching"] == [(i, 28) for i in range(1, 29)]


# -- which pairs -----------------------------------------------------------------------------------


def photos_of(flight: Flight, gimbal: bool = True, gps_sigma_m: float = 2.5) -> list[Photo]:
    frame = LocalFrame(50.83, -0.14, 75.0)
    centres = flight.centres_m + np.random.default_rng(0).normal(0, gps_sigma_m, flight.centres_m.shape)
    geodetic = frame.geodetic(centres)
    camera = CameraIdentity("DJI", "FC300X", None, 4000, 3000)
    return [
        Photo(
            Path(f"{i}.JPG"),
            camera,
            Position(float(a), float(b), float(c), float(height)),
            gimbal_from_rotation(r) if gimbal else None,
        )
        for i, ((a, b, c), height, r) in enumerate(
            zip(geodetic, flight.centres_m[:, 2], flight.rotations_cam_from_world, strict=True)
        )
    ]


def words_of(flight: Flight) -> list[Features]:
    """Features with one descriptor for each piece of ground that a photo looks down on."""
    rng = np.random.default_rng(1)
    ground = rng.uniform(-200, 200, (3000, 2))
    words = rng.normal(size=(3000, 128))
    made = []
    for centre in flight.centres_m:
        near = np.flatnonzero((np.abs(ground - centre[:2]) < [45, 35]).all(axis=1))[:200]
        descriptors = words[near] + rng.normal(0, 0.3, (len(near), 128))
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        count = np.arange(len(near))
        made.append(Features(ground[near], np.ones(len(near)), descriptors.astype(np.float32), count))
    return made


def neighbours(lines: int, per_line: int) -> set[tuple[int, int]]:
    """Pairs next to each other along and across the lines of a grid flown there and back."""
    place = {}
    for line in range(lines):
        for step in range(per_line):
            place[line, step if line % 2 == 0 else per_line - 1 - step] = line * per_line + step
    pairs = set()
    for (x, y), index in place.items():
        for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
            other = place.get((x + dx, y + dy))
            if other is not None:
                pairs.add((min(index, other), max(index, other)))
    return pairs


@pytest.mark.parametrize("known", ["gps and gimbal", "gps", "nothing"])
def test_neighbours_of_a_large_grid_are_candidates(known: str) -> None:
    flight = grid(7, 9, 60.0, 240.0)
    photos = photos_of(flight, gimbal=known != "gps")
    if known == "nothing":
        photos = [replace(p, position=None, gimbal=None) for p in photos]
    pairs = candidate_pairs(photos, words_of(flight), np.ones(63, bool))
    assert len(photos) > TRY_ALL
    assert pairs == sorted(set(pairs))
    assert all(a < b for a, b in pairs)
    missed = neighbours(7, 9) - set(pairs)
    assert missed == set()
    assert len(pairs) < 63 * (NEIGHBOURS + 6) < 63 * 62 / 2


def test_oblique_photos_are_paired_with_what_they_look_at() -> None:
    flight = grid(6, 7, 60.0, 240.0) + convergent(4, 40.0, 60.0)
    photos = photos_of(flight)
    targets = footprint_centres(photos)
    assert np.linalg.norm(targets[42:] - targets[42:].mean(axis=0), axis=1).max() < 10
    pairs = set(candidate_pairs(photos, words_of(flight), np.ones(46, bool)))
    middle = np.argsort(np.linalg.norm(flight.centres_m[:42, :2], axis=1))[:4]
    assert all((int(m), o) in pairs for m in middle for o in range(42, 46))


def test_small_sets_are_tried_all_and_unusable_photos_are_not() -> None:
    flight = grid(3, 4, 60.0, 100.0)
    usable = np.ones(12, bool)
    usable[[2, 7]] = False
    pairs = candidate_pairs(photos_of(flight), words_of(flight), usable)
    assert len(pairs) == 10 * 9 // 2
    assert not {2, 7} & {i for pair in pairs for i in pair}


def test_alike_is_what_shows_the_same_ground() -> None:
    flight = grid(1, 12, 60.0, 360.0)
    likeness = appearance(words_of(flight))
    assert np.allclose(np.diag(likeness), -1)
    off: FloatArray = np.abs(np.subtract.outer(np.arange(12), np.arange(12)))
    assert likeness[off == 1].min() > likeness[off > 3].max()


def test_nothing_alike_without_features() -> None:
    empty = Features(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128), np.float32), np.zeros(0, np.intp))
    assert not appearance([empty] * 3).any()

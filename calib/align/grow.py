"""A block from nothing: seed pair, resection of further photos, triangulation, adjustment.

The block lives in an arbitrary frame until geotags give it a place (calib.align.georeference).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from calib.align.adjust import Adjustment, Priors, State
from calib.align.matching import PairMatches
from calib.align.rays import ray_angle_deg, triangulate
from calib.align.tracks import select
from calib.camera import FloatArray
from calib.field import LENS_NAMES, Lens
from calib.solution import Observations


@dataclass(frozen=True)
class Partial:
    """A block under construction: poses of the photos in ``registered`` (k,), points NaN where unknown."""

    lens: Lens
    registered: np.ndarray  # (n_photos,) bool
    rotations: FloatArray  # (n_photos, 3, 3)
    centres: FloatArray  # (n_photos, 3)
    points: FloatArray  # (m, 3)
    active: np.ndarray  # (n,) bool: observations not rejected


def lens_mask(names: str) -> np.ndarray:
    """Boolean (35,) with the named Brown parameters set, e.g. ``"f k1"``."""
    wanted = set(names.split())
    return np.array([name in wanted for name in LENS_NAMES])


def free_network_priors(k: int, lens: Lens, extent: float, centres: FloatArray) -> Priors:
    """Priors that only hold the gauge: every position within many times its own spread."""
    spread = np.full((k, 3), 30.0 * extent)
    lens_sigma = np.full(len(LENS_NAMES), np.inf)
    # A nadir block would let f wander along its valley, a little farther with every photo.
    lens_sigma[0] = 0.05 * lens.brown.f_px
    lens_sigma[3:6] = 0.3
    return Priors(centres, spread, np.tile(np.eye(3), (k, 1, 1)), np.full(k, np.inf), lens.vector, lens_sigma)


def reject_and_triangulate(
    obs: Observations, block: Partial, threshold_px: float, min_angle_deg: float
) -> Partial:
    """Triangulate all points from the registered photos; drop what misses by more than the threshold."""
    here = block.registered[obs.photo]
    seen = here.copy()
    points = np.full((len(block.points), 3), np.nan)
    for _ in range(3):
        sub, old = select(obs, seen)
        if not len(sub):
            break
        found = triangulate(block.lens, block.rotations, block.centres, sub, len(old))
        points[:] = np.nan
        points[old] = found
        miss = reprojection_px(obs, block, points)
        bad = seen & ~(miss < threshold_px)
        if not bad.any():
            break
        # The worst observation of a point goes first; the others may be innocent.
        worst = np.zeros(len(points))
        np.maximum.at(worst, obs.point[seen], np.nan_to_num(miss[seen], nan=1e9, posinf=1e9))
        drop = bad & (np.nan_to_num(miss, nan=1e9, posinf=1e9) >= worst[obs.point] * 0.999)
        seen &= ~drop
    miss = reprojection_px(obs, block, points)
    seen &= miss < threshold_px
    counts = np.bincount(obs.point[seen], minlength=len(points))
    points[counts < 2] = np.nan
    used = Observations(obs.photo[seen], obs.point[seen], obs.pixels[seen], obs.sigma_px[seen])
    angle = ray_angle_deg(block.centres, points, used)
    points[~(angle > min_angle_deg)] = np.nan
    seen &= np.isfinite(points[obs.point]).all(axis=1)
    return Partial(block.lens, block.registered, block.rotations, block.centres, points, seen)


def reprojection_px(obs: Observations, block: Partial, points: FloatArray) -> FloatArray:
    """Distance measured - projected (n,); inf behind the camera or where unknown."""
    offset = points[obs.point] - block.centres[obs.photo]
    in_cam = np.einsum("nij,nj->ni", block.rotations[obs.photo], offset)
    ok = np.isfinite(in_cam).all(axis=1) & (in_cam[:, 2] > 1e-9) & block.registered[obs.photo]
    miss = np.full(len(obs), np.inf)
    rays = in_cam[ok, :2] / in_cam[ok, 2:]
    inside = np.linalg.norm(rays, axis=1) < 3
    distance = np.linalg.norm(
        obs.pixels[ok] - block.lens.project(np.where(inside[:, None], rays, 0.0)), axis=1
    )
    miss[ok] = np.where(inside, distance, np.inf)
    return miss


def adjust_partial(
    obs: Observations,
    block: Partial,
    free: np.ndarray,
    iterations: int,
    per_photo: int,
    tick: Callable[[], None] | None = None,
) -> Partial:
    """Adjust what is registered, on at most about ``per_photo`` observations a photo."""
    use = block.active & block.registered[obs.photo]
    k = int(block.registered.sum())
    # Long tracks hold a block together best.
    length = np.bincount(obs.point[use], minlength=len(block.points))
    budget = per_photo * k
    order = np.argsort(-length, kind="stable")
    taken = np.cumsum(length[order]) <= max(budget, 200)
    wanted = np.zeros(len(block.points), bool)
    wanted[order[taken]] = True
    for photo in np.flatnonzero(block.registered):
        mine = obs.point[use & (obs.photo == photo)]
        if wanted[mine].sum() < 40:
            wanted[mine[:60]] = True
    sub, old = select(obs, use & wanted[obs.point])
    photos = np.flatnonzero(block.registered)
    position = np.full(len(block.registered), -1)
    position[photos] = np.arange(k)
    if len(np.unique(sub.photo)) < k:
        return block
    local = Observations(position[sub.photo], sub.point, sub.pixels, sub.sigma_px)
    centres = block.centres[photos]
    extent = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()) or 1.0
    priors = free_network_priors(k, block.lens, extent, centres)
    start = State(block.lens, block.rotations[photos], centres, block.points[old])
    result = Adjustment(local, k, len(old), priors, robust_positions=False).run(
        start, free, max_iterations=iterations, decrement=1.0, tick=tick
    )
    rotations, all_centres, points = block.rotations.copy(), block.centres.copy(), block.points.copy()
    rotations[photos], all_centres[photos] = result.state.rotations, result.state.centres_m
    points[old] = result.state.points_m
    return Partial(result.state.lens, block.registered, rotations, all_centres, points, block.active)


def relative_poses(
    first: FloatArray, second: FloatArray, seed: int, focal_px: float
) -> list[tuple[FloatArray, FloatArray]]:
    """Candidate relative poses (R, t) of two photos from rays (n, 2): essential matrix and homography.

    Flat ground is the rule here, so the homography's ambiguous solutions are candidates too; the
    photos that are added later decide between them.
    """
    threshold = 3.0 / focal_px
    candidates: list[tuple[FloatArray, FloatArray]] = []
    params = cv2.UsacParams()
    params.threshold, params.confidence, params.maxIterations = threshold, 0.9999, 5000
    params.score, params.loMethod = cv2.SCORE_METHOD_MAGSAC, cv2.LOCAL_OPTIM_SIGMA
    params.randomGeneratorState = seed
    eye = np.eye(3)
    essential, mask = cv2.findEssentialMat(first, second, eye, eye, np.zeros(5), np.zeros(5), params)
    if essential is not None and essential.shape == (3, 3):
        _, rotation, translation, _ = cv2.recoverPose(essential, first, second, eye, mask=mask.copy())
        candidates.append((np.asarray(rotation, float), np.asarray(translation, float).ravel()))
    homography, _ = cv2.findHomography(first, second, cv2.USAC_MAGSAC, threshold * 2)
    if homography is not None:
        _, turns, shifts, _ = cv2.decomposeHomographyMat(homography, eye)
        for rotation, translation in zip(turns, shifts, strict=True):
            length = float(np.linalg.norm(translation))
            if length > 1e-3:
                candidates.append(
                    (np.asarray(rotation, float), np.asarray(translation, float).ravel() / length)
                )
    return candidates


def _seed_block(
    obs: Observations, lens: Lens, a: int, b: int, pose: tuple[FloatArray, FloatArray], n_photos: int
) -> Partial:
    rotations = np.tile(np.eye(3), (n_photos, 1, 1))
    centres = np.zeros((n_photos, 3))
    rotation, translation = pose
    rotations[b], centres[b] = rotation, -rotation.T @ translation
    registered = np.zeros(n_photos, bool)
    registered[[a, b]] = True
    n_points = int(obs.point.max()) + 1
    block = Partial(
        lens, registered, rotations, centres, np.full((n_points, 3), np.nan), np.zeros(len(obs), bool)
    )
    return reject_and_triangulate(obs, block, 0.008 * max(lens.brown.width, lens.brown.height), 1.0)


def _resect(obs: Observations, block: Partial, photo: int, seed: int, threshold_px: float) -> Partial | None:
    """Add one photo by resection from the points already known; None where it does not fit."""
    mine = np.flatnonzero((obs.photo == photo) & np.isfinite(block.points[obs.point]).all(axis=1))
    if len(mine) < 12:
        return None
    rays = block.lens.unproject(obs.pixels[mine])
    ok = np.isfinite(rays).all(axis=1)
    mine, rays = mine[ok], rays[ok]
    if len(mine) < 12:
        return None
    points = np.ascontiguousarray(block.points[obs.point[mine]])
    cv2.setRNGSeed(seed)
    found, turn, shift, inliers = cv2.solvePnPRansac(
        points,
        np.ascontiguousarray(rays),
        np.eye(3),
        np.zeros(4),
        iterationsCount=500,
        reprojectionError=threshold_px / block.lens.brown.f_px,
        confidence=0.9999,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not found or inliers is None or len(inliers) < max(12, 0.25 * len(mine)):
        return None
    keep = inliers.ravel()
    turn, shift = cv2.solvePnPRefineLM(
        points[keep], np.ascontiguousarray(rays[keep]), np.eye(3), np.zeros(4), turn, shift
    )
    rotation = cv2.Rodrigues(turn)[0]
    rotations, centres, registered = block.rotations.copy(), block.centres.copy(), block.registered.copy()
    rotations[photo] = rotation
    centres[photo] = -(rotation.T @ shift).ravel()
    registered[photo] = True
    return Partial(block.lens, registered, rotations, centres, block.points, block.active)


def grow(
    obs: Observations,
    block: Partial,
    seed: int,
    limit: int,
    tick: Callable[[], None] | None = None,
    quick: bool = False,
) -> Partial:
    """Register further photos, most tied first, adjusting as the block grows by a fifth."""
    side = max(block.lens.brown.width, block.lens.brown.height)
    adjusted_at = int(block.registered.sum())
    failed: set[int] = set()
    while int(block.registered.sum()) < limit:
        known = np.isfinite(block.points[obs.point]).all(axis=1)
        ties = np.bincount(obs.photo[known], minlength=len(block.registered))
        ties[block.registered] = 0
        ties[list(failed)] = 0
        photo = int(ties.argmax())
        if ties[photo] < 12:
            if not failed or adjusted_at == int(block.registered.sum()):
                break
            # Photos that did not fit get another chance after the next adjustment.
            failed.clear()
            block = _settle(obs, block, side, tick, quick)
            adjusted_at = int(block.registered.sum())
            continue
        grown = _resect(obs, block, photo, seed, 0.005 * side)
        if grown is None:
            failed.add(photo)
            continue
        block = grown
        count = int(block.registered.sum())
        if count >= adjusted_at * 1.2 or count == limit:
            block = _settle(obs, block, side, tick, quick)
            adjusted_at = count
            failed.clear()
        else:
            block = reject_and_triangulate(obs, block, 0.004 * side, 1.0)
    return block


def _settle(
    obs: Observations, block: Partial, side: int, tick: Callable[[], None] | None, quick: bool
) -> Partial:
    count = int(block.registered.sum())
    # The corners of a wide lens are bent more than f and K1 can follow: they would go as blunders.
    names = "k1" if count < 4 else "f k1" if count < 8 else "f k1 k2 k3"
    block = reject_and_triangulate(obs, block, 0.004 * side, 1.0)
    block = adjust_partial(obs, block, lens_mask(names), 8 if quick else 12, 150, tick)
    return reject_and_triangulate(obs, block, 0.0025 * side, 1.0)


def seed_order(pairs: Sequence[PairMatches], side: int) -> list[PairMatches]:
    """Pairs by how well they can start a block: many matches over a long base line."""

    def score(pair: PairMatches) -> float:
        return float(min(len(pair.indices), 400) * min(pair.shift_px / side, 0.35))

    return sorted(pairs, key=score, reverse=True)


def build_block(
    obs: Observations,
    pairs: Sequence[PairMatches],
    lens: Lens,
    n_photos: int,
    seed: int,
    tick: Callable[[], None] | None = None,
) -> Partial | None:
    """The largest block that the tracks carry, from the best of several seeds; None if none grows."""
    side = max(lens.brown.width, lens.brown.height)
    best: tuple[float, Partial] | None = None
    trial_size = min(6, n_photos)
    tried: set[int] = set()
    for pair in seed_order(pairs, side):
        if len(tried) >= 6:
            break
        if pair.a in tried and pair.b in tried:
            continue
        tried.update((pair.a, pair.b))
        in_a, in_b = obs.photo == pair.a, obs.photo == pair.b
        common, ia, ib = np.intersect1d(obs.point[in_a], obs.point[in_b], return_indices=True)
        if len(common) < 20:
            continue
        first = lens.unproject(obs.pixels[in_a][ia])
        second = lens.unproject(obs.pixels[in_b][ib])
        ok = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
        for pose in relative_poses(first[ok], second[ok], seed, lens.brown.f_px):
            block = _seed_block(obs, lens, pair.a, pair.b, pose, n_photos)
            if np.isfinite(block.points[:, 0]).sum() < 20:
                continue
            block = grow(obs, block, seed, trial_size, tick, quick=True)
            quality = _quality(obs, block)
            if best is None or quality > best[0]:
                best = quality, block
        if best is not None and best[1].registered.sum() >= trial_size and best[0] > 0.7 * trial_size:
            break
    if best is None or best[1].registered.sum() < min(3, n_photos):
        return None
    return grow(obs, best[1], seed, n_photos, tick)


def _quality(obs: Observations, block: Partial) -> float:
    """Photos registered, times the share of their tied observations that fit."""
    counts = np.bincount(obs.point[block.registered[obs.photo]], minlength=len(block.points))
    tied = block.registered[obs.photo] & (counts[obs.point] >= 2)
    share = float((block.active & tied).sum() / max(tied.sum(), 1))
    return float(block.registered.sum()) * share


def resume_block(
    obs: Observations, earlier: Partial, n_photos: int, seed: int, tick: Callable[[], None] | None = None
) -> Partial | None:
    """Go on from an earlier block whose photos are the first of these; None if they do not fit."""
    known = len(earlier.registered)
    registered = np.zeros(n_photos, bool)
    registered[:known] = earlier.registered
    rotations = np.tile(np.eye(3), (n_photos, 1, 1))
    rotations[:known] = earlier.rotations
    centres = np.zeros((n_photos, 3))
    centres[:known] = earlier.centres
    n_points = int(obs.point.max()) + 1
    block = Partial(
        earlier.lens, registered, rotations, centres, np.full((n_points, 3), np.nan), np.zeros(len(obs), bool)
    )
    side = max(earlier.lens.brown.width, earlier.lens.brown.height)
    block = reject_and_triangulate(obs, block, 0.004 * side, 1.0)
    if _quality(obs, block) < 0.6 * registered.sum():
        return None
    return grow(obs, block, seed, n_photos, tick)

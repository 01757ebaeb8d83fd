"""Matches of two photos: coarse by appearance, verified, then dense within the found geometry."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calib.align.features import Features
from calib.camera import FloatArray

IndexPairs = NDArray[np.intp]


@dataclass(frozen=True)
class PairMatches:
    """Verified matches of photos ``a`` < ``b``: index pairs (n, 2) into their features."""

    a: int
    b: int
    indices: IndexPairs
    #: Median shift of the matches in px of the full image, a measure of the base line.
    shift_px: float


def match_descriptors(
    first: NDArray[np.float32], second: NDArray[np.float32], ratio: float = 0.85
) -> IndexPairs:
    """Mutual nearest neighbours that pass Lowe's ratio test, (n, 2)."""
    if len(first) < 2 or len(second) < 2:
        return np.zeros((0, 2), np.intp)
    similarity = first @ second.T
    best = similarity.argmax(axis=1)
    back = similarity.argmax(axis=0)
    rows = np.arange(len(first))
    top = similarity[rows, best]
    similarity[rows, best] = -1
    runner_up = similarity.max(axis=1)
    # |a - b|^2 = 2 - 2 a.b for unit vectors.
    distinct = 1 - top < ratio**2 * (1 - runner_up)
    good = (back[best] == rows) & distinct
    return np.stack([rows[good], best[good]], axis=1)


def _fundamental(
    first: FloatArray, second: FloatArray, threshold_px: float, seed: int
) -> tuple[FloatArray | None, NDArray[np.bool_]]:
    """Fundamental matrix by MAGSAC++ and its inliers; deterministic for a seed."""
    none = np.zeros(len(first), bool)
    if len(first) < 12:
        return None, none
    params = cv2.UsacParams()
    params.threshold = threshold_px
    params.confidence = 0.9999
    params.maxIterations = 5000
    params.sampler = cv2.SAMPLING_UNIFORM
    params.score = cv2.SCORE_METHOD_MAGSAC
    params.loMethod = cv2.LOCAL_OPTIM_SIGMA
    params.randomGeneratorState = seed
    try:
        matrix, mask = cv2.findFundamentalMat(first, second, params)
    except cv2.error:  # It asserts where its local optimisation runs into a degenerate sample.
        return None, none
    if matrix is None or mask is None or matrix.shape != (3, 3):
        return None, none
    return np.asarray(matrix, float), mask.ravel().astype(bool)


def _predict(
    from_px: FloatArray, source_px: FloatArray, target_px: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Where points of one photo lie in the other, by local affine maps through matches around.

    Returns predicted px (n, 2), search radius px (n,), and local scale target / source (n,).
    """
    neighbours = min(10, len(source_px))
    distance, index = (np.asarray(a) for a in cKDTree(source_px).query(from_px, k=neighbours))
    source, target = source_px[index], target_px[index]
    mean_s, mean_t = source.mean(axis=1, keepdims=True), target.mean(axis=1, keepdims=True)
    ds, dt = source - mean_s, target - mean_t
    moment = np.einsum("nki,nkj->nij", ds, ds)
    spread = np.trace(moment, axis1=1, axis2=2)
    moment += 0.02 * spread[:, None, None] * np.eye(2) + 1e-9 * np.eye(2)
    cross = np.einsum("nki,nkj->nij", ds, dt)
    affine = np.linalg.solve(moment, cross)
    predicted = mean_t[:, 0] + np.einsum("ni,nij->nj", from_px - mean_s[:, 0], affine)
    misfit = dt - np.einsum("nki,nij->nkj", ds, affine)
    rms = np.sqrt(np.mean(np.sum(misfit**2, axis=2), axis=1))
    scale = np.asarray(np.sqrt(np.abs(np.linalg.det(affine))), float)
    radius = 2.5 * rms + 0.08 * distance[:, -1]
    return predicted, radius, scale


def match_pair(
    a: int, b: int, first: Features, second: Features, side_px: int, seed: int
) -> PairMatches | None:
    """Match two photos; None when they do not overlap reliably.

    Args:
        side_px: longer side of the full image: tolerances scale with it.
    """
    coarse = match_descriptors(first.descriptors[first.coarse], second.descriptors[second.coarse])
    if len(coarse) < 12:
        return None
    seeds = np.stack([first.coarse[coarse[:, 0]], second.coarse[coarse[:, 1]]], axis=1)
    tolerance = 1.5 * side_px / 1600
    _, inlier = _fundamental(first.pixels[seeds[:, 0]], second.pixels[seeds[:, 1]], 2 * tolerance, seed)
    seeds = seeds[inlier]
    if len(seeds) < 15:
        return None
    # Mismatches that happen to lie on their epipolar line betray themselves against their neighbours.
    predicted, _, _ = _predict(
        first.pixels[seeds[:, 0]], first.pixels[seeds[:, 0]], second.pixels[seeds[:, 1]]
    )
    off = np.linalg.norm(predicted - second.pixels[seeds[:, 1]], axis=1)
    seeds = seeds[off < max(4 * float(np.median(off)), 0.01 * side_px)]
    if len(seeds) < 15:
        return None
    dense = _guided(first, second, seeds, side_px)
    if len(dense) < 20:
        return None
    p, q = first.pixels[dense[:, 0]], second.pixels[dense[:, 1]]
    _, inlier = _fundamental(p, q, tolerance, seed)
    dense = dense[inlier]
    if len(dense) < 20:
        return None
    shift = np.linalg.norm(first.pixels[dense[:, 0]] - second.pixels[dense[:, 1]], axis=1)
    return PairMatches(a, b, dense, float(np.median(shift)))


def _guided(first: Features, second: Features, seeds: IndexPairs, side_px: int) -> IndexPairs:
    """All features of both photos matched near where the seed matches say they should be."""
    predicted, radius, scale = _predict(first.pixels, first.pixels[seeds[:, 0]], second.pixels[seeds[:, 1]])
    radius = np.clip(radius, 0.006 * side_px, 0.03 * side_px)
    low, high = second.pixels.min(axis=0) - radius.max(), second.pixels.max(axis=0) + radius.max()
    inside = np.flatnonzero(((predicted > low) & (predicted < high)).all(axis=1))
    if not len(inside):
        return np.zeros((0, 2), np.intp)
    neighbours = cKDTree(second.pixels).query_ball_point(predicted[inside], radius[inside])
    counts = np.fromiter((len(n) for n in neighbours), np.intp, len(inside))
    if not counts.sum():
        return np.zeros((0, 2), np.intp)
    left = np.repeat(inside, counts)
    right = np.concatenate([np.asarray(n, np.intp) for n in neighbours if n])
    relative = second.scale_px[right] / (first.scale_px[left] * np.maximum(scale[left], 1e-3))
    same_size = (relative > 0.6) & (relative < 1.7)
    left, right = left[same_size], right[same_size]
    similarity = np.einsum("nd,nd->n", first.descriptors[left], second.descriptors[right])
    order = np.lexsort((-similarity, left))
    left, right, similarity = left[order], right[order], similarity[order]
    head = np.concatenate([[True], left[1:] != left[:-1]]) if len(left) else np.zeros(0, bool)
    start = np.flatnonzero(head)
    runner_up = np.full(len(start), 0.5)
    has_second = start + 1 < len(left)
    has_second[has_second] = ~head[start[has_second] + 1]
    runner_up[has_second] = similarity[start[has_second] + 1]
    top = similarity[start]
    good = (1 - top < 0.85**2 * (1 - runner_up)) & (top > 0.75)
    left, right, top = left[start][good], right[start][good], top[good]
    # One to one: the best claim on every feature of the second photo wins.
    order = np.lexsort((-top, right))
    first_claim = np.ones(len(right), bool)
    first_claim[1:] = right[order][1:] != right[order][:-1]
    keep = order[first_claim]
    return np.stack([left[keep], right[keep]], axis=1)

"""Which pairs of photos are worth matching."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.align.features import Features
from calib.align.georeference import read_tags
from calib.camera import FloatArray
from calib.photos.photo import Photo

#: Up to this many photos every pair is tried by its strongest features: cheap, and geotags may lie.
TRY_ALL = 36
NEIGHBOURS = 14
IN_SEQUENCE = 3


def candidate_pairs(
    photos: Sequence[Photo], features: Sequence[Features], usable: np.ndarray
) -> list[tuple[int, int]]:
    """Pairs (a < b) by predicted footprint, by sequence, and by appearance where there is no position."""
    index = [int(i) for i in np.flatnonzero(usable)]
    n = len(index)
    if n <= TRY_ALL:
        return [(index[i], index[j]) for i in range(n) for j in range(i + 1, n)]
    wanted: set[tuple[int, int]] = set()

    def want(i: int, j: int) -> None:
        if i != j:
            wanted.add((min(i, j), max(i, j)))

    for i in range(n):
        for j in range(i + 1, min(i + 1 + IN_SEQUENCE, n)):
            want(index[i], index[j])
    targets = footprint_centres([photos[i] for i in index])
    known = np.flatnonzero(np.isfinite(targets).all(axis=1))
    for i in known.tolist():
        distance = np.linalg.norm(targets[known] - targets[i], axis=1)
        for j in known[np.argsort(distance)[: NEIGHBOURS + 1]].tolist():
            want(index[i], index[j])
    # Geotags that are missing or wrong are made up for by looks.
    located = set(known.tolist())
    likeness = appearance([features[i] for i in index])
    for i in range(n):
        count = NEIGHBOURS if i not in located else 4
        for j in np.argsort(-likeness[i])[:count].tolist():
            want(index[i], index[j])
    return sorted(wanted)


def footprint_centres(photos: Sequence[Photo]) -> FloatArray:
    """Where the photos look, horizontally in m (n, 2); NaN without a position.

    Beyond 60 degrees off nadir, and without angles or height, the camera's own position is used.
    """
    tags = read_tags(photos)
    centres: FloatArray = tags.positions_m[:, :2].copy()
    for i, photo in enumerate(photos):
        if photo.position is None or photo.position.height_above_launch_m is None or not tags.has_rotation[i]:
            continue
        axis = tags.rotations[i][2]
        if axis[2] < -0.5:
            centres[i] += axis[:2] / -axis[2] * photo.position.height_above_launch_m
    return centres


def appearance(features: Sequence[Features], words: int = 64, seed: int = 0) -> FloatArray:
    """Likeness of all photos (n, n) from residual sums over a small vocabulary (VLAD)."""
    rng = np.random.default_rng(seed)
    stack = np.concatenate([f.descriptors[f.coarse[:200]] for f in features])
    if len(stack) <= words:
        return np.zeros((len(features), len(features)))
    vocabulary = stack[rng.choice(len(stack), words, replace=False)]
    for _ in range(5):
        label = (stack @ vocabulary.T).argmax(axis=1)
        for word in range(words):
            mine = stack[label == word]
            if len(mine):
                vocabulary[word] = mine.mean(axis=0)
                vocabulary[word] /= max(float(np.linalg.norm(vocabulary[word])), 1e-9)
    signatures = []
    for one in features:
        descriptors = one.descriptors[one.coarse]
        label = (descriptors @ vocabulary.T).argmax(axis=1) if len(descriptors) else np.zeros(0, int)
        sums = np.zeros((words, 128))
        np.add.at(sums, label, descriptors - vocabulary[label])
        sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
        signatures.append(sums.ravel() / np.sqrt(words))
    matrix = np.array(signatures)
    likeness: FloatArray = matrix @ matrix.T
    np.fill_diagonal(likeness, -1)
    return likeness

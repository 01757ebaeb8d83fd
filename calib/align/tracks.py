"""Tracks: the same ground point across photos, from pairwise matches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from calib.solution import IntArray, Observations

if TYPE_CHECKING:  # Image libraries, which a planned network can do without.
    from calib.align.features import Features
    from calib.align.matching import PairMatches


def build_tracks(features: Sequence[Features], pairs: Sequence[PairMatches], sigma_px: float) -> Observations:
    """Observations of all tracks with at least two photos, sorted by track.

    A track that visits one photo twice contradicts itself and is dropped whole.
    """
    offset = np.concatenate([[0], np.cumsum([len(f) for f in features])])
    total = int(offset[-1])
    left = np.concatenate([offset[p.a] + p.indices[:, 0] for p in pairs]) if pairs else np.zeros(0, int)
    right = np.concatenate([offset[p.b] + p.indices[:, 1] for p in pairs]) if pairs else np.zeros(0, int)
    graph = coo_matrix((np.ones(len(left), np.int8), (left, right)), shape=(total, total))
    _, label = connected_components(graph, directed=False)
    used = np.unique(np.concatenate([left, right]))
    photo = np.searchsorted(offset, used, side="right") - 1
    track = label[used]
    # Contradictions: the same (track, photo) twice.
    key = track.astype(np.int64) * len(features) + photo
    values, counts = np.unique(key, return_counts=True)
    bad = np.unique(values[counts > 1] // len(features))
    keep = ~np.isin(track, bad)
    used, photo, track = used[keep], photo[keep], track[keep]
    _, track = np.unique(track, return_inverse=True)
    order = np.lexsort((photo, track))
    used, photo, track = used[order], photo[order], track[order]
    pixels = np.zeros((len(used), 2))
    for index, one in enumerate(features):
        mine = photo == index
        pixels[mine] = one.pixels[used[mine] - offset[index]]
    return Observations(photo, track, pixels, np.full(len(used), sigma_px))


def select(obs: Observations, keep: np.ndarray) -> tuple[Observations, IntArray]:
    """Observations where ``keep``, points with fewer than two views dropped and renumbered.

    Returns the observations and the old index of every remaining point.
    """
    photo, point = obs.photo[keep], obs.point[keep]
    counts = np.bincount(point, minlength=int(obs.point.max(initial=-1)) + 1)
    enough = counts[point] >= 2
    rows = np.flatnonzero(keep)[enough]
    old, renumbered = np.unique(point[enough], return_inverse=True)
    return (
        Observations(photo[enough], renumbered, obs.pixels[rows], obs.sigma_px[rows]),
        old,
    )


def thin(obs: Observations, n_photos: int, cells: int, per_cell: int) -> np.ndarray:
    """Which points to keep so that every photo still has long tracks in all its parts.

    Points are taken in the order of their track length; a point is wanted while one of the
    grid cells it falls in (``cells`` x ``cells`` a photo) has fewer than ``per_cell`` points.
    Returns a mask over points.
    """
    n_points = int(obs.point.max()) + 1
    length = np.bincount(obs.point, minlength=n_points)
    start = np.concatenate([[0], np.cumsum(length)[:-1]])
    size = np.array([obs.pixels[:, 0].max(), obs.pixels[:, 1].max()]) + 1
    cell = np.minimum((obs.pixels * cells / size).astype(int), cells - 1)
    slot = (obs.photo * cells + cell[:, 1]) * cells + cell[:, 0]
    filled = np.zeros(n_photos * cells * cells, np.int64)
    chosen = np.zeros(n_points, bool)
    for point in np.argsort(-length, kind="stable"):
        slots = slot[start[point] : start[point] + length[point]]
        if (filled[slots] < per_cell).any():
            chosen[point] = True
            filled[slots] += 1
    return chosen

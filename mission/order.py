"""The order and direction of pieces that make the path short."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.camera import FloatArray
from mission.patterns.piece import Piece, backwards, begun_at

_MOST_ROUNDS = 300


def ordered(pieces: Sequence[Piece], start_m: FloatArray, home_m: FloatArray) -> list[Piece]:
    """The pieces in an order and direction that is short from ``start_m`` (3,) and on to ``home_m`` (3,).

    Nearest neighbour from several beginnings, then stretches turned round while that helps.
    """
    if len(pieces) == 1 and pieces[0].loop:
        return [_begun_near(pieces[0], start_m)]
    ends = np.array([piece.ends_m for piece in pieces])
    free = np.array([piece.reversible for piece in pieces])
    best: list[tuple[int, int]] = []
    cost = np.inf
    for first in _beginnings(ends, free, start_m):
        tour = _nearest(ends, free, first)
        if free.all():
            tour = _improved(ends, tour, start_m, home_m)
        length = _length(ends, tour, start_m, home_m)
        if length < cost - 1e-6:
            best, cost = tour, length
    return [backwards(pieces[i]) if flip else pieces[i] for i, flip in best]


def _begun_near(loop: Piece, start_m: FloatArray) -> Piece:
    places = np.array([w.enu_m for w in loop.waypoints])
    return begun_at(loop, int(np.argmin(np.linalg.norm(places - start_m, axis=1))))


def _beginnings(ends: FloatArray, free: np.ndarray, start_m: FloatArray) -> list[tuple[int, int]]:
    """Pieces to begin with: the nearest to the start, the first and the last."""
    distance = np.linalg.norm(ends - start_m, axis=2)
    distance[~free, 1] = np.inf
    nearest = int(np.argmin(distance)) // 2
    found = []
    for index in dict.fromkeys([nearest, 0, len(ends) - 1]):
        found.append((index, 0))
        if free[index]:
            found.append((index, 1))
    return found


def _nearest(ends: FloatArray, free: np.ndarray, first: tuple[int, int]) -> list[tuple[int, int]]:
    tour = [first]
    left = np.ones(len(ends), dtype=bool)
    left[first[0]] = False
    while left.any():
        index, flip = tour[-1]
        distance = np.linalg.norm(ends - ends[index, 1 - flip], axis=2)
        distance[~left] = np.inf
        distance[~free, 1] = np.inf
        chosen = int(np.argmin(distance))
        tour.append((chosen // 2, chosen % 2))
        left[chosen // 2] = False
    return tour


def _improved(
    ends: FloatArray, tour: list[tuple[int, int]], start_m: FloatArray, home_m: FloatArray
) -> list[tuple[int, int]]:
    """2-opt: the stretch whose turning round saves most, as long as one saves."""
    for _ in range(_MOST_ROUNDS):
        begins = np.array([ends[i, flip] for i, flip in tour])
        finishes = np.array([ends[i, 1 - flip] for i, flip in tour])
        before = np.concatenate([start_m[None], finishes[:-1]])
        after = np.concatenate([begins[1:], home_m[None]])
        enter = np.linalg.norm(before - begins, axis=1)
        leave = np.linalg.norm(finishes - after, axis=1)
        # Stretch i..j turned round: i's predecessor meets j's end, i's beginning meets j's successor.
        saved = (
            enter[:, None]
            + leave[None, :]
            - np.linalg.norm(before[:, None] - finishes[None, :], axis=2)
            - np.linalg.norm(begins[:, None] - after[None, :], axis=2)
        )
        saved[np.tril_indices(len(tour), -1)] = -np.inf
        i, j = divmod(int(np.argmax(saved)), len(tour))
        if saved[i, j] < 1e-6:
            break
        tour = tour[:i] + [(k, 1 - flip) for k, flip in tour[i : j + 1][::-1]] + tour[j + 1 :]
    return tour


def _length(ends: FloatArray, tour: list[tuple[int, int]], start_m: FloatArray, home_m: FloatArray) -> float:
    begins = np.array([ends[i, flip] for i, flip in tour])
    finishes = np.array([ends[i, 1 - flip] for i, flip in tour])
    path = np.concatenate([start_m[None], finishes]), np.concatenate([begins, home_m[None]])
    return float(np.linalg.norm(path[0] - path[1], axis=1).sum())

"""Rays of a block: where they meet, and at what angles."""

from __future__ import annotations

import numpy as np

from calib.camera import FloatArray
from calib.field import Lens
from calib.solution import Observations


def ray_angle_deg(centres_m: FloatArray, points_m: FloatArray, obs: Observations) -> FloatArray:
    """Twice the largest angle between a point's rays and their mean direction, (m,) degrees.

    ``obs`` need not be sorted; points without observations get 0.
    """
    direction = points_m[obs.point] - centres_m[obs.photo]
    direction = direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    direction = np.where(np.isfinite(direction), direction, 0.0)
    m = len(points_m)
    mean = np.stack([np.bincount(obs.point, direction[:, i], m) for i in range(3)], axis=1).astype(float)
    mean = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    cosine = np.clip(np.sum(direction * mean[obs.point], axis=1), -1, 1)
    angle = np.zeros(m)
    np.maximum.at(angle, obs.point, np.arccos(cosine))
    doubled: FloatArray = np.degrees(2 * angle)
    return doubled


def triangulate(
    lens: Lens, rotations: FloatArray, centres_m: FloatArray, obs: Observations, n_points: int
) -> FloatArray:
    """Points (m, 3) nearest to their rays (linear least squares); NaN where rays are parallel."""
    rays = lens.unproject(obs.pixels)
    direction = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    world = np.einsum("nji,nj->ni", rotations[obs.photo], direction)
    bad = ~np.isfinite(world).all(axis=1)
    world[bad] = 0.0
    across = np.eye(3) - world[:, :, None] * world[:, None, :]
    across[bad] = 0.0
    moment = np.einsum("nij,nj->ni", across, centres_m[obs.photo])
    matrix = np.zeros((n_points, 3, 3))
    right = np.zeros((n_points, 3))
    for i in range(3):
        right[:, i] = np.bincount(obs.point, moment[:, i], n_points)
        for j in range(3):
            matrix[:, i, j] = np.bincount(obs.point, across[:, i, j], n_points)
    values = np.linalg.eigvalsh(matrix)
    weak = values[:, 0] < 1e-7 * np.maximum(values[:, 2], 1e-12)
    matrix[weak] = np.eye(3)
    points = np.asarray(np.linalg.solve(matrix, right[:, :, None])[:, :, 0], float)
    points[weak] = np.nan
    return points

"""Small turns, and what a shift, turn and scale of everything does to points."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from calib.camera import FloatArray


def rotation_exp(omega: FloatArray) -> FloatArray:
    """Rotation vectors (k, 3) -> matrices (k, 3, 3) (Rodrigues)."""
    angle = np.linalg.norm(omega, axis=1)
    safe = np.where(angle < 1e-12, 1.0, angle)
    x, y, z = (omega / safe[:, None]).T
    cross = np.zeros((len(omega), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2] = -z, y
    cross[:, 1, 0], cross[:, 1, 2] = z, -x
    cross[:, 2, 0], cross[:, 2, 1] = -y, x
    s, c = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    turned: FloatArray = np.eye(3) + s * cross + (1 - c) * (cross @ cross)
    return turned


def rotation_log(rotations: FloatArray) -> FloatArray:
    """Matrices (k, 3, 3) -> rotation vectors (k, 3)."""
    vectors: FloatArray = Rotation.from_matrix(rotations).as_rotvec()
    return vectors


def similarity_tangent(points: FloatArray) -> FloatArray:
    """d point / d (shift, rotation vector, log scale) of a similarity at points (m, 3), as (m, 3, 7)."""
    design = np.zeros((len(points), 3, 7))
    x, y, z = points.T
    design[:, [0, 1, 2], [0, 1, 2]] = 1
    design[:, 1, 3], design[:, 2, 3] = -z, y
    design[:, 0, 4], design[:, 2, 4] = z, -x
    design[:, 0, 5], design[:, 1, 5] = -y, x
    design[:, :, 6] = points
    return design

"""The flat wall of [C&D]: convergent pairs along it, and what a known camera would measure of it.

Coordinates: x along the wall, y up it, z out of it towards the cameras (m); the wall is z = 0. Seen
as a horizontal plane from above it is the same geometry.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.align.adjust import Adjustment, Priors, State
from calib.camera import BrownCamera, FloatArray
from calib.errors import InputError
from calib.field import LENS_NAMES, Lens
from calib.solution import Observations

#: [C&D] methods: 12 pairs, about 10 m away, axes at 45 degrees to the wall; overlap above 80 %.
PAIRS, DISTANCE_M, OBLIQUE_DEG, OVERLAP = 12, 10.0, 45.0, 0.8
_SIGMA_PX = 0.5


@dataclass(frozen=True)
class Wall:
    """Poses of the photos and the wall's size, m. rotations_cam_from_world (k, 3, 3), centres_m (k, 3)."""

    rotations_cam_from_world: FloatArray
    centres_m: FloatArray
    width_m: float
    height_m: float
    #: Views flatter than this on the wall are not matched.
    most_incidence_deg: float = 75.0


def wall_poses(camera: BrownCamera, pairs: int = PAIRS, distance_m: float = DISTANCE_M) -> Wall:
    """Photos of a flat wall as [C&D] took them: each pair looks at one spot from either side.

    The spots are a fifth of a photo's width at that distance apart (overlap 80 %), which for their
    Phantom 3 gives a wall of 55 m, five times the distance, as they say of theirs. The wall's
    height is not published: half a photo's width is assumed.
    """
    footprint = distance_m * camera.width / camera.f_px
    spots = (np.arange(pairs) - (pairs - 1) / 2) * (1 - OVERLAP) * footprint
    angle = np.radians(OBLIQUE_DEG)
    rotations, centres = [], []
    for spot in spots:
        for side in (1.0, -1.0):
            forward = np.array([side * np.sin(angle), 0.0, -np.cos(angle)])
            right = np.array([np.cos(angle), 0.0, side * np.sin(angle)])
            rotations.append(np.stack([right, np.cross(forward, right), forward]))
            centres.append([spot - side * distance_m * np.tan(angle), 0.0, distance_m])
    width = float(np.ptp(spots)) + footprint
    return Wall(np.array(rotations), np.array(centres), width, footprint / 2)


def wall_observations(
    camera: BrownCamera, wall: Wall, points: int, seed: int = 0
) -> tuple[Observations, FloatArray]:
    """Exact pixels of ``points`` spots of the wall in every photo that sees them, and the spots (m, 3).

    Spots that fewer than two photos see are left out. The spots are the same for the same seed.
    """
    rng = np.random.default_rng(seed)
    flat = rng.uniform(-0.5, 0.5, (points, 2)) * [wall.width_m, wall.height_m]
    spots = np.column_stack([flat, np.zeros(points)])
    offset = spots[:, None, :] - wall.centres_m[None, :, :]
    x, y, z = np.moveaxis(np.einsum("kij,mkj->mki", wall.rotations_cam_from_world, offset), -1, 0)
    size = np.array([camera.width, camera.height])
    edge = camera.unproject(np.array([[0, 0], [0, 1], [1, 0], [1, 1], [0.5, 0], [0, 0.5]]) * size)
    edge = edge[np.isfinite(edge).all(axis=1)]
    # Rays far outside are left out before the radial polynomial can fold them back in.
    limit = 1.02 * np.abs(edge).max(axis=0, initial=0.0)
    least = np.cos(np.radians(wall.most_incidence_deg))
    steep = -offset[..., 2] > least * np.linalg.norm(offset, axis=-1)
    point, photo = np.nonzero((z > 0) & steep & (np.abs(x) < limit[0] * z) & (np.abs(y) < limit[1] * z))
    depth = z[point, photo]
    pixels = camera.project(np.stack([x[point, photo] / depth, y[point, photo] / depth], axis=-1))
    inside = ((pixels >= 0) & (pixels <= size)).all(axis=1)
    point, photo, pixels = point[inside], photo[inside], pixels[inside]
    twice = np.bincount(point, minlength=points)[point] >= 2
    used, renumbered = np.unique(point[twice], return_inverse=True)
    sigma = np.full(int(twice.sum()), _SIGMA_PX)
    return Observations(photo[twice], renumbered, pixels[twice], sigma), spots[used]


def wall_adjustment(
    lens: Lens, wall: Wall, observations: Observations, points_m: FloatArray
) -> tuple[Adjustment, State]:
    """The block to be adjusted, and a state to start from.

    A hand-held camera has no positions: weak ones (a tenth of the distance) only keep the block from
    floating away as a whole.

    Raises:
        InputError: a photo sees less than six spots.
    """
    k = len(wall.centres_m)
    if len(observations) == 0 or np.bincount(observations.photo, minlength=k).min() < 6:
        raise InputError("Some photos of the wall see too little of it: more points are needed.")
    loose = 0.1 * float(np.abs(wall.centres_m[:, 2]).mean())
    priors = Priors(
        centres_m=wall.centres_m,
        centre_sigma_m=np.full((k, 3), loose),
        rotations=wall.rotations_cam_from_world,
        rotation_sigma_rad=np.full(k, np.inf),
        lens_mean=np.zeros(len(LENS_NAMES)),
        lens_sigma=np.full(len(LENS_NAMES), np.inf),
    )
    adjustment = Adjustment(observations, k, len(points_m), priors, robust_positions=False)
    return adjustment, State(lens, wall.rotations_cam_from_world, wall.centres_m, points_m)


def wall_block(camera: BrownCamera, points: int = 500, seed: int = 0) -> tuple[Adjustment, State]:
    """An exact, noise-free block of the wall for ``camera``, and its true state.

    Raises:
        InputError: the camera sees too little of the wall.
    """
    wall = wall_poses(camera)
    observations, spots = wall_observations(camera, wall, points, seed)
    return wall_adjustment(Lens(camera), wall, observations, spots)

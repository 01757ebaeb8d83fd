"""A flat or bent wall at observation level: exact truth, no images; calibrated as its photos would be."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.align.adjust import Priors, State
from calib.align.child import Outcome, measured
from calib.align.flatness import measure_flatness
from calib.align.rotations import rotation_exp
from calib.align.selfcal import calibrate, with_lens_priors
from calib.align.tracks import select
from calib.camera import BrownCamera, FloatArray
from calib.field import LENS_NAMES, Lens
from calib.photos.photo import CameraIdentity, Photo, Processing
from calib.solution import Georeference, Observations
from calib.wall import DISTANCE_M, OBLIQUE_DEG, OVERLAP, PAIRS, Wall, wall_poses
from sim.flights import phantom3
from sim.pattern import random_pattern


@dataclass(frozen=True)
class WallOptions:
    """``advised``: photographed as the manual advises, ``pairs`` not counting; otherwise [C&D]'s level pairs.
    ``bend_percent``: height of the wall's middle over its ends, percent of the distance; ``rough_m``: rms of
    its surface. ``match_share``: probability that a view of a spot is kept. ``one_sided``: pairs from one
    side only. ``pattern_px``: non-Brown part of the lens at 4000 px width."""

    pairs: int = PAIRS
    advised: bool = False
    points: int = 1200
    bend_percent: float = 0.0
    rough_m: float = 0.002
    noise_px: float = 0.3
    match_share: float = 0.5
    one_sided: bool = False
    pattern_px: float = 0.5


def wall_outcome(seed: int, options: WallOptions | None = None, camera: BrownCamera | None = None) -> Outcome:
    """What an alignment of photos of the wall would give, the same for the same seed.

    Raises:
        AlignmentError: too few observations survive.
    """
    options, camera = options or WallOptions(), camera or phantom3()
    rng = np.random.default_rng([seed, 21])
    wall = advised_wall(camera) if options.advised else wall_poses(camera, options.pairs)
    rotations, centres = wall.rotations_cam_from_world, wall.centres_m
    if options.one_sided:
        rotations, centres = rotations[::2], centres[::2]
    k = len(centres)
    rotations = rotation_exp(np.radians(2.0) * rng.normal(size=(k, 3))) @ rotations
    centres = centres + 0.3 * rng.normal(size=(k, 3))
    spots = rng.uniform(-0.5, 0.5, (options.points, 2)) * [wall.width_m, wall.height_m]
    bend = -options.bend_percent / 100 * DISTANCE_M * (2 * spots[:, 0] / wall.width_m) ** 2
    points = np.column_stack([spots, bend + options.rough_m * rng.normal(size=len(spots))])
    observations, points = _seen(camera, rotations, centres, points, options, rng, seed)
    loose = Priors(
        centres,
        np.full((k, 3), 30 * wall.width_m),
        rotations,
        np.full(k, np.inf),
        np.zeros(len(LENS_NAMES)),
        np.full(len(LENS_NAMES), np.inf),
    )
    nominal = 1.02 * camera.f_px
    start = State(
        Lens(BrownCamera.ideal(camera.width, camera.height, nominal)),
        rotation_exp(0.01 * rng.normal(size=(k, 3))) @ rotations,
        centres + 0.1 * rng.normal(size=(k, 3)),
        points + 0.05 * rng.normal(size=points.shape),
    )
    block = calibrate(observations, start, with_lens_priors(loose, camera.width, camera.height, nominal))
    nowhere = Georeference(None, None, None, None, trusted=False)
    solution = block.solution(_photos(camera, k), nowhere, (k,))
    outcome = measured(solution, block, None)
    return replace(outcome, flatness=measure_flatness(block, outcome.estimate))


def advised_wall(camera: BrownCamera, places: int = 8) -> Wall:
    """At every place along the wall three photos, from the left, head-on and from the right.

    From 8 m and 12 m by turns, and at two places level, at the next two with the camera upright. Places are a
    fifth of a photo's width apart.
    """
    footprint = DISTANCE_M * camera.width / camera.f_px
    spots = (np.arange(places) - (places - 1) / 2) * (1 - OVERLAP) * footprint
    rotations, centres = [], []
    for i, spot in enumerate(spots):
        distance = (8.0, 12.0)[i % 2]
        roll = rotation_exp(np.array([[0.0, 0.0, np.pi / 2 * (i // 2 % 2)]]))[0]
        for side in (1.0, 0.0, -1.0):
            angle = side * np.radians(OBLIQUE_DEG)
            forward = np.array([np.sin(angle), 0.0, -np.cos(angle)])
            right = np.array([np.cos(angle), 0.0, np.sin(angle)])
            rotations.append(roll @ np.stack([right, np.cross(forward, right), forward]))
            centres.append([spot - distance * np.tan(angle), 0.0, distance])
    width = float(np.ptp(spots)) + footprint
    return Wall(np.array(rotations), np.array(centres), width, footprint / 2)


def _seen(
    camera: BrownCamera,
    rotations: FloatArray,
    centres: FloatArray,
    points: FloatArray,
    options: WallOptions,
    rng: np.random.Generator,
    seed: int,
) -> tuple[Observations, FloatArray]:
    """Noisy pixels of the spots in the photos that see them, and the spots seen twice."""
    size = np.array([camera.width, camera.height], float)
    offset = points[:, None, :] - centres[None, :, :]
    x, y, z = np.moveaxis(np.einsum("kij,mkj->mki", rotations, offset), -1, 0)
    edge = camera.unproject(np.array([[0, 0], [0, 1], [1, 0], [1, 1], [0.5, 0], [0, 0.5]]) * size)
    # Rays far outside are left out before the radial polynomial can fold them back in.
    limit = 1.05 * np.abs(edge).max(axis=0)
    steep = -offset[..., 2] > np.cos(np.radians(75)) * np.linalg.norm(offset, axis=-1)
    point, photo = np.nonzero((z > 0) & steep & (np.abs(x) < limit[0] * z) & (np.abs(y) < limit[1] * z))
    kept = rng.random(len(point)) < options.match_share
    point, photo = point[kept], photo[kept]
    depth = z[point, photo]
    pixels = camera.project(np.stack([x[point, photo] / depth, y[point, photo] / depth], axis=-1))
    if options.pattern_px > 0:
        pixels = pixels + random_pattern(seed, camera, options.pattern_px * camera.width / 4000)(pixels)
    inside = ((pixels >= 0) & (pixels <= size)).all(axis=1)
    point, photo, pixels = point[inside], photo[inside], pixels[inside]
    noisy = pixels + options.noise_px * rng.normal(size=pixels.shape)
    seen = Observations(photo, point, noisy, np.full(len(point), options.noise_px))
    seen, old = select(seen, np.ones(len(point), bool))
    return seen, points[old]


def _photos(camera: BrownCamera, count: int) -> tuple[Photo, ...]:
    identity = CameraIdentity("DJI", "FC300X", "SIM", camera.width, camera.height, Processing.RAW)
    return tuple(Photo(Path(f"WALL_{i:04d}.JPG"), identity) for i in range(count))

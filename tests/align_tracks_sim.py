"""What matching would have found in a simulated block: tracks and pairs without priors."""

from __future__ import annotations

import numpy as np

from calib.align.grow import Partial
from calib.align.matching import PairMatches
from calib.camera import BrownCamera, FloatArray
from calib.field import Lens
from calib.similarity import Similarity, fit_similarity
from sim.network import SimBlock


def pairs_of(block: SimBlock, least: int = 20) -> list[PairMatches]:
    """All pairs of photos with at least ``least`` points in common."""
    seen = block.observations
    k = len(block.centres_m)
    where = np.full((k, len(block.points_m)), -1)
    where[seen.photo, seen.point] = np.arange(len(seen))
    found = []
    for a in range(k):
        for b in range(a + 1, k):
            both = np.flatnonzero((where[a] >= 0) & (where[b] >= 0))
            if len(both) >= least:
                shift = seen.pixels[where[a, both]] - seen.pixels[where[b, both]]
                distance = float(np.median(np.linalg.norm(shift, axis=1)))
                found.append(PairMatches(a, b, np.stack([both, both], axis=1), distance))
    return found


def nominal_lens(block: SimBlock) -> Lens:
    camera = block.lens.brown
    return Lens(BrownCamera.ideal(camera.width, camera.height, 0.99 * camera.f_px))


def placed(block: SimBlock, found: Partial) -> tuple[Similarity, FloatArray, FloatArray]:
    """The best transformation to the truth; what then remains in positions (m) and attitudes (degrees)."""
    on = found.registered
    transform = fit_similarity(found.centres[on], block.centres_m[on])
    away = np.linalg.norm(transform.apply(found.centres[on]) - block.centres_m[on], axis=1)
    turns = found.rotations[on] @ transform.rotation.T @ block.rotations_cam_from_world[on].transpose(0, 2, 1)
    angle = np.degrees(np.arccos(np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    return transform, away, angle

"""Several flights over one ground: what a photo measures does not depend on the flights beside its own.

The same first flight, seen alone and together with a later one, has the same errors of receiver and
gimbal and the same noise in every tie point; a later flight only brings more of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.camera import BrownCamera, FloatArray
from calib.network_views import Matching, nearest_view_deg
from sim.flights import Flight
from sim.network import (
    SimBlock,
    SimOptions,
    blunders_px,
    candidates,
    draw_ground,
    measured,
    seen,
    smooth_noise,
    truth_of,
)


def observe_together(
    name: str,
    flights: Sequence[tuple[int, Flight]],
    camera: BrownCamera,
    seed: int,
    options: SimOptions,
    matching: Matching,
) -> SimBlock:
    """What ``camera`` measures on numbered flights over the same random ground.

    A view becomes a tie point with the probability ``options.match_share``, times what ``matching`` says
    for its angle to the nearest other view of the point.
    """
    rngs = [np.random.default_rng([seed, 41, number]) for number, _ in flights]
    normals = [rng.normal(size=(2, len(flight), 3)) for rng, (_, flight) in zip(rngs, flights, strict=True)]
    whole = flights[0][1]
    for _, flight in flights[1:]:
        whole = whole + flight
    ground = draw_ground(np.random.default_rng([seed, 4]), options)
    truth = truth_of(name, whole, camera, seed, options, ground, np.concatenate(normals, axis=1))
    point, photo = candidates(truth, np.cos(np.radians(matching.max_incidence_deg)))
    pixels = seen(truth, photo, truth.points_m[point])
    size = np.array([camera.width, camera.height], dtype=float)
    inside = np.all((pixels >= 0) & (pixels <= size), axis=-1)
    point, photo, pixels = point[inside], photo[inside], pixels[inside]
    share = matching.share(nearest_view_deg(photo, point, truth.centres_m, truth.points_m))

    # One row a view, drawn photo by photo for all ground points.
    unit, noise = np.empty((len(point), 4)), np.empty((len(point), 2))
    first = 0
    for rng, (_, flight) in zip(rngs, flights, strict=True):
        for i in range(first, first + len(flight)):
            mine = photo == i
            unit[mine] = rng.random((len(ground), 4))[point[mine]]
            noise[mine] = rng.normal(size=(len(ground), 2))[point[mine]]
        mine = (photo >= first) & (photo < first + len(flight))
        noise[mine] *= options.noise_px
        if options.correlated_px > 0:
            where = pixels[mine] / camera.width
            smooth = smooth_noise(rng, len(flight), photo[mine] - first, where)
            noise[mine] += options.correlated_px * smooth
        first += len(flight)
    kept = unit[:, 0] < options.match_share * share
    kept &= (np.bincount(point[kept], minlength=len(ground)) >= 2)[point]
    mismatched = unit[:, 1] < options.mismatch_rate
    noisy: FloatArray = pixels + noise
    blunders = noisy + blunders_px(unit[:, 2:].T, camera.width)
    noisy[mismatched] = np.clip(blunders[mismatched], 0, size)
    return measured(truth, photo[kept], point[kept], noisy[kept], mismatched[kept], options.noise_px)

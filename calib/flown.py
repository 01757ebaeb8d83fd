"""The network that was flown and solved, thinned to what planning more photos needs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.align.rays import ray_angle_deg
from calib.align.selfcal import LEAST_ANGLE_DEG, Calibrated
from calib.camera import FloatArray
from calib.network_design import CameraNetwork, Known
from calib.network_views import seen_points
from calib.solution import IntArray, Observations

#: Views kept of each photo, on average: as many as let its pose and its part of the lens be told.
VIEWS_PER_PHOTO = 90
#: Photos keep at least so many.
LEAST_VIEWS = 8
#: Observations with less robust weight are outliers and say nothing.
_LEAST_WEIGHT = 0.1


@dataclass(frozen=True)
class FlownNetwork:
    """A solved block as a camera network; frame and units of ``CameraNetwork``.

    Its points are an even part of the block's, each standing for ``stands_for`` of them.
    ``noise_px``: standard deviation of one real tie point's coordinate, correlation within photos
    and variance factor included. ``matched_share``: share of the block's points in a photo's field
    of view that are matched in it.
    """

    network: CameraNetwork
    known: Known
    noise_px: float
    stands_for: float
    matched_share: float

    @property
    def tie_points_per_photo(self) -> float:
        """Real tie points of a photo, on average."""
        return self.stands_for * len(self.network.point) / len(self.network.centres_m)

    @property
    def points_per_photo(self) -> float:
        """Points of this network in the field of view of a photo, on average."""
        return self.tie_points_per_photo / (self.stands_for * self.matched_share)


def flown_network(block: Calibrated, correlation_factor: float) -> FlownNetwork:
    """The network of a solved block.

    Args:
        correlation_factor: variance factor of residuals correlated within photos; what of it the
            block's own weights hold already is not counted again.
    """
    adjusted, adjustment = block.adjusted, block.adjustment
    obs, state = block.observations, adjusted.state
    # Less than 1 where the weights allow for what the shutter's unknowns have explained since.
    excess = correlation_factor / adjustment.noise_factor
    noise = float(np.median(obs.sigma_px)) * adjusted.sigma0 * float(np.sqrt(excess))
    good = adjusted.weights > _LEAST_WEIGHT
    # A point whose remaining rays hardly cross hangs in the air: it says nothing of the lens, and its place
    # would decide the dome.
    counted = Observations(obs.photo[good], obs.point[good], obs.pixels[good], obs.sigma_px[good])
    good &= (ray_angle_deg(state.centres_m, state.points_m, counted) > LEAST_ANGLE_DEG)[obs.point]
    priors = adjustment.priors
    known = Known(
        priors.centre_sigma_m, priors.rotation_sigma_rad, priors.lens_sigma, adjusted.free,
        priors.way_information,
    )  # fmt: skip
    views = CameraNetwork(
        state.lens, state.rotations, state.centres_m, state.points_m, obs.photo[good], obs.point[good],
        np.full(int(good.sum()), noise),
    )  # fmt: skip
    return thinned(views, known, noise)


def thinned(full: CameraNetwork, known: Known, noise_px: float) -> FlownNetwork:
    """An even part of a network's points, standing for all of them; points without views are left out."""
    photo, point = full.photo, full.point
    chosen = _even_part(full.points_m, photo, point, len(full.centres_m))
    used = chosen[point]
    old, renumbered = np.unique(point[used], return_inverse=True)
    stands_for = len(np.unique(point)) / len(old)
    seen = seen_points(full.lens.brown, full.rotations, full.centres_m, full.points_m[old])[0]
    network = replace(
        full,
        points_m=full.points_m[old],
        photo=photo[used],
        point=renumbered,
        sigma_px=np.full(int(used.sum()), noise_px / np.sqrt(stands_for)),
    )
    return FlownNetwork(network, known, noise_px, stands_for, min(len(renumbered) / max(len(seen), 1), 1.0))


def _even_part(points_m: FloatArray, photo: IntArray, point: IntArray, n_photos: int) -> np.ndarray:
    """Which points (m,) stay: every n-th along a way over all the ground, and what photos need."""
    present = np.unique(point)
    most = VIEWS_PER_PHOTO * n_photos
    chosen = np.zeros(len(points_m), bool)
    share = min(most / max(len(point), 1), 1.0)
    wanted = max(round(share * len(present)), 1)
    order = present[_there_and_back(points_m[present], wanted)]
    chosen[order[np.linspace(0, len(order) - 1, wanted).round().astype(int)]] = True
    lacking = LEAST_VIEWS - np.bincount(photo[chosen[point]], minlength=n_photos)
    for i in np.flatnonzero(lacking > 0):
        mine = point[(photo == i) & ~chosen[point]]
        chosen[mine[np.linspace(0, len(mine) - 1, min(int(lacking[i]), len(mine))).astype(int)]] = True
    return chosen


def _there_and_back(points_m: FloatArray, cells: int) -> IntArray:
    """An order of points that goes to and fro over strips of the ground, as wide as cells of even parts."""
    level = points_m[:, :2] - points_m[:, :2].min(axis=0)
    extent = np.maximum(np.ptp(level, axis=0), 1e-6)
    width = float(np.sqrt(extent.prod() / max(cells, 1)))
    strip = np.floor(level[:, 0] / width).astype(int)
    along = np.where(strip % 2 == 0, level[:, 1], -level[:, 1])
    order: IntArray = np.lexsort((along, strip))
    return order

"""What an alignment gives: lens, poses, points, observations and their covariances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.camera import BrownCamera, FloatArray
from calib.field import Lens
from calib.photos.photo import LeftOut, Photo

IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Observations:
    """Image measurements, sorted by point. n observations of m points in k photos.

    photo: (n,) index into the solution's photos. point: (n,) index into its points.
    pixels: (n, 2). sigma_px: (n,) a-priori standard deviation per coordinate.
    """

    photo: IntArray
    point: IntArray
    pixels: FloatArray
    sigma_px: FloatArray

    def __len__(self) -> int:
        return len(self.photo)


@dataclass(frozen=True)
class Georeference:
    """The local frame (east, north, up in metres) and how the geotags fit the block."""

    #: Latitude, longitude, altitude of the local origin; None where photos have no positions.
    origin_wgs84: tuple[float, float, float] | None
    crs: str | None
    #: Camera position minus geotag after the best seven-parameter fit, rms.
    rms_xy_m: float | None
    rms_z_m: float | None
    #: Whether the geotags were believed in the adjustment, and if not, why (a sentence).
    trusted: bool
    fault: str | None = None
    #: Angle between the up axis that the geotags ask for and the one kept, degrees.
    tilt_conflict_deg: float | None = None

    @property
    def metric(self) -> bool:
        """Whether lengths of the block are metres and its axes east and north.

        Scale and heading come from the geotags alone; where those are missing or not believed,
        only proportions mean anything, such as a share of the flying height.
        """
        return self.trusted


@dataclass(frozen=True)
class Solution:
    """A self-calibrated block.

    photos: the k aligned photos. rotations_cam_from_world (k, 3, 3), centres_m (k, 3): in the
    local frame (x east, y north, z up). points_m (m, 3). ``residuals_px`` (n, 2): measured minus
    projected. ``weights`` (n,): robust weight 0..1 of each observation in the last step.
    ``covariance`` (35, 35) over ``LENS_NAMES``: formal, scaled by sigma0; parameters that were
    held have zero rows. ``free`` (35,) tells which were estimated.
    """

    photos: tuple[Photo, ...]
    lens: Lens
    free: NDArray[np.bool_]
    covariance: FloatArray
    rotations_cam_from_world: FloatArray
    centres_m: FloatArray
    points_m: FloatArray
    observations: Observations
    residuals_px: FloatArray
    weights: FloatArray
    sigma0: float
    georeference: Georeference
    left_out: tuple[LeftOut, ...] = ()
    #: Photos given to the alignment (after the sorting), and size of every component in photos.
    photos_used: int = 0
    components: tuple[int, ...] = ()
    converged: bool = True
    iterations: int = 0

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals per observation (2-d), outliers left out."""
        good = self.weights > 0.1
        return float(np.sqrt(np.mean(np.sum(self.residuals_px[good] ** 2, axis=1)))) if good.any() else 0.0


@dataclass(frozen=True)
class Estimate:
    """The calibration to be judged: Brown fitted to the total mapping, with honest sigmas.

    ``covariance`` (11, 11) over ``BROWN_NAMES`` is that of ``brown``, inflated by correlated
    residuals and by the spread over defensible models. ``sigma_f_formal_px`` is before inflation.
    ``models`` maps a model's name to its f in px; ``spread_f_px`` is the largest move among the
    defensible ones, ``split_f_px`` odd minus even. ``lens_covariance`` (35, 35) is the inflated
    covariance of the total mapping's parameters.
    """

    brown: BrownCamera
    covariance: FloatArray
    lens: Lens
    lens_covariance: FloatArray
    sigma_f_formal_px: float
    spread_f_px: float
    models: dict[str, float]
    #: Models whose residuals are significantly worse: tried, not defensible, not in the spread.
    rejected_models: dict[str, float]
    split_f_px: float
    split_sigma_f_px: float
    #: Largest projection difference between the two halves over its predicted sigma.
    split_profile_ratio: float
    #: Variance factor from residuals that are correlated within a photo (1: none).
    correlation_factor: float

    @property
    def sigma_f_px(self) -> float:
        return float(np.sqrt(self.covariance[0, 0]))


@dataclass(frozen=True)
class Network:
    """How the photos look at the ground. tilt_deg (k,) off nadir, height_agl_m (k,)."""

    tilt_deg: FloatArray
    height_agl_m: FloatArray
    gsd_m: float
    #: Flying heights as rounded levels in m.
    heights_agl_m: tuple[float, ...]
    nadir: int
    convergent: int

    @property
    def convergent_share(self) -> float:
        return self.convergent / max(len(self.tilt_deg), 1)


@dataclass(frozen=True)
class Dome:
    """Height error that a wrong calibration bends into the model.

    ``amplitude_m``: signed, positive when the middle of the site comes out too high (dome),
    negative for a dish; free solution minus solution held at the reference, after a
    seven-parameter alignment. None without a reference. ``sigma_m``: of it, from the inflated covariances of
    the photos and of the reference; ``left_open_m``: what the photos alone leave open.
    ``grid_*``: (g,), (g,), (g, g) map of the difference.
    """

    amplitude_m: float | None
    sigma_m: float
    left_open_m: float
    flying_height_m: float
    site_radius_m: float
    grid_east_m: FloatArray | None = None
    grid_north_m: FloatArray | None = None
    grid_difference_m: FloatArray | None = None

    @property
    def amplitude_percent(self) -> float | None:
        return None if self.amplitude_m is None else 100 * self.amplitude_m / self.flying_height_m


@dataclass(frozen=True)
class HeldFit:
    """How a block whose lens was held at a reference fits it.

    ``move_percent``: what the photos would change of f, were they free to; ``move_p``: how often chance
    alone moves f and K1-K3 as far, given the sigmas of both.
    ``ring_*`` (r,): mean radial residual with its sigma, by distance from the principal point.
    ``position_dome_percent``: bend of the camera heights against the measured ones over the site, in
    percent of the flying height, positive as in :class:`Dome`; None without believed positions.
    """

    move_percent: float
    move_p: float
    ring_radius_px: FloatArray
    ring_mean_px: FloatArray
    ring_sigma_px: FloatArray
    position_dome_percent: float | None
    sigma_position_dome_percent: float | None

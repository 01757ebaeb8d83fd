"""How good a model is against reference points: P_SfM = M7 P_true + eta ([C&D] eq. 4).

Seven parameters say where the model sits, what is left (eta) is the model's own error: signed
vertical distances to the Delaunay surface of the reference after M7. Their standard deviation is
eta_p; a profile across the site shows a dome or dish, eta against elevation a wrong vertical scale.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import QhullError
from scipy.spatial.transform import Rotation

from calib.camera import FloatArray
from calib.errors import InputError
from calib.similarity import Similarity, fit_similarity

#: Order of every vector and covariance of the seven parameters: m, degrees, percent.
SEVEN_NAMES = ("Tx", "Ty", "Tz", "Rphi", "Rtheta", "Rpsi", "S")
#: First about z (azimuth), then x, then y, all about fixed axes ([C&D] results).
_ORDER: Final = "zxy"


@dataclass(frozen=True)
class Seven:
    """M7: reference -> model, about the origin of the coordinates.

    ``values`` and ``sigmas`` (7,) in the order of ``SEVEN_NAMES``: Tx Ty Tz in m; Rphi about z, then
    Rtheta about x, then Rpsi about y, degrees; S in percent, 100 where the model has the true scale.
    ``covariance`` (7, 7) of the values. ``residual_mean_m``, ``residual_std_m``: vertical, at the points
    of the registration.
    """

    similarity: Similarity
    values: FloatArray
    covariance: FloatArray
    residual_mean_m: float
    residual_std_m: float

    @property
    def sigmas(self) -> FloatArray:
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def similarity_of(values: FloatArray) -> Similarity:
    """The transformation of seven values (7,) in the order of ``SEVEN_NAMES``."""
    return Similarity(float(values[6]) / 100, _matrix(values[3:6]), np.asarray(values[:3], float))


def seven_derivatives(values: FloatArray, reference_m: FloatArray) -> FloatArray:
    """How transformed points (n, 3) move with each of the seven values: (n, 3, 7)."""
    at = similarity_of(values)
    design = np.zeros((len(reference_m), 3, 7))
    design[:, [0, 1, 2], [0, 1, 2]] = 1
    small = 1e-4
    for i in range(3):
        step = np.zeros(3)
        step[i] = small
        turned = (_matrix(values[3:6] + step) - _matrix(values[3:6] - step)) / (2 * small)
        design[:, :, 3 + i] = at.scale * reference_m @ turned.T
    design[:, :, 6] = reference_m @ at.rotation.T / 100
    return design


def _matrix(angles_deg: FloatArray) -> FloatArray:
    matrix: FloatArray = Rotation.from_euler(_ORDER, angles_deg, degrees=True).as_matrix()
    return matrix


def seven_parameters(reference_m: FloatArray, model_m: FloatArray) -> Seven:
    """M7 by least squares over the same points in the reference and in the model, (n, 3) each.

    Sigmas are from the residuals, taken as independent.

    Raises:
        InputError: shapes differ, fewer than three points, points on one line or not finite.
    """
    if reference_m.shape != model_m.shape or reference_m.ndim != 2 or reference_m.shape[1] != 3:
        raise InputError("Reference points and model points must be two lists of equally many x, y, z.")
    if not (np.isfinite(reference_m).all() and np.isfinite(model_m).all()):
        raise InputError("Reference points and model points must be numbers.")
    if len(model_m) < 3 or np.linalg.matrix_rank(reference_m - reference_m.mean(axis=0), rtol=1e-9) < 2:
        raise InputError("Seven parameters need three points that are not on one line.")
    fitted = fit_similarity(reference_m, model_m)
    angles = Rotation.from_matrix(fitted.rotation).as_euler(_ORDER, degrees=True)
    values = np.concatenate([fitted.shift, angles, [100 * fitted.scale]])
    rest = model_m - fitted.apply(reference_m)
    flat = seven_derivatives(values, reference_m).reshape(-1, 7)
    columns = np.linalg.norm(flat, axis=0)
    inverse = np.linalg.pinv((flat / columns).T @ (flat / columns))
    variance = float(np.sum(rest**2)) / max(3 * len(model_m) - 7, 1)
    covariance = variance * inverse / np.outer(columns, columns)
    return Seven(fitted, values, covariance, float(rest[:, 2].mean()), float(rest[:, 2].std()))


class Surface:
    """The Delaunay surface over points (m, 3): height as a function of x and y."""

    def __init__(self, points_m: FloatArray) -> None:
        """Raises:
        InputError: the points span no surface.
        """
        try:
            self._height = LinearNDInterpolator(points_m[:, :2], points_m[:, 2])
        except (QhullError, ValueError) as error:
            raise InputError("The reference points span no surface: three apart are needed.") from error

    def height_m(self, xy_m: FloatArray) -> FloatArray:
        """Height at (n, 2); NaN outside the points."""
        height: FloatArray = np.asarray(self._height(xy_m), float)
        return height

    def signed_distance_m(self, points_m: FloatArray) -> FloatArray:
        """How far points (n, 3) lie above the surface, vertically; NaN outside."""
        return points_m[:, 2] - self.height_m(points_m[:, :2])


@dataclass(frozen=True)
class ElevationTrend:
    """eta = slope x elevation + constant: ``slope`` is the error of the vertical scale, with sigma.

    ``told``: the ground has relief enough to tell it.
    """

    slope: float
    sigma: float
    correlation: float
    told: bool = True


@dataclass(frozen=True)
class Assessment:
    """M7 and what it leaves: ``points_m`` (n, 3) of the model over the reference, with ``eta_m`` (n,)."""

    seven: Seven
    points_m: FloatArray
    eta_m: FloatArray

    @property
    def eta_p_m(self) -> float:
        """Standard deviation of eta: the precision of the model."""
        return float(self.eta_m.std())


def assess(
    model_m: FloatArray,
    surface_m: FloatArray,
    registration: tuple[FloatArray, FloatArray],
) -> Assessment:
    """Hold a model against a reference.

    Args:
        model_m: (n, 3) points of the model.
        surface_m: (m, 3) reference points that make the surface.
        registration: the same points in the reference and in the model, (r, 3) each; M7 is from
            these ([C&D] took the periphery of the site).

    Raises:
        InputError: too few points, or no point of the model lies over the reference.
    """
    seven = seven_parameters(*registration)
    eta = Surface(seven.similarity.apply(surface_m)).signed_distance_m(model_m)
    over = np.isfinite(eta)
    if not over.any():
        raise InputError("No point of the model lies over the reference points.")
    return Assessment(seven, model_m[over], eta[over])


def profile(
    points_m: FloatArray,
    eta_m: FloatArray,
    start_xy_m: FloatArray,
    end_xy_m: FloatArray,
    width_m: float,
    bins: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """eta along a line: distance from its start (bins,), mean and standard deviation (bins,).

    Points within ``width_m`` / 2 of the line count; NaN where there are none.
    """
    way = np.asarray(end_xy_m, float) - start_xy_m
    length = float(np.linalg.norm(way))
    along = (points_m[:, :2] - start_xy_m) @ way / length
    across = (points_m[:, :2] - start_xy_m) @ np.array([-way[1], way[0]]) / length
    near = (np.abs(across) <= width_m / 2) & (along >= 0) & (along <= length)
    slot = np.minimum((along[near] / length * bins).astype(int), bins - 1)
    count = np.bincount(slot, minlength=bins)
    safe = np.where(count > 0, count, 1)
    mean = np.bincount(slot, eta_m[near], bins) / safe
    square = np.bincount(slot, eta_m[near] ** 2, bins) / safe
    spread = np.sqrt(np.maximum(square - mean**2, 0))
    empty = count == 0
    mean[empty], spread[empty] = np.nan, np.nan
    return (np.arange(bins) + 0.5) * length / bins, mean, spread


def elevation_trend(elevation_m: FloatArray, eta_m: FloatArray) -> ElevationTrend:
    """Plain regression of eta (n,) on elevation (n,), errors taken as independent ([C&D] fig. 9).

    Raises:
        InputError: fewer than three points or all at one elevation.
    """
    x = elevation_m - elevation_m.mean()
    if len(x) < 3 or not float(x @ x) > 0:
        raise InputError("A trend with elevation needs points at different elevations.")
    y = eta_m - eta_m.mean()
    slope = float(x @ y / (x @ x))
    rest = float(np.sum((y - slope * x) ** 2)) / (len(x) - 2)
    scale = float(np.sqrt((x @ x) * (y @ y)))
    return ElevationTrend(slope, float(np.sqrt(rest / (x @ x))), float(x @ y) / scale if scale > 0 else 0.0)

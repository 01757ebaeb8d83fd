"""Equifinal families of (K1, K2): which pairs give the same radial distortion.

Two calibrations are equifinal when their radial profiles differ by no more than a tolerance
anywhere on the image radius R ([C&D] fig. 5):

    max over r <= R of |dK1 r^3 + dK2 r^5 + dK3 r^7| <= tolerance.

With s = r / R, A = dK1 R^3, B = dK2 R^5, C = dK3 R^7 (all px) that is a set of strips
|A s^3 + B s^5 + C s^7| <= tolerance in the (A, B) plane, one for each s. Their intersection is
convex, so a Monte Carlo that draws (K1, K2) uniformly and keeps the draws within tolerance
draws uniformly from a convex region, and its regression line of K2 on K1 converges to

    slope = cov(K1, K2) / var(K1),  through the centroid,

with the second moments of that region. Of a polygon these are exact sums over its corners, so
line, band and domain need no sampling. (The tangent strips of finely spaced s differ from the
smooth region by less than 1e-6 of its size.)

The draws may lack K3 ([C&D] eq. 5 and 6) or keep it (eq. 7 and 8): ``k3_model_px``.
All K are in pixel units. The method needs K1 and K2 of opposite sign.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection

from calib.camera import BrownCamera, FloatArray
from calib.errors import InputError
from calib.reference import EquifinalLine

#: Minimax approximation of s^7 on 0..1 by ALPHA s^3 + BETA s^5; its error alternates four times.
MINIMAX_ALPHA = -0.5148440243527993
MINIMAX_BETA = 1.4887040640766898
MINIMAX_ERROR = 0.026139960276109875

#: [C&D] discussion: equifinal within 2 px at 60 m (half the site width), within 10 px at 10 m
#: (a fifth of the wall's width).
STRICT_TOLERANCE_PX, LOOSE_TOLERANCE_PX = 2.0, 10.0
_STRICT_HEIGHT_M, _LOOSE_HEIGHT_M = 60.0, 10.0
_STRICT_RATIO, _LOOSE_RATIO = 0.5, 0.2

_STRIPS = 2000
_DEVIATION_STEPS = 400


@dataclass(frozen=True)
class Radial:
    """Radial distortion K1 (px^-2), K2 (px^-4), K3 (px^-6): displacement K1 r^3 + K2 r^5 + K3 r^7."""

    k1_px: float
    k2_px: float
    k3_px: float = 0.0

    @classmethod
    def of(cls, camera: BrownCamera) -> Radial:
        return cls(camera.k1_px, camera.k2_px, camera.k3_px)

    @property
    def vector(self) -> FloatArray:
        """(3,)."""
        return np.array([self.k1_px, self.k2_px, self.k3_px])

    @property
    def opposite_signs(self) -> bool:
        """The necessary condition of equifinality ([C&D] discussion)."""
        return self.k1_px * self.k2_px < 0


@dataclass(frozen=True)
class Deviation:
    """Largest difference of two radial profiles over the image radius, px, with its sigma.

    ``raw_px`` as [C&D] have it; ``linear_removed_px`` after the multiple of r that fits best
    (least squares over the image area) is taken out: a linear term acts like a change of f,
    which the reconstruction hardly feels. A sigma is the one at the radius where
    |difference| + 1.96 sigma is largest, so that "within tolerance at 95 %" holds at every radius.
    """

    raw_px: float
    sigma_raw_px: float
    linear_removed_px: float
    sigma_linear_removed_px: float


def tolerance_px(height_agl_m: float | None, site_width_m: float | None) -> float:
    """Tolerance on the profile: 2 px, growing to 10 px for low flights ([C&D] discussion).

    Published are two points: 10 px at 10 m, where the height was 20 % of the site's width, and
    2 px at 60 m and 50 %. Between them the tolerance is interpolated linearly, in the height and
    in the ratio, and the smaller of the two counts: a high flight over a wide site is not low.
    2 px where the height or the width is unknown.
    """
    if not height_agl_m or not site_width_m or height_agl_m <= 0 or site_width_m <= 0:
        return STRICT_TOLERANCE_PX
    ends = [LOOSE_TOLERANCE_PX, STRICT_TOLERANCE_PX]
    by_height = np.interp(height_agl_m, [_LOOSE_HEIGHT_M, _STRICT_HEIGHT_M], ends)
    by_ratio = np.interp(height_agl_m / site_width_m, [_LOOSE_RATIO, _STRICT_RATIO], ends)
    return float(min(by_height, by_ratio))


def image_radius_px(camera: BrownCamera) -> float:
    """The radius of [C&D]: half the longer side of the image."""
    return max(camera.width, camera.height) / 2


def without_scale(profile: FloatArray, r_px: FloatArray) -> FloatArray:
    """Profiles (n,) or (n, c) at radii (n,) less the multiple of r that fits each best: a change of f."""
    # Weights r: every pixel of the image counts the same.
    multiple = (r_px * r_px) @ profile / np.sum(r_px**3)
    return np.asarray(profile - np.multiply.outer(r_px, multiple))


def profile_deviation(
    survey: Radial, reference: Radial, radius_px: float, covariance: FloatArray | None = None
) -> Deviation:
    """Deviation of two profiles; ``covariance`` (3, 3) is that of the difference of K1, K2, K3."""
    r = np.linspace(0, radius_px, _DEVIATION_STEPS + 1)[1:]
    design = np.stack([r**3, r**5, r**7], axis=-1)
    values = []
    for jacobian in (design, without_scale(design, r)):
        difference = np.abs(jacobian @ (survey.vector - reference.vector))
        if covariance is None:
            sigma = np.zeros_like(r)
        else:
            sigma = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", jacobian, covariance, jacobian), 0))
        values += [float(difference.max()), float(sigma[np.argmax(difference + 1.96 * sigma)])]
    return Deviation(*values)


def best_pair(reference: Radial, radius_px: float, k3_model_px: float = 0.0) -> tuple[Radial, float]:
    """The calibration with K3 = ``k3_model_px`` nearest to ``reference``, and its deviation in px.

    Nearest in the maximum norm over the radius; the solution for s^7 is universal.
    """
    excess = reference.k3_px - k3_model_px
    pair = Radial(
        reference.k1_px + MINIMAX_ALPHA * excess * radius_px**4,
        reference.k2_px + MINIMAX_BETA * excess * radius_px**2,
        k3_model_px,
    )
    return pair, abs(excess) * radius_px**7 * MINIMAX_ERROR


@dataclass(frozen=True)
class Region:
    """All (K1, K2) within ``tolerance_px`` of ``reference`` for models with K3 = ``k3_model_px``.

    ``corners`` is (c, 2), K1 and K2 in pixel units, counter-clockwise.
    """

    reference: Radial
    radius_px: float
    tolerance_px: float
    k3_model_px: float
    corners: FloatArray

    @cached_property
    def _moments(self) -> tuple[float, float, float, float]:
        """Mean K1, mean K2, slope and K2 at K1 = 0 of the regression line of K2 on K1."""
        # Px at the image edge keep the sums well scaled; the offset avoids cancellation.
        scale = np.array([self.radius_px**3, self.radius_px**5])
        origin = self.corners[0]
        x, y = ((self.corners - origin) * scale).T
        xn, yn = np.roll(x, -1), np.roll(y, -1)
        cross = x * yn - xn * y
        area = cross.sum() / 2
        mean_x = ((x + xn) * cross).sum() / 6 / area
        mean_y = ((y + yn) * cross).sum() / 6 / area
        var_x = ((x * x + x * xn + xn * xn) * cross).sum() / 12 / area - mean_x**2
        cov_xy = ((x * yn + 2 * x * y + 2 * xn * yn + xn * y) * cross).sum() / 24 / area - mean_x * mean_y
        slope = float(cov_xy / var_x * scale[0] / scale[1])
        k1 = float(origin[0] + mean_x / scale[0])
        k2 = float(origin[1] + mean_y / scale[1])
        return k1, k2, slope, k2 - slope * k1

    @property
    def centroid(self) -> tuple[float, float]:
        return self._moments[0], self._moments[1]

    @property
    def slope(self) -> float:
        """dK2 / dK1 of the line, px^-2."""
        return self._moments[2]

    @property
    def intercept(self) -> float:
        """K2 of the line at K1 = 0, px^-4."""
        return self._moments[3]

    @property
    def band_k2_px(self) -> float:
        """Half width of the narrowest band about the line, in K2, that holds the whole region."""
        return float(np.abs(self.offset_k2_px(self.corners[:, 0], self.corners[:, 1])).max())

    def offset_k2_px(self, k1_px: FloatArray, k2_px: FloatArray) -> FloatArray:
        """K2 minus the line at K1: the distance of [C&D] Table 3's last column."""
        return np.asarray(k2_px - self.intercept - self.slope * k1_px)

    @property
    def line(self) -> EquifinalLine:
        """Line, band and domain in one value."""
        low, high = self.corners.min(axis=0), self.corners.max(axis=0)
        return EquifinalLine(
            slope=self.slope,
            intercept=self.intercept,
            k1_min=float(low[0]),
            k1_max=float(high[0]),
            k2_min=float(low[1]),
            k2_max=float(high[1]),
            band_k2_px=self.band_k2_px,
            source=(
                f"closed form: within {self.tolerance_px:g} px of the reference over a radius of "
                f"{self.radius_px:g} px, models with K3 = {self.k3_model_px:.3g} px^-6"
            ),
        )


def equifinal_region(
    reference: Radial, radius_px: float, tolerance_px: float = STRICT_TOLERANCE_PX, k3_model_px: float = 0.0
) -> Region:
    """The region of equifinal (K1, K2) in closed form.

    Raises:
        InputError: radius or tolerance are not positive, or no pair comes within the tolerance.
    """
    if not (np.isfinite(radius_px) and radius_px > 0):
        raise InputError(f"The image radius must be a positive number of pixels, not {radius_px:g}.")
    if not (np.isfinite(tolerance_px) and tolerance_px > 0):
        raise InputError(f"The tolerance must be a positive number of pixels, not {tolerance_px:g}.")
    pair, misfit = best_pair(reference, radius_px, k3_model_px)
    if misfit >= tolerance_px:
        raise InputError(
            f"No pair of K1 and K2 with K3 = {k3_model_px:.3g} px^-6 comes within {tolerance_px:g} px of "
            f"this lens over {radius_px:g} px: the nearest is {misfit:.2g} px away. Allow a larger one."
        )
    s = np.linspace(0, 1, _STRIPS + 1)[1:]
    normals = np.stack([s**3, s**5], axis=-1)
    # In px at the edge about the best pair, in units of the tolerance.
    remainder = s**7 - MINIMAX_ALPHA * s**3 - MINIMAX_BETA * s**5
    excess = (k3_model_px - reference.k3_px) * radius_px**7 / tolerance_px * remainder
    strips = np.concatenate(
        [np.column_stack([normals, excess - 1]), np.column_stack([-normals, -excess - 1])], axis=0
    )
    # Near the centre of the image both strips and normals vanish; the rows are scaled to unit normals.
    strips /= np.linalg.norm(strips[:, :2], axis=1, keepdims=True)
    points = HalfspaceIntersection(strips, np.zeros(2)).intersections
    corners = points[ConvexHull(points).vertices]
    scale = tolerance_px / np.array([radius_px**3, radius_px**5])
    centre = np.array([pair.k1_px, pair.k2_px])
    return Region(reference, radius_px, tolerance_px, k3_model_px, centre + corners * scale)

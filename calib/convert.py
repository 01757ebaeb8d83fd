"""Conversions of a calibration: units, and the image it belongs to (crop, quarter turn, other size).

The other direction of the distortion, distorted -> corrected, is in :mod:`calib.correction`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.camera import BROWN_NAMES, BrownCamera, FloatArray
from calib.errors import InputError

# --- Units -------------------------------------------------------------------------------------


def radial_per_length(radial: Sequence[float], focal_length: float) -> tuple[float, ...]:
    """K1, K2, ... from focal units to px^-2, px^-4, ... or mm^-2, mm^-4, ... ([C&D] eq. 1-3).

    The unit of the result is that of ``focal_length``: px or mm.
    """
    return tuple(k / focal_length ** (2 * i) for i, k in enumerate(radial, 1))


def radial_in_focal_units(radial: Sequence[float], focal_length: float) -> tuple[float, ...]:
    """Inverse of :func:`radial_per_length`."""
    return tuple(k * focal_length ** (2 * i) for i, k in enumerate(radial, 1))


def radial_px_to_mm(radial_px: Sequence[float], pixel_size_mm: float) -> tuple[float, ...]:
    """K1, K2, ... from px^-2, px^-4, ... to mm^-2, mm^-4, ... ([SEN] Table 2's unit)."""
    return radial_per_length(radial_px, pixel_size_mm)


def radial_mm_to_px(radial_mm: Sequence[float], pixel_size_mm: float) -> tuple[float, ...]:
    """Inverse of :func:`radial_px_to_mm`."""
    return radial_in_focal_units(radial_mm, pixel_size_mm)


def decentring_per_length(p: float, focal_length: float) -> float:
    """P1 or P2 from focal units to px^-1 or mm^-1, the unit of ``focal_length``."""
    return p / focal_length


def decentring_in_focal_units(p: float, focal_length: float) -> float:
    """Inverse of :func:`decentring_per_length`."""
    return p * focal_length


# --- Fitting -----------------------------------------------------------------------------------


#: Below this no fit needs to be any better.
NEGLIGIBLE_PX = 1e-5

#: Rounds of reweighting after which the largest misfit of a lens polynomial has settled.
MINIMAX_ROUNDS = 10


def image_grid_px(width: int, height: int, nodes: int = 21) -> FloatArray:
    """Pixels (nodes^2, 2) over the whole image, denser towards the edges (Chebyshev's nodes).

    A least-squares polynomial on these nodes comes close to the one with the smallest maximum error.
    """
    t = (1 - np.cos(np.pi * np.arange(nodes) / (nodes - 1))) / 2
    return np.stack(np.meshgrid(width * t, height * t), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class Fit:
    """A fitted camera; ``misfit_px`` is its largest distance to what it was fitted to."""

    camera: BrownCamera
    misfit_px: float


def fit_brown(
    rays: FloatArray,
    pixels: FloatArray,
    start: BrownCamera,
    free: Sequence[str] = BROWN_NAMES,
    minimax_rounds: int = 0,
) -> Fit:
    """The Brown camera that maps ``rays`` to ``pixels`` (both (n, 2)) best, by Gauss-Newton.

    Only the parameters named in ``free`` move; the others keep ``start``'s values. The sum of squares
    is least; with ``minimax_rounds`` rounds of Lawson's (1961) reweighting the largest distance is.
    """
    columns = [BROWN_NAMES.index(name) for name in free]

    def step(vector: FloatArray, weights: FloatArray) -> tuple[FloatArray, float]:
        """The next vector, and by how much it moves the pixels (root of the weighted sum)."""
        at, _, by_param = BrownCamera.from_vector(start.width, start.height, vector).derivatives(rays)
        root = np.sqrt(weights)[:, None]
        design = (by_param[:, :, columns] * root[:, :, None]).reshape(-1, len(columns))
        scale = np.linalg.norm(design, axis=0)
        solution = np.linalg.lstsq(design / scale, ((pixels - at) * root).ravel(), rcond=None)[0]
        moved = vector.copy()
        moved[columns] += solution / scale
        return moved, float(np.linalg.norm(design / scale @ solution))

    weights = np.ones(len(rays))
    vector = start.vector
    for _ in range(30):
        vector, moved_px = step(vector, weights)
        if moved_px < 1e-7:
            break
    best = _fit(BrownCamera.from_vector(start.width, start.height, vector), rays, pixels)
    for _ in range(minimax_rounds):
        if best.misfit_px < NEGLIGIBLE_PX:
            break
        at = BrownCamera.from_vector(start.width, start.height, vector).project(rays)
        weights = lawson_weights(weights, np.hypot(*(at - pixels).T))
        vector, _ = step(vector, weights)
        found = _fit(BrownCamera.from_vector(start.width, start.height, vector), rays, pixels)
        best = min(best, found, key=lambda fit: fit.misfit_px)
    return best


def _fit(camera: BrownCamera, rays: FloatArray, pixels: FloatArray) -> Fit:
    return Fit(camera, largest_distance_px(camera.project(rays), pixels))


def lawson_weights(weights: FloatArray, errors: FloatArray) -> FloatArray:
    """Next weights (n,) of Lawson's algorithm: what misses most counts more in the next round."""
    grown = weights * errors
    return np.asarray(grown / grown.mean())


def largest_distance_px(a: FloatArray, b: FloatArray) -> float:
    """Largest distance between two sets of pixels (n, 2); infinite where one of them is not a number."""
    worst = float(np.hypot(*(a - b).T).max(initial=0.0))
    return worst if np.isfinite(worst) else float("inf")


def mapping_difference_px(a: BrownCamera, b: BrownCamera) -> float:
    """Largest distance of the two cameras' projections of the rays that fill ``a``'s image.

    Pixels that no ray reaches (a polynomial that turns back before the corners) do not count.
    """
    rays = a.unproject(image_grid_px(a.width, a.height))
    rays = rays[np.isfinite(rays).all(axis=-1)]
    if not len(rays):
        return float("inf")
    return largest_distance_px(a.project(rays), b.project(rays))


# --- Another image of the same lens --------------------------------------------------------------


def cropped(camera: BrownCamera, left: int, top: int, width: int, height: int) -> BrownCamera:
    """The calibration of a window cut out of the image.

    Raises:
        InputError: the window does not lie within the image.
    """
    inside = left >= 0 and top >= 0 and left + width <= camera.width and top + height <= camera.height
    if not inside or width < 1 or height < 1:
        raise InputError(
            f"A window of {width}x{height} px at ({left}, {top}) does not lie within an image of "
            f"{camera.width}x{camera.height} px: give one that does."
        )
    return replace(camera, width=width, height=height, cx_px=camera.cx_px - left, cy_px=camera.cy_px - top)


@dataclass(frozen=True)
class Turned:
    """The calibration of a turned image.

    ``ray(x, y)`` of the original becomes ``R(roll_rad) T (x, y)`` of ``camera``, with T the quarter
    turns and R(a) = [[cos a, -sin a], [sin a, cos a]]. ``roll_rad`` is zero unless the camera has a
    shear b2: Brown's model has its shear along rows only, a turned one has it along columns, and the
    two are the same up to a small roll about the optical axis, which the camera's pose takes up.
    """

    camera: BrownCamera
    roll_rad: float


def rotated(camera: BrownCamera, quarter_turns: int) -> Turned:
    """The calibration of the image after ``quarter_turns`` turns by 90 degrees clockwise, exactly.

    Radial terms do not change, (P2, P1) turns like a vector, the affine part A = [[f, b2], [0, f - b1]]
    becomes T A T^-1, brought back to Brown's upper triangle by a roll.
    """
    turned = Turned(camera, 0.0)
    for _ in range(quarter_turns % 4):
        turned = _quarter_turn(turned)
    return turned


def _quarter_turn(before: Turned) -> Turned:
    c = before.camera
    # (u, v) -> (height - v, u), so x' = -y, y' = x and A' = [[fy, 0], [-b2, fx]].
    p1, p2 = c.p2, -c.p1
    fx, fy, b2, roll = c.fy_px, c.f_px, 0.0, 0.0
    if c.b2_px:
        # A' = U R(roll) with U upper triangular: R turns the last row of A' onto the y axis.
        roll = float(np.arctan2(-c.b2_px, c.f_px))
        cos, sin = np.cos(roll), np.sin(roll)
        fy = float(np.hypot(c.f_px, c.b2_px))
        fx, b2 = float(c.fy_px * cos), float(c.fy_px * sin)
        # Decentring sees the rolled rays.
        p2, p1 = float(cos * p2 - sin * p1), float(sin * p2 + cos * p1)
    camera = replace(
        c,
        width=c.height,
        height=c.width,
        f_px=fx,
        cx_px=c.height - c.cy_px,
        cy_px=c.cx_px,
        p1=p1,
        p2=p2,
        b1_px=fx - fy,
        b2_px=b2,
    )
    return Turned(camera, before.roll_rad + roll)


@dataclass(frozen=True)
class Resized:
    """A calibration brought to another image size; ``how`` is one sentence for the user."""

    camera: BrownCamera
    how: str


def to_image_size(camera: BrownCamera, width: int, height: int) -> Resized:
    """The calibration for the same camera's images of another size.

    Same aspect: the image was resampled. Same width and less height, or same height and less width:
    the camera cut the image about its centre (a 4:3 sensor that writes 16:9).

    Raises:
        InputError: neither applies, so that nobody can say which part of the sensor the image shows.
    """
    w, h = camera.width, camera.height
    sizes = f"{w}x{h} px, the images {width}x{height} px"
    if (width, height) == (w, h):
        return Resized(camera, f"The calibration and the images have the same size, {w}x{h} px.")
    if width < 1 or height < 1:
        raise InputError(f"An image of {width}x{height} px cannot exist: give its real size.")
    if width == w and height < h:
        cut = (h - height) / 2
        moved = replace(camera, height=height, cy_px=camera.cy_px - cut)
        how = f"the height differs only, so the top and bottom {cut:g} rows were taken as cut off"
        return Resized(moved, f"The calibration was made at {sizes}: {how}.")
    if height == h and width < w:
        cut = (w - width) / 2
        moved = replace(camera, width=width, cx_px=camera.cx_px - cut)
        how = f"the width differs only, so the left and right {cut:g} columns were taken as cut off"
        return Resized(moved, f"The calibration was made at {sizes}: {how}.")
    # Resampled sizes are rounded to whole pixels (some encoders: to even ones).
    if abs(width * h / w - height) <= 1 or abs(height * w / h - width) <= 1:
        return Resized(
            camera.scaled(width, height),
            f"The calibration was made at {sizes}: same proportions, so it was scaled by {width / w:.4g}.",
        )
    if (width > w and height >= h) or (height > h and width >= w):
        why = "the images show more of the sensor than was calibrated"
    elif abs(width * w / h - height) <= 1:
        why = "the images are turned by 90 degrees; use them as the camera stored them"
    else:
        why = "neither a plain reduction nor a centred crop leads from one to the other"
    raise InputError(f"The calibration was made at {sizes}: {why}, so it cannot be converted.")

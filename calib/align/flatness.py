"""How flat a photographed wall comes out: plane and second-order surface through its points.

[C&D] methods: a calibration from a flat wall is good when the second-order terms of a surface through
the points are negligible. Their size is given where it is largest, at the rim of the wall, in percent of
the distance between camera and wall; so no scale is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from calib.align.rotations import similarity_tangent
from calib.align.selfcal import Calibrated
from calib.camera import FloatArray
from calib.errors import AlignmentError
from calib.solution import Estimate

#: The second-order terms: bend along the wall, twist, bend up the wall.
TERMS = ("x2", "xy", "y2")
#: Points further from the plane than this share of the distance are something else (ground, trees).
#: A wall that is bent more than this is no wall to calibrate on.
NEAR_PLANE = 0.02
#: Points beyond so many robust sigmas of the surface are left out (a window's reveal, a pipe, a mismatch).
OUTLIER_SIGMAS = 4.0
#: Tie points that a wall needs at least.
LEAST_POINTS = 60
#: A wall longer than so many heights shows by itself which way it runs.
ELONGATED = 1.5
_TRIALS = 400
_CELLS = (12, 6)


@dataclass(frozen=True)
class Plane:
    """A plane through points: ``origin`` (3,), ``axes`` (3, 3) with rows along, up and out of it."""

    origin: FloatArray
    axes: FloatArray

    def coordinates(self, points: FloatArray) -> FloatArray:
        """Points (n, 3) as x along, y up and z out of the plane."""
        local: FloatArray = (points - self.origin) @ self.axes.T
        return local


@dataclass(frozen=True)
class Flatness:
    """Second-order surface through the points of a wall.

    ``terms_percent`` (3,) in the order of ``TERMS`` with ``covariance`` (3, 3): what each term adds at
    the rim (middle of the ends, corner), in percent of the distance. ``points`` (w, 3): points of the
    wall in its plane, lengths in distances: x along, y up, z towards the cameras. ``out_percent`` (w,):
    what the plane alone leaves of them. ``half_size`` (2,): half length and half height, in distances.
    ``cameras`` (k, 3): the cameras in the same frame; ``axes`` (k, 3): their optical axes.
    ``wall_share``: share of all points that belong to the wall; ``rough_percent``: rms around the surface.
    """

    terms_percent: FloatArray
    covariance: FloatArray
    points: FloatArray
    out_percent: FloatArray
    half_size: FloatArray
    cameras: FloatArray
    axes: FloatArray
    ups: FloatArray
    on_wall: NDArray[np.bool_]
    rough_percent: float

    @property
    def sigmas_percent(self) -> FloatArray:
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def wall_share(self) -> float:
        return float(np.mean(self.on_wall))

    @property
    def chance(self) -> float:
        """Probability that chance alone makes the three terms together so large."""
        square = float(self.terms_percent @ np.linalg.solve(self.covariance, self.terms_percent))
        return float(chdtrc(3, max(square, 0.0)))

    def surface_percent(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """The second-order terms at positions in the plane (lengths in distances), percent."""
        u, v = x / self.half_size[0], y / self.half_size[1]
        a, b, c = self.terms_percent
        return np.asarray(a * u * u + b * u * v + c * v * v)


def find_plane(points: FloatArray, cameras: FloatArray, seed: int = 0) -> tuple[Plane, NDArray[np.bool_]]:
    """The plane that most points (m, 3) lie on, its normal towards the cameras (k, 3), and those points.

    ``axes`` of the answer: x and y are any two directions in the plane.

    Raises:
        AlignmentError: the points span no plane.
    """
    rng = np.random.default_rng(seed)
    best: tuple[int, Plane] | None = None
    for _ in range(_TRIALS):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-12:
            continue
        normal = normal / length
        distance = float(np.median(np.abs((cameras - a) @ normal)))
        count = int(np.sum(np.abs((points - a) @ normal) < NEAR_PLANE * distance))
        if best is None or count > best[0]:
            best = count, Plane(a, np.array([[0, 0, 0], [0, 0, 0], normal]))
    if best is None:
        raise AlignmentError("The tie points lie on one line, so there is no wall to be measured.")
    plane = best[1]
    near = np.ones(len(points), bool)
    for _ in range(5):
        distance = float(np.median(np.abs(plane.coordinates(cameras)[:, 2])))
        near = np.abs(plane.coordinates(points)[:, 2]) < NEAR_PLANE * distance
        middle = points[near].mean(axis=0)
        _, _, vt = np.linalg.svd(points[near] - middle, full_matrices=False)
        towards = np.sign(np.median((cameras - middle) @ vt[2])) or 1.0
        axes = np.stack([vt[0], np.cross(towards * vt[2], vt[0]), towards * vt[2]])
        plane = Plane(middle, axes)
    return plane, near


def _levelled(plane: Plane, on_wall: FloatArray, rotations: FloatArray) -> Plane:
    """The plane with x along the wall (where it is long), or as the photos' rows run, and y up.

    ``on_wall`` (w, 3): points of the wall. Photos may be turned upright, so rows alone do not tell.
    """
    normal = plane.axes[2]
    spread, vectors = np.linalg.eigh(np.cov((on_wall - plane.origin).T))
    x = vectors[:, 2]
    if spread[2] < ELONGATED**2 * spread[1]:
        rows = rotations[:, 0, :] - np.outer(rotations[:, 0, :] @ normal, normal)
        rows /= np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
        x = np.linalg.eigh(rows.T @ rows)[1][:, 2]
    x = x - (x @ normal) * normal
    x /= np.linalg.norm(x)
    y = np.cross(normal, x)
    if float(np.sum(rotations[:, 1, :] @ y)) > 0:  # Image rows count downwards.
        x, y = -x, -y
    return Plane(plane.origin, np.stack([x, y, normal]))


def _design(u: FloatArray, v: FloatArray) -> FloatArray:
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)


def measure_flatness(block: Calibrated, estimate: Estimate, seed: int = 0) -> Flatness:
    """Surface through the wall of a calibrated block, with the sigmas that the calibration deserves.

    The covariance has three parts: the block's own (lens, poses and points, inflated by correlated
    residuals), what model spread adds to the lens, and the roughness of the wall itself, waves included.

    Raises:
        AlignmentError: too few points lie on one plane, or the block is too weak to tell.
    """
    adjusted, adjustment = block.adjusted, block.adjustment
    state = adjusted.state
    points, cameras = state.points_m, state.centres_m
    plane, near = find_plane(points, cameras, seed)
    if int(near.sum()) < LEAST_POINTS:
        raise AlignmentError(f"Only {int(near.sum())} tie points lie on one plane: no wall was found.")
    plane = _levelled(plane, points[near], state.rotations)
    local = plane.coordinates(points)
    distance = float(np.median(plane.coordinates(cameras)[:, 2]))
    low, high = np.percentile(local[near, :2], [1.5, 98.5], axis=0)
    half = (high - low) / 2
    middle = (high + low) / 2
    plane = Plane(plane.origin + middle @ plane.axes[:2], plane.axes)
    local = plane.coordinates(points)
    u, v = local[:, 0] / half[0], local[:, 1] / half[1]
    # The points beyond the percentiles would weigh too much at the rim.
    near &= (np.abs(u) < 1.1) & (np.abs(v) < 1.1)
    design = _design(u, v)
    used = near
    for _ in range(8):
        coefficients = np.linalg.lstsq(design[used], local[used, 2], rcond=None)[0]
        rest = local[:, 2] - design @ coefficients
        spread = 1.4826 * float(np.median(np.abs(rest[used])))
        used = near & (np.abs(rest) < OUTLIER_SIGMAS * max(spread, 1e-9 * distance))
    inverse: FloatArray = np.linalg.inv(design[used].T @ design[used]).astype(float)
    # d terms / d heights, carried to all three coordinates of the points.
    rows = (inverse @ design[used].T)[3:]
    gradients = np.zeros((len(points), 3, len(TERMS)))
    gradients[used] = plane.axes[2][None, :, None] * rows.T[:, None, :]
    # In distances the terms do not change with the block's scale, of which nothing is known.
    tangent = similarity_tangent(points - points.mean(axis=0)).reshape(-1, 7)
    flat = gradients.reshape(-1, len(TERMS))
    gradients = (flat - tangent @ np.linalg.lstsq(tangent, flat, rcond=None)[0]).reshape(gradients.shape)
    try:
        formal = adjustment.functional_covariance(adjusted, gradients)
    except np.linalg.LinAlgError as error:
        raise AlignmentError("The photos of the wall hang together too weakly to measure it.") from error
    excess = estimate.correlation_factor / adjustment.noise_factor
    covariance: FloatArray = formal * excess
    if adjusted.point_response is not None:
        by_lens = np.einsum("mjc,mjp->cp", gradients, adjusted.point_response)
        more = estimate.lens_covariance - excess * adjusted.covariance
        covariance = covariance + by_lens @ more @ by_lens.T
    covariance = covariance + _roughness(rest[used], u[used], v[used], inverse)
    percent = 100 / distance
    plain = design[used, :3]
    level = local[used, 2] - plain @ np.linalg.lstsq(plain, local[used, 2], rcond=None)[0]
    return Flatness(
        terms_percent=coefficients[3:] * percent,
        covariance=covariance * percent**2,
        points=np.column_stack([local[used, :2], rest[used]]) / distance,
        out_percent=level * percent,
        half_size=half / distance,
        cameras=plane.coordinates(cameras) / distance,
        axes=state.rotations[:, 2, :] @ plane.axes.T,
        ups=-state.rotations[:, 1, :] @ plane.axes.T,
        on_wall=used,
        rough_percent=float(np.sqrt(np.mean(rest[used] ** 2))) * percent,
    )


def _roughness(rest: FloatArray, u: FloatArray, v: FloatArray, inverse: FloatArray) -> FloatArray:
    """Covariance (3, 3) of the terms from what the points do around the surface.

    Waves of the wall are errors that neighbours share: their variance counts by the cell, not by the point.
    """
    column = np.clip(((u + 1.1) / 2.2 * _CELLS[0]).astype(int), 0, _CELLS[0] - 1)
    row = np.clip(((v + 1.1) / 2.2 * _CELLS[1]).astype(int), 0, _CELLS[1] - 1)
    cell = row * _CELLS[0] + column
    count = np.bincount(cell, minlength=_CELLS[0] * _CELLS[1])
    total = np.bincount(cell, rest, minlength=_CELLS[0] * _CELLS[1])
    filled = count > 0
    variance = float(np.mean(rest**2))
    factor = float(np.mean(total[filled] ** 2 / count[filled])) / max(variance, 1e-300)
    part: FloatArray = inverse[3:, 3:] * variance * max(factor, 1.0)
    return part

"""From an arbitrary block frame to east, north, up; and whether the geotags deserve belief."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib import frames
from calib.camera import FloatArray
from calib.photos.photo import Photo
from calib.similarity import Similarity, fit_robust, mean_rotation
from calib.solution import Georeference

#: A GPS good to 2.5 m gets 5 m ([C&D] pre-processing); heights of the barometer or the GPS alike.
DEFAULT_SIGMA_M = 5.0
#: Stated accuracies are those of the antenna, not of the lens at the moment of exposure.
LEAST_SIGMA_M = 0.05
#: Misfits beyond this many metres (or sigmas) do not come from an honest receiver.
FAULT_M = 10.0
GIMBAL_SIGMA_DEG = 5.0
#: Share of geotags that may be stray (an old fix before the receiver woke up) without spoiling the rest.
STRAY_SHARE = 0.1


@dataclass(frozen=True)
class Tags:
    """Measured positions and attitudes of the photos in the local frame.

    positions_m (k, 3) NaN where unknown, sigma_m (k, 3); rotations (k, 3, 3), has_rotation (k,).
    """

    frame: frames.LocalFrame | None
    crs: str | None
    positions_m: FloatArray
    sigma_m: FloatArray
    rotations: FloatArray
    has_rotation: np.ndarray


def read_tags(photos: Sequence[Photo]) -> Tags:
    """Positions and gimbal angles of the photos as arrays."""
    k = len(photos)
    positions = np.full((k, 3), np.nan)
    frame = crs = None
    local = frames.local_positions([p.position for p in photos])
    if local is not None:
        frame, positions = local
        first = next(p.position for p in photos if p.position is not None)
        crs = frames.utm_crs(first.latitude_deg, first.longitude_deg)
    sigma = np.full((k, 3), DEFAULT_SIGMA_M)
    for index, photo in enumerate(photos):
        if photo.position is None:
            continue
        if photo.position.sigma_horizontal_m:
            sigma[index, :2] = max(photo.position.sigma_horizontal_m, LEAST_SIGMA_M)
        if photo.position.sigma_vertical_m:
            sigma[index, 2] = max(photo.position.sigma_vertical_m, LEAST_SIGMA_M)
    rotations = np.tile(np.eye(3), (k, 1, 1))
    has = np.zeros(k, bool)
    for index, photo in enumerate(photos):
        if photo.gimbal is not None:
            rotations[index] = frames.rotation_cam_from_world(photo.gimbal)
            has[index] = True
    return Tags(frame, crs, positions, sigma, rotations, has)


@dataclass(frozen=True)
class Placement:
    """Where a block goes: the transformation and what is to be said about the geotags."""

    transform: Similarity
    georeference: Georeference


def place(rotations: FloatArray, centres: FloatArray, points: FloatArray, tags: Tags) -> Placement:
    """Fit the block (k poses, points (m, 3)) to the geotags, or level it by gimbal or ground without.

    Geotags are refused, with the reason, when the best seven-parameter fit misses them by far
    more than a receiver errs, or asks for an up direction that contradicts the gimbal (or, without
    gimbal, tilts ground and cameras together while missing the tags).
    """
    leveled = _level(rotations, centres, points, tags)
    has = np.isfinite(tags.positions_m).all(axis=1)
    if has.sum() < 3 or _spread(tags.positions_m[has]) < 3.0:
        fault = None
        if has.any():
            fault = "The photos' positions are too few or too close together to place the block."
        return Placement(leveled, Georeference(None, None, None, None, trusted=False, fault=fault))
    frame = tags.frame
    origin = None if frame is None else (frame.latitude_deg, frame.longitude_deg, frame.altitude_m)
    target, sigma = tags.positions_m[has], tags.sigma_m[has]
    fitted, residual = fit_robust(centres[has], target, np.maximum(sigma, 0.5))
    limit_xy = max(FAULT_M, 3 * float(np.median(sigma[:, 0])))
    near = np.linalg.norm(residual, axis=1) < 2 * limit_xy
    if (~near).sum() > STRAY_SHARE * len(near):
        near[:] = True
    residual = residual[near]
    rms_xy = float(np.sqrt(np.mean(np.sum(residual[:, :2] ** 2, axis=1))))
    rms_z = float(np.sqrt(np.mean(residual[:, 2] ** 2)))
    # The tags fix the up direction only as far as they spread sideways.
    up_tags, up_level = fitted.rotation[2], leveled.rotation[2]
    conflict = float(np.degrees(np.arccos(np.clip(up_tags @ up_level, -1, 1))))
    sideways = np.linalg.svd(target[near] - target[near].mean(axis=0), compute_uv=False)
    line_like = sideways[1] < 0.1 * sideways[0]
    fault = None
    if rms_xy > limit_xy or rms_z > 2 * limit_xy:
        axis = ("east", "north", "height")[int(np.sqrt(np.mean(residual**2, axis=0)).argmax())]
        worst = float(np.sqrt(np.mean(residual**2, axis=0)).max())
        fault = (
            f"The geotags do not fit the photos: {worst:.0f} m rms remain in {axis} after the best fit"
            + (f", which also tilts the block by {conflict:.0f} degrees" if conflict > 10 else "")
            + ". They were not used; check the camera's clock and GPS. More photos do not cure this."
        )
    elif conflict > 15 and tags.has_rotation.sum() >= 3 and not line_like:
        fault = (
            f"The geotags tilt the block by {conflict:.0f} degrees against the gimbal angles. "
            "They were not used; check heights and GPS. More photos do not cure this."
        )
    if fault is None and not line_like:
        return Placement(fitted, Georeference(origin, tags.crs, rms_xy, rms_z, True, None, conflict))
    # Scale, heading and place from the tags, the up direction from gimbal or ground.
    flat = leveled.apply(centres[has])
    scale, heading, shift = _horizontal_fit(flat, target)
    rotation = heading @ leveled.rotation
    transform = Similarity(scale * leveled.scale, rotation, scale * heading @ leveled.shift + shift)
    return Placement(transform, Georeference(origin, tags.crs, rms_xy, rms_z, fault is None, fault, conflict))


def _spread(positions: FloatArray) -> float:
    return float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).max())


def _level(rotations: FloatArray, centres: FloatArray, points: FloatArray, tags: Tags) -> Similarity:
    """Rotation to z up by the gimbal, else by the ground's plane; mean distance to the ground is 1."""
    known = tags.has_rotation
    if known.sum() >= 1:
        # R_block = R_tag R_world_from_block^T for every photo: average over the photos.
        world_from_block = mean_rotation(tags.rotations[known].transpose(0, 2, 1) @ rotations[known])
    else:
        middle = np.median(points, axis=0)
        near = points[np.argsort(np.linalg.norm(points - middle, axis=1))[: max(10, int(0.9 * len(points)))]]
        _, _, vt = np.linalg.svd(near - near.mean(axis=0), full_matrices=False)
        up = vt[2] * np.sign(vt[2] @ (centres.mean(axis=0) - near.mean(axis=0)))
        world_from_block = np.stack([vt[0], np.cross(up, vt[0]), up])
    height = float(np.median(np.linalg.norm(centres - np.median(points, axis=0), axis=1)))
    scale = 1.0 / max(height, 1e-12)
    return Similarity(scale, world_from_block, -scale * world_from_block @ np.median(points, axis=0))


def _horizontal_fit(source: FloatArray, target: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Scale, rotation about the vertical and shift that bring ``source`` near ``target`` (n, 3), robustly."""
    weights = np.ones(len(source))
    for _ in range(15):
        w = weights / weights.sum()
        mean_s, mean_t = w @ source, w @ target
        ds, dt = source - mean_s, target - mean_t
        a = ds[:, 0] + 1j * ds[:, 1]
        b = dt[:, 0] + 1j * dt[:, 1]
        turn = np.sum(w * np.conj(a) * b) / max(float(np.sum(w * np.abs(a) ** 2)), 1e-300)
        residual = np.abs(b - turn * a)
        weights = 1 / (1 + (residual / max(2 * float(np.median(residual)), 1e-6)) ** 2)
    scale, angle = float(np.abs(turn)), float(np.angle(turn))
    rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return scale, rotation, mean_t - scale * rotation @ mean_s

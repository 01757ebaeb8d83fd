"""[SEN]: calibration on a building, its parameters released in steps, and the sensor's coverage.

Targets on the four walls of their building, photos on orbits around it. The targets are held at
their scanned positions, as in the paper, so the unknowns are poses and lens.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.align.rotations import rotation_exp
from calib.camera import BROWN_NAMES, BrownCamera, FloatArray
from calib.references import bundled_references
from sim.papers.published import CAMPAIGN, SENN

#: [SEN] 2.1: the building, m.
BUILDING_M = (12.5, 7.5, 10.5)
#: Orbits: distance from the building's middle, so that it fills the narrower sensor too, and heights of
#: the camera, m (both assumed).
DISTANCES_M = {"thermal": (20.0, 23.0, 26.0), "RGB": (13.0, 15.0, 17.0)}
HEIGHTS_M = (3.0, 8.0, 14.0)
#: Noise of a marker, px (1/2 px of natural features, [SEN] discussion), and of a scanned target, m.
MARKER_PX, TARGET_M = 0.5, 0.003
#: Release of the parameters ([SEN] 2.3); f joins with the radial terms.
STAGES = (
    ("poses", ()),
    ("+ f, K1-K3", ("f", "k1", "k2", "k3")),
    ("+ principal point", ("cx", "cy")),
    ("+ P1 P2", ("p1", "p2")),
    ("+ b1 b2", ("b1", "b2")),
)


@dataclass(frozen=True)
class Orbit:
    """Marks of one data set: targets_m (t, 3) as scanned, control (t,), photo (n,), target (n,),
    pixels (n, 2); true poses rotations_cam_from_world (k, 3, 3), centres_m (k, 3), true ``camera``."""

    camera: BrownCamera
    targets_m: FloatArray
    control: np.ndarray
    photo: np.ndarray
    target: np.ndarray
    pixels: FloatArray
    rotations_cam_from_world: FloatArray
    centres_m: FloatArray


def sensor(name: str) -> BrownCamera:
    """The library's calibration of the sensor, with a small decentring and affinity to be found.

    Decentring as in the "subset" row of Metashape in [SEN] Table 2 (mm^-1, times c); b1, b2 assumed.
    """
    library = {"thermal": "workswell-wiris-pro", "RGB": "dji-phantom-4-pro"}
    p1, p2 = {"thermal": (2.52e-5, 3.67e-4), "RGB": (-1.43e-5, 5.39e-6)}[name]
    c_mm = {"thermal": 13.12, "RGB": 8.85}[name]
    (reference,) = [r for r in bundled_references() if r.name == library[name]]
    assert reference.brown is not None
    return replace(reference.brown, p1=p1 * c_mm, p2=p2 * c_mm, b1_px=0.4, b2_px=-0.3)


def fly(name: str, seed: int) -> Orbit:
    """The data set ``name`` ("thermal subset", ...): as many images, targets and about as many marks."""
    theirs = SENN[name]
    rng = np.random.default_rng([seed, sorted(SENN).index(name)])
    return _flown(name.split()[0], theirs.images, theirs.targets, theirs.observations, rng)


def fly_all(kind: str, seed: int) -> Orbit:
    """All that was photographed of one sensor ("thermal", "RGB"), marked as densely as its larger set."""
    theirs = SENN[f"{kind} add6"]
    marks = round(theirs.observations / theirs.images * CAMPAIGN[kind])
    rng = np.random.default_rng([seed, 40 + sorted(CAMPAIGN).index(kind)])
    return _flown(kind, CAMPAIGN[kind], theirs.targets, marks, rng)


def _flown(kind: str, k: int, targets: int, most_marks: int, rng: np.random.Generator) -> Orbit:
    camera = sensor(kind)
    spots, normals = _targets(targets, rng)
    azimuth = 2 * np.pi * (np.arange(k) + rng.uniform(-0.2, 0.2, k)) / k
    distance = np.array(DISTANCES_M[kind])[np.arange(k) % 3]
    height = np.array(HEIGHTS_M)[(np.arange(k) // 2) % 3]
    centres = np.column_stack([distance * np.sin(azimuth), distance * np.cos(azimuth), height])
    rotations = _looking_at(centres, np.array([0, 0, BUILDING_M[2] / 2]) + rng.normal(0, 0.5, (k, 3)))
    offset = spots[None, :, :] - centres[:, None, :]
    in_cam = np.einsum("kij,ktj->kti", rotations, offset)
    facing = -np.einsum("kti,ti->kt", offset, normals) / np.linalg.norm(offset, axis=-1)
    pixels = camera.project(in_cam[..., :2] / np.maximum(in_cam[..., 2:], 1e-6))
    inside = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(axis=-1)
    photo, target = np.nonzero((in_cam[..., 2] > 1) & (facing > np.cos(np.radians(80))) & inside)
    # Operators leave out what they cannot place well: about as many marks as the paper had.
    kept = np.sort(rng.permutation(len(photo))[:most_marks])
    photo, target = photo[kept], target[kept]
    noisy = pixels[photo, target] + MARKER_PX * rng.normal(size=(len(photo), 2))
    scanned = spots + TARGET_M * rng.normal(size=spots.shape)
    control = np.arange(len(spots)) % 4 != 0
    return Orbit(camera, scanned, control, photo, target, noisy, rotations, centres)


def _targets(count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Points (t, 3) spread over the four walls and their outward normals (t, 3)."""
    long, wide, high = BUILDING_M
    wall = rng.choice(4, count, p=np.array([long, wide, long, wide]) / (2 * (long + wide)))
    along, up = rng.uniform(-0.48, 0.48, count), rng.uniform(0.04, 0.96, count) * high
    normal = np.array([[0, 1, 0], [1, 0, 0], [0, -1, 0], [-1, 0, 0]], float)[wall]
    length, depth = np.array([long, wide, long, wide])[wall], np.array([wide, long, wide, long])[wall]
    side = np.column_stack([normal[:, 1], -normal[:, 0]])
    ground = normal[:, :2] * depth[:, None] / 2 + side * (along * length)[:, None]
    return np.column_stack([ground, up]), normal


def _looking_at(centres_m: FloatArray, at_m: FloatArray) -> FloatArray:
    """cam_from_world (k, 3, 3) of level cameras at centres (k, 3) that look at (k, 3)."""
    forward = at_m - centres_m
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


@dataclass(frozen=True)
class Solved:
    """A stage's outcome; ``covariance`` (11, 11) over ``BROWN_NAMES``, held parameters zero."""

    camera: BrownCamera
    rotations_cam_from_world: FloatArray
    centres_m: FloatArray
    covariance: FloatArray
    sigma0: float
    control_rms_px: float
    check_rms_px: float


def solve(
    orbit: Orbit, start: Solved | None, free: tuple[str, ...], a_priori_px: float = MARKER_PX
) -> Solved:
    """Least squares over poses and ``free`` lens parameters; control targets held, check targets unused.

    RMS are per coordinate, of all control and all check marks.
    """
    k = len(orbit.centres_m)
    if start is None:
        rng = np.random.default_rng(5)
        turned = rotation_exp(0.02 * rng.normal(size=(k, 3))) @ orbit.rotations_cam_from_world
        nominal = BrownCamera.ideal(orbit.camera.width, orbit.camera.height, 0.99 * orbit.camera.f_px)
        camera, rotations = nominal, turned
        centres = orbit.centres_m + 0.3 * rng.normal(size=(k, 3))
    else:
        camera, rotations, centres = start.camera, start.rotations_cam_from_world, start.centres_m
    columns = np.array([name in free for name in BROWN_NAMES])
    used = orbit.control[orbit.target]
    p = int(columns.sum())
    damping = 1e-3
    state = (camera, rotations, centres)
    for _ in range(100):
        residual, design = _linearised(orbit, *state, columns)
        inner = design[used].reshape(-1, 6 * k + p)
        cost = float(np.sum(residual[used] ** 2))
        scale = np.maximum(np.linalg.norm(inner, axis=0), 1e-300)
        normal = (inner / scale).T @ (inner / scale)
        right = (inner / scale).T @ residual[used].ravel()
        step = np.linalg.solve(normal + damping * np.eye(len(normal)), right)
        trial = _moved(state, step / scale, columns)
        if float(np.sum(_linearised(orbit, *trial, columns)[0][used] ** 2)) > cost:
            damping = min(10 * damping, 1e6)
            continue
        state, damping = trial, max(damping / 10, 1e-15)
        if float(step @ right) < 1e-9 * cost:
            break
    camera, rotations, centres = state
    residual, design = _linearised(orbit, camera, rotations, centres, columns)
    inner = design[used].reshape(-1, 6 * k + p)
    redundancy = len(inner) - 6 * k - p
    sigma0 = float(np.sqrt(np.sum(residual[used] ** 2) / a_priori_px**2 / redundancy))
    scale = np.linalg.norm(inner, axis=0)
    inverse = np.linalg.inv((inner / scale).T @ (inner / scale)) / np.outer(scale, scale)
    covariance = np.zeros((11, 11))
    covariance[np.ix_(columns, columns)] = inverse[6 * k :, 6 * k :] * (sigma0 * a_priori_px) ** 2
    rms = [float(np.sqrt(np.mean(residual[mask] ** 2))) for mask in (used, ~used)]
    return Solved(camera, rotations, centres, covariance, sigma0, *rms)


_Unknowns = tuple[BrownCamera, FloatArray, FloatArray]


def _moved(state: _Unknowns, step: FloatArray, columns: np.ndarray) -> _Unknowns:
    camera, rotations, centres = state
    k = len(centres)
    pose = step[: 6 * k].reshape(k, 6)
    vector = camera.vector
    vector[columns] += step[6 * k :]
    moved = BrownCamera.from_vector(camera.width, camera.height, vector)
    return moved, rotation_exp(pose[:, :3]) @ rotations, centres + pose[:, 3:]


def _linearised(
    orbit: Orbit, camera: BrownCamera, rotations: FloatArray, centres: FloatArray, columns: np.ndarray
) -> tuple[FloatArray, FloatArray]:
    """Residuals (n, 2) and their design matrix (n, 2, 6 k + p)."""
    k, n = len(centres), len(orbit.photo)
    turn = rotations[orbit.photo]
    in_cam = np.einsum("nij,nj->ni", turn, orbit.targets_m[orbit.target] - centres[orbit.photo])
    rays = in_cam[:, :2] / in_cam[:, 2:]
    pixels, by_ray, by_lens = camera.derivatives(rays)
    by_cam = np.concatenate([by_ray, -(by_ray @ rays[:, :, None])], axis=2) / in_cam[:, 2][:, None, None]
    design = np.zeros((n, 2, 6 * k + int(columns.sum())))
    rows = np.arange(n)
    for i, block in enumerate(np.moveaxis(np.cross(in_cam[:, None, :], by_cam), -1, 0)):
        design[rows, :, 6 * orbit.photo + i] = block
    for i, block in enumerate(np.moveaxis(-(by_cam @ turn), -1, 0)):
        design[rows, :, 6 * orbit.photo + 3 + i] = block
    design[:, :, 6 * k :] = by_lens[:, :, columns]
    return orbit.pixels - pixels, design


def staged(orbit: Orbit) -> list[tuple[str, Solved]]:
    """All stages in their order, each from the one before."""
    found: list[tuple[str, Solved]] = []
    free: tuple[str, ...] = ()
    for name, more in STAGES:
        free = (*free, *more)
        found.append((name, solve(orbit, found[-1][1] if found else None, free)))
    return found


def with_k4(orbit: Orbit, last: Solved) -> tuple[Solved, float]:
    """K4 released as well, and its correlation with K3."""
    names = tuple(name for name in BROWN_NAMES)
    solved = solve(orbit, last, names)
    i, j = BROWN_NAMES.index("k3"), BROWN_NAMES.index("k4")
    c: Any = solved.covariance
    return solved, float(c[i, j] / np.sqrt(c[i, i] * c[j, j]))

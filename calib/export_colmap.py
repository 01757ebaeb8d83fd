"""A solved block as a COLMAP text model (cameras.txt, images.txt, points3D.txt).

COLMAP's FULL_OPENCV holds Brown's K1-K3, P1, P2 exactly, with its denominator at one; pixel origin
and rotation are ours (first pixel's centre at 0.5, cam_from_world). It has no skew and no residual
field: what the other terms cannot take up of them stays in the residuals.
"""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.camera import BrownCamera, FloatArray
from calib.convert import fit_brown, image_grid_px
from calib.formats.rational import RationalModel, rational_from_brown
from calib.result import CheckResult
from calib.solution import IntArray, Solution

COLMAP_FILES = ("cameras.txt", "images.txt", "points3D.txt")
#: Observations with less robust weight than this are outliers and are not exported.
LEAST_WEIGHT = 0.1


def colmap_lens(brown: BrownCamera) -> RationalModel:
    """``brown`` as COLMAP can hold it: K4 goes into the denominator, skew into the other terms."""
    if brown.b2_px == 0:
        return rational_from_brown(brown)
    pixels = image_grid_px(brown.width, brown.height)
    rays = brown.unproject(pixels)
    reached = np.isfinite(rays).all(axis=1)
    start = replace(brown, b2_px=0.0)
    free = ("f", "cx", "cy", "k1", "k2", "k3", "p1", "p2", "b1")
    return rational_from_brown(fit_brown(rays[reached], pixels[reached], start, free).camera)


def image_names(solution: Solution) -> tuple[str, ...]:
    """Names of the photos below their common folder, with forward slashes and "_" for spaces.

    COLMAP's text format ends a name at its first space, so such a photo has to be renamed for it.
    """
    folders = [photo.path.parent.absolute() for photo in solution.photos]
    common = os.path.commonpath(folders)
    return tuple(
        re.sub(r"\s", "_", (folder / photo.path.name).relative_to(common).as_posix())
        for folder, photo in zip(folders, solution.photos, strict=True)
    )


def write_colmap(result: CheckResult, folder: Path) -> None:
    """Write the three files of the text model into ``folder`` (made if need be)."""
    solution = result.solution
    folder.mkdir(parents=True, exist_ok=True)
    kept = np.flatnonzero(solution.weights > LEAST_WEIGHT)
    seen_by = np.bincount(solution.observations.point[kept], minlength=len(solution.points_m))
    kept = kept[seen_by[solution.observations.point[kept]] >= 2]
    lens = colmap_lens(result.estimate.brown)
    (folder / "cameras.txt").write_text(_cameras(lens), encoding="utf-8")
    slots = _slots(solution, kept)
    (folder / "images.txt").write_text(_images(solution, kept), encoding="utf-8", errors="surrogateescape")
    (folder / "points3D.txt").write_text(_points(solution, lens, kept, slots), encoding="utf-8")


def _cameras(lens: RationalModel) -> str:
    focal, centre = (lens.fx_px, lens.fy_px), (lens.cx_px, lens.cy_px)
    k1, k2, k3 = lens.numerator
    numbers = (*focal, *centre, k1, k2, lens.p1, lens.p2, k3, *lens.denominator)
    parameters = " ".join(f"{value:.17g}" for value in numbers)
    return (
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"1 FULL_OPENCV {lens.width} {lens.height} {parameters}\n"
    )


def _slots(solution: Solution, kept: IntArray) -> IntArray:
    """Index of every kept observation within its image, in the order of ``kept``."""
    photo = solution.observations.photo[kept]
    slots = np.zeros(len(kept), dtype=np.intp)
    for k in range(len(solution.photos)):
        mine = photo == k
        slots[mine] = np.arange(mine.sum())
    return slots


def _images(solution: Solution, kept: IntArray) -> str:
    observations = solution.observations
    lines = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "#   POINTS2D[] as (X, Y, POINT3D_ID)",
        "# Spaces in names are written as _, because this format cannot hold them.",
    ]
    names = image_names(solution)
    for k, name in enumerate(names):
        rotation = solution.rotations_cam_from_world[k]
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        t = -rotation @ solution.centres_m[k]
        pose = " ".join(f"{value:.17g}" for value in (w, x, y, z, *t))
        lines.append(f"{k + 1} {pose} 1 {name}")
        mine = kept[observations.photo[kept] == k]
        lines.append(
            " ".join(
                f"{u:.7f} {v:.7f} {point + 1}"
                for (u, v), point in zip(observations.pixels[mine], observations.point[mine], strict=True)
            )
        )
    return "\n".join(lines) + "\n"


def _points(solution: Solution, lens: RationalModel, kept: IntArray, slots: IntArray) -> str:
    observations = solution.observations
    error = np.linalg.norm(_reprojected(solution, lens, kept) - observations.pixels[kept], axis=1)
    lines = [
        "# 3D point list with one line of data per point:",
        "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
    ]
    order = np.argsort(observations.point[kept], kind="stable")
    point = observations.point[kept][order]
    for chunk in np.split(order, np.flatnonzero(np.diff(point)) + 1) if len(order) else []:
        m = observations.point[kept[chunk[0]]]
        x, y, z = solution.points_m[m]
        track = " ".join(f"{observations.photo[kept[i]] + 1} {slots[i]}" for i in chunk)
        lines.append(f"{m + 1} {x:.12g} {y:.12g} {z:.12g} 128 128 128 {error[chunk].mean():.6g} {track}")
    return "\n".join(lines) + "\n"


def _reprojected(solution: Solution, lens: RationalModel, which: IntArray) -> FloatArray:
    """Pixels (n, 2) of the observations ``which`` (n,) through ``lens`` at the solved poses."""
    photo, point = solution.observations.photo[which], solution.observations.point[which]
    world = solution.points_m[point] - solution.centres_m[photo]
    in_camera = np.einsum("nij,nj->ni", solution.rotations_cam_from_world[photo], world)
    return lens.project(in_camera[:, :2] / in_camera[:, 2:])

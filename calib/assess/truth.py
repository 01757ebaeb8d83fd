"""Reference points in a cloud's coordinates, and what gives a wrong coordinate system away."""

from __future__ import annotations

import fnmatch
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError

from calib.camera import FloatArray
from calib.clouds import LoadedCloud
from calib.control_files import read_points
from calib.errors import InputError

#: A vertical offset as large is said: two kinds of heights differ by as much.
DATUM_M = 5.0


@dataclass(frozen=True)
class Truth:
    """Reference points by ``names``, (n, 3) in the cloud's coordinates, metres."""

    names: tuple[str, ...]
    xyz_m: FloatArray
    notes: tuple[str, ...] = ()


def parse_crs(text: str) -> CRS:
    """A coordinate system by its number ("25832", "EPSG:25832") or any text that PROJ knows.

    Raises:
        InputError: it is not known.
    """
    try:
        return CRS.from_user_input(int(text) if text.strip().isdigit() else text)
    except CRSError as error:
        raise InputError(
            f"{text} is no coordinate system that is known; give its number, EPSG:25832."
        ) from error


def read_truth(path: Path, crs: CRS | None, cloud_crs: CRS | None) -> Truth:
    """Points of a file (name, x, y, z) carried into the cloud's coordinate system.

    Raises:
        InputError: file or coordinate systems cannot be used.
    """
    degrees = crs is not None and crs.is_geographic
    points = read_points(path, degrees=degrees)
    names = tuple(point.name for point in points)
    xyz = np.array([point.xyz_m for point in points])
    if cloud_crs is not None and cloud_crs.is_geographic:
        raise InputError("The cloud is in degrees; export it in a projected system such as UTM.")
    if crs is None or cloud_crs is None:
        if degrees:
            raise InputError(
                "The cloud's file does not say its coordinate system, so points in degrees cannot be "
                "carried into it; give it with --cloud-crs."
            )
        known = "neither file says" if crs is None and cloud_crs is None else "only one file says"
        note = f"The points are taken to be in the cloud's coordinate system ({known} which it is)."
        return Truth(names, xyz, (note,))
    if crs == cloud_crs or crs.equals(cloud_crs, ignore_axis_order=True):
        return Truth(names, xyz)
    try:
        moved = Transformer.from_crs(crs, cloud_crs, always_xy=True).transform(
            xyz[:, 0], xyz[:, 1], xyz[:, 2], errcheck=True
        )
    except ProjError as error:
        raise InputError(
            f"The points of {path} cannot be carried from {crs.name} to {cloud_crs.name}: is --crs right?"
        ) from error
    note = f"The points were carried from {crs.name} to {cloud_crs.name}."
    return Truth(names, np.column_stack(moved), (note,))


def chosen(names: Sequence[str], wanted: str) -> NDArray[np.bool_]:
    """Which of ``names`` are meant by a file of names, or by names with commas between (* stands for any).

    Raises:
        InputError: the file cannot be read, or a name is none of them.
    """
    path = Path(wanted)
    if path.is_file():
        text = path.read_text(encoding="utf-8-sig", errors="replace")
        parts = [line.replace(";", ",").split(",")[0].strip() for line in text.splitlines()]
        parts = [part for part in parts if part and not part.startswith("#") and part.lower() != "name"]
    else:
        parts = [part.strip() for part in wanted.split(",") if part.strip()]
    mask = np.zeros(len(names), bool)
    for part in parts:
        found = np.array([fnmatch.fnmatchcase(name, part) for name in names])
        if not found.any():
            raise InputError(f"--on names {part}, but there is no reference point of that name.")
        mask |= found
    if not mask.any():
        raise InputError(f"--on {wanted} names no point.")
    return mask


def check_overlap(truth: Truth, cloud: LoadedCloud) -> None:
    """Refuse points that lie nowhere near the cloud, and say what such a distance usually means.

    Raises:
        InputError: with the distance and, where it fits, its cause.
    """
    low, high = _extent(cloud)
    xyz = truth.xyz_m
    if _over(xyz, low, high):
        return
    raise InputError(
        f"The reference points do not lie on the cloud: {_distance(xyz, low, high)} {_cause(xyz, low, high)}"
    )


def _extent(cloud: LoadedCloud) -> tuple[FloatArray, FloatArray]:
    """Corners (3,) of the cloud without the last few stray points."""
    some = cloud.xyz[:: max(1, len(cloud.xyz) // 200_000)].astype(float)
    low, high = np.percentile(some, [0.1, 99.9], axis=0)
    return low + cloud.origin, high + cloud.origin


def _over(xyz: FloatArray, low: FloatArray, high: FloatArray) -> bool:
    room = 0.2 * (high - low)[:2] + 20.0
    inside = ((xyz[:, :2] > low[:2] - room) & (xyz[:, :2] < high[:2] + room)).all(axis=1)
    return bool(inside.mean() > 0.1)


def _distance(xyz: FloatArray, low: FloatArray, high: FloatArray) -> str:
    east, north = np.median(xyz, axis=0)[:2] - (low + high)[:2] / 2
    return (
        f"their middle is {_length(abs(east))} {'east' if east > 0 else 'west'} and "
        f"{_length(abs(north))} {'north' if north > 0 else 'south'} of the cloud's."
    )


def _length(metres: float) -> str:
    return f"{metres / 1000:.0f} km" if metres >= 10_000 else f"{metres:.0f} m"


def _cause(xyz: FloatArray, low: FloatArray, high: FloatArray) -> str:
    if _over(xyz[:, [1, 0, 2]], low, high):
        return "With x and y exchanged they would: swap the columns of the file."
    if (np.abs(xyz[:, 0]) <= 180).all() and (np.abs(xyz[:, 1]) <= 180).all() and np.abs(low[:2]).max() > 1000:
        return "They look like degrees or local: give their system with --crs (EPSG:4326 for degrees)."
    if (
        np.abs(low[:2]).max() < 1000 * max(1.0, float((high - low).max()) / 100)
        and np.abs(xyz[:, :2]).max() > 1e5
    ):
        return "The cloud is in local coordinates: export it georeferenced, or give points in its own system."
    for unit, name in ((0.3048, "feet"), (1 / 0.3048, "metres (and the cloud in feet)")):
        if _over(xyz * [unit, unit, 1], low, high):
            return f"They would if they were in {name}: convert one of the two."
    north = float(np.median(xyz[:, 1]) - (low + high)[1] / 2)
    if abs(abs(north) - 1e7) < 1e5:
        return (
            "Ten thousand kilometres is the difference between UTM north and south: the zone's half is wrong."
        )
    if _over(xyz[:, [0, 2, 1]], low, high) or _over(
        np.column_stack([xyz[:, 0], -xyz[:, 2], xyz[:, 1]]), low, high
    ):
        return "With y and z exchanged they would: the cloud has its y axis up; export it with z up."
    return "One of the two is in another coordinate system or zone: see --crs and --cloud-crs."

"""Clouds made from a known M7 and a known eta over known ground, and files of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np
import pyproj

from calib.assess.model import similarity_of
from calib.assess.truth import Truth
from calib.camera import FloatArray
from calib.clouds import CloudFile, Kind, LoadedCloud

OFFSET = np.array([500_000.0, 5_600_000.0, 100.0])
EPSG = 32630


def ground_m(x: FloatArray, y: FloatArray) -> FloatArray:
    """Hills with more than one crest across the site, or a dome could not be told from a shift."""
    height: FloatArray = 4 * np.sin(x / 22) + 3 * np.cos(y / 17 + x / 40) + 0.02 * x
    return height


def flat_m(x: FloatArray, y: FloatArray) -> FloatArray:
    return 0.02 * x + 0 * y


@dataclass(frozen=True)
class Case:
    """``values`` (7,): M7 about ``OFFSET``; ``bad`` (n,): reference points put in wrong."""

    cloud: LoadedCloud
    truth: Truth
    values: FloatArray
    bad: FloatArray

    def about(self, origin: FloatArray) -> FloatArray:
        """The seven values about another place."""
        place = origin - OFFSET
        values = self.values.copy()
        values[:3] = similarity_of(values).apply(place[None])[0] - place
        return values


def made(
    seed: int, eta_m: float = 0.1, dome_m: float = 0.0, outliers: float = 0.0, points: int = 40_000,
    references: int = 576, flat: bool = False, values: FloatArray | None = None,
) -> Case:  # fmt: skip
    rng = np.random.default_rng(seed)
    shape = flat_m if flat else ground_m
    if values is None:
        draws = [rng.normal(0, [2, 2, 3]), rng.normal(0, 0.7, 3), [100 + rng.normal(0, 2)]]
        values = np.concatenate(draws)
    xy = rng.uniform(-70, 70, (points, 2))
    cloud = similarity_of(values).apply(np.column_stack([xy, shape(*xy.T)]))
    cloud[:, 2] += eta_m * rng.normal(size=points) + dome_m * (1 - np.sum(xy**2, axis=1) / 60**2)
    # Even, as a survey walks, with the site's rim: no long thin triangles.
    across = int(np.ceil(np.sqrt(references)))
    grid = np.stack(np.meshgrid(*[np.linspace(-58, 58, across)] * 2), axis=-1).reshape(-1, 2)
    at = rng.permutation(grid + rng.uniform(-0.8, 0.8, grid.shape))[:references]
    reference = np.column_stack([at, shape(*at.T) + 0.005 * rng.normal(size=references)])
    bad = rng.random(references) < outliers
    reference[bad, 2] += rng.uniform(1.5, 5, int(bad.sum())) * rng.choice([-1, 1], int(bad.sum()))
    loaded = LoadedCloud(
        CloudFile(Path("made.las"), Kind.LAS), OFFSET, cloud.astype(np.float32), points, 0, 1
    )
    names = tuple(f"P{i}" for i in range(references))
    return Case(loaded, Truth(names, reference + OFFSET), values, bad)


def write_las(path: Path, xyz: FloatArray) -> None:
    header = laspy.LasHeader(point_format=3, version="1.4")
    header.offsets, header.scales = np.floor(xyz.min(axis=0)), np.full(3, 0.001)
    header.add_crs(pyproj.CRS.from_epsg(EPSG))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.intensity = np.arange(len(xyz)) % 1000
    las.write(path)


def write_points(path: Path, xyz: FloatArray, header: str = "name,x,y,z") -> None:
    rows = [f"P{i},{x:.9f},{y:.9f},{z:.4f}" for i, (x, y, z) in enumerate(xyz.tolist())]
    path.write_text("\n".join([header, *rows]) + "\n")

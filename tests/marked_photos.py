"""Small photos of targets on two walls of a building, rendered with a known lens."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from calib.camera import BrownCamera, FloatArray

CAMERA = BrownCamera(640, 480, 560.0, 322.0, 238.0, k1=-0.08, k2=0.02)
#: As a file would state it: 36 mm of the equivalent frame are the image's width.
FOCAL_35_MM = 31
_TARGET_PX = 6.0
_FAR = np.array([400.0, 5600.0, 20.0])


@dataclass(frozen=True)
class Site:
    """Points (t, 3) by name, and their true pixels (k, t, 2) in k photos of ``folder``."""

    folder: Path
    names: tuple[str, ...]
    xyz_m: FloatArray
    pixels: FloatArray
    photos: tuple[str, ...]

    def write_points(self, path: Path) -> Path:
        rows = [
            f"{name},{x:.4f},{y:.4f},{z:.4f}" for name, (x, y, z) in zip(self.names, self.xyz_m, strict=True)
        ]
        path.write_text("\n".join(["name,x,y,z", *rows]) + "\n", encoding="utf-8")
        return path


def build(folder: Path, seed: int = 0) -> Site:
    """Ten points in five photos; the last photo says that it is to be shown turned."""
    folder.mkdir()
    random = np.random.default_rng(seed)
    along, up = np.array([0.6, 1.8, 3.0, 0.9, 2.7]), np.array([0.5, 1.7, 0.6, 2.6, 2.5])
    right = np.column_stack([along, np.zeros(5), up])
    left = np.column_stack([np.zeros(5), along, up[::-1]])
    xyz = np.concatenate([right, left])
    pixels, photos = [], []
    for i, azimuth in enumerate(np.radians([12, 30, 45, 62, 78])):
        centre = np.array([np.cos(azimuth), np.sin(azimuth), 0.0]) * 5.4 + [0.9, 0.9, 1.2 + 0.5 * (i % 3)]
        forward = np.array([0.9, 0.9, 1.5]) - centre
        forward /= np.linalg.norm(forward)
        across = np.cross(forward, [0, 0, 1])
        across /= np.linalg.norm(across)
        roll = 0.3 * (i - 2)
        down = np.cross(forward, across)
        turn = np.stack(
            [np.cos(roll) * across + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * across]
        )
        local = (xyz - centre) @ np.concatenate([turn, forward[None]]).T
        at = CAMERA.project(local[:, :2] / local[:, 2:])
        pixels.append(at)
        photos.append(f"IMG_{i + 1}.JPG")
        _save(folder / photos[-1], _drawn(at, random), 6 if i == 4 else 1)
    names = tuple(f"T{i + 1:02d}" for i in range(len(xyz)))
    return Site(folder, names, xyz + _FAR, np.array(pixels), tuple(photos))


def _drawn(at: FloatArray, random: np.random.Generator) -> FloatArray:
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    image = 165 + 25 * np.sin(columns / 37) * np.cos(rows / 23) + random.normal(0, 2, rows.shape)
    for u, v in at:
        # A disc whose rim is grey over a pixel: its centroid is its middle.
        cover = np.clip(_TARGET_PX + 0.5 - np.hypot(columns - u, rows - v), 0, 1)
        image = image * (1 - cover) + 25 * cover
    return image


def _save(path: Path, image: FloatArray, orientation: int) -> None:
    picture = Image.fromarray(np.clip(image, 0, 255).astype(np.uint8)).convert("RGB")
    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0112] = "Ricoh", "GR III", orientation
    exif.get_ifd(0x8769)[0xA405] = FOCAL_35_MM
    picture.save(path, quality=95, subsampling=0, exif=exif)

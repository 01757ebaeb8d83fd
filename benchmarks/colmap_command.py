"""The COLMAP command of the system, default options, on a folder of photos."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pycolmap

from benchmarks.cost import Cost, measure
from calib.photos import collect, read_photos


def installed() -> str | None:
    """Path of the command, None where there is none."""
    return shutil.which("colmap")


def run(photos: Path, work: Path) -> tuple[Cost, int, float | None]:
    """Cost of extraction, matching and mapping together, photos aligned, and f in px.

    No graphics processor is used: the machines that this is about have none.
    """
    command = installed()
    if command is None:
        raise FileNotFoundError("colmap")
    found, _ = read_photos(collect([photos]))
    database, names, models = work / "colmap.db", work / "names.txt", work / "models"
    names.write_text("".join(f"{p.path.relative_to(photos)}\n" for p in found))
    models.mkdir()
    located = all(p.position is not None for p in found)
    matcher = ["spatial_matcher"] if located else ["exhaustive_matcher"]
    common = ["--database_path", str(database)]
    images = ["--image_path", str(photos)]
    reader = ["--ImageReader.single_camera", "1", "--ImageReader.camera_model", "OPENCV"]
    reader += ["--SiftExtraction.use_gpu", "0"]
    steps = [
        ["feature_extractor", *common, *images, "--image_list_path", str(names), *reader],
        [*matcher, *common, "--SiftMatching.use_gpu", "0"],
        ["mapper", *common, *images, "--output_path", str(models)],
    ]
    environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
    costs = [measure([command, *step], environment) for step in steps]
    total = Cost(
        sum(c.cpu_s for c in costs),
        sum(c.wall_s for c in costs),
        max(c.peak_mb for c in costs),
        max(c.code for c in costs),
    )
    solved = [pycolmap.Reconstruction(p) for p in models.iterdir() if p.is_dir()]
    if not solved:
        return total, 0, None
    best = max(solved, key=lambda m: m.num_reg_images())
    camera = next(iter(best.cameras.values()))
    return total, best.num_reg_images(), float(np.asarray(camera.params)[0])

"""The peer: pycolmap's default pipeline on a folder of photos (full size, pairs by position).

    python -m benchmarks.peer PHOTOS OUT.npz

Writes its camera, poses and tie points, so that both sides' networks can be given the same noise
model. Nothing here is tuned: default options, one shared camera of the OPENCV model, spatial pairs
where the photos have positions, all pairs otherwise.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
import pycolmap

from calib.photos import collect, read_photos


def main(photos: Path, out: Path) -> None:
    """Run the pipeline and save the largest model."""
    found, _ = read_photos(collect([photos]))
    with tempfile.TemporaryDirectory() as work:
        database = Path(work) / "database.db"
        names = [str(p.path.relative_to(photos)) for p in found]
        reader = pycolmap.ImageReaderOptions(camera_model="OPENCV")
        pycolmap.extract_features(
            database, photos, image_names=names, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader
        )
        if all(p.position is not None for p in found):
            pycolmap.match_spatial(database)
        else:
            pycolmap.match_exhaustive(database)
        models = pycolmap.incremental_mapping(database, photos, work)
        if not models:
            np.savez(out, aligned=0)
            return
        model = max(models.values(), key=lambda m: m.num_reg_images())
    images = [i for i in model.images.values() if i.has_pose]
    number = {image.image_id: index for index, image in enumerate(images)}
    rows = [
        (number[element.image_id], index, *model.images[element.image_id].points2D[element.point2D_idx].xy)
        for index, point in enumerate(model.points3D.values())
        for element in point.track.elements
    ]
    camera = next(iter(model.cameras.values()))
    np.savez(
        out,
        aligned=len(images),
        names=np.array([i.name for i in images]),
        width=camera.width,
        height=camera.height,
        params=camera.params,
        rotations=np.array([i.cam_from_world().rotation.matrix() for i in images]),
        centres=np.array([i.projection_center() for i in images]),
        points=np.array([p.xyz for p in model.points3D.values()]),
        observations=np.array(rows),
        mean_reprojection_px=model.compute_mean_reprojection_error(),
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))

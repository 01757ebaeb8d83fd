"""Blocks solved by Ceres through pycolmap, as a peer of our adjustments; skips where it is missing."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from calib.camera import BrownCamera, FloatArray
from calib.solution import IntArray

pycolmap = pytest.importorskip("pycolmap")

#: pycolmap's parameters of each model, in its order, and ours that stand for them.
MODELS = {
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("f", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}


def reconstruction(
    brown: BrownCamera,
    model: str,
    poses: tuple[FloatArray, FloatArray],
    points_m: FloatArray,
    photo: IntArray,
    point: IntArray,
    pixels: FloatArray,
) -> Any:
    """A block in pycolmap, starting at an undistorted camera: both count pixels from the corner.

    Poses: cam_from_world rotations (k, 3, 3) and centres (k, 3); photo, point (n,), pixels (n, 2).
    """
    values = {"fy": brown.fy_px, "f": brown.f_px, "cx": brown.cx_px, "cy": brown.cy_px}
    made = pycolmap.Reconstruction()
    params = [values.get(name, 0.0) for name in MODELS[model]]
    made.add_camera_with_trivial_rig(
        pycolmap.Camera(model=model, width=brown.width, height=brown.height, params=params, camera_id=1)
    )
    slot = np.zeros(len(photo), int)
    for i, (rotation, centre) in enumerate(zip(*poses, strict=True)):
        mine = np.flatnonzero(photo == i)
        slot[mine] = np.arange(len(mine))
        image = pycolmap.Image(name=str(i), keypoints=pixels[mine], camera_id=1, image_id=i + 1)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ centre)
        made.add_image_with_trivial_frame(image, pose)
    for number, where in enumerate(points_m):
        track = pycolmap.Track()
        for i in np.flatnonzero(point == number):
            track.add_element(int(photo[i]) + 1, int(slot[i]))
        made.add_point3D(where, track)
    return made


def solve_with_ceres(made: Any, points_held: bool = False) -> tuple[Any, Any]:
    """Adjust it to the last digit; the solver's summary and the covariance of the camera's parameters."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    solver = options.ceres.solver_options
    solver.num_threads, solver.max_num_iterations = 1, 200
    solver.gradient_tolerance = solver.function_tolerance = solver.parameter_tolerance = 1e-14
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in made.images:
        config.add_image(image_id)
    if points_held:
        for point_id in made.points3D:
            config.add_constant_point(point_id)
    else:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, made)
    summary = adjuster.solve()
    covariance = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), made, adjuster)
    assert covariance is not None
    return summary, covariance.get_other_params_cov(made.cameras[1].params)

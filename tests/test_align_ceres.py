"""Our adjustment against Ceres, on the lens models that both have."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from align_blocks import INDEX, block_adjustment, loose_priors
from ceres_peer import MODELS, reconstruction, solve_with_ceres

from calib.align.adjust import State
from calib.align.grow import lens_mask
from calib.align.rotations import rotation_exp
from calib.camera import BrownCamera, FloatArray
from calib.field import Lens
from sim.flights import phantom3
from sim.network import SimBlock, SimOptions, survey


def true_lens(model: str) -> BrownCamera:
    camera = replace(phantom3(), k3=0.0, cx_px=2011.0, cy_px=1492.0)
    return camera if model == "RADIAL" else replace(camera, p1=8e-4, p2=-5e-4, b1_px=4.0)


def disturbed(block: SimBlock) -> State:
    rng = np.random.default_rng(3)
    k = len(block.centres_m)
    camera = block.lens.brown
    ideal = BrownCamera.ideal(camera.width, camera.height, 1.03 * camera.f_px)
    return State(
        Lens(ideal),
        rotation_exp(rng.normal(0, 0.01, (k, 3))) @ block.rotations_cam_from_world,
        block.centres_m + rng.normal(0, 1.0, (k, 3)),
        block.points_m + rng.normal(0, 1.0, block.points_m.shape),
    )


def reconstruction_of(block: SimBlock, start: State, model: str) -> Any:
    """The same block in pycolmap, from the same start."""
    seen = block.observations
    poses = (start.rotations, start.centres_m)
    return reconstruction(start.lens.brown, model, poses, start.points_m, seen.photo, seen.point, seen.pixels)


@pytest.mark.parametrize("model", ["RADIAL", "OPENCV"])
def test_adjustment_agrees_with_ceres(model: str) -> None:
    block = survey("demo", 4, SimOptions(n_points=250), camera=true_lens(model))
    start = disturbed(block)
    made = reconstruction_of(block, start, model)
    summary, _ = solve_with_ceres(made)
    assert summary.is_solution_usable()
    theirs = dict(zip(MODELS[model], made.cameras[1].params, strict=True))

    names = "f cx cy k1 k2" if model == "RADIAL" else "f cx cy k1 k2 p1 p2 b1"
    # Positions known to a kilometre hold the gauge and nothing else.
    adjustment = block_adjustment(block, loose_priors(block, 1000.0))
    ours = adjustment.run(start, lens_mask(names), decrement=1e-7)
    assert ours.converged
    lens, sigma = ours.state.lens, np.sqrt(np.diag(ours.covariance))
    expected = {"fy": lens.brown.fy_px} | {
        name: lens.vector[INDEX[name]] for name in MODELS[model] if name != "fy"
    }
    for name, value in theirs.items():
        tolerance = 0.01 * sigma[INDEX["f" if name == "fy" else name]]
        assert value == pytest.approx(expected[name], rel=0, abs=tolerance), name

    cost = cost_px2(block, made)
    assert np.sum(ours.residuals_px**2) == pytest.approx(cost, rel=1e-7)
    # The truth is where both should be; the start was far from it.
    assert abs(lens.brown.f_px - block.lens.brown.f_px) < 4 * sigma[0] < 20


def cost_px2(block: SimBlock, made: Any) -> float:
    """Square sum of the residuals, by pycolmap's own projection."""
    total = 0.0
    for image_id, image in made.images.items():
        mine = np.flatnonzero(block.observations.photo == image_id - 1)
        for i in mine:
            seen = image.project_point(made.points3D[int(block.observations.point[i]) + 1].xyz)
            total += float(np.sum((seen - block.observations.pixels[i]) ** 2))
    return total


def test_covariance_agrees_with_ceres() -> None:
    block = survey("demo", 5, SimOptions(n_points=150), camera=true_lens("RADIAL"))
    start = disturbed(block)
    made = reconstruction_of(block, start, "RADIAL")
    _, theirs = solve_with_ceres(made)
    ours = block_adjustment(block, loose_priors(block, 1000.0)).run(
        start, lens_mask("f cx cy k1 k2"), decrement=1e-7
    )
    chosen = [INDEX[name] for name in MODELS["RADIAL"]]
    # Ceres counts in pixels of standard deviation 1.
    unit: FloatArray = ours.covariance[np.ix_(chosen, chosen)] / ours.sigma0**2 / 0.5**2
    scale = np.sqrt(np.diag(unit))
    assert np.allclose(theirs / np.outer(scale, scale), unit / np.outer(scale, scale), rtol=0, atol=2e-3)
    assert scale[0] > 1.0

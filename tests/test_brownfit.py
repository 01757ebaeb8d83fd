"""Brown fitted to a total mapping, and how its covariance follows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.align.adjust import Priors
from calib.align.selfcal import lens_priors, mask
from calib.align.uncertainty import beyond_field
from calib.brownfit import fit_brown, image_grid_rays, turned_rays
from calib.camera import BROWN_NAMES, BrownCamera, FloatArray
from calib.field import LENS_NAMES, Lens
from sim.flights import phantom3
from sim.pattern import random_pattern

INDEX = {name: i for i, name in enumerate(BROWN_NAMES)}


def with_field(seed: int, size_px: float) -> Lens:
    field = np.random.default_rng(seed).normal(0, size_px, 24)
    return Lens(phantom3(), field)


def test_plain_brown_is_fitted_by_itself() -> None:
    camera = BrownCamera(4000, 3000, 2300.0, 2010, 1480, -0.13, 0.1, -0.02, 0.0, 1e-3, -2e-3, 5.0, 1.0)
    fitted, jacobian = fit_brown(Lens(camera))
    assert np.allclose(fitted.vector, camera.vector, rtol=1e-9, atol=1e-12)
    chosen = [i for i, name in enumerate(BROWN_NAMES) if name != "k4"]
    assert np.allclose(jacobian[np.ix_(chosen, chosen)], np.eye(10), atol=1e-6)
    assert not jacobian[INDEX["k4"]].any()


def test_no_other_brown_camera_is_nearer() -> None:
    lens = with_field(1, 0.3)
    fitted, _ = fit_brown(lens)
    rays = image_grid_rays(lens)

    def misfit(camera: BrownCamera) -> float:
        return float(np.sum((camera.project(rays) - lens.project(rays)) ** 2))

    best = misfit(fitted)
    assert 0.05 < np.sqrt(best / len(rays)) < 1.0
    assert best < misfit(lens.brown)
    sizes = dict.fromkeys(("f", "cx", "cy", "b1", "b2"), 0.05)
    sizes |= dict.fromkeys(("k1", "k2", "k3", "p1", "p2"), 1e-5)
    for name, size in sizes.items():
        for sign in (1, -1):
            vector = fitted.vector
            vector[INDEX[name]] += sign * size
            assert misfit(BrownCamera.from_vector(4000, 3000, vector)) > best, name


def test_pattern_orthogonal_to_brown_leaves_the_focal_length() -> None:
    """What the simulator calls the true f is the f of this fit, up to its coarser grid."""
    camera = phantom3()
    pattern = random_pattern(3, camera, 1.5)
    rays = image_grid_rays(Lens(camera), 60, 45)
    brown_px = camera.project(rays)
    # The field that imitates the pattern best.
    basis = Lens(camera).derivatives(rays)[2][:, :, 11:]
    coefficients = np.linalg.lstsq(basis.reshape(-1, 24), pattern(brown_px).ravel(), rcond=None)[0]
    fitted, _ = fit_brown(Lens(camera, np.asarray(coefficients, float)))
    assert abs(fitted.f_px / camera.f_px - 1) < 2e-4
    assert np.abs(coefficients).max() > 0.05


@pytest.mark.parametrize("keep_k4", [False, True])
def test_jacobian_is_the_derivative_of_the_fit(keep_k4: bool) -> None:
    lens = with_field(2, 0.3)
    fitted, jacobian = fit_brown(lens, keep_k4)
    assert jacobian.shape == (len(BROWN_NAMES), len(LENS_NAMES))
    rays = image_grid_rays(lens)
    _, _, by_brown = fitted.derivatives(rays)
    _, _, by_lens = lens.derivatives(rays)
    for column, name in enumerate(LENS_NAMES):
        if name == "k4" and not keep_k4:
            continue
        size = 0.05 if column >= 11 or name in ("f", "cx", "cy", "b1", "b2") else 1e-4
        up, down = lens.vector, lens.vector
        up[column] += size
        down[column] -= size
        plus, minus = (fit_brown(lens.with_vector(v), keep_k4)[0].vector for v in (up, down))
        numeric = (plus - minus) / (2 * size)
        # Held against each other by what they do to the image. Gauss-Newton's derivative leaves
        # out curvature times misfit, which is half a pixel here.
        difference = np.abs(by_brown @ (numeric - jacobian[:, column])).max()
        assert difference < 0.01 * np.abs(by_lens[:, :, column]).max(), name
    assert abs(fitted.f_px - lens.brown.f_px) > 0.01


def test_k4_is_kept_when_it_was_estimated() -> None:
    camera = phantom3()
    lens = Lens(BrownCamera.from_vector(4000, 3000, camera.vector + np.eye(11)[6] * 0.01))
    kept, _ = fit_brown(lens, keep_k4=True)
    dropped, _ = fit_brown(lens)
    assert kept.k4 == pytest.approx(0.01, rel=1e-6)
    assert dropped.k4 == 0.01  # stays where it was, the others fit around it
    assert kept.f_px == pytest.approx(camera.f_px, rel=1e-9)


def test_pixels_beyond_the_lens_are_left_out_of_the_grid() -> None:
    sound = image_grid_rays(Lens(phantom3()), 20, 15)
    assert sound.shape == (300, 2)
    # A strong barrel turns back before the corners: they show nothing.
    barrel = Lens(BrownCamera(4000, 3000, 2000.0, 2000, 1500, k1=-0.2))
    rays = image_grid_rays(barrel, 20, 15)
    assert 150 < len(rays) < 300
    assert np.isfinite(rays).all()


def test_turned_rays_are_those_of_a_turned_camera() -> None:
    rays = np.random.default_rng(3).uniform(-0.7, 0.7, (20, 2))
    slopes = turned_rays(rays)
    for axis in range(3):
        turned = [_turned(rays, h * np.eye(3)[axis]) for h in (1e-6, -1e-6)]
        assert np.allclose((turned[0] - turned[1]) / 2e-6, slopes[:, :, axis], atol=1e-8)


def _turned(rays: FloatArray, rotation: FloatArray) -> FloatArray:
    moved = np.column_stack([rays, np.ones(len(rays))]) @ Rotation.from_rotvec(rotation).as_matrix().T
    seen: FloatArray = moved[:, :2] / moved[:, 2:]
    return seen


def test_a_pattern_beyond_the_field_hides_the_principal_point_and_not_f() -> None:
    camera = phantom3()
    _, sigma = lens_priors(camera.width, camera.f_px)
    priors = Priors(*(np.zeros(0),) * 4, lens_mean=camera.vector, lens_sigma=sigma)
    free = mask(("f", "cx", "cy", "k1", "k2", "k3", "p1", "p2"), field=True)
    assert not beyond_field(Lens(camera), free, priors).any()
    lens = with_field(1, 0.4)
    covariance = beyond_field(lens, free, priors)
    assert not covariance[~free].any()
    _, jacobian = fit_brown(lens)
    out = np.sqrt(np.diag(jacobian @ covariance @ jacobian.T))
    assert 0.5 < out[INDEX["cx"]] < 3.0
    assert 0.5 < out[INDEX["cy"]] < 3.0
    assert 0 < out[INDEX["f"]] / camera.f_px < 1e-4

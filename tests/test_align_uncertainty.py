"""Sigmas that take more than noise into account."""

from __future__ import annotations

import numpy as np
import pytest
from align_blocks import solved

from calib.align.correlation import SMOOTHER_STILL, correlation_factor
from calib.align.selfcal import Calibrated
from calib.align.uncertainty import estimate, projection_jacobian
from calib.brownfit import fit_brown, image_grid_rays
from calib.solution import Estimate
from sim.network import SimBlock


def factor_of(solved: Calibrated) -> float:
    adjusted, seen = solved.adjusted, solved.observations
    return correlation_factor(adjusted.residuals_px, adjusted.weights, seen.photo, seen.pixels, (4000, 3000))


@pytest.fixture(scope="module")
def estimates() -> list[tuple[SimBlock, Calibrated, Estimate]]:
    made = [solved("demo", seed, 200) for seed in range(8)]
    return [(block, calibrated, estimate(calibrated)) for block, calibrated in made]


def test_white_noise_has_no_factor(estimates: list[tuple[SimBlock, Calibrated, Estimate]]) -> None:
    """Also on thin blocks, where poses eat much of the few residuals in each part of a photo."""
    factors = [e.correlation_factor for _, _, e in estimates]
    assert np.median(factors) == 1.0
    assert max(factors) < 1 + 0.15 * SMOOTHER_STILL
    assert np.mean(factors) < 1.15
    assert [factor_of(c) for _, c, _ in estimates] == factors
    assert 1.0 <= factor_of(solved("demo", 1, 500)[1]) < 1.15
    assert 1.0 <= factor_of(solved("A1", 2, 200)[1]) < 1.15


def test_smooth_noise_has_one() -> None:
    thin = [factor_of(solved("demo", seed, 200, correlated_px=0.4)[1]) for seed in range(3)]
    assert min(thin) > 1.5
    # More points on the same smooth error carry no more information: the factor grows with them.
    dense = factor_of(solved("demo", 0, 500, correlated_px=0.4)[1])
    assert thin[0] * 1.2 < dense < 12


def test_factor_counts_what_was_put_in() -> None:
    """Residuals without an adjustment: one shift for every ninth of a photo."""
    rng = np.random.default_rng(0)
    n, photos = 20_000, 20
    photo = rng.integers(0, photos, n)
    pixels = rng.uniform([0, 0], [4000, 3000], (n, 2))
    cell = np.minimum((pixels / [4000, 3000] * 3).astype(int), 2)
    shifts = rng.normal(0, 0.1, (photos, 3, 3, 2))[photo, cell[:, 1], cell[:, 0]]
    residuals = rng.normal(0, 0.5, (n, 2)) + shifts
    ones = np.ones(n)
    factor = correlation_factor(residuals, ones, photo, pixels, (4000, 3000))
    # 111 residuals a cell: 1 + 111 (0.1 / 0.5)^2 over the 6 of 9 cells that poses leave.
    excess = (factor - 1) / SMOOTHER_STILL
    assert 0.8 < (1 + excess) / ((1 + n / photos / 9 * 0.04) * 9 / 6) < 1.2
    # Outliers are not asked.
    residuals[:500] = 300.0
    assert correlation_factor(
        residuals, np.where(np.arange(n) < 500, 0.1, 1.0), photo, pixels, (4000, 3000)
    ) == pytest.approx(factor, rel=0.1)
    assert correlation_factor(residuals[:30], ones[:30], photo[:30], pixels[:30], (4000, 3000)) == 1.0


def test_estimate_is_consistent(estimates: list[tuple[SimBlock, Calibrated, Estimate]]) -> None:
    errors = []
    for block, calibrated, found in estimates:
        assert found.brown == fit_brown(calibrated.adjusted.state.lens)[0]
        assert found.sigma_f_px >= found.sigma_f_formal_px * 0.999
        # Nothing is wrong with this lens: sigma stays near the formal one.
        assert found.sigma_f_px < 2 * found.sigma_f_formal_px
        # Inflation adds, it never takes away.
        excess = found.correlation_factor / calibrated.adjustment.noise_factor
        grown = found.lens_covariance - excess * calibrated.adjusted.covariance
        scale = np.sqrt(np.maximum(np.diag(found.lens_covariance), 1e-30))
        assert np.linalg.eigvalsh(grown / np.outer(scale, scale)).min() > -1e-9
        assert found.spread_f_px == pytest.approx(
            max(abs(f - found.brown.f_px) for f in found.models.values())
        )
        assert not set(found.models) & set(found.rejected_models)
        errors.append((found.brown.f_px - block.lens.brown.f_px) / found.sigma_f_px)
    assert np.abs(errors).max() < 3
    assert np.sqrt(np.mean(np.square(errors))) > 0.4


def test_models_that_do_not_fit_are_rejected(
    estimates: list[tuple[SimBlock, Calibrated, Estimate]],
) -> None:
    """The papers' lens has a K3; without it no fit is as good. A lens with affinity needs b1, b2."""
    for _, _, found in estimates:
        assert "without K3" in found.rejected_models
        assert {"without affinity", "without residual field", "with K4"} <= set(found.models)
    bent = estimate(solved("demo", 1, 200, aspect=0.005)[1])
    assert "without affinity" in bent.rejected_models


def test_halves_differ_as_their_sigmas_say(
    estimates: list[tuple[SimBlock, Calibrated, Estimate]],
) -> None:
    ratios = np.array([e.split_f_px / e.split_sigma_f_px for _, _, e in estimates])
    assert np.abs(ratios).max() < 3
    assert 0.4 < np.sqrt(np.mean(ratios**2)) < 1.6
    profile = np.array([e.split_profile_ratio for _, _, e in estimates])
    assert 0.4 < np.sqrt(np.mean(profile**2)) < 1.6
    for _, _, found in estimates:
        # Half the points, twice, in the difference.
        assert 1.5 < found.split_sigma_f_px / found.sigma_f_formal_px < 3


def test_unmodelled_lens_is_held_by_sigma() -> None:
    """A pattern of 1.5 px, smooth noise, an aspect: three sigmas hold the true f all the same."""
    for options in ({"pattern_px": 1.5}, {"correlated_px": 0.4}, {"aspect": 0.005}):
        for seed in range(3):
            block, calibrated = solved("demo", seed, 200, **options)
            found = estimate(calibrated)
            error = found.brown.f_px - block.lens.brown.f_px
            assert abs(error) < 3 * found.sigma_f_px < 40, (options, seed)


def test_progress_is_told() -> None:
    count = 0

    def tick() -> None:
        nonlocal count
        count += 1

    estimate(solved("demo", 1, 100)[1], tick)
    assert count > 8


def test_projection_jacobian() -> None:
    _, calibrated = solved("demo", 1, 100)
    lens = calibrated.adjusted.state.lens
    mapping = projection_jacobian(lens)
    move = np.random.default_rng(0).normal(0, 1, 35) * np.sqrt(np.diag(calibrated.adjusted.covariance)) * 0.1
    rays = image_grid_rays(lens, 12, 9)
    numeric = (lens.with_vector(lens.vector + move).project(rays) - lens.project(rays)).ravel()
    assert np.abs(mapping @ move - numeric).max() < 0.02 * np.abs(numeric).max()

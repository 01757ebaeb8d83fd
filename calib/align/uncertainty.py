"""Honest sigma: what a formal covariance leaves out, measured on the block itself.

* Residuals that agree among neighbours within a photo (correlated noise, rolling shutter, terrain
  that moved) carry less information than their number says: a variance factor from block means.
* Models that fit as well but give another f: their spread goes into the covariance.
* Halves of the tie points, adjusted apart (mrcal's cross-validation).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from calib.align.adjust import Adjusted, Adjustment, Priors, State
from calib.align.chance import CHANCE, Lengths, projection_jacobian
from calib.align.selfcal import Calibrated, block_correlation
from calib.align.tracks import select, thin
from calib.brownfit import fit_brown, image_grid_rays, turned_rays
from calib.camera import BROWN_NAMES, FloatArray
from calib.field import LENS_NAMES, Lens
from calib.solution import Estimate

NB = len(BROWN_NAMES)
#: Observations above which the model comparisons run on a thinned block.
COMPARE_ON = 25_000
#: A model whose chi-square is worse with less probability than this is not defensible.
DEFENSIBLE_P = 1e-3
#: A smooth lens pattern does not end at the field's fourth degree; what goes on beyond it, as a share of
#: the coefficients found, in each of this many parts of the image.
BEYOND_FIELD, PARTS = 0.15, (6, 4)
#: Ways to halve the points that are tried: a photo with a dozen of them is left bare by every other one.
SHUFFLES = 6


@dataclass(frozen=True)
class _Model:
    name: str
    free: np.ndarray
    priors: Priors
    lens: Lens


def _variants(base: Adjusted, priors: Priors) -> list[_Model]:
    """Defensible neighbours of the model that the verdict rests on."""
    index = {name: i for i, name in enumerate(LENS_NAMES)}
    lens = base.state.lens

    def toggled(name: str, *parameters: str) -> _Model:
        free = base.free.copy()
        columns = [index[p] for p in parameters]
        adding = not free[columns].any()
        free[columns] = adding
        vector = lens.vector
        if not adding:
            vector[columns] = priors.lens_mean[columns]
        return _Model(("with " if adding else "without ") + name, free, priors, lens.with_vector(vector))

    no_field = base.free.copy()
    no_field[NB:] = False
    plain = Lens(fit_brown(lens)[0])
    wide = priors.lens_sigma.copy()
    wide[NB:] *= 3
    # A stronger field lets all cameras turn together (:func:`beyond_field`) by degrees where the lens hardly
    # distorts, and f follows the principal point in the square of that: the same rays by other numbers.
    still = base.free.copy()
    still[[index["cx"], index["cy"]]] = False
    return [
        toggled("K3", "k3"),
        toggled("K4", "k4"),
        toggled("decentring", "p1", "p2"),
        toggled("affinity", "b1", "b2"),
        toggled("principal point", "cx", "cy"),
        _Model("without residual field", no_field, priors, Lens(replace(plain.brown, k4=lens.brown.k4))),
        _Model("stronger residual field", still, replace(priors, lens_sigma=wide), lens),
    ]


def beyond_field(lens: Lens, free: np.ndarray, priors: Priors) -> FloatArray:
    """Covariance (35, 35) from the part of the lens's pattern that the residual field cannot follow.

    A common turn of all cameras looks like a shift of the principal point with decentring and some
    field, to within far less than a pixel: tie points tell them apart only if the model is exact to
    that. f and radial distortion, which no turn imitates, hardly notice.
    """
    size = BEYOND_FIELD * float(np.sqrt(np.mean(np.square(lens.field_px))))
    covariance = np.zeros((len(free), len(free)))
    if size == 0.0:
        return covariance
    rays = image_grid_rays(lens, *PARTS)
    _, by_ray, by_lens = lens.derivatives(rays)
    turns = by_ray @ turned_rays(rays)
    design = np.concatenate([by_lens[:, :, free], turns], axis=-1).reshape(2 * len(rays), -1)
    known = np.concatenate([1 / np.square(priors.lens_sigma[free]), np.zeros(3)])
    normal = design.T @ design / size**2 + np.diag(known)
    scale = 1 / np.sqrt(np.diag(normal))
    inverse = np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale)
    n = int(free.sum())
    covariance[np.ix_(free, free)] = inverse[:n, :n]
    return covariance


@dataclass(frozen=True)
class _Part:
    """Part of a block, with the weights that all models compared on it share."""

    adjustment: Adjustment
    state: State
    weights: tuple[FloatArray, FloatArray]

    def run(self, model: _Model, tick: Callable[[], None] | None) -> Adjusted:
        return self.adjustment.with_priors(model.priors).run(
            replace(self.state, lens=model.lens),
            model.free,
            max_iterations=40,
            decrement=0.05,
            weights=self.weights,
            damping=1e-8,
            tick=tick,
        )


def _subset(block: Calibrated, points: np.ndarray, n_photos: int) -> _Part | None:
    """The block on some of its points; None where a photo would be left bare."""
    obs = block.observations
    kept = points[obs.point]
    sub, old = select(obs, kept)
    if not len(sub) or np.bincount(sub.photo, minlength=n_photos).min() < 6:
        return None
    state = block.adjusted.state
    return _Part(
        Adjustment(
            sub,
            n_photos,
            len(old),
            block.adjustment.priors,
            noise_factor=block.adjustment.noise_factor,
        ),
        replace(state, points_m=state.points_m[old]),
        (block.adjusted.weights[kept], block.adjusted.position_weights),
    )


def estimate(block: Calibrated, tick: Callable[[], None] | None = None) -> Estimate:
    """The calibration with sigmas that take model error into account."""
    base, adjustment = block.adjusted, block.adjustment
    state = base.state
    n_photos = len(state.rotations)
    factor = block_correlation(adjustment, base)
    # Part of it may be in the weights, and so in the covariance, already.
    excess = factor / adjustment.noise_factor
    fitted, jacobian = fit_brown(state.lens, keep_k4=bool(base.free[6]))
    formal = base.covariance
    covariance_35 = formal * excess
    sigma_f_formal = float(np.sqrt(jacobian[0] @ formal @ jacobian[0] / adjustment.noise_factor))

    compare = _comparison_block(block, n_photos)
    own = compare.run(_Model("", base.free, adjustment.priors, state.lens), tick)
    scale = own.sigma0**2 * excess / adjustment.noise_factor
    f_here = fit_brown(own.state.lens)[0].f_px
    models: dict[str, float] = {}
    rejected: dict[str, float] = {}
    moves: list[_Move] = []
    for model in _variants(base, adjustment.priors):
        run = replace(compare, state=own.state).run(model, tick)
        f = fit_brown(run.state.lens, keep_k4=bool(model.free[6]))[0].f_px
        worse = max((run.chi2 - own.chi2) / scale, 0.0)
        dropped = max(int(base.free.sum()) - int(model.free.sum()), 1)
        if float(chdtrc(dropped, worse)) < DEFENSIBLE_P or not np.isfinite(f):
            rejected[model.name] = fitted.f_px + f - f_here
            continue
        models[model.name] = fitted.f_px + f - f_here
        moved = run.state.lens.vector - own.state.lens.vector
        moves.append(_Move(f - f_here, moved, run.covariance * excess))
    spread = max((abs(f - fitted.f_px) for f in models.values()), default=0.0)
    lengths = Lengths(jacobian[0], projection_jacobian(state.lens))
    covariance_35 = _with_spread(covariance_35, moves, lengths)
    covariance_35 = covariance_35 + beyond_field(state.lens, base.free, adjustment.priors)
    split_f, split_sigma, split_ratio = _split(block, lengths, n_photos, excess, tick)
    return Estimate(
        brown=fitted,
        covariance=jacobian @ covariance_35 @ jacobian.T,
        lens=state.lens,
        lens_covariance=covariance_35,
        sigma_f_formal_px=sigma_f_formal,
        spread_f_px=spread,
        models=models,
        rejected_models=rejected,
        split_f_px=split_f,
        split_sigma_f_px=split_sigma,
        split_profile_ratio=split_ratio,
        correlation_factor=factor,
    )


def _comparison_block(block: Calibrated, n_photos: int) -> _Part:
    obs = block.observations
    if len(obs) > COMPARE_ON:
        per_cell = max(2, round(COMPARE_ON / n_photos / 64))
        thinned = _subset(block, thin(obs, n_photos, 8, per_cell), n_photos)
        if thinned is not None:
            return thinned
    adjusted = block.adjusted
    return _Part(block.adjustment, adjusted.state, (adjusted.weights, adjusted.position_weights))


@dataclass(frozen=True)
class _Move:
    """How a defensible model differs: f in px, lens parameters (35,), their covariance (35, 35)."""

    df_px: float
    lens: FloatArray
    covariance: FloatArray


def _with_spread(covariance: FloatArray, moves: list[_Move], lengths: Lengths) -> FloatArray:
    """Add each model's move where it exceeds what chance explains, the largest first.

    Between nested models noise alone moves an estimate by the root of the difference of their
    variances (Hausman 1978). A move within sigma, or within three times that root, is no sign of
    model error (of seven models one exceeds twice the root by chance every fifth time); beyond it
    the whole excess over sigma is. Looked for in f and in the total mapping.
    """
    formal = lengths.variances(covariance)
    for move in sorted(moves, key=lambda m: -abs(m.df_px)):
        own = lengths.variances(move.covariance)
        now = lengths.variances(covariance)
        sizes = (move.df_px**2, lengths.squares(move.lens)[1])
        excess = 0.0
        for size, before, other, current in zip(sizes, formal, own, now, strict=True):
            if size > max(current, CHANCE**2 * abs(other - before)):
                excess = max(excess, 1 - current / size)
        if excess > 0:
            covariance = covariance + excess * np.outer(move.lens, move.lens)
    return covariance


def _halves(block: Calibrated, n_photos: int) -> tuple[_Part, _Part] | None:
    """Two random halves of the points, by fixed shuffles; None where each leaves a photo bare."""
    n_points = len(block.adjusted.state.points_m)
    for seed in range(SHUFFLES):
        # Neighbouring points have neighbouring numbers; a shuffle makes the halves alike.
        half = np.random.default_rng(seed).permutation(n_points) % 2 == 0
        first, second = _subset(block, half, n_photos), _subset(block, ~half, n_photos)
        if first is not None and second is not None:
            return first, second
    return None


def _split(
    block: Calibrated, lengths: Lengths, n_photos: int, excess: float, tick: Callable[[], None] | None
) -> tuple[float, float, float]:
    """Odd minus even: f, its sigma, and the rms projection difference over its predicted rms."""
    model = _Model("", block.adjusted.free, block.adjustment.priors, block.adjusted.state.lens)
    parts = _halves(block, n_photos)
    if parts is None:
        return float("nan"), float("nan"), float("nan")
    results = [part.run(model, tick) for part in parts]
    first, second = results
    move = first.state.lens.vector - second.state.lens.vector
    covariance = (first.covariance + second.covariance) * excess
    variance, expected = lengths.variances(covariance)
    return (
        float(lengths.f_px @ move),
        float(np.sqrt(variance)),
        float(np.sqrt(lengths.squares(move)[1] / max(expected, 1e-300))),
    )

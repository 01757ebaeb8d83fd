"""The other direction of lens distortion: distorted -> corrected, as Australis and VMS have it.

Fraser's (1997) model adds corrections to *measured* coordinates, Brown's as OpenCV, Metashape and
fieldcal use it distorts *ideal* ones. Neither polynomial is the inverse of the other, and flipping
the signs is right to first order only; here one is fitted to the other over the whole image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.camera import BrownCamera, FloatArray
from calib.convert import MINIMAX_ROUNDS, NEGLIGIBLE_PX, Fit, fit_brown, image_grid_px, lawson_weights
from calib.errors import FormatError

#: What a conversion may cost at its worst place in the image unless the caller says otherwise.
TOLERANCE_PX = 0.01


@dataclass(frozen=True)
class CorrectionModel:
    """Fraser's model: measured pixel -> ray.

    With xd = (u - cx) / f, yd = (v - cy) / f (y down) and r2 = xd2 + yd2:
    x = xd (1 + K1 r2 + K2 r4 + ...) + P1 (r2 + 2 xd2) + 2 P2 xd yd + B1 xd + B2 yd
    y = yd (1 + K1 r2 + K2 r4 + ...) + P2 (r2 + 2 yd2) + 2 P1 xd yd.

    ``radial`` (K1, K2, ...), ``p1``, ``p2`` in focal units; ``b1``, ``b2`` without unit.
    P1 goes with x here, as in Australis; Brown's P1 in :class:`BrownCamera` goes with y.
    """

    width: int
    height: int
    f_px: float
    cx_px: float
    cy_px: float
    radial: tuple[float, ...]
    p1: float = 0.0
    p2: float = 0.0
    b1: float = 0.0
    b2: float = 0.0

    def unproject(self, pixels: FloatArray) -> FloatArray:
        """Pixels (n, 2) -> rays (n, 2)."""
        xd, yd = (pixels[:, 0] - self.cx_px) / self.f_px, (pixels[:, 1] - self.cy_px) / self.f_px
        r2 = xd * xd + yd * yd
        scale = 1 + sum((k * r2**i for i, k in enumerate(self.radial, 1)), start=np.zeros_like(r2))
        x = xd * scale + self.p1 * (r2 + 2 * xd * xd) + 2 * self.p2 * xd * yd + self.b1 * xd + self.b2 * yd
        y = yd * scale + self.p2 * (r2 + 2 * yd * yd) + 2 * self.p1 * xd * yd
        return np.stack([x, y], axis=-1)


@dataclass(frozen=True)
class CorrectionFit:
    """A fitted correction model; ``misfit_px`` is its largest error over the image."""

    model: CorrectionModel
    misfit_px: float


def fit_correction(camera: BrownCamera, radial_terms: int = 3) -> CorrectionFit:
    """The correction model closest to ``camera`` over its image, whatever its misfit.

    Principal distance and principal point keep their meaning: the fit moves K1.., P1, P2 only (and,
    where the camera has an affine part, B1, B2 by some 1e-5).

    Raises:
        FormatError: the camera's polynomial turns back within the image and has no inverse there.
    """
    pixels = image_grid_px(camera.width, camera.height)
    rays = camera.unproject(pixels)
    if np.isnan(rays).any():
        raise FormatError(
            "The lens model folds back within the image, so its distortion has no inverse there: "
            "the calibration is not usable at the image's corners."
        )
    f = camera.fy_px
    xd, yd = (pixels[:, 0] - camera.cx_px) / f, (pixels[:, 1] - camera.cy_px) / f
    r2 = xd * xd + yd * yd
    zero = np.zeros_like(r2)
    columns = [np.stack([xd, yd], -1) * r2[:, None] ** k for k in range(1, radial_terms + 1)]
    columns += [
        np.stack([r2 + 2 * xd * xd, 2 * xd * yd], -1),
        np.stack([2 * xd * yd, r2 + 2 * yd * yd], -1),
    ]
    affine = np.array([f / camera.f_px - 1, -camera.b2_px / camera.f_px])
    moving_affine = bool(affine.any())
    target = rays - np.stack([xd * (1 + affine[0]) + yd * affine[1], yd], -1)
    if moving_affine:
        columns += [np.stack([xd, zero], -1), np.stack([yd, zero], -1)]
    design = np.stack(columns, -1)
    design_scale = np.linalg.norm(design, axis=(0, 1))
    weights = np.ones(len(pixels))
    best: CorrectionFit | None = None
    # First least squares, then Lawson's reweighting towards the smallest largest misfit.
    for _ in range(1 + MINIMAX_ROUNDS):
        root = np.sqrt(weights)[:, None]
        weighted = (design / design_scale * root[:, :, None]).reshape(-1, len(columns))
        solution = np.linalg.lstsq(weighted, (target * root).ravel(), rcond=None)[0] / design_scale
        moved = affine + solution[-2:] if moving_affine else affine
        model = CorrectionModel(
            camera.width,
            camera.height,
            f,
            camera.cx_px,
            camera.cy_px,
            tuple(float(v) for v in solution[:radial_terms]),
            *(float(v) for v in solution[radial_terms : radial_terms + 2]),
            *(float(v) for v in moved),
        )
        errors_px = np.hypot(*(camera.project(model.unproject(pixels)) - pixels).T)
        if best is None or errors_px.max() < best.misfit_px:
            best = CorrectionFit(model, float(errors_px.max()))
        if best.misfit_px < NEGLIGIBLE_PX:
            break
        weights = lawson_weights(weights, errors_px)
    assert best is not None
    return best


def to_correction(
    camera: BrownCamera, radial_terms: int = 3, tolerance_px: float = TOLERANCE_PX
) -> CorrectionFit:
    """:func:`fit_correction`, refused where its misfit exceeds ``tolerance_px``.

    Raises:
        FormatError: the model cannot hold the lens to the tolerance.
    """
    fit = fit_correction(camera, radial_terms)
    _check(fit.misfit_px, tolerance_px, f"K1-K{radial_terms} and P1, P2 applied to distorted coordinates")
    return fit


def fit_from_correction(model: CorrectionModel) -> Fit:
    """The Brown camera (K1-K4, P1, P2) closest to a correction model, whatever its misfit."""
    pixels = image_grid_px(model.width, model.height)
    rays = model.unproject(pixels)
    fx = model.f_px / (1 + model.b1)
    start = BrownCamera(
        model.width,
        model.height,
        fx,
        model.cx_px,
        model.cy_px,
        p1=-model.p2,
        p2=-model.p1,
        b1_px=fx - model.f_px,
        b2_px=-fx * model.b2,
    )
    free = ["k1", "k2", "k3", "k4", "p1", "p2"] + (["b1", "b2"] if model.b1 or model.b2 else [])
    return fit_brown(rays, pixels, start, free, MINIMAX_ROUNDS)


def from_correction(model: CorrectionModel, tolerance_px: float = TOLERANCE_PX) -> Fit:
    """:func:`fit_from_correction`, refused where its misfit exceeds ``tolerance_px``.

    Raises:
        FormatError: Brown's model cannot hold the correction to the tolerance.
    """
    fit = fit_from_correction(model)
    _check(fit.misfit_px, tolerance_px, "K1-K4 and P1, P2 applied to ideal coordinates")
    return fit


def _check(misfit_px: float, tolerance_px: float, what: str) -> None:
    if not misfit_px <= tolerance_px:
        raise FormatError(
            f"{what} miss this lens by up to {misfit_px:.3g} px within the image, more than the "
            f"{tolerance_px:g} px allowed: use a format of the other direction, or allow more."
        )

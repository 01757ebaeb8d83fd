"""Whether a reference may be held against a set of photos, and its conversion to their size."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from calib.camera import BROWN_NAMES, BrownCamera, FloatArray
from calib.convert import to_image_size
from calib.errors import InputError
from calib.field import FIELD_NAMES, field_basis
from calib.photos.photo import CameraIdentity, Processing
from calib.reference import Reference

#: Body-to-body spread (1 sigma) assumed where a reference belongs to another body of the model:
#: f in parts, distortion at the image edge in parts of the half width ([C&D]'s two bodies of one
#: lens lie 0.26 % apart in f and 0.3 % of the half width apart in distortion).
OTHER_BODY_SIGMA_F = 0.005
OTHER_BODY_SIGMA_EDGE = 0.002
#: Zoom settings closer than this count as the same.
_SAME_FOCAL = 0.01
_LENGTHS = ("f", "cx", "cy", "b1", "b2")


def same_model(reference: Reference, camera: CameraIdentity) -> bool:
    """Whether make and model agree, by the names under which the camera signs its photos."""
    names = {_plain(name) for name in (*reference.exif_models, reference.model) if name}
    return _plain(camera.model) in names


def match_reference(
    reference: Reference, camera: CameraIdentity, named: bool = False
) -> tuple[Reference | None, str]:
    """The reference converted to the photos' image size, or None, and one sentence about it.

    Raw against lens-corrected, another zoom setting and a size that no crop or scale explains
    are refused. Where the photos or the reference do not say how they were processed, or the
    reference belongs to another model or body, it is used only when the user ``named`` it, and
    then with the body-to-body spread in its sigmas.
    """
    name, notes = reference.name, []
    processings = {reference.processing, camera.processing}
    if processings == {Processing.RAW, Processing.LENS_CORRECTED}:
        return None, (
            f"Reference {name} is for {_files(reference.processing)} and these photos are "
            f"{_files(camera.processing)}: their distortion cannot be compared, so it is not used."
        )
    if len(processings) == 2:
        silent = "the reference" if reference.processing is Processing.UNKNOWN else "the photos"
        if not named:
            return None, (
                f"Reference {name} is not used: it is not known of {silent} whether the camera corrected "
                "the lens (name it with --reference to use it all the same)."
            )
        notes.append(f"whether the camera corrected the lens is not known of {silent}")
    if reference.focal_mm and camera.focal_mm:
        ratio = camera.focal_mm / reference.focal_mm
        if abs(ratio - 1) > _SAME_FOCAL:
            return None, (
                f"Reference {name} was made at {reference.focal_mm:g} mm and these photos were taken at "
                f"{camera.focal_mm:g} mm, so it is not used."
            )
    other_body = False
    if reference.model and camera.model and not same_model(reference, camera):
        if not named:
            return None, f"Reference {name} is of a {reference.model}, not of a {camera.model}."
        notes.append(f"it is of a {reference.model} and the photos are of a {camera.model}")
        other_body = True
    if reference.serial and camera.serial and reference.serial != camera.serial:
        if not named:
            return None, (
                f"Reference {name} belongs to another body (serial {reference.serial}, photos "
                f"{camera.serial}), so it is not used; name it with --reference to use it all the same."
            )
        notes.append(f"it belongs to another body (serial {reference.serial}, photos {camera.serial})")
        other_body = True
    if other_body:
        reference = _with_body_spread(reference)
    try:
        converted, size_note = convert_reference(reference, camera.width, camera.height)
    except InputError as error:
        return None, f"Reference {name} is not used: {_lower(str(error))}"
    if size_note:
        notes.append(_lower(size_note).rstrip("."))
    if not reference.serial and not other_body and reference.model:
        notes.append("it does not name a camera body, so its sigmas stand for the model")
    return converted, f"Held against reference {name}" + (": " + "; ".join(notes) if notes else "") + "."


def convert_reference(reference: Reference, width: int, height: int) -> tuple[Reference, str]:
    """``reference`` for images of ``width`` x ``height``, and what was done ("" where nothing).

    Raises:
        InputError: its image size is unknown, or no crop or scale leads to the new one.
    """
    if (reference.width, reference.height) == (width, height):
        return reference, ""
    if reference.width == 0:
        raise InputError("its image size is not known.")
    if reference.brown is None:
        raise InputError(
            f"it is for {reference.width}x{reference.height} images and too little of it is published "
            f"to convert it to {width}x{height}."
        )
    resized = to_image_size(reference.brown, width, height)
    brown = resized.camera
    fitted = reference.fitted_brown
    if fitted is not None:
        fitted = to_image_size(fitted, width, height).camera
    field_px = reference.field_px
    if field_px is not None:
        field_px = _refit_field(field_px, reference.brown, brown)
    scale = brown.f_px / reference.brown.f_px
    lengths = np.array([scale if key in _LENGTHS else 1.0 for key in BROWN_NAMES])
    return replace(
        reference,
        width=width,
        height=height,
        brown=brown,
        field_px=None
        if reference.field_px is None
        else _refit_field(reference.field_px, reference.brown, brown),
        fitted_brown=fitted,
        sigma={key: s * (scale if key in _LENGTHS else 1.0) for key, s in reference.sigma.items()},
        # The field's coefficients mean something else in another frame; the sigmas remain.
        covariance=None,
        fitted_covariance=_scaled(reference.fitted_covariance, lengths),
        line=None,
    ), resized.how


def _refit_field(field_px: FloatArray, old: BrownCamera, brown: BrownCamera) -> FloatArray:
    """The residual field in the frame of the new images, (24,).

    Its polynomial is sampled there and fitted with the terms that a field has; the constant and
    linear terms that a crop brings with it stay out, as everywhere.
    """
    scale = brown.f_px / old.f_px
    u, v = np.meshgrid(np.linspace(0, brown.width, 25), np.linspace(0, brown.height, 25))
    new_px = np.stack([u.ravel(), v.ravel()], axis=-1)
    old_px = (new_px - [brown.cx_px, brown.cy_px]) / scale + [old.cx_px, old.cy_px]
    n = len(FIELD_NAMES) // 2
    values = field_basis(old_px, old.width, old.height) @ field_px.reshape(2, n).T * scale
    st = 2 * new_px / [brown.width, brown.height] - 1
    design = np.column_stack([field_basis(new_px, brown.width, brown.height), np.ones(len(st)), st])
    return np.asarray(np.linalg.lstsq(design, values, rcond=None)[0][:n].T.ravel())


def _with_body_spread(reference: Reference) -> Reference:
    brown = reference.comparable_brown
    if brown is None:
        return reference
    radius = max(brown.width, brown.height) / 2
    spread = {
        "f": OTHER_BODY_SIGMA_F * brown.f_px,
        "k1": OTHER_BODY_SIGMA_EDGE * brown.f_px**2 / radius**2,
    }
    sigma = {
        key: math.hypot(reference.sigma.get(key, 0.0), spread.get(key, 0.0))
        for key in (*reference.sigma, *(k for k in spread if k not in reference.sigma))
    }
    covariance = reference.fitted_covariance
    if covariance is not None:
        variances = np.array([spread.get(key, 0.0) ** 2 for key in BROWN_NAMES])
        covariance = covariance + np.diag(variances)
    return replace(reference, sigma=sigma, fitted_covariance=covariance, covariance=None)


def _scaled(covariance: FloatArray | None, factors: FloatArray) -> FloatArray | None:
    return None if covariance is None else np.asarray(covariance * np.outer(factors, factors))


def _files(processing: Processing) -> str:
    return {
        Processing.RAW: "raw files",
        Processing.LENS_CORRECTED: "files that the camera corrected for the lens",
        Processing.UNKNOWN: "files of unknown processing",
    }[processing]


def _lower(sentence: str) -> str:
    return sentence[:1].lower() + sentence[1:]


def _plain(text: str) -> str:
    return " ".join(text.lower().replace("_", " ").split())

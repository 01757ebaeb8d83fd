"""What the readers and writers of foreign calibration files share."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import cast
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml.common import DefusedXmlException  # type: ignore[import-untyped]
from defusedxml.ElementTree import fromstring  # type: ignore[import-untyped]

from calib.camera import BrownCamera, FloatArray
from calib.convert import MINIMAX_ROUNDS, Fit, fit_brown, image_grid_px, mapping_difference_px
from calib.errors import FormatError

#: What writing may change of the mapping ray -> pixel, at its worst place in the image.
TOLERANCE_PX = 0.01

#: Largest misfit that reading allows where a file's lens model is not Brown's and has to be fitted: a
#: fifth of a tie point's noise, and at the worst place of the image only.
READ_TOLERANCE_PX = 0.1

_TERMS = ("k1", "k2", "k3", "k4", "p1", "p2", "b1_px", "b2_px")

#: A sensor pitch for formats that want millimetres where nobody knows it. The calibration does not
#: depend on it; the file's numbers in mm do.
NOMINAL_PIXEL_SIZE_MM = 0.0024


@dataclass(frozen=True)
class ReadOptions:
    """What a file may leave open.

    ``image_size``: (width, height) in px. ``pixel_size_mm``: sensor pitch. ``camera_name``: which
    camera of a file with several. ``tolerance_px``: largest misfit where the file's lens model is not
    Brown's own and has to be fitted (None: the format's own bound).
    """

    image_size: tuple[int, int] | None = None
    pixel_size_mm: float | None = None
    camera_name: str | None = None
    tolerance_px: float | None = None


@dataclass(frozen=True)
class WriteOptions:
    """What a file wants to hold besides the calibration.

    ``tolerance_px``: largest change of the mapping that the writer may cause where the format cannot
    hold the lens exactly; above it the writer refuses.
    """

    pixel_size_mm: float | None = None
    make: str = "unknown"
    model: str = "unknown"
    tolerance_px: float = TOLERANCE_PX


def number(text: str | None, what: str) -> float:
    """A finite number from a file."""
    try:
        value = float(text) if text is not None else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        shown = "missing" if text is None else f"{text.strip()[:40]!r}"
        raise FormatError(f"{what} is {shown}, not a number: the calibration file cannot be used.")
    return value


def numbers(text: str, what: str) -> tuple[float, ...]:
    """Numbers separated by blanks or commas."""
    return tuple(number(word, what) for word in re.split(r"[\s,]+", text.strip()) if word)


def json_number(value: object, what: str) -> float:
    """A finite number from JSON (not a string, not true)."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise FormatError(
            f"{what} is {str(value)[:40]!r}, not a number: the calibration file cannot be used."
        )
    # An integer of hundreds of digits has no float.
    if isinstance(value, int) and value.bit_length() > 1000:
        raise FormatError(f"{what} is too large: the calibration file cannot be used.")
    return number(repr(float(value)), what)


def image_size(width: float, height: float) -> tuple[int, int]:
    """Checked image size in px."""
    if not (1 <= width <= 200_000 and 1 <= height <= 200_000 and width % 1 == 0 and height % 1 == 0):
        raise FormatError(f"An image of {width:g}x{height:g} px cannot be: the calibration file is damaged.")
    return int(width), int(height)


def required_size(options: ReadOptions, what: str) -> tuple[int, int]:
    if options.image_size is None:
        raise FormatError(f"{what} does not say how large the images are in px: give the image size.")
    return image_size(*options.image_size)


def usable(camera: BrownCamera) -> BrownCamera:
    """The camera, if its numbers can be those of a camera at all."""
    if not np.isfinite(camera.vector).all():
        raise FormatError("The calibration holds numbers that are not finite, so it cannot be used.")
    extent = max(camera.width, camera.height)
    for name, focal in (("focal length", camera.f_px), ("focal length along columns", camera.fy_px)):
        if not 0.01 * extent <= focal <= 1000 * extent:
            raise FormatError(
                f"The {name} comes out as {focal:.6g} px for images of {camera.width}x{camera.height} px, "
                "which no camera has: check the file's units and image size."
            )
    return camera


def writable(camera: BrownCamera) -> BrownCamera:
    """The camera with Python's own numbers (their repr is what files hold), if they are a camera's."""
    return usable(BrownCamera.from_vector(int(camera.width), int(camera.height), camera.vector))


def one_of(cameras: Mapping[str, BrownCamera], options: ReadOptions, what: str) -> BrownCamera:
    """The camera asked for, or the only one."""
    if not cameras:
        raise FormatError(f"{what} holds no camera.")
    names = ", ".join(repr(name) for name in list(cameras)[:5]) + (", ..." if len(cameras) > 5 else "")
    if options.camera_name is not None:
        if options.camera_name not in cameras:
            raise FormatError(f"{what} holds no camera {options.camera_name!r}, only {names}.")
        return cameras[options.camera_name]
    if len(cameras) > 1:
        raise FormatError(f"{what} holds {len(cameras)} cameras ({names}): say which one, or keep only one.")
    return next(iter(cameras.values()))


# --- XML -----------------------------------------------------------------------------------------


def parse_xml(text: str, what: str) -> Element:
    """The root element; entities, DTDs and external references are refused."""
    try:
        return cast(Element, fromstring(text, forbid_dtd=True))
    except DefusedXmlException as error:
        raise FormatError(
            f"{what} holds a document type or entity definitions, which no calibration needs and which "
            "can harm the reader: it is not read."
        ) from error
    except (ParseError, ValueError, LookupError) as error:
        raise FormatError(f"{what} is not well-formed XML ({error}): export it again.") from error


def root_tag(text: str) -> str | None:
    """Name of an XML text's root element without parsing it (None: not XML)."""
    if not text.lstrip().startswith("<"):
        return None
    match = re.search(r"<([A-Za-z_][\w.:-]*)", text)
    return match.group(1) if match else None


def child_number(element: Element, tag: str, default: float | None = None) -> float:
    """Number in the child ``tag``; ``default`` where there is no such child (None: required)."""
    child = element.find(tag)
    if child is None and default is not None:
        return default
    return number(None if child is None else child.text or "", f"<{tag}>")


# --- Models that are not Brown's own ------------------------------------------------------------


def fitted(
    project: Callable[[FloatArray], FloatArray], start: BrownCamera, tolerance_px: float, what: str
) -> BrownCamera:
    """The Brown camera closest to a foreign projection rays (n, 2) -> pixels (n, 2).

    ``start`` gives size, focal length and principal point, which the fit keeps; K1-K4, P1, P2 move.

    Raises:
        FormatError: the misfit exceeds ``tolerance_px``, or the foreign model has no inverse.
    """
    pixels = image_grid_px(start.width, start.height)
    fit = fit_rays(invert(project, pixels, start, what), pixels, start)
    if not fit.misfit_px <= tolerance_px:
        raise FormatError(
            f"{what} cannot be expressed with K1-K4, P1, P2: the best fit misses by up to "
            f"{fit.misfit_px:.3g} px within the image, more than the {tolerance_px:g} px allowed."
        )
    return fit.camera


def fit_rays(rays: FloatArray, pixels: FloatArray, start: BrownCamera) -> Fit:
    """:func:`calib.convert.fit_brown` over the distortion terms, with affine terms where start has any."""
    free = ["k1", "k2", "k3", "k4", "p1", "p2"]
    if start.b1_px or start.b2_px:
        free += ["b1", "b2"]
    reached = np.isfinite(rays).all(axis=-1)
    return fit_brown(rays[reached], pixels[reached], start, free, MINIMAX_ROUNDS)


def invert(
    project: Callable[[FloatArray], FloatArray], pixels: FloatArray, start: BrownCamera, what: str
) -> FloatArray:
    """Rays (n, 2) that ``project`` maps to ``pixels`` (n, 2), by Newton with numerical derivatives.

    Pixels that no ray reaches come back as NaN: measured lenses do turn back in the extreme corners,
    where nothing was observed.

    Raises:
        FormatError: they are more than a tenth of the grid.
    """
    focal = np.array([start.f_px, start.fy_px])
    rays: FloatArray = (pixels - [start.cx_px, start.cy_px]) / focal
    step = 1e-6
    along_x, along_y = np.array([step, 0.0]), np.array([0.0, step])
    with np.errstate(all="ignore"):
        for _ in range(50):
            residual = pixels - project(rays)
            by_x = (project(rays + along_x) - project(rays - along_x)) / (2 * step)
            by_y = (project(rays + along_y) - project(rays - along_y)) / (2 * step)
            det = by_x[:, 0] * by_y[:, 1] - by_x[:, 1] * by_y[:, 0]
            dx = (by_y[:, 1] * residual[:, 0] - by_y[:, 0] * residual[:, 1]) / det
            dy = (by_x[:, 0] * residual[:, 1] - by_x[:, 1] * residual[:, 0]) / det
            rays = rays + np.clip(np.stack([dx, dy], -1), -0.5, 0.5)
            if np.abs(residual).max(initial=0.0) < 1e-9:
                break
        reached = (np.abs(project(rays) - pixels).max(axis=-1) < 1e-6) & (det > 0)
    if reached.mean() < 0.9:
        raise FormatError(
            f"{what} folds back well within the image, so many pixels belong to no ray: "
            "the calibration is not usable."
        )
    rays[~reached] = np.nan
    return rays


def reduced(camera: BrownCamera, keep: tuple[str, ...]) -> BrownCamera:
    """``camera`` with only the distortion terms ``keep``, refitted so that they take up what they can.

    Focal length and principal point stay. The caller checks what it cost (:func:`checked`).
    """
    held = {name: getattr(camera, name) if name in keep else 0.0 for name in _TERMS}
    start = BrownCamera(camera.width, camera.height, camera.f_px, camera.cx_px, camera.cy_px, **held)
    if start == camera:
        return camera
    pixels = image_grid_px(camera.width, camera.height)
    rays = camera.unproject(pixels)
    reached = np.isfinite(rays).all(axis=-1)
    rays, pixels = rays[reached], pixels[reached]
    free = [name for name in keep if not name.startswith("b")]
    return fit_brown(rays, pixels, start, free, MINIMAX_ROUNDS).camera


def checked(
    camera: BrownCamera,
    text: str,
    read: Callable[[str], BrownCamera],
    options: WriteOptions,
    what: str,
) -> str:
    """``text``, once it is shown to read back as ``camera``'s mapping to ``options.tolerance_px``.

    Raises:
        FormatError: the format cannot hold this calibration.
    """
    change = mapping_difference_px(camera, read(text))
    if not change <= options.tolerance_px:
        raise FormatError(
            f"{what} cannot hold this lens: written and read back, pixels would move by up to "
            f"{change:.3g} px, more than the {options.tolerance_px:g} px allowed; use a format that "
            "holds all of K1-K4, P1, P2, b1, b2 (json, metashape)."
        )
    return text

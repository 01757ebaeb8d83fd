"""MicMac's AutoCal XML (``CalibrationInternConique``), as Tapas' RadialBasic, RadialStd, FraserBasic
and Fraser write it.

All lengths in px. A ray goes to (PP + F x, PP + F y), then through the distortions, the last listed
first, each with d = point - CDist, r2 = d.d (MicMac, ``phgr_ebner_brown_dist.cpp``,
``cDistModStdPhpgr::Direct``):

ModRad:      d += d (R1 r2 + R2 r4 + ...)
ModPhgrStd:  as ModRad, and  dx += P1 (2 dx2 + r2) + 2 P2 dx dy + b1 dx + b2 dy,
                             dy += P2 (2 dy2 + r2) + 2 P1 dx dy

so P1 goes with x, opposite to fieldcal's. Direction: with KnownConv eConvApero_DistM2C (M for
"monde") the polynomial runs from ideal to distorted coordinates, as here: MicMac's own import from
Bundler and iTowns' MicMac reader both use it so. eConvApero_DistC2M runs the other way.
MicMac does not say which point of the first pixel is zero; its nominal PP is half the size, so the
corner is taken.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np

from calib.camera import BrownCamera, FloatArray
from calib.convert import image_grid_px
from calib.errors import FormatError
from calib.formats.common import (
    READ_TOLERANCE_PX,
    ReadOptions,
    WriteOptions,
    checked,
    fit_rays,
    fitted,
    image_size,
    number,
    numbers,
    parse_xml,
    root_tag,
    usable,
    writable,
)

_WHAT = "The MicMac calibration"
_TO_DISTORTED = "eConvApero_DistM2C"
_TO_CORRECTED = "eConvApero_DistC2M"


@dataclass(frozen=True)
class Distortion:
    """One <CalibDistortion>: ``radial`` R1, R2, ... in px^-2, px^-4, ...; ``p1``, ``p2`` in px^-1."""

    center_x_px: float
    center_y_px: float
    radial: tuple[float, ...]
    p1: float = 0.0
    p2: float = 0.0
    b1: float = 0.0
    b2: float = 0.0

    def apply(self, points: FloatArray) -> FloatArray:
        """Points (n, 2) -> points (n, 2), px."""
        dx, dy = points[:, 0] - self.center_x_px, points[:, 1] - self.center_y_px
        r2 = dx * dx + dy * dy
        scale = np.zeros_like(r2)
        for k in reversed(self.radial):
            scale = r2 * (k + scale)
        x = dx * scale + self.p1 * (2 * dx * dx + r2) + 2 * self.p2 * dx * dy + self.b1 * dx + self.b2 * dy
        y = dy * scale + self.p2 * (2 * dy * dy + r2) + 2 * self.p1 * dx * dy
        return points + np.stack([x, y], -1)


def detect(text: str) -> bool:
    return "<CalibrationInternConique>" in text or root_tag(text) == "ExportAPERO"


def read(text: str, options: ReadOptions | None = None) -> BrownCamera:
    """Exact for a Fraser or radial model about the principal point, else fitted.

    Raises:
        FormatError: not such a file, a model other than ModNoDist, ModRad, ModPhgrStd and the
            ModUnif forms of the latter two, or one that Brown's model cannot hold.
    """
    options = options or ReadOptions()
    tolerance_px = READ_TOLERANCE_PX if options.tolerance_px is None else options.tolerance_px
    node = parse_xml(text, _WHAT)
    if node.tag != "CalibrationInternConique":
        found = node.find(".//CalibrationInternConique")
        if found is None:
            raise FormatError(f"{_WHAT} has no <CalibrationInternConique>: give an AutoCal file.")
        node = found
    convention = (node.findtext("KnownConv") or "").strip()
    if convention not in (_TO_DISTORTED, _TO_CORRECTED):
        raise FormatError(f"{_WHAT} has the convention {convention[:40]!r}; {_TO_DISTORTED} is expected.")
    if node.find("OrIntGlob") is not None and not _is_identity(node.find("OrIntGlob")):
        raise FormatError(f"{_WHAT} has an image transformation <OrIntGlob>, which is not supported.")
    f = _values(node, "F", (1, 2))
    fx, fy = f[0], f[-1]
    ppx, ppy = _values(node, "PP", (2,))
    width, height = image_size(*_values(node, "SzIm", (2,)))
    distortions = [
        distortion
        for element in reversed(node.findall("CalibDistortion"))
        if (distortion := _distortion(element, ppx, ppy)) is not None
    ]
    pp, focal = np.array([ppx, ppy]), np.array([fx, fy])

    def through(points: FloatArray) -> FloatArray:
        for distortion in distortions:
            points = distortion.apply(points)
        return points

    if convention == _TO_CORRECTED:
        return _from_corrections(
            through, BrownCamera(width, height, fx, ppx, ppy, b1_px=fx - fy), tolerance_px
        )
    start, exact = _start(BrownCamera(width, height, fx, ppx, ppy, b1_px=fx - fy), distortions)
    if exact:
        return usable(start)
    return usable(fitted(lambda rays: through(pp + rays * focal), usable(start), tolerance_px, _WHAT))


def _is_identity(element: Element | None) -> bool:
    if element is None:
        return True
    affine = element.find("Affinite")
    parts = element if affine is None else affine
    expected = {"I00": (0.0, 0.0), "V10": (1.0, 0.0), "V01": (0.0, 1.0)}
    return all(numbers(parts.findtext(tag) or "", tag) == value for tag, value in expected.items())


def _values(node: Element, tag: str, counts: tuple[int, ...]) -> tuple[float, ...]:
    values = numbers(node.findtext(tag) or "", f"<{tag}>")
    if len(values) not in counts:
        raise FormatError(f"{_WHAT}: <{tag}> has {len(values)} numbers instead of {counts[0]}.")
    return values


def _distortion(element: Element, ppx: float, ppy: float) -> Distortion | None:
    kinds = list(element)
    if len(kinds) != 1:
        raise FormatError(f"{_WHAT}: a <CalibDistortion> holds {len(kinds)} models instead of one.")
    model = kinds[0]
    if model.tag == "ModNoDist":
        return None
    if model.tag in ("ModRad", "ModPhgrStd"):
        part = model.find("RadialePart")
        part = model if part is None else part
        cx, cy = _values(part, "CDist", (2,))
        radial = tuple(number(k.text or "", "<CoeffDist>") for k in part.findall("CoeffDist"))
        rest = (number(model.findtext(tag, "0"), f"<{tag}>") for tag in ("P1", "P2", "b1", "b2"))
        return Distortion(cx, cy, radial, *(rest if model.tag == "ModPhgrStd" else ()))
    if model.tag == "ModUnif":
        kind = (model.findtext("TypeModele") or "").strip()
        params = tuple(number(p.text or "", "<Params>") for p in model.findall("Params"))
        # R3 R5 R7 R9 R11 [P1 P2 b1 b2], about the principal point.
        if kind == "eModele_DRad_PPaEqPPs" and len(params) == 5:
            return Distortion(ppx, ppy, params)
        if kind == "eModele_Fraser_PPaEqPPs" and len(params) == 9:
            return Distortion(ppx, ppy, params[:5], *params[5:])
        raise FormatError(f"{_WHAT} has the distortion {kind[:40]!r}, which is not of Brown's kind.")
    raise FormatError(f"{_WHAT} has the distortion <{model.tag[:40]}>, which is not of Brown's kind.")


def _start(pinhole: BrownCamera, distortions: list[Distortion]) -> tuple[BrownCamera, bool]:
    """Brown parameters by comparison of terms, and whether they are the whole of the model."""
    if not distortions:
        return pinhole, True
    first = distortions[0]
    f = pinhole.fy_px
    k = [r * f ** (2 * i) for i, r in enumerate(first.radial, 1)] + [0.0] * 4
    k1, k2, k3, k4 = k[:4]
    fx = pinhole.f_px * (1 + first.b1)
    zero_ray = np.array([[pinhole.cx_px, pinhole.cy_px]])
    for distortion in distortions:
        zero_ray = distortion.apply(zero_ray)
    start = BrownCamera(
        pinhole.width,
        pinhole.height,
        fx,
        float(zero_ray[0, 0]),
        float(zero_ray[0, 1]),
        k1,
        k2,
        k3,
        k4,
        p1=first.p2 * f,
        p2=first.p1 * f,
        b1_px=fx - f,
        b2_px=f * first.b2,
    )
    centred = (first.center_x_px, first.center_y_px) == (pinhole.cx_px, pinhole.cy_px)
    square = pinhole.b1_px == 0
    plain = (
        len(distortions) == 1 and centred and square and not (first.b1 or first.b2 or any(first.radial[4:]))
    )
    return start, plain


def _from_corrections(
    through: Callable[[FloatArray], FloatArray], start: BrownCamera, tolerance_px: float
) -> BrownCamera:
    pixels = image_grid_px(start.width, start.height)
    rays = (through(pixels) - [start.cx_px, start.cy_px]) / [start.f_px, start.fy_px]
    fit = fit_rays(rays, pixels, start)
    if not fit.misfit_px <= tolerance_px:
        raise FormatError(
            f"{_WHAT} runs from distorted to corrected coordinates ({_TO_CORRECTED}), and the best fit of "
            f"the other direction misses by up to {fit.misfit_px:.3g} px, more than the "
            f"{tolerance_px:g} px allowed."
        )
    return usable(fit.camera)


def write(camera: BrownCamera, options: WriteOptions | None = None) -> str:
    """ModPhgrStd about the principal point; exact without b1, b2, else fitted.

    Raises:
        FormatError: an affine part that MicMac's model cannot hold.
    """
    options, camera = options or WriteOptions(), writable(camera)
    held = _terms(camera)
    coefficients = "".join(f"                    <CoeffDist>{r!r}</CoeffDist>\n" for r in held.radial)
    text = (
        '<?xml version="1.0" ?>\n<ExportAPERO>\n     <CalibrationInternConique>\n'
        f"          <KnownConv>{_TO_DISTORTED}</KnownConv>\n"
        f"          <PP>{camera.cx_px!r} {camera.cy_px!r}</PP>\n"
        f"          <F>{camera.fy_px!r}</F>\n"
        f"          <SzIm>{camera.width} {camera.height}</SzIm>\n"
        "          <CalibDistortion>\n               <ModPhgrStd>\n                <RadialePart>\n"
        f"                    <CDist>{camera.cx_px!r} {camera.cy_px!r}</CDist>\n{coefficients}"
        "                </RadialePart>\n"
        f"                <P1>{held.p1!r}</P1>\n                <P2>{held.p2!r}</P2>\n"
        f"                <b1>{held.b1!r}</b1>\n                <b2>{held.b2!r}</b2>\n"
        "               </ModPhgrStd>\n          </CalibDistortion>\n"
        "     </CalibrationInternConique>\n</ExportAPERO>\n"
    )
    back = ReadOptions(tolerance_px=options.tolerance_px)
    return checked(camera, text, lambda t: read(t, back), options, "MicMac's AutoCal")


def _terms(camera: BrownCamera) -> Distortion:
    f = camera.fy_px
    if not (camera.b1_px or camera.b2_px):
        radial = tuple(
            k / f ** (2 * i) for i, k in enumerate((camera.k1, camera.k2, camera.k3, camera.k4), 1)
        )
        used = max((i for i, r in enumerate(radial, 1) if r), default=3)
        return Distortion(camera.cx_px, camera.cy_px, radial[: max(used, 3)], camera.p2 / f, camera.p1 / f)
    # MicMac's b1, b2 act on ideal coordinates, Brown's on distorted ones: linear fit of all terms.
    pixels = image_grid_px(camera.width, camera.height)
    rays = camera.unproject(pixels)
    rays = rays[np.isfinite(rays).all(axis=-1)]
    x, y = rays[:, 0], rays[:, 1]
    r2, zero = x * x + y * y, np.zeros_like(x)
    columns = [rays * r2[:, None] ** i for i in range(1, 5)]
    columns += [
        np.stack([r2 + 2 * x * x, 2 * x * y], -1),
        np.stack([2 * x * y, r2 + 2 * y * y], -1),
        np.stack([x, zero], -1),
        np.stack([y, zero], -1),
    ]
    target = (camera.project(rays) - [camera.cx_px, camera.cy_px]) / f - rays
    design = np.stack(columns, -1).reshape(-1, len(columns))
    scale = np.linalg.norm(design, axis=0)
    s = [float(v) for v in np.linalg.lstsq(design / scale, target.ravel(), rcond=None)[0] / scale]
    radial = tuple(k / f ** (2 * i) for i, k in enumerate(s[:4], 1))
    return Distortion(camera.cx_px, camera.cy_px, radial, s[4] / f, s[5] / f, s[6], s[7])

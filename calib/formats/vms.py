"""VMS' (and Australis' own) camera: the report of :mod:`calib.formats.australis` with the model that
*corrects measured coordinates* (Fraser 1997; [SEN] Table 2, rows VMS).

VMS' own file layout is not published; besides the report, a plain list of "name value" lines is read
(PD or C, PPx or XP, PPy or YP, K1-K3, P1, P2, A1 or B1, A2 or B2, in mm).

The two directions have no polynomial in common. What the conversion costs at its worst place, the
image corner, grows fast with the lens's distortion: 0.1-0.5 px for [SEN]'s four rows. Reading allows half a
pixel there; writing keeps to the caller's tolerance, a hundredth of a pixel unless more is allowed.
"""

from __future__ import annotations

from calib.camera import BrownCamera
from calib.convert import Fit, decentring_in_focal_units, radial_in_focal_units, radial_per_length
from calib.correction import CorrectionModel, from_correction, to_correction
from calib.formats.australis import (
    TO_CORRECTED,
    TO_DISTORTED,
    Report,
    direction,
    is_report,
    parse,
    render,
    unknown_direction,
)
from calib.formats.common import NOMINAL_PIXEL_SIZE_MM, ReadOptions, WriteOptions, checked, usable, writable

#: Largest misfit that reading allows, px.
READ_TOLERANCE_PX = 0.5


def detect(text: str) -> bool:
    return is_report(text) and direction(text) == TO_CORRECTED


def read_fit(text: str, options: ReadOptions | None = None) -> Fit:
    """The Brown camera fitted over the image, with its misfit.

    Raises:
        FormatError: not such a file, one that does not name VMS, or a misfit above the tolerance.
    """
    options = options or ReadOptions()
    report = parse(text, options)
    if direction(text) is None or direction(text) == TO_DISTORTED:
        raise unknown_direction()
    tolerance_px = READ_TOLERANCE_PX if options.tolerance_px is None else options.tolerance_px
    fit = from_correction(correction_model(report), tolerance_px)
    return Fit(usable(fit.camera), fit.misfit_px)


def read(text: str, options: ReadOptions | None = None) -> BrownCamera:
    """:func:`read_fit` without the misfit."""
    return read_fit(text, options).camera


def correction_model(report: Report) -> CorrectionModel:
    """A report's numbers (mm, y up) as a correction model (px, focal units, y down)."""
    v, pitch_mm = report.values, report.pixel_size_mm
    return CorrectionModel(
        report.width,
        report.height,
        v["C"] / pitch_mm,
        report.width / 2 + v["XP"] / pitch_mm,
        report.height / 2 - v["YP"] / pitch_mm,
        radial_in_focal_units((v["K1"], v["K2"], v["K3"]), v["C"]),
        decentring_in_focal_units(v["P1"], v["C"]),
        -decentring_in_focal_units(v["P2"], v["C"]),
        v["B1"],
        -v["B2"],
    )


def write(camera: BrownCamera, options: WriteOptions | None = None) -> str:
    """The report in VMS' direction, fitted over the image.

    Raises:
        FormatError: the correction polynomial cannot hold the lens to ``options.tolerance_px``.
    """
    options, camera = options or WriteOptions(), writable(camera)
    pitch_mm = NOMINAL_PIXEL_SIZE_MM if options.pixel_size_mm is None else options.pixel_size_mm
    m = to_correction(camera, 3, options.tolerance_px).model
    c_mm = m.f_px * pitch_mm
    k1, k2, k3 = radial_per_length(m.radial, c_mm)
    values = {
        "C": c_mm,
        "XP": (m.cx_px - m.width / 2) * pitch_mm,
        "YP": -(m.cy_px - m.height / 2) * pitch_mm,
        "K1": k1,
        "K2": k2,
        "K3": k3,
        "P1": m.p1 / c_mm,
        "P2": -m.p2 / c_mm,
        "B1": m.b1,
        "B2": -m.b2,
    }
    text = render(Report(m.width, m.height, pitch_mm, values), f"for VMS, {TO_CORRECTED}")
    back = ReadOptions(tolerance_px=options.tolerance_px)
    return checked(camera, text, lambda t: read(t, back), options, "VMS' format")

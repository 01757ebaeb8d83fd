"""Australis' camera parameter report, as Metashape exports it.

"Australis Bundle Adjustment Results: Camera Parameters": sensor size and pixel size (H, V), then
C, XP, YP in mm, K1-K3 in mm^-2.., P1, P2 in mm^-1, B1, B2 without unit; the third number of a line is
the final value. x points right, *y up*, the origin is the image centre, P1 goes with x (Fraser 1997).

Two programs, two directions. Australis and VMS correct measured coordinates (:mod:`calib.formats.vms`).
The Metashape rows of [SEN] Table 2, exported "in the 'australis' format", have K1-K3 of the opposite
sign for the same lenses: Metashape's own direction in mm, and that is what this module holds. Nothing
in the numbers says which program wrote a file, so a file that names none is refused, not guessed.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from calib.camera import BrownCamera
from calib.convert import decentring_in_focal_units, radial_in_focal_units, radial_per_length
from calib.errors import FormatError
from calib.formats.common import (
    NOMINAL_PIXEL_SIZE_MM,
    ReadOptions,
    WriteOptions,
    checked,
    image_size,
    number,
    reduced,
    usable,
    writable,
)

_WHAT = "The Australis file"
_NAMES = ("C", "XP", "YP", "K1", "K2", "K3", "P1", "P2", "B1", "B2")
_VALUE = re.compile(r"^\s*([A-Za-z]+\d?)\s*[:=]?\s+([-+]?\.?\d.*)$", re.MULTILINE)
# Other names for the same: VMS' windows and [SEN] Table 2.
_ALIASES = {"PD": "C", "F": "C", "PPX": "XP", "PPY": "YP", "XO": "XP", "YO": "YP", "A1": "B1", "A2": "B2"}

#: Header phrases that fieldcal writes, and the words by which the programs are known.
TO_DISTORTED = "ideal to distorted"
TO_CORRECTED = "distorted to corrected"
_METASHAPE = re.compile(r"metashape|photoscan|agisoft", re.IGNORECASE)
_VMS = re.compile(r"\bVMS\b|geomsoft|vision measurement system", re.IGNORECASE)


@dataclass(frozen=True)
class Report:
    """The numbers of a report: mm, y up, origin at the image centre; ``values`` by Australis' names."""

    width: int
    height: int
    pixel_size_mm: float
    values: dict[str, float]


def is_report(text: str) -> bool:
    """Whether the text has the lines of an Australis or VMS camera."""
    if text.lstrip()[:1] in ("<", "{"):
        return False
    found = {_name(match.group(1)) for match in _VALUE.finditer(text)}
    return {"C", "XP", "YP", "K1"} <= found


def direction(text: str) -> str | None:
    """TO_DISTORTED or TO_CORRECTED, as far as the text says (None: it does not)."""
    for phrase in (TO_DISTORTED, TO_CORRECTED):
        if phrase in text:
            return phrase
    metashape, vms = bool(_METASHAPE.search(text)), bool(_VMS.search(text))
    if metashape == vms:
        return None
    return TO_DISTORTED if metashape else TO_CORRECTED


def unknown_direction() -> FormatError:
    return FormatError(
        f"{_WHAT} does not say which program wrote it: Metashape's numbers run from ideal to distorted "
        "coordinates, those of Australis and VMS the other way, with opposite signs; put the word "
        "Metashape or VMS into its Project line."
    )


def detect(text: str) -> bool:
    return is_report(text) and direction(text) != TO_CORRECTED


def read(text: str, options: ReadOptions | None = None) -> BrownCamera:
    """A report in Metashape's direction.

    Raises:
        FormatError: not such a file, or a file that does not name Metashape.
    """
    report = parse(text, options or ReadOptions())
    if direction(text) is None:
        raise unknown_direction()
    v, pitch_mm = report.values, report.pixel_size_mm
    k1, k2, k3 = radial_in_focal_units((v["K1"], v["K2"], v["K3"]), v["C"])
    fy = v["C"] / pitch_mm
    fx = fy * (1 + v["B1"])
    return usable(
        BrownCamera(
            report.width,
            report.height,
            fx,
            report.width / 2 + v["XP"] / pitch_mm,
            report.height / 2 - v["YP"] / pitch_mm,
            k1,
            k2,
            k3,
            # y points up in the file: the terms that are odd in y change sign.
            p1=-decentring_in_focal_units(v["P2"], v["C"]),
            p2=decentring_in_focal_units(v["P1"], v["C"]),
            b1_px=fx - fy,
            b2_px=-v["B2"] * fy,
        )
    )


def write(camera: BrownCamera, options: WriteOptions | None = None) -> str:
    """The report in Metashape's direction, exact but for K4.

    Raises:
        FormatError: a K4 that the other terms cannot take up.
    """
    options, camera = options or WriteOptions(), writable(camera)
    held = reduced(camera, ("k1", "k2", "k3", "p1", "p2", "b1_px", "b2_px"))
    pitch_mm = NOMINAL_PIXEL_SIZE_MM if options.pixel_size_mm is None else options.pixel_size_mm
    c_mm = held.fy_px * pitch_mm
    k1, k2, k3 = radial_per_length((held.k1, held.k2, held.k3), c_mm)
    values = {
        "C": c_mm,
        "XP": (held.cx_px - held.width / 2) * pitch_mm,
        "YP": -(held.cy_px - held.height / 2) * pitch_mm,
        "K1": k1,
        "K2": k2,
        "K3": k3,
        "P1": held.p2 / c_mm,
        "P2": -held.p1 / c_mm,
        "B1": held.b1_px / held.fy_px,
        "B2": -held.b2_px / held.fy_px,
    }
    text = render(Report(held.width, held.height, pitch_mm, values), f"for Metashape, {TO_DISTORTED}")
    return checked(camera, text, read, options, "Metashape's Australis format")


def parse(text: str, options: ReadOptions) -> Report:
    """The numbers of a report, or of a plain list "name value".

    Raises:
        FormatError: a number missing, pixels that are not square, or no image or pixel size.
    """
    values: dict[str, float] = {}
    sensor: dict[str, tuple[float, float]] = {}
    for match in _VALUE.finditer(text):
        name = _name(match.group(1))
        words = match.group(2).split()
        if name in ("H", "V") and len(words) >= 2 and name not in sensor:
            sensor[name] = number(words[0], "The sensor size"), number(words[1], "The pixel size")
        elif name in _NAMES and name not in values:
            # "initial, adjustment, final, sigma, sigma" in a report; "value [sigma]" in a list.
            values[name] = number(words[2] if len(words) >= 3 and _is_number(words[2]) else words[0], name)
    missing = [name for name in ("C", "XP", "YP", "K1") if name not in values]
    if missing:
        raise FormatError(f"{_WHAT} lacks {', '.join(missing)}.")
    if not values["C"] > 0:
        raise FormatError(f"{_WHAT} has a principal distance of {values['C']:g} mm, which no camera has.")
    if len(sensor) == 2:
        width, height = image_size(sensor["H"][0], sensor["V"][0])
        pitches_mm = sensor["H"][1], sensor["V"][1]
    elif options.image_size is not None and options.pixel_size_mm is not None:
        width, height = image_size(*options.image_size)
        pitches_mm = options.pixel_size_mm, options.pixel_size_mm
    else:
        raise FormatError(
            f"{_WHAT} does not hold sensor size in px and pixel size in mm (lines H and V): give both."
        )
    if not (pitches_mm[0] > 0 and abs(pitches_mm[1] / pitches_mm[0] - 1) < 1e-6):
        raise FormatError(
            f"{_WHAT} has pixels of {pitches_mm[0]:g} x {pitches_mm[1]:g} mm; square ones are read."
        )
    return Report(width, height, pitches_mm[0], {name: values.get(name, 0.0) for name in _NAMES})


def _name(word: str) -> str:
    return _ALIASES.get(word.upper(), word.upper())


def _is_number(word: str) -> bool:
    return re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", word) is not None


def render(report: Report, project: str) -> str:
    """The report's text, with every digit (Australis prints four)."""
    v = report.values
    rows = "".join(f"{name:>6}  {v[name]!r}  0.0  {v[name]!r}\n" for name in _NAMES)
    return (
        "Australis Bundle Adjustment Results: Camera Parameters\n\n"
        f"Project:  {project}\n\n"
        "Results for Camera 1    Lens\n\n"
        "Sensor Size        Pixel Size (mm)\n"
        f"  H    {report.width}        {report.pixel_size_mm!r}\n"
        f"  V    {report.height}        {report.pixel_size_mm!r}\n\n"
        "Camera    Initial    Total         Final\n"
        "Variable  Value      Adjustment    Value\n\n"
        f"{rows}"
    )

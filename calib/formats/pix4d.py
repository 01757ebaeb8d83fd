"""Pix4D's ``*_pix4d_calibrated_internal_camera_parameters.cam``.

F, Px, Py in mm of a sensor whose size the comment line states; K1-K3, T1, T2 in focal units, from
ideal to distorted coordinates (Pix4D support, "How are the internal and external camera parameters
defined"): x' = x (1 + R1 r2 + R2 r4 + R3 r6) + 2 T1 x y + T2 (r2 + 2 x2), OpenCV's order. The same
project's ``calibrated_camera_parameters.txt`` has the camera matrix in px and fixes the rest: px = mm
x image width / sensor width, counted from the upper left. Pix4D does not say which point of the
first pixel is zero; its nominal principal points are half the sensor, so the corner is taken.

The file does not hold the image size in px; fieldcal adds it as a comment and reads it back.
"""

from __future__ import annotations

import re

from calib.camera import BrownCamera
from calib.errors import FormatError
from calib.formats.common import (
    NOMINAL_PIXEL_SIZE_MM,
    ReadOptions,
    WriteOptions,
    checked,
    image_size,
    number,
    one_of,
    reduced,
    required_size,
    usable,
    writable,
)

_WHAT = "The Pix4D camera file"
_HEADER = "Pix4D camera calibration file"
_NUMBER = r"([-+\d.eE]+)"
_SENSOR = re.compile(rf"sensor width of\s+{_NUMBER}\s*x\s*{_NUMBER}\s*mm")
_IMAGE = re.compile(r"Image size\s+(\d+)\s*x\s*(\d+)\s*pixel")


def detect(text: str) -> bool:
    return _HEADER.lower() in text.lower() or "assuming a sensor width of" in text


def read_all(text: str, options: ReadOptions | None = None) -> dict[str, BrownCamera]:
    """All cameras (a rig has several) by their number.

    Raises:
        FormatError: not such a file, a value missing, or no image size known.
    """
    options = options or ReadOptions()
    if "SYM_DIST" in text or "FID_PAIRS" in text:
        raise FormatError(
            f"{_WHAT} is the variant for other photogrammetry programs; give the one whose name ends in "
            "_pix4d_calibrated_internal_camera_parameters.cam."
        )
    blocks = re.split(rf"(?im)^\s*{re.escape(_HEADER)}", text)
    if len(blocks) == 1:
        raise FormatError(f"{_WHAT} does not begin with '{_HEADER}'.")
    cameras: dict[str, BrownCamera] = {}
    for block in blocks[1:]:
        name = block.split("\n", 1)[0].strip() or "0"
        cameras[name] = _camera(block, options)
    return cameras


def read(text: str, options: ReadOptions | None = None) -> BrownCamera:
    """The only camera, or the one whose number is ``options.camera_name``."""
    options = options or ReadOptions()
    return one_of(read_all(text, options), options, _WHAT)


def _camera(block: str, options: ReadOptions) -> BrownCamera:
    sensor = _SENSOR.search(block)
    if sensor is None:
        raise FormatError(f"{_WHAT} does not state the sensor size in mm, so its numbers have no scale.")
    sensor_width_mm, sensor_height_mm = (number(text, "The sensor size") for text in sensor.groups())
    if not (sensor_width_mm > 0 and sensor_height_mm > 0):
        raise FormatError(f"{_WHAT} states a sensor size that is not positive.")
    stated = _IMAGE.search(block)
    if stated is not None:
        width, height = image_size(float(stated.group(1)), float(stated.group(2)))
    else:
        width, height = required_size(options, _WHAT)
    if abs(sensor_height_mm * width / (sensor_width_mm * height) - 1) > 0.02:
        raise FormatError(
            f"{_WHAT} is for a sensor of {sensor_width_mm:g}x{sensor_height_mm:g} mm, whose proportions are "
            f"not those of {width}x{height} px: give the size of the images it was made with."
        )
    values: dict[str, float] = {}
    for line in block.splitlines():
        words = line.split()
        if len(words) == 2 and words[0] in ("F", "Px", "Py", "K1", "K2", "K3", "T1", "T2"):
            values[words[0]] = number(words[1], words[0])
    missing = [key for key in ("F", "Px", "Py") if key not in values]
    if missing:
        raise FormatError(f"{_WHAT} lacks {', '.join(missing)}.")
    # The sensor's height is printed with it but may be rounded differently: pixels are square here.
    px_per_mm = width / sensor_width_mm
    return usable(
        BrownCamera(
            width,
            height,
            values["F"] * px_per_mm,
            values["Px"] * px_per_mm,
            values["Py"] * px_per_mm,
            values.get("K1", 0.0),
            values.get("K2", 0.0),
            values.get("K3", 0.0),
            p1=values.get("T1", 0.0),
            p2=values.get("T2", 0.0),
        )
    )


def write(camera: BrownCamera, options: WriteOptions | None = None) -> str:
    """One camera with number 0.

    Raises:
        FormatError: K4, b1 or b2 that the other terms cannot take up.
    """
    options, camera = options or WriteOptions(), writable(camera)
    pitch_mm = NOMINAL_PIXEL_SIZE_MM if options.pixel_size_mm is None else options.pixel_size_mm
    held = reduced(camera, ("k1", "k2", "k3", "p1", "p2"))
    sensor_mm = f"{held.width * pitch_mm!r}x{held.height * pitch_mm!r}"
    text = (
        f"{_HEADER} 0\n"
        f"#Focal Length mm assuming a sensor width of {sensor_mm}mm\n"
        f"F {held.f_px * pitch_mm!r}\n"
        f"#Principal Point mm\nPx {held.cx_px * pitch_mm!r}\nPy {held.cy_px * pitch_mm!r}\n"
        f"#Symmetrical Lens Distortion Coeffs\nK1 {held.k1!r}\nK2 {held.k2!r}\nK3 {held.k3!r}\n"
        f"#Tangential Lens Distortion Coeffs\nT1 {held.p1!r}\nT2 {held.p2!r}\n"
        f"#Image size {held.width}x{held.height} pixel\n"
    )
    return checked(camera, text, read, options, "Pix4D's .cam")

"""OpenCV's calibration files: ``cv2.FileStorage`` in YAML or XML, and ROS ``camera_info`` YAML.

Distortion in the order k1 k2 p1 p2 [k3 [k4 k5 k6]] (OpenCV, calib3d). Pixels have their origin at
the *centre* of the first pixel, so principal points move by half a pixel on the way in and out.
The files are parsed here, never by OpenCV: they may come from anywhere.
"""

from __future__ import annotations

import re
from xml.etree.ElementTree import Element

from calib.camera import BrownCamera
from calib.errors import FormatError
from calib.formats.common import (
    READ_TOLERANCE_PX,
    ReadOptions,
    WriteOptions,
    checked,
    image_size,
    number,
    numbers,
    parse_xml,
    required_size,
    root_tag,
    writable,
)
from calib.formats.rational import RationalModel, brown_from_rational, rational_from_brown

_WHAT = "The OpenCV calibration file"

# Names in use: the calibration sample's of OpenCV 2 and later, ROS, and common scripts; compared
# without case and underscores.
_MATRIX = ("cameramatrix", "k", "mtx", "intrinsicmatrix", "intrinsics")
_DISTORTION = ("distortioncoefficients", "distcoeffs", "distcoeff", "dist", "d", "distortion")
_WIDTH = ("imagewidth", "width")
_HEIGHT = ("imageheight", "height")

_YAML_KEY = re.compile(r"^([A-Za-z_][\w-]*)\s*:[ \t]*(.*)$")
_YAML_DATA = re.compile(r"\bdata\s*:\s*\[([^\]]*)\]")
_YAML_LIST = re.compile(r"^\s*\[([^\]]*)\]")


def _canonical(name: str) -> str:
    return name.replace("_", "").replace("-", "").lower()


def detect_yaml(text: str) -> bool:
    if text.lstrip()[:1] in ("{", "<"):
        return False
    keys = {_canonical(match.group(1)) for line in text.splitlines() if (match := _YAML_KEY.match(line))}
    return any(key in keys for key in _MATRIX) and any(key in keys for key in _DISTORTION)


def detect_xml(text: str) -> bool:
    return root_tag(text) == "opencv_storage"


def read(text: str, options: ReadOptions | None = None) -> BrownCamera:
    """YAML or XML, by content.

    Raises:
        FormatError: no camera matrix or distortion, an unknown number of coefficients, a skewed
            matrix, no image size, or a lens model that Brown's cannot hold.
    """
    options = options or ReadOptions()
    entries = _xml_entries(text) if text.lstrip().startswith("<") else _yaml_entries(text)
    matrix = numbers(_entry(entries, _MATRIX, "camera matrix"), "The camera matrix")
    distortion = numbers(_entry(entries, _DISTORTION, "distortion"), "The distortion coefficients")
    if len(matrix) != 9:
        raise FormatError(f"{_WHAT}: the camera matrix has {len(matrix)} numbers instead of 9.")
    fx, skew, cx, _, fy, cy, _, _, scale = matrix
    if matrix[3] or matrix[6] or matrix[7] or scale != 1 or skew:
        raise FormatError(f"{_WHAT}: the camera matrix is not [fx 0 cx; 0 fy cy; 0 0 1].")
    if len(distortion) not in (0, 4, 5, 8, 12, 14) or any(distortion[8:]):
        raise FormatError(
            f"{_WHAT} has {len(distortion)} distortion coefficients; "
            "4, 5 or 8 are read (k1 k2 p1 p2 k3 k4 k5 k6), thin-prism and tilt terms only if zero."
        )
    model = str(entries.get("distortionmodel", "")).strip().strip("'\"")
    if model not in ("", "plumb_bob", "rational_polynomial"):
        raise FormatError(f"{_WHAT} has the distortion model {model[:40]!r}, which is not of Brown's kind.")
    if any(key in entries for key in _WIDTH) and any(key in entries for key in _HEIGHT):
        width, height = image_size(
            number(_entry(entries, _WIDTH, "image width"), "The image width"),
            number(_entry(entries, _HEIGHT, "image height"), "The image height"),
        )
    else:
        width, height = required_size(options, _WHAT)
    k1, k2, p1, p2, k3, k4, k5, k6 = (*distortion[:8], *(0.0,) * 8)[:8]
    rational = RationalModel(
        # OpenCV's (0, 0) is the centre of the first pixel, ours is (0.5, 0.5).
        width, height, fx, fy, cx + 0.5, cy + 0.5, (k1, k2, k3), (k4, k5, k6), p1, p2
    )  # fmt: skip
    tolerance_px = READ_TOLERANCE_PX if options.tolerance_px is None else options.tolerance_px
    return brown_from_rational(rational, tolerance_px, "OpenCV's rational lens model")


def _entry(entries: dict[str, str], names: tuple[str, ...], what: str) -> str:
    for name in names:
        if name in entries:
            return entries[name]
    raise FormatError(f"{_WHAT} holds no {what}: it is not a camera calibration.")


def _xml_entries(text: str) -> dict[str, str]:
    entries: dict[str, str] = {}
    for element in parse_xml(text, _WHAT):
        data: Element | None = element.find("data")
        entries[_canonical(element.tag)] = (element if data is None else data).text or ""
    return entries


def _yaml_entries(text: str) -> dict[str, str]:
    """Top-level scalars, lists, and the data of matrices; the rest of YAML does not occur here."""
    blocks: dict[str, list[str]] = {}
    current: list[str] = []
    for line in text.splitlines():
        match = _YAML_KEY.match(line)
        if match:
            current = blocks[_canonical(match.group(1))] = [match.group(2)]
        else:
            current.append(line)
    entries: dict[str, str] = {}
    for key, lines in blocks.items():
        block = "\n".join(lines)
        data = _YAML_DATA.search(block) or _YAML_LIST.match(block)
        entries[key] = data.group(1) if data else lines[0]
    return entries


def write_yaml(camera: BrownCamera, options: WriteOptions | None = None) -> str:
    """``cv2.FileStorage`` YAML with 5 coefficients (8 where K4 needs a denominator).

    Raises:
        FormatError: a shear b2 or a K4 that OpenCV's model cannot hold.
    """
    matrix, distortion = _arrays(camera)
    text = (
        "%YAML:1.0\n---\n"
        f"image_width: {camera.width}\nimage_height: {camera.height}\n"
        f"{_yaml_matrix('camera_matrix', 3, 3, matrix)}"
        f"{_yaml_matrix('distortion_coefficients', 1, len(distortion), distortion)}"
    )
    return _checked(camera, text, options, "OpenCV's YAML")


def write_xml(camera: BrownCamera, options: WriteOptions | None = None) -> str:
    """The same as :func:`write_yaml`, in XML."""
    matrix, distortion = _arrays(camera)
    text = (
        '<?xml version="1.0"?>\n<opencv_storage>\n'
        f"<image_width>{camera.width}</image_width>\n<image_height>{camera.height}</image_height>\n"
        f"{_xml_matrix('camera_matrix', 3, 3, matrix)}"
        f"{_xml_matrix('distortion_coefficients', 1, len(distortion), distortion)}"
        "</opencv_storage>\n"
    )
    return _checked(camera, text, options, "OpenCV's XML")


def _arrays(camera: BrownCamera) -> tuple[tuple[float, ...], tuple[float, ...]]:
    m = rational_from_brown(writable(camera))
    matrix = (m.fx_px, 0.0, m.cx_px - 0.5, 0.0, m.fy_px, m.cy_px - 0.5, 0.0, 0.0, 1.0)
    k1, k2, k3 = m.numerator
    distortion = (k1, k2, m.p1, m.p2, k3)
    return matrix, (*distortion, *m.denominator) if any(m.denominator) else distortion


def _yaml_matrix(name: str, rows: int, columns: int, values: tuple[float, ...]) -> str:
    data = ", ".join(repr(float(v)) for v in values)
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {data} ]\n"


def _xml_matrix(name: str, rows: int, columns: int, values: tuple[float, ...]) -> str:
    data = " ".join(repr(float(v)) for v in values)
    return (
        f'<{name} type_id="opencv-matrix">\n  <rows>{rows}</rows>\n  <cols>{columns}</cols>\n'
        f"  <dt>d</dt>\n  <data>\n    {data}</data></{name}>\n"
    )


def _checked(camera: BrownCamera, text: str, options: WriteOptions | None, what: str) -> str:
    options = options or WriteOptions()
    back = ReadOptions(tolerance_px=options.tolerance_px)
    return checked(camera, text, lambda t: read(t, back), options, what)

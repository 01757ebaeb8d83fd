"""Agisoft Metashape's (PhotoScan's) calibration XML.

``<calibration>`` as Lens and the camera calibration dialogue save it, or a whole ``<document>`` as
"Export Cameras" writes it. Frame cameras (Metashape user manual, appendix "Camera models"):

u = w/2 + cx + f x' + B1 x' + B2 y',  v = h/2 + cy + f y'
x' = x (1 + K1 r2 + K2 r4 + K3 r6 + K4 r8) + P1 (r2 + 2 x2) + 2 P2 x y,  y' likewise

so f is the focal length along columns (fx = f + B1), and P1, P2 stand in the opposite order to
OpenCV's and fieldcal's. Files of PhotoScan before 1.2 have fx, fy, skew, an absolute principal point,
and P1, P2 in OpenCV's order (Agisoft Lens manual 0.4; F = Fy, B1 = Fx - Fy, B2 = skew, says Agisoft).
"""

from __future__ import annotations

from xml.etree.ElementTree import Element

from calib.camera import BrownCamera
from calib.errors import FormatError
from calib.formats.common import (
    ReadOptions,
    WriteOptions,
    checked,
    child_number,
    image_size,
    number,
    one_of,
    parse_xml,
    root_tag,
    usable,
    writable,
)

_WHAT = "The Metashape calibration"


def detect(text: str) -> bool:
    return root_tag(text) == "calibration" or (root_tag(text) == "document" and "<sensor" in text)


def read_all(text: str, options: ReadOptions | None = None) -> dict[str, BrownCamera]:
    """All calibrations: sensors by their label (adjusted before initial), else one named "camera".

    Raises:
        FormatError: not such a file, or a projection other than "frame".
    """
    del options  # nothing is left open
    root = parse_xml(text, _WHAT)
    if root.tag == "calibration":
        return {"camera": _camera(root)}
    cameras: dict[str, BrownCamera] = {}
    for index, sensor in enumerate(root.iter("sensor")):
        found = {calibration.get("class"): calibration for calibration in sensor.findall("calibration")}
        best = found.get("adjusted", found.get("initial"))
        if best is not None:
            label = sensor.get("label", "camera")
            cameras[label if label not in cameras else f"{label} ({index})"] = _camera(best)
    return cameras


def read(text: str, options: ReadOptions | None = None) -> BrownCamera:
    """The only calibration, or that of the sensor with the label ``options.camera_name``."""
    options = options or ReadOptions()
    return one_of(read_all(text, options), options, _WHAT)


def _camera(element: Element) -> BrownCamera:
    projection = (element.findtext("projection") or element.get("type") or "frame").strip()
    if projection != "frame":
        raise FormatError(f"{_WHAT} has the projection {projection[:40]!r}; fieldcal reads 'frame'.")
    resolution = element.find("resolution")
    if resolution is None:
        size = child_number(element, "width"), child_number(element, "height")
    else:
        size = number(resolution.get("width"), "width"), number(resolution.get("height"), "height")
    width, height = image_size(*size)
    for tag in ("p3", "p4"):
        if child_number(element, tag, 0.0):
            raise FormatError(f"{_WHAT} uses {tag.upper()}, which Brown's model does not have.")
    k1, k2, k3, k4, pa, pb, cx, cy = (
        child_number(element, tag, 0.0) for tag in ("k1", "k2", "k3", "k4", "p1", "p2", "cx", "cy")
    )
    if element.find("f") is None and element.find("fx") is not None:
        fx, fy = child_number(element, "fx"), child_number(element, "fy")
        b2, p1, p2 = child_number(element, "skew", 0.0), pa, pb
        if element.find("cx") is None or element.find("cy") is None:
            raise FormatError(f"{_WHAT} has no principal point.")
    else:
        fy = child_number(element, "f")
        fx = fy + child_number(element, "b1", 0.0)
        b2, p1, p2 = child_number(element, "b2", 0.0), pb, pa
        cx, cy = width / 2 + cx, height / 2 + cy
    return usable(BrownCamera(width, height, fx, cx, cy, k1, k2, k3, k4, p1, p2, fx - fy, b2))


def write(camera: BrownCamera, options: WriteOptions | None = None) -> str:
    """``<calibration>``; the format holds every term of Brown's model."""
    camera = writable(camera)
    values = {
        "f": camera.fy_px,
        "cx": camera.cx_px - camera.width / 2,
        "cy": camera.cy_px - camera.height / 2,
        "b1": camera.b1_px,
        "b2": camera.b2_px,
        "k1": camera.k1,
        "k2": camera.k2,
        "k3": camera.k3,
        "k4": camera.k4,
        "p1": camera.p2,
        "p2": camera.p1,
    }
    lines = "".join(f"  <{tag}>{float(value)!r}</{tag}>\n" for tag, value in values.items())
    text = (
        '<?xml version="1.0" encoding="UTF-8"?>\n<calibration>\n  <projection>frame</projection>\n'
        f"  <width>{camera.width}</width>\n  <height>{camera.height}</height>\n{lines}</calibration>\n"
    )
    return checked(camera, text, read, options or WriteOptions(), "Metashape's XML")

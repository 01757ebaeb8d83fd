"""OpenDroneMap's ``cameras.json`` (OpenSfM camera models), as ``--cameras`` takes it.

{id: {projection_type, width, height, focal_x, focal_y, c_x, c_y, k1, k2, p1, p2, k3}}. Lengths are
in units of max(width, height) and the principal point counts from the image centre; OpenSfM
(``features.py``, ``normalized_image_coordinates``) maps pixel (u + 0.5 - width/2) / max(width, height)
with OpenCV's u, so the centre is width/2 in the pixels used here. ODM (``opendm/camera.py``) takes ids
with or without the leading "v2".
"""

from __future__ import annotations

import json

from calib.camera import BrownCamera
from calib.errors import FormatError
from calib.formats.common import (
    ReadOptions,
    WriteOptions,
    checked,
    image_size,
    json_number,
    one_of,
    reduced,
    usable,
    writable,
)
from calib.formats.plain import json_object

_WHAT = "The ODM camera file"

#: Keys of the projection types that Brown's model contains.
_TYPES: dict[str, tuple[str, ...]] = {
    "perspective": ("focal", "k1", "k2"),
    "simple_radial": ("focal_x", "focal_y", "c_x", "c_y", "k1"),
    "radial": ("focal_x", "focal_y", "c_x", "c_y", "k1", "k2"),
    "brown": ("focal_x", "focal_y", "c_x", "c_y", "k1", "k2", "p1", "p2", "k3"),
}


def detect(text: str) -> bool:
    return text.lstrip().startswith("{") and '"projection_type"' in text


def read_all(text: str, options: ReadOptions | None = None) -> dict[str, BrownCamera]:
    """All cameras by their id.

    Raises:
        FormatError: not such a file, or a projection type that Brown's model does not contain.
    """
    del options  # nothing is left open
    cameras: dict[str, BrownCamera] = {}
    for name, entry in json_object(text, _WHAT).items():
        where = f"{_WHAT}, camera {name[:80]!r},"
        if not isinstance(entry, dict):
            raise FormatError(f"{where} holds no parameters.")
        kind = entry.get("projection_type")
        if kind not in _TYPES:
            raise FormatError(
                f"{where} has the projection type {str(kind)[:40]!r}; fieldcal reads {', '.join(_TYPES)}."
            )
        missing = [key for key in ("width", "height", *_TYPES[kind]) if key not in entry]
        if missing:
            raise FormatError(f"{where} lacks {', '.join(missing)}.")
        width, height = image_size(
            json_number(entry["width"], "width"), json_number(entry["height"], "height")
        )
        p = {key: json_number(entry[key], key) for key in _TYPES[kind]}
        scale = max(width, height)
        fx = scale * p.get("focal_x", p.get("focal", 0.0))
        fy = scale * p.get("focal_y", p.get("focal", 0.0))
        cameras[name] = usable(
            BrownCamera(
                width,
                height,
                fx,
                width / 2 + scale * p.get("c_x", 0.0),
                height / 2 + scale * p.get("c_y", 0.0),
                p.get("k1", 0.0),
                p.get("k2", 0.0),
                p.get("k3", 0.0),
                p1=p.get("p1", 0.0),
                p2=p.get("p2", 0.0),
                b1_px=fx - fy,
            )
        )
    return cameras


def read(text: str, options: ReadOptions | None = None) -> BrownCamera:
    """The only camera, or the one whose id is ``options.camera_name``."""
    options = options or ReadOptions()
    return one_of(read_all(text, options), options, _WHAT)


def camera_id(camera: BrownCamera, make: str, model: str) -> str:
    """OpenSfM's id: "v2 make model width height projection focal-ratio", in lower case."""
    ratio = str(camera.f_px / max(camera.width, camera.height))[:6]
    return f"v2 {make} {model} {camera.width} {camera.height} brown {ratio}".lower()


def write(camera: BrownCamera, options: WriteOptions | None = None) -> str:
    """One "brown" camera, named after ``options.make`` and ``options.model``.

    Raises:
        FormatError: a K4 or shear b2 that the other terms cannot take up.
    """
    options, camera = options or WriteOptions(), writable(camera)
    held = reduced(camera, ("k1", "k2", "k3", "p1", "p2", "b1_px"))
    scale = max(camera.width, camera.height)
    entry = {
        "projection_type": "brown",
        "width": held.width,
        "height": held.height,
        "focal_x": held.f_px / scale,
        "focal_y": held.fy_px / scale,
        "c_x": (held.cx_px - held.width / 2) / scale,
        "c_y": (held.cy_px - held.height / 2) / scale,
        "k1": held.k1,
        "k2": held.k2,
        "p1": held.p1,
        "p2": held.p2,
        "k3": held.k3,
    }
    text = json.dumps({camera_id(camera, options.make, options.model): entry}, indent=4) + "\n"
    return checked(camera, text, read, options, "ODM's cameras.json")

"""COLMAP's ``cameras.txt``: CAMERA_ID MODEL WIDTH HEIGHT PARAMS[].

Models and their parameters as in COLMAP's documentation and ``sensor/models.h``; pixels with the
first pixel's centre at (0.5, 0.5), as here.
"""

from __future__ import annotations

import re

from calib.camera import BrownCamera
from calib.errors import FormatError
from calib.formats.common import (
    READ_TOLERANCE_PX,
    ReadOptions,
    WriteOptions,
    checked,
    image_size,
    number,
    one_of,
    writable,
)
from calib.formats.rational import RationalModel, brown_from_rational, rational_from_brown

_WHAT = "The COLMAP camera file"

#: Parameters of the models that Brown's contains or comes close to.
MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
_LINE = re.compile(r"^\s*\d+\s+[A-Z][A-Z0-9_]+\s+\d+\s+\d+\s+[-+.\d]")


def detect(text: str) -> bool:
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    return bool(lines) and bool(_LINE.match(lines[0]))


def read_all(text: str, options: ReadOptions | None = None) -> dict[str, BrownCamera]:
    """All cameras by their id.

    Raises:
        FormatError: a line that is not a camera, or a lens model that Brown's cannot hold.
    """
    tolerance_px = (options or ReadOptions()).tolerance_px
    tolerance_px = READ_TOLERANCE_PX if tolerance_px is None else tolerance_px
    cameras: dict[str, BrownCamera] = {}
    for line_number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        where = f"{_WHAT}, line {line_number},"
        if len(words) < 4:
            raise FormatError(f"{where} is not 'CAMERA_ID MODEL WIDTH HEIGHT PARAMS'.")
        name, model = words[0], words[1]
        if model not in MODELS:
            raise FormatError(
                f"{where} has the lens model {model[:40]}, which is not of Brown's kind; "
                f"fieldcal reads {', '.join(MODELS)}."
            )
        if len(words) - 4 != len(MODELS[model]):
            raise FormatError(f"{where} has {len(words) - 4} parameters; {model} has {len(MODELS[model])}.")
        if name in cameras:
            raise FormatError(f"{where} gives camera {name} a second time.")
        width, height = image_size(number(words[2], "WIDTH"), number(words[3], "HEIGHT"))
        p = {key: number(word, key) for key, word in zip(MODELS[model], words[4:], strict=True)}
        focal = p.get("f", 0.0)
        rational = RationalModel(
            width,
            height,
            p.get("fx", focal),
            p.get("fy", focal),
            p["cx"],
            p["cy"],
            (p.get("k1", 0.0), p.get("k2", 0.0), p.get("k3", 0.0)),
            (p.get("k4", 0.0), p.get("k5", 0.0), p.get("k6", 0.0)),
            p.get("p1", 0.0),
            p.get("p2", 0.0),
        )
        cameras[name] = brown_from_rational(rational, tolerance_px, f"COLMAP camera {name}")
    return cameras


def read(text: str, options: ReadOptions | None = None) -> BrownCamera:
    """The only camera, or the one whose id is ``options.camera_name``."""
    options = options or ReadOptions()
    return one_of(read_all(text, options), options, _WHAT)


def simplest_model(model: RationalModel) -> str:
    """The COLMAP model with the fewest parameters that holds the lens exactly."""
    k1, k2, k3 = model.numerator
    if any(model.denominator) or k3:
        return "FULL_OPENCV"
    square = model.fx_px == model.fy_px
    if model.p1 or model.p2 or ((k1 or k2) and not square):
        return "OPENCV"
    if k2:
        return "RADIAL"
    if k1:
        return "SIMPLE_RADIAL"
    return "SIMPLE_PINHOLE" if square else "PINHOLE"


def write(camera: BrownCamera, options: WriteOptions | None = None) -> str:
    """One camera with id 1, in the simplest model that holds it (K4: FULL_OPENCV, fitted).

    Raises:
        FormatError: a shear b2 or a K4 that COLMAP's models cannot hold.
    """
    options, camera = options or WriteOptions(), writable(camera)
    rational = rational_from_brown(camera)
    name = simplest_model(rational)
    values = {
        "f": rational.fx_px,
        "fx": rational.fx_px,
        "fy": rational.fy_px,
        "cx": rational.cx_px,
        "cy": rational.cy_px,
        "p1": rational.p1,
        "p2": rational.p2,
    }
    values |= {f"k{i}": k for i, k in enumerate((*rational.numerator, *rational.denominator), 1)}
    parameters = " ".join(repr(float(values[key])) for key in MODELS[name])
    text = (
        "# Camera list with one line of data per camera:\n"
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        "# Number of cameras: 1\n"
        f"1 {name} {camera.width} {camera.height} {parameters}\n"
    )
    back = ReadOptions(tolerance_px=options.tolerance_px)
    return checked(camera, text, lambda t: read(t, back), options, "COLMAP's cameras.txt")

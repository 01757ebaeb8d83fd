"""fieldcal's own JSON: every parameter of :class:`calib.camera.BrownCamera` by its name."""

from __future__ import annotations

import json
from dataclasses import fields

from calib.camera import BrownCamera
from calib.errors import FormatError
from calib.formats.common import ReadOptions, WriteOptions, image_size, json_number, usable, writable

SCHEMA = "fieldcal.camera/1"
_WHAT = "The fieldcal camera file"
_REQUIRED = ("width", "height", "f_px", "cx_px", "cy_px")


def detect(text: str) -> bool:
    return text.lstrip().startswith("{") and '"fieldcal.camera/' in text


def read(text: str, options: ReadOptions | None = None) -> BrownCamera:
    """Parameters that are not in the file are zero.

    Raises:
        FormatError: not this schema, a parameter missing or not a number.
    """
    del options  # the file leaves nothing open
    document = json_object(text, _WHAT)
    if document.get("schema") != SCHEMA:
        raise FormatError(f"{_WHAT} has the schema {document.get('schema')!r}; this version reads {SCHEMA}.")
    missing = [name for name in _REQUIRED if name not in document]
    if missing:
        raise FormatError(f"{_WHAT} lacks {', '.join(missing)}.")
    values = {
        field.name: json_number(document[field.name], field.name)
        for field in fields(BrownCamera)
        if field.name in document
    }
    width, height = image_size(values.pop("width"), values.pop("height"))
    return usable(BrownCamera(width, height, **values))


def write(camera: BrownCamera, options: WriteOptions | None = None) -> str:
    del options
    camera = writable(camera)
    parameters = {field.name: getattr(camera, field.name) for field in fields(BrownCamera)}
    return json.dumps({"schema": SCHEMA, **parameters}, indent=2) + "\n"


def json_object(text: str, what: str) -> dict[str, object]:
    """The object that a JSON text holds.

    Raises:
        FormatError: not JSON, or not an object.
    """
    try:
        document = json.loads(text)
    except RecursionError as error:
        raise FormatError(f"{what} is nested too deeply: it is not a calibration.") from error
    except ValueError as error:
        raise FormatError(f"{what} is not valid JSON ({error}): export it again.") from error
    if not isinstance(document, dict):
        raise FormatError(f"{what} holds no JSON object: it is not a calibration.")
    return document

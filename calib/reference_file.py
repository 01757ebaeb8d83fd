"""The file of one reference calibration: schema "fieldcal.reference/1", JSON.

Read strictly: a misspelt key would otherwise silently lose a sigma or a serial number.
"""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from calib.camera import BROWN_NAMES, BrownCamera
from calib.errors import FormatError, OutputError
from calib.field import FIELD_NAMES, LENS_NAMES
from calib.photos.photo import Processing
from calib.reference import EquifinalLine, PublishedRow, Reference

SCHEMA = "fieldcal.reference/1"
#: No reference is longer; a photo or a video given by mistake is not read whole.
_LARGEST_BYTES = 5_000_000

Positive = Annotated[FiniteFloat, Field(gt=0)]
NotNegative = Annotated[FiniteFloat, Field(ge=0)]
Matrix = list[list[FiniteFloat]]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Brown(_Part):
    """Lengths in px, K and P in focal units, as in :class:`BrownCamera`."""

    f_px: Positive
    cx_px: FiniteFloat
    cy_px: FiniteFloat
    k1: FiniteFloat = 0.0
    k2: FiniteFloat = 0.0
    k3: FiniteFloat = 0.0
    k4: FiniteFloat = 0.0
    p1: FiniteFloat = 0.0
    p2: FiniteFloat = 0.0
    b1_px: FiniteFloat = 0.0
    b2_px: FiniteFloat = 0.0


class _Line(_Part):
    slope: FiniteFloat
    intercept: FiniteFloat
    k1_min: FiniteFloat
    k1_max: FiniteFloat
    k2_min: FiniteFloat
    k2_max: FiniteFloat
    band_k2_px: Positive | None = None
    source: str


class _Row(_Part):
    label: str
    values: dict[str, FiniteFloat]
    chosen: bool = False


class _File(_Part):
    schema_: Literal["fieldcal.reference/1"] = Field(alias="schema")
    name: str
    make: str
    model: str
    exif_models: list[str] = []
    serial: str | None = None
    #: 0 x 0 where the image size is not known.
    width: Annotated[int, Field(ge=0, le=1_000_000)]
    height: Annotated[int, Field(ge=0, le=1_000_000)]
    focal_mm: Positive | None = None
    processing: Processing
    date: str | None = None
    temperature_c: FiniteFloat | None = None
    source: str
    provenance: str = ""
    brown: _Brown | None = None
    field_px: list[FiniteFloat] | None = None
    focal_px: Positive | None = None
    implied_radial_px: tuple[FiniteFloat, FiniteFloat, FiniteFloat] | None = None
    sigma: dict[Literal[BROWN_NAMES], NotNegative] = {}  # type: ignore[valid-type]
    covariance: Matrix | None = None
    fitted_brown: _Brown | None = None
    fitted_covariance: Matrix | None = None
    line: _Line | None = None
    published: list[_Row] = []

    @model_validator(mode="after")
    def _shapes(self) -> _File:
        if self.field_px is not None and len(self.field_px) != len(FIELD_NAMES):
            raise ValueError(f"field_px must hold {len(FIELD_NAMES)} numbers")
        for key, matrix, size in (
            ("covariance", self.covariance, len(LENS_NAMES)),
            ("fitted_covariance", self.fitted_covariance, len(BROWN_NAMES)),
        ):
            if matrix is not None and (len(matrix) != size or any(len(row) != size for row in matrix)):
                raise ValueError(f"{key} must be {size} by {size}")
        if self.brown is None and self.line is None:
            raise ValueError("neither a calibration (brown) nor an equifinal line is given")
        return self


def is_reference_json(path: Path) -> bool:
    """Whether ``path`` is a JSON file that says it is of this schema."""
    try:
        with path.open("rb") as file:
            data = json.loads(file.read(_LARGEST_BYTES))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(data, dict) and str(data.get("schema", "")).startswith("fieldcal.reference/")


def read_reference_file(path: Path) -> Reference:
    """Read one reference.

    Raises:
        FormatError: the file cannot be read or does not follow the schema.
    """
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise FormatError(f"{path} is too large to be a reference calibration.")
        file = _File.model_validate_json(path.read_bytes())
    except OSError as error:
        raise FormatError(f"The reference {path} cannot be read: {error.strerror}.") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "the file"
        raise FormatError(
            f"{path} is not a valid reference of schema {SCHEMA}: {where}: {first['msg']}."
        ) from error

    def camera(part: _Brown | None) -> BrownCamera | None:
        return None if part is None else BrownCamera(file.width, file.height, **part.model_dump())

    return Reference(
        name=file.name,
        make=file.make,
        model=file.model,
        width=file.width,
        height=file.height,
        processing=file.processing,
        source=file.source,
        brown=camera(file.brown),
        field_px=None if file.field_px is None else np.array(file.field_px),
        sigma=dict(file.sigma),
        covariance=None if file.covariance is None else np.array(file.covariance),
        serial=file.serial,
        date=file.date,
        temperature_c=file.temperature_c,
        provenance=file.provenance,
        line=None if file.line is None else EquifinalLine(**file.line.model_dump()),
        exif_models=tuple(file.exif_models),
        focal_mm=file.focal_mm,
        focal_px=file.focal_px,
        implied_radial_px=file.implied_radial_px,
        fitted_brown=camera(file.fitted_brown),
        fitted_covariance=None if file.fitted_covariance is None else np.array(file.fitted_covariance),
        published=tuple(PublishedRow(row.label, dict(row.values), row.chosen) for row in file.published),
    )


def reference_json(reference: Reference) -> str:
    """The reference as the text of a file; reading it back gives the same values bit for bit."""

    def brown(camera: BrownCamera | None) -> dict[str, float] | None:
        if camera is None:
            return None
        return {key: getattr(camera, key) for key in _Brown.model_fields}

    def numbers(array: object) -> object:
        return None if array is None else np.asarray(array).tolist()

    line = reference.line
    data = {
        "schema": SCHEMA,
        **{
            key: getattr(reference, key)
            for key in (
                *("name", "make", "model", "serial", "width", "height", "focal_mm", "processing"),
                *("date", "temperature_c", "source", "provenance", "focal_px", "sigma"),
            )
        },
        "exif_models": list(reference.exif_models),
        "implied_radial_px": reference.implied_radial_px,
        "brown": brown(reference.brown),
        "field_px": numbers(reference.field_px),
        "covariance": numbers(reference.covariance),
        "fitted_brown": brown(reference.fitted_brown),
        "fitted_covariance": numbers(reference.fitted_covariance),
        "line": None if line is None else {key: getattr(line, key) for key in _Line.model_fields},
        "published": [
            {"label": r.label, "values": r.values, "chosen": r.chosen} for r in reference.published
        ],
    }
    filled = {key: value for key, value in data.items() if value not in (None, [], {})}
    return json.dumps(filled, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def write_reference_file(reference: Reference, path: Path) -> None:
    """Write atomically: a reader, or a crash, sees the old file or the new one.

    Raises:
        OutputError: a value is not finite, or the file cannot be written.
    """
    try:
        text = reference_json(reference)
        _File.model_validate_json(text)
    except (ValueError, ValidationError) as error:
        raise OutputError(
            f"Reference {reference.name} is not saved: it is incomplete or holds values that are not numbers."
        ) from error
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            Path(temporary).replace(path)
        except OSError:
            Path(temporary).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise OutputError(f"The reference cannot be written to {path}: {error.strerror}.") from error

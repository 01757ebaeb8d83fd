"""``calibration.json``: a calibration made on site as data, schema ``fieldcal.calibration/1``."""

from __future__ import annotations

import json
from typing import Any, Literal

from pydantic import Field

from calib.align.flatness import TERMS
from calib.camera import FloatArray
from calib.onsite import Calibration
from calib.reference import EquifinalLine
from calib.report_json import (
    AlignmentModel,
    CalibrationModel,
    CameraModel,
    FindingModel,
    JsonModel,
    TimingModel,
    alignment_model,
    calibration_model,
    camera_model,
    finding_models,
    timing_model,
)
from calib.wording import printable


class LineModel(JsonModel):
    """K2 = slope K1 + intercept in pixel units, the band's half width in K2, the domain."""

    slope: float
    intercept: float
    band_k2_px: float | None
    k1_min: float
    k1_max: float
    k2_min: float
    k2_max: float
    source: str


class WallModel(JsonModel):
    """Second-order terms at the rim of the wall in percent of the distance, by ``x2``, ``xy``, ``y2``.

    ``covariance`` (3, 3) in that order; ``chance``: probability that chance alone makes them as large.
    Lengths in distances between camera and wall.
    """

    terms_percent: dict[str, float]
    covariance: list[list[float]]
    chance: float
    rough_percent: float
    points: int
    wall_share: float
    length: float
    height: float


class CalibrationReport(JsonModel):
    """The whole of ``calibration.json``; units as in ``report.json``."""

    schema_: Literal["fieldcal.calibration/1"] = Field(alias="schema")
    kind: Literal["wall", "orbit"]
    acceptance: Literal["ACCEPTED", "RETAKE", "CANNOT_TELL"]
    headline: str
    what_to_do: list[str]
    findings: list[FindingModel]
    camera: CameraModel
    calibration: CalibrationModel
    alignment: AlignmentModel
    wall: WallModel | None
    line: LineModel | None
    line_no_k3: LineModel | None
    temperature_c: float | None
    #: Name under which it was saved (null: not saved).
    saved_as: str | None
    timing: TimingModel


def calibration_report(calibration: Calibration, saved_as: str | None = None) -> CalibrationReport:
    flatness = calibration.flatness
    wall = None
    if flatness is not None:
        terms = dict(zip(TERMS, map(float, flatness.terms_percent), strict=True))
        wall = WallModel(
            terms_percent=terms,
            covariance=_rows(flatness.covariance),
            chance=flatness.chance,
            rough_percent=flatness.rough_percent,
            points=len(flatness.points),
            wall_share=flatness.wall_share,
            length=2 * float(flatness.half_size[0]),
            height=2 * float(flatness.half_size[1]),
        )
    return CalibrationReport(
        schema="fieldcal.calibration/1",
        kind=calibration.kind.value,
        acceptance=calibration.acceptance.value,
        headline=printable(calibration.headline),
        what_to_do=[printable(text) for text in calibration.what_to_do],
        findings=finding_models(calibration.findings),
        camera=camera_model(calibration.camera),
        calibration=calibration_model(calibration.estimate),
        alignment=alignment_model(calibration),
        wall=wall,
        line=_line(calibration.line),
        line_no_k3=_line(calibration.line_no_k3),
        temperature_c=calibration.temperature_c,
        saved_as=saved_as,
        timing=timing_model(calibration.timing),
    )


def calibration_dict(calibration: Calibration, saved_as: str | None = None) -> dict[str, Any]:
    """The calibration as plain dicts, lists, strings and finite numbers."""
    return calibration_report(calibration, saved_as).model_dump(mode="json", by_alias=True)


def calibration_json(calibration: Calibration, saved_as: str | None = None) -> str:
    """The calibration as JSON text."""
    data = calibration_dict(calibration, saved_as)
    return json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _line(line: EquifinalLine | None) -> LineModel | None:
    if line is None:
        return None
    return LineModel(**{key: getattr(line, key) for key in LineModel.model_fields})


def _rows(matrix: FloatArray) -> list[list[float]]:
    return [[float(value) for value in row] for row in matrix]

"""``report.json``: the check as data, schema ``fieldcal.check/1``.

The pydantic models below are the schema. Numbers are numbers; what is unknown is null (never
NaN or Infinity). A sigma of 0 means that the parameter was held, not estimated.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from calib.extra_pass import Knowledge, extra_pass_words, knowledge_of, not_joined
from calib.findings import Finding, State
from calib.photos.photo import CameraIdentity
from calib.propagation import correlations, parameter_sigmas
from calib.reference import Reference
from calib.result import CheckResult, Timing
from calib.solution import Estimate
from calib.wording import (
    WithLeftOut,
    all_left_out,
    parameter_values,
    path_text,
    photos_given,
    printable,
)


class JsonModel(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


class FindingModel(JsonModel):
    rule: str
    state: Literal["pass", "flag", "unknown"]
    value: float | None
    sigma: float | None
    unit: str
    threshold: float | None
    source: str
    message: str


class CameraModel(JsonModel):
    make: str
    model: str
    serial: str | None
    width: int
    height: int
    processing: Literal["raw", "lens-corrected", "unknown"]


class SigmaModel(JsonModel):
    """Standard deviations, by the keys of the calibration."""

    f_px: float | None
    cx_px: float | None
    cy_px: float | None
    k1: float | None
    k2: float | None
    k3: float | None
    k4: float | None
    p1: float | None
    p2: float | None
    b1_px: float | None
    b2_px: float | None
    k1_px: float | None
    k2_px: float | None
    k3_px: float | None


class CalibrationModel(SigmaModel):
    """Brown parameters: f, c, b in px, K and P in focal units, K*_px in pixel units.

    ``correlation[a][b]`` is given for every pair of estimated parameters.
    """

    sigma: SigmaModel
    correlation: dict[str, dict[str, float]]


class ReferenceModel(JsonModel):
    name: str
    source: str
    processing: Literal["raw", "lens-corrected", "unknown"]
    f_px: float | None
    note: str


class LeftOutModel(JsonModel):
    path: str
    reason: str


class AlignmentModel(JsonModel):
    """``photos`` given, ``used`` of them handed to the alignment, ``aligned`` of those."""

    photos: int
    used: int
    aligned: int
    components: list[int]
    points: int
    observations: int
    reprojection_rms_px: float | None
    left_out: list[LeftOutModel]


class NetworkModel(JsonModel):
    """Lengths are given only where believed geotags set the scale (``georeference.trusted``)."""

    nadir: int
    convergent: int
    heights_agl_m: list[float]
    gsd_m: float | None


class GeoreferenceModel(JsonModel):
    crs: str | None
    rms_xy_m: float | None
    rms_z_m: float | None
    trusted: bool
    fault: str | None


class DomeModel(JsonModel):
    """``amplitude_m`` and ``sigma_m`` are null without believed geotags; the percentage needs none."""

    amplitude_m: float | None
    amplitude_percent: float | None
    sigma_m: float | None


class KnowledgeModel(JsonModel):
    """Standard deviations: of f in percent, of the dome in percent of the flying height."""

    sigma_f_percent: float | None
    dome_percent: float | None


class ExtraPassModel(JsonModel):
    """The recommended pass whose photos are among those checked.

    ``photos``: that of each station in its order, null where there is none; ``not_used`` of them are not in
    the block.
    """

    photos: list[str | None]
    not_used: list[str]
    before: KnowledgeModel
    predicted: KnowledgeModel
    now: KnowledgeModel
    text: str


class TimingModel(JsonModel):
    wall_s: float | None
    cpu_s: float | None
    photos_per_s: float | None


class CheckReport(JsonModel):
    """The whole of ``report.json``."""

    schema_: Literal["fieldcal.check/1"] = Field(alias="schema")
    verdict: Literal["TRUST", "REFLY", "CANNOT_TELL"]
    headline: str
    what_to_fly: str | None
    findings: list[FindingModel]
    camera: CameraModel
    calibration: CalibrationModel
    reference: ReferenceModel | None
    #: Why a candidate reference was not used, or how it was converted.
    reference_note: str
    alignment: AlignmentModel
    network: NetworkModel
    georeference: GeoreferenceModel
    dome: DomeModel
    extra_pass: ExtraPassModel | None
    timing: TimingModel
    exports: dict[str, str]


def report_dict(result: CheckResult) -> dict[str, Any]:
    """The check as plain dicts, lists, strings and finite numbers."""
    return check_report(result).model_dump(mode="json", by_alias=True)


def report_json(result: CheckResult) -> str:
    """The check as JSON text."""
    return json.dumps(report_dict(result), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def check_report(result: CheckResult) -> CheckReport:
    solution = result.solution
    metric = solution.georeference.metric
    return CheckReport(
        schema="fieldcal.check/1",
        verdict=result.verdict.value,
        headline=printable(result.headline),
        what_to_fly=None if result.what_to_fly is None else printable(result.what_to_fly),
        findings=finding_models(result.findings),
        camera=camera_model(result.camera),
        calibration=calibration_model(result.estimate),
        reference=None if result.reference is None else _reference(result.reference, result.reference_note),
        reference_note=printable(result.reference_note),
        alignment=alignment_model(result),
        network=NetworkModel(
            nadir=result.network.nadir,
            convergent=result.network.convergent,
            heights_agl_m=[float(h) for h in result.network.heights_agl_m if metric and math.isfinite(h)],
            gsd_m=finite(result.network.gsd_m) if metric else None,
        ),
        georeference=GeoreferenceModel(
            crs=solution.georeference.crs,
            rms_xy_m=finite(solution.georeference.rms_xy_m),
            rms_z_m=finite(solution.georeference.rms_z_m),
            trusted=bool(solution.georeference.trusted),
            fault=solution.georeference.fault,
        ),
        dome=DomeModel(
            amplitude_m=finite(result.dome.amplitude_m) if metric else None,
            amplitude_percent=finite(result.dome.amplitude_percent),
            sigma_m=finite(result.dome.sigma_m) if metric else None,
        ),
        extra_pass=_extra_pass(result),
        timing=timing_model(result.timing),
        exports=dict(result.exports),
    )


def finding_models(findings: tuple[Finding, ...]) -> list[FindingModel]:
    return [
        FindingModel(
            rule=finding.rule,
            state=finding.state.value,
            value=finite(finding.value),
            sigma=finite(finding.sigma),
            unit=finding.unit,
            threshold=finite(finding.threshold),
            source=finding.source,
            message=printable(finding.message),
        )
        for finding in findings
    ]


def findings_of(models: Iterable[FindingModel]) -> tuple[Finding, ...]:
    """Inverse of :func:`finding_models`."""
    return tuple(Finding(**model.model_dump() | {"state": State(model.state)}) for model in models)


def camera_model(camera: CameraIdentity) -> CameraModel:
    return CameraModel(
        make=printable(camera.make),
        model=printable(camera.model),
        serial=None if camera.serial is None else printable(camera.serial),
        width=camera.width,
        height=camera.height,
        processing=camera.processing.value,
    )


def alignment_model(result: WithLeftOut) -> AlignmentModel:
    solution = result.solution
    return AlignmentModel(
        photos=photos_given(result),
        used=solution.photos_used,
        aligned=len(solution.photos),
        components=list(solution.components),
        points=len(solution.points_m),
        observations=len(solution.observations),
        reprojection_rms_px=finite(solution.rms_px),
        left_out=[
            LeftOutModel(path=path_text(item.path), reason=printable(item.reason))
            for item in all_left_out(result)
        ],
    )


def timing_model(timing: Timing) -> TimingModel:
    return TimingModel(
        wall_s=finite(timing.wall_s),
        cpu_s=finite(timing.cpu_s),
        photos_per_s=finite(timing.photos_per_s),
    )


def calibration_model(estimate: Estimate) -> CalibrationModel:
    values = {key: finite(value) for key, value in parameter_values(estimate.brown).items()}
    sigma = {key: finite(value) for key, value in parameter_sigmas(estimate).items()}
    keys, matrix = correlations(estimate.covariance)
    table = {a: {b: float(matrix[i, j]) for j, b in enumerate(keys)} for i, a in enumerate(keys)}
    return CalibrationModel(**values, sigma=SigmaModel(**sigma), correlation=table)


def _extra_pass(result: CheckResult) -> ExtraPassModel | None:
    extra, text = result.extra_pass, extra_pass_words(result)
    if extra is None or text is None:
        return None
    return ExtraPassModel(
        photos=[None if path is None else path_text(path) for path in extra.photos],
        not_used=[path_text(path) for path in not_joined(result)],
        before=_knowledge(extra.before),
        predicted=_knowledge(extra.predicted),
        now=_knowledge(knowledge_of(result)),
        text=text,
    )


def _knowledge(known: Knowledge) -> KnowledgeModel:
    return KnowledgeModel(
        sigma_f_percent=finite(known.sigma_f_percent), dome_percent=finite(known.dome_percent)
    )


def _reference(reference: Reference, note: str) -> ReferenceModel:
    return ReferenceModel(
        name=printable(reference.name),
        source=printable(reference.source),
        processing=reference.processing.value,
        f_px=finite(reference.f_px),
        note=printable(note),
    )


def finite(value: float | None) -> float | None:
    """JSON knows no NaN and no infinity."""
    """``value`` as a float, or None where it is unknown or not a number."""
    return None if value is None or not math.isfinite(value) else float(value)

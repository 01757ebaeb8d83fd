"""An assessment as data, schema ``fieldcal.assessment/1``."""

from __future__ import annotations

import json
from typing import Literal

import numpy as np
from pydantic import Field

from calib.assess.model import SEVEN_NAMES
from calib.assess.study import SECOND_ORDER, CloudAssessment
from calib.camera import FloatArray
from calib.report_json import JsonModel, finite
from calib.wording import path_text, printable


class SevenModel(JsonModel):
    """One of M7: m, degrees or percent; ``determined`` false: the points do not fix it."""

    value: float
    sigma: float
    determined: bool
    at_edge_m: float


class EtaModel(JsonModel):
    points: int
    outside: int
    mean_m: float
    eta_p_m: float
    sigma_eta_p_m: float | None
    robust_m: float
    at_points_m: float


class BowlModel(JsonModel):
    """Second-order surface; ``amplitude_m`` above zero is a dome; ``chance`` that there is none."""

    amplitude_m: float
    sigma_m: float
    percent_of_height: float | None
    chance: float
    radius_m: float
    terms_m: dict[str, float]
    sigma_terms_m: dict[str, float]


class TrendModel(JsonModel):
    """eta against elevation: an error of the vertical scale.

    ``told`` false: the ground is too flat for it; ``sigma`` null: it has no relief beyond its noise.
    """

    slope: float
    sigma: float | None
    correlation: float
    told: bool


class ProfileModel(JsonModel):
    name: str
    start_m: list[float]
    end_m: list[float]
    width_m: float
    along_m: list[float]
    eta_m: list[float | None]
    spread_m: list[float | None]


class PointModel(JsonModel):
    """``residual_m``: cloud minus reference, vertically, after M7; null: no cloud there."""

    name: str
    xyz_m: list[float]
    residual_m: float | None
    used: bool
    outlier: bool


class AssessmentReport(JsonModel):
    """The whole of ``assessment.json``; M7 turns about ``origin_m`` in the cloud's coordinates."""

    schema_: Literal["fieldcal.assessment/1"] = Field(alias="schema")
    cloud: str
    kind: str
    crs: str | None
    cloud_points: int
    reference_points: int
    registered_on: Literal["surface", "picked points"]
    radius_m: float
    origin_m: list[float]
    seven: dict[str, SevenModel]
    registration_mean_m: float
    registration_std_m: float
    correlation: float
    eta: EtaModel
    dome: BowlModel | None
    elevation: TrendModel | None
    profiles: list[ProfileModel]
    points: list[PointModel]
    height_agl_m: float | None
    notes: list[str]


def assessment_report(made: CloudAssessment) -> AssessmentReport:
    registration, seven, bowl = made.registration, made.registration.seven, made.bowl
    crs = made.cloud.file.crs
    return AssessmentReport(
        schema="fieldcal.assessment/1",
        cloud=path_text(made.cloud.file.path),
        kind=made.cloud.file.kind.value,
        crs=None if crs is None else printable(crs.name),
        cloud_points=made.cloud.total,
        reference_points=len(made.truth.names),
        registered_on="picked points" if made.by_picked else "surface",
        radius_m=registration.radius_m,
        origin_m=registration.origin.tolist(),
        seven={
            name: SevenModel(
                value=float(seven.values[i]),
                sigma=float(seven.sigmas[i]),
                determined=bool(registration.determined[i]),
                at_edge_m=float(made.at_edge_m[i]),
            )
            for i, name in enumerate(SEVEN_NAMES)
        },
        registration_mean_m=seven.residual_mean_m,
        registration_std_m=seven.residual_std_m,
        correlation=registration.correlation,
        eta=EtaModel(
            points=made.eta.points,
            outside=made.eta.outside,
            mean_m=made.eta.mean_m,
            eta_p_m=made.eta.eta_p_m,
            sigma_eta_p_m=finite(made.eta.sigma_m),
            robust_m=made.eta.robust_m,
            at_points_m=made.at_points_m,
        ),
        dome=None
        if bowl is None
        else BowlModel(
            amplitude_m=bowl.amplitude_m,
            sigma_m=bowl.sigma_m,
            percent_of_height=None if not made.height_agl_m else 100 * bowl.amplitude_m / made.height_agl_m,
            chance=bowl.chance,
            radius_m=bowl.radius_m,
            terms_m=dict(zip(SECOND_ORDER, map(float, bowl.terms_m), strict=True)),
            sigma_terms_m=dict(zip(SECOND_ORDER, map(float, np.sqrt(np.diag(bowl.covariance))), strict=True)),
        ),
        elevation=None
        if made.trend is None
        else TrendModel(
            slope=made.trend.slope,
            sigma=finite(made.trend.sigma),
            correlation=made.trend.correlation,
            told=made.trend.told,
        ),
        profiles=[
            ProfileModel(
                name=printable(one.line.name),
                start_m=one.line.start_m.tolist(),
                end_m=one.line.end_m.tolist(),
                width_m=one.width_m,
                along_m=one.along_m.tolist(),
                eta_m=_finites(one.eta_m),
                spread_m=_finites(one.spread_m),
            )
            for one in made.profiles
        ],
        points=[
            PointModel(
                name=printable(name),
                xyz_m=made.truth.xyz_m[i].tolist(),
                residual_m=finite(float(registration.residual_m[i])),
                used=bool(registration.used[i]),
                outlier=bool(registration.outlier[i]),
            )
            for i, name in enumerate(made.truth.names)
        ],
        height_agl_m=made.height_agl_m,
        notes=[printable(note) for note in made.notes],
    )


def assessment_json(made: CloudAssessment) -> str:
    data = assessment_report(made).model_dump(mode="json", by_alias=True)
    return json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _finites(values: FloatArray) -> list[float | None]:
    return [finite(float(value)) for value in values]

"""A calibration on control points as data (schema ``fieldcal.control/1``), as a page and as a reference."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from importlib import metadata
from typing import Any, Literal

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from calib.control import ControlCalibration, coverage_hint
from calib.control_subset import subsets
from calib.figures import correlation_figure
from calib.figures.control import control_profiles_figure, marks_figure
from calib.findings import State
from calib.html_page import drawn_sign, facts_section, html_page, sentence, table_section
from calib.mount import Mounted
from calib.onsite import calibration_date
from calib.onsite_rules import reference_limit_percent
from calib.propagation import BROWN_KEYS, correlations
from calib.reference import Reference
from calib.references import reference_of_body
from calib.report import SIGNS
from calib.report_figures import figures_html
from calib.report_json import CameraModel, JsonModel, camera_model, finite
from calib.wording import PARAMETERS, camera_name, printable, quantity


class StepModel(JsonModel):
    """One release; ``chance``: probability that chance alone improves the fit as much."""

    name: str
    parameters: list[str]
    sigma0: float | None
    control_rms_px: float | None
    check_rms_px: float | None
    chance: float | None
    kept: bool


class ErrorModel(JsonModel):
    """Of one kind of points: marks' rms per coordinate, and points from their marks against the survey."""

    points: int
    marks: int
    rms_px: float | None
    rmse_m: list[float | None]


class SubsetModel(JsonModel):
    """A calibration on the most telling photos; ``apart_sigmas``: of any parameter, from all photos."""

    photos: list[str]
    f_px: float
    sigma_f_px: float
    apart_sigmas: float


class MountModel(JsonModel):
    """How this camera sits on another: rotation from that one's axes, rows first, and offset in them; sigmas
    of one pair of photos and of the mean; ``miss_px``: marks where the other's poses put them, rms."""

    on: str
    pairs: int
    rotation: list[list[float]]
    offset_m: list[float]
    scatter_deg: list[float]
    scatter_m: list[float]
    sigma_deg: list[float]
    sigma_m: list[float]
    miss_px: float
    placed: list[str]


class ControlReport(JsonModel):
    """The whole of ``control.json``: f, c, b in px, K and P in focal units; ``sigma`` of the free ones."""

    schema_: Literal["fieldcal.control/1"] = Field(alias="schema")
    camera: CameraModel
    photos: list[str]
    sigma0: float | None
    parameters: dict[str, float]
    sigma: dict[str, float]
    correlation: dict[str, dict[str, float]]
    steps: list[StepModel]
    control: ErrorModel
    check: ErrorModel
    subsets: list[SubsetModel]
    blunders: list[str]
    hint: str | None
    notes: list[str]
    saved_as: str | None
    #: Share that sigma of f must not exceed for a reference, percent.
    sigma_limit_percent: float
    mount: MountModel | None = None


class CampaignReport(JsonModel):
    """Several cameras over the same control; ``failed``: what could not be calibrated, and why."""

    schema_: Literal["fieldcal.controls/1"] = Field(alias="schema")
    cameras: list[ControlReport]
    failed: list[str]


def control_report(made: ControlCalibration, saved_as: str | None = None) -> ControlReport:
    keys, matrix = correlations(made.fit.covariance)
    sigmas = dict(zip(BROWN_KEYS, np.sqrt(np.diag(made.covariance)).tolist(), strict=True))
    return ControlReport(
        schema="fieldcal.control/1",
        camera=camera_model(made.photos[0].camera),
        photos=[printable(photo.path.name) for photo in made.photos],
        sigma0=finite(made.fit.sigma0),
        parameters=dict(zip(BROWN_KEYS, map(float, made.camera.vector), strict=True)),
        sigma={key: sigmas[key] for key in keys},
        correlation={a: {b: float(matrix[i, j]) for j, b in enumerate(keys)} for i, a in enumerate(keys)},
        steps=[
            StepModel(
                name=step.name,
                parameters=list(step.parameters),
                sigma0=finite(step.sigma0),
                control_rms_px=finite(step.control_rms_px),
                check_rms_px=finite(step.check_rms_px),
                chance=step.chance,
                kept=step.kept,
            )
            for step in made.steps
        ],
        control=_errors(made, False),
        check=_errors(made, True),
        subsets=[
            SubsetModel(
                photos=[printable(made.photos[i].path.name) for i in subset.photos],
                f_px=subset.camera.f_px,
                sigma_f_px=float(np.sqrt(subset.covariance[0, 0])),
                apart_sigmas=subset.apart_sigmas,
            )
            for subset in subsets(made)
        ],
        blunders=[printable(text) for text in made.blunders],
        hint=coverage_hint(made),
        notes=[printable(text) for text in made.notes],
        saved_as=saved_as,
        sigma_limit_percent=reference_limit_percent(made.camera.width),
        mount=None if made.mounted is None else _mount(made.mounted),
    )


def _mount(mounted: Mounted) -> MountModel:
    mount = mounted.mount
    return MountModel(
        on=mounted.on,
        pairs=mount.pairs,
        rotation=mount.rotation_second_from_first.tolist(),
        offset_m=mount.offset_m.tolist(),
        scatter_deg=mount.scatter_deg.tolist(),
        scatter_m=mount.scatter_m.tolist(),
        sigma_deg=mount.sigma_deg.tolist(),
        sigma_m=mount.sigma_m.tolist(),
        miss_px=mounted.miss_px,
        placed=[printable(name) for name in mounted.placed],
    )


def control_json(made: ControlCalibration, saved_as: str | None = None) -> str:
    data = control_report(made, saved_as).model_dump(mode="json", by_alias=True)
    return json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def campaign_json(
    made: Sequence[ControlCalibration], saved_as: Sequence[str | None], failed: Sequence[str]
) -> str:
    """One camera as :func:`control_json`; several, or some that failed, together."""
    if len(made) == 1 and not failed:
        return control_json(made[0], saved_as[0])
    report = CampaignReport(
        schema="fieldcal.controls/1",
        cameras=[control_report(one, name) for one, name in zip(made, saved_as, strict=True)],
        failed=[printable(text) for text in failed],
    )
    data = report.model_dump(mode="json", by_alias=True)
    return json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def expected_csv(mounted: Mounted) -> str:
    """Where points should be in photos that have too few marks, in the columns of a file of marks."""
    out = io.StringIO()
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(("photo", "point", "u_px", "v_px"))
    rows.writerows((m.photo, m.point, m.u_px, m.v_px) for m in mounted.expected)
    return out.getvalue()


def mount_words(mounted: Mounted) -> tuple[str, ...]:
    """What is known of the mount, in sentences."""
    mount = mounted.mount
    x, y, z = 1000 * mount.offset_m
    turned = float(np.degrees(Rotation.from_matrix(mount.rotation_second_from_first).magnitude()))
    scatter_deg, scatter_mm = float(mount.scatter_deg.max()), 1000 * float(mount.scatter_m.max())
    said = [
        f"Mounted on {mounted.on}, from {mount.pairs} pairs of photos of the same moment: {x:+.0f} mm to its "
        f"right, {y:+.0f} mm down, {z:+.0f} mm ahead, turned by {turned:.2f} degrees (one pair scatters by "
        f"{scatter_mm:.0f} mm and {scatter_deg:.2f} degrees, the mean is known to "
        f"{1000 * float(mount.sigma_m.max()):.0f} mm and {float(mount.sigma_deg.max()):.2f} degrees).",
        f"Placed by {mounted.on} alone, the marks are missed by {mounted.miss_px:.1f} px rms.",
    ]
    if mounted.placed:
        said.append(
            f"Photos with few marks that were placed through it: {', '.join(mounted.placed[:5])}"
            f"{' ...' if len(mounted.placed) > 5 else ''}."
        )
    return tuple(said)


def control_reference(made: ControlCalibration, name: str, temperature_c: float | None) -> Reference:
    """As a reference for the check: Brown with its full covariance."""
    reference = reference_of_body(
        name,
        made.photos[0].camera,
        made.camera,
        made.covariance,
        calibration_date(made.photos),
        "fieldcal calibrate control: self-calibration on control points",
        summary(made),
    )
    return replace(reference, temperature_c=temperature_c)


def summary(made: ControlCalibration) -> str:
    """Counts and residuals in one line."""
    control = int(made.marks.control.sum())
    text = (
        f"{len(made.photos)} photos, {control} control and {len(made.points) - control} check points, "
        f"{int(made.used.sum())} marks, sigma0 {made.fit.sigma0:.2f}, rms "
        f"{made.rms_px(False):.2f} px on control"
    )
    check = made.rms_px(True)
    return text + (f" and {check:.2f} px on check points" if math.isfinite(check) else "")


def render_control(made: ControlCalibration, saved_as: str | None = None) -> str:
    """The report as HTML text, in the look of the check's."""
    sigma = made.sigma_f_percent
    fine = not made.blunders
    look = "trust" if fine else "cannot_tell"
    head = (
        f'<header class="verdict {look}"><h1>{drawn_sign(SIGNS[State.PASS if fine else State.UNKNOWN])}'
        f"<span>CALIBRATED</span></h1><p>"
        + sentence(
            f"The focal length is {made.camera.f_px:.2f} px, known to {sigma:.3f} % (1 sigma)"
            + ("." if fine else f"; {len(made.blunders)} blunders were left out.")
        )
        + "</p></header>"
    )
    facts = f"Calibration on control points · {camera_name(made.photos[0].camera)} · {summary(made)}"
    parts = [head, "<main>", f'<p class="facts">{sentence(facts)}</p>', _blunders(made), _steps(made)]
    parts += [
        _points(made),
        _subsets(made),
        figures_html(_figures(made)),
        _parameters(made),
        _mount_section(made),
        _provenance(made, saved_as),
    ]
    return html_page(f"CALIBRATED: {camera_name(made.photos[0].camera)}", "\n".join([*parts, "</main>"]))


def _blunders(made: ControlCalibration) -> str:
    said = [*made.blunders, *made.notes]
    hint = coverage_hint(made)
    if hint is not None:
        said.append(hint)
    if not said:
        return ""
    items = "".join(f"<li>{sentence(text)}</li>" for text in said)
    return f'<section class="fly"><h2>What to look at</h2><ul class="names">{items}</ul></section>'


def _steps(made: ControlCalibration) -> str:
    rows = []
    for step in made.steps:
        chance = "" if step.chance is None else f"{step.chance:.2g}"
        rows.append(
            (
                step.name,
                quantity(step.sigma0, None, "", 3),
                quantity(step.control_rms_px, None, "px", 3),
                quantity(step.check_rms_px, None, "px", 3),
                chance,
                "kept" if step.kept else "left out",
            )
        )
    return table_section(
        "Release in steps",
        "Each step joins those kept before it; it stays where chance explains its gain with less than 1 %.",
        ("Step", "sigma0", "Control", "Check", "Chance", ""),
        rows,
    )


def _points(made: ControlCalibration) -> str:
    rows = []
    for name, check in (("control", False), ("check", True)):
        error = _errors(made, check)
        sizes = [quantity(None if v is None else 1000 * v, None, "mm", 3) for v in error.rmse_m]
        rows.append(
            (name, str(error.points), str(error.marks), quantity(error.rms_px, None, "px", 3), *sizes)
        )
    return table_section(
        "Points",
        "Rms of the marks per coordinate; root mean square errors of the points from their marks, x y z.",
        ("Points", "Number", "Marks", "Marks rms", "x", "y", "z"),
        rows,
    )


def _subsets(made: ControlCalibration) -> str:
    rows = [
        (
            f"{len(subset.photos)} of {len(made.photos)}",
            quantity(subset.camera.f_px, float(np.sqrt(subset.covariance[0, 0])), "px", 6),
            f"{subset.apart_sigmas:.1f} sigma",
        )
        for subset in subsets(made)
    ]
    if not rows:
        return ""
    return table_section(
        "The most telling photos alone",
        "Chosen one by one for what they add to the calibration; the largest difference of a parameter from "
        "that of all photos, in sigmas of both.",
        ("Photos", "f", "Apart"),
        rows,
    )


def _figures(made: ControlCalibration) -> list[tuple[str, str, Any]]:
    hint = coverage_hint(made)
    return [
        ("Marks over the sensor", hint or "The marks reach all edges.", marks_figure(made)),
        (
            "Radial and decentring profiles",
            "As far out as there are marks; beyond, the polynomial is free to go anywhere.",
            control_profiles_figure(made),
        ),
        (
            "Correlations",
            "Correlations between the estimated parameters; near ±1 two of them cannot be told apart.",
            correlation_figure(made.fit.covariance),
        ),
    ]


def _parameters(made: ControlCalibration) -> str:
    rows = []
    free = np.diag(made.fit.covariance) > 0
    sigmas = np.where(free, np.sqrt(np.diag(made.covariance)), 0.0)
    for key, value, sigma in zip(BROWN_KEYS, made.camera.vector, sigmas, strict=True):
        if sigma > 0 or key in ("f_px", "cx_px", "cy_px"):
            name, unit = PARAMETERS[key]
            shown = quantity(float(value), float(sigma), unit, 6) + ("" if sigma > 0 else " (held)")
            rows.append((name, shown))
    return table_section(
        "Parameters",
        "One standard deviation, with what steps left out and a lens beyond Brown's model would change. "
        "K and P in focal units; undistorted to distorted; image corner at (0, 0).",
        ("Parameter", "This calibration"),
        rows,
    )


def _mount_section(made: ControlCalibration) -> str:
    if made.mounted is None:
        return ""
    mounted, mount = made.mounted, made.mounted.mount
    rows = [
        (f"{side}, mm", quantity(1000 * float(v), 1000 * float(s), "", 2))
        for side, v, s in zip(("To its right", "Down", "Ahead"), mount.offset_m, mount.sigma_m, strict=True)
    ]
    turn = Rotation.from_matrix(mount.rotation_second_from_first).as_rotvec(degrees=True)
    rows += [
        (f"Turned about {axis}, degrees", quantity(float(v), float(s), "", 2))
        for axis, v, s in zip(("its right", "down", "ahead"), turn, mount.sigma_deg, strict=True)
    ]
    rows += [
        (
            "One pair scatters by",
            f"{1000 * mount.scatter_m.max():.0f} mm, {mount.scatter_deg.max():.2f} degrees",
        ),
        ("Marks missed through it", f"{mounted.miss_px:.1f} px rms"),
        ("Photos placed through it", ", ".join(mounted.placed) or "none needed it"),
    ]
    title = f"Mounted on {mounted.on}, from {mount.pairs} pairs of photos"
    return facts_section("mount", title, rows)


def _provenance(made: ControlCalibration, saved_as: str | None) -> str:
    rows = [
        ("Photos", ", ".join(photo.path.name for photo in made.photos)),
        ("Date", calibration_date(made.photos)),
        ("Saved as", saved_as or "not saved"),
        ("Software", f"fieldcal {metadata.version('fieldcal')}, plotly {metadata.version('plotly')}"),
    ]
    return facts_section("provenance", "Where this comes from", rows)


def _errors(made: ControlCalibration, check: bool) -> ErrorModel:
    mine = made.marks.control != check
    return ErrorModel(
        points=int(mine.sum()),
        marks=int((made.used & mine[made.marks.point]).sum()),
        rms_px=finite(made.rms_px(check)),
        rmse_m=[finite(float(v)) for v in made.rmse_m(check)],
    )

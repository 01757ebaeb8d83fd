"""The report of a calibration on site: one HTML file in the look of the check's report."""

from __future__ import annotations

from importlib import metadata
from typing import Any

from calib.figures import correlation_figure, coverage_figure, profile_figure, residual_figure
from calib.figures.lens import equifinal_figure
from calib.figures.sensor import residual_exaggeration
from calib.figures.site import METRES, camera_network_figure, relative_unit
from calib.figures.wall import wall_figure, wall_plan_figure
from calib.html_page import drawn_sign, facts_section, html_page, sentence
from calib.onsite import Calibration, Kind, calibration_date
from calib.propagation import parameter_sigmas
from calib.report import (
    PROCESSING_WORDS,
    SIGNS,
    VERDICT_SIGNS,
    adjustment_rows,
    findings_section,
    left_out_section,
)
from calib.report_figures import figures_html
from calib.wording import (
    PARAMETERS,
    camera_name,
    html_text,
    left_out_by_reason,
    parameter_values,
    photos_given,
    quantity,
)

_TITLES = {Kind.WALL: "Calibration on a wall", Kind.ORBIT: "Calibration from a flight"}


def render_calibration(calibration: Calibration, saved_as: str | None = None) -> str:
    """The whole report as HTML text; the same calibration gives the same text."""
    acceptance = calibration.acceptance
    look = acceptance.verdict
    head = (
        f'<header class="verdict {look.value.lower()}"><h1>{drawn_sign(SIGNS[VERDICT_SIGNS[look]])}'
        f"<span>{acceptance.words}</span></h1><p>{sentence(calibration.headline)}</p></header>"
    )
    body = "\n".join(
        [
            head,
            "<main>",
            _facts(calibration),
            _what_to_do(calibration),
            findings_section(calibration.findings),
            left_out_section(left_out_by_reason(calibration)),
            figures_html(_figures(calibration)),
            _parameters(calibration),
            _provenance(calibration, saved_as),
            "</main>",
        ]
    )
    return html_page(f"{acceptance.words}: {camera_name(calibration.camera)}", body)


def _facts(calibration: Calibration) -> str:
    parts = [
        _TITLES[calibration.kind],
        camera_name(calibration.camera),
        f"{photos_given(calibration)} photos, {len(calibration.solution.photos)} aligned",
    ]
    flatness = calibration.flatness
    if flatness is not None:
        length, height = 2 * flatness.half_size
        parts.append(f"wall {length:.1f} x {height:.1f} distances")
    return f'<p class="facts">{sentence(" · ".join(parts))}</p>'


def _what_to_do(calibration: Calibration) -> str:
    if not calibration.what_to_do:
        return ""
    items = "".join(f"<li>{sentence(text)}</li>" for text in calibration.what_to_do)
    return (
        '<section class="fly" aria-labelledby="fly"><h2 id="fly">What to do</h2>'
        f'<ul class="names">{items}</ul></section>'
    )


def _figures(calibration: Calibration) -> list[tuple[str, str, Any]]:
    estimate, solution, network = calibration.estimate, calibration.solution, calibration.network
    brown = estimate.brown
    entries: list[tuple[str, str, Any]] = []
    flatness = calibration.flatness
    if flatness is not None:
        entries += [
            (
                "The wall from the front",
                "How far its points lie in front of (blue) or behind (red) its plane, in percent of the "
                f"distance between camera and wall; around the second-order surface "
                f"{quantity(flatness.rough_percent, None, '%', 2)} remain (rms).",
                wall_figure(flatness),
            ),
            (
                "Cameras in front of the wall",
                "Seen from above; the strokes show where they look. Lengths in distances.",
                wall_plan_figure(flatness),
            ),
        ]
    else:
        metric = solution.georeference.metric
        unit = METRES if metric else relative_unit(calibration.dome.flying_height_m)
        entries.append(
            (
                "Camera network from above",
                f"{network.nadir} photos look down, {network.convergent or 'none'} are convergent "
                "(triangles); the strokes show where the cameras look.",
                camera_network_figure(solution, network, unit),
            )
        )
    plane = f"K1 = {quantity(brown.k1_px)}, K2 = {quantity(brown.k2_px)} in pixel units."
    if calibration.line is not None:
        plane += " Line, band and domain of this camera: along the line different K1 and K2 are equally good."
    stretch = residual_exaggeration(solution)
    entries += [
        ("K1-K2 plane", plane, equifinal_figure(estimate, None, calibration.line)),
        (
            "Radial distortion",
            "Radial displacement over the image, to the corner, with its 95 % band.",
            profile_figure(estimate, None, None),
        ),
        (
            "Sensor coverage",
            f"Where on the sensor the {len(solution.observations)} tie point observations lie; empty edges "
            "and corners leave the distortion there to guessing.",
            coverage_figure(solution),
        ),
        (
            "Residuals on the sensor",
            f"Mean residual of each cell, drawn {stretch:g} times as long; the rms of all residuals is "
            f"{quantity(solution.rms_px, None, 'px', 2)}.",
            residual_figure(solution),
        ),
        (
            "Correlations",
            "Correlations between the estimated parameters; near ±1 two of them cannot be told apart.",
            correlation_figure(estimate.covariance),
        ),
    ]
    return [entry for entry in entries if entry[2] is not None]


def _parameters(calibration: Calibration) -> str:
    values = parameter_values(calibration.estimate.brown)
    sigmas = parameter_sigmas(calibration.estimate)
    rows = []
    for key, (name, unit) in PARAMETERS.items():
        if values[key] == 0 and not sigmas[key] > 0:
            continue
        shown = quantity(values[key], sigmas[key], unit, 6) + (" (held)" if sigmas[key] == 0 else "")
        rows.append(f'<tr><th scope="row">{html_text(name)}</th><td>{html_text(shown)}</td></tr>')
    return (
        '<section aria-labelledby="parameters"><h2 id="parameters">Parameters</h2><table>'
        "<caption>Brown's model fitted to the whole distortion, one standard deviation. K and P in focal "
        "units unless a unit is given; undistorted to distorted; image corner at (0, 0).</caption>"
        '<thead><tr><th scope="col">Parameter</th><th scope="col">This calibration</th></tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></section>"
    )


def _provenance(calibration: Calibration, saved_as: str | None) -> str:
    camera, solution, estimate = calibration.camera, calibration.solution, calibration.estimate
    rows = [
        (
            "Camera",
            f"{camera_name(camera)}, {camera.width} × {camera.height} px, "
            f"{PROCESSING_WORDS[camera.processing]}",
        ),
        ("Serial number", camera.serial or "not in the photos"),
        ("Date", calibration_date(solution.photos)),
    ]
    if calibration.temperature_c is not None:
        rows.append(("Temperature", f"{calibration.temperature_c:g} °C"))
    rows.append(("Saved as", saved_as or "not saved"))
    for label, line in (
        ("Equifinal line", calibration.line),
        ("The same for models without K3", calibration.line_no_k3),
    ):
        if line is not None:
            rows.append(
                (
                    label,
                    f"K2 = {quantity(line.slope)} K1 + {quantity(line.intercept)}, K1 from "
                    f"{quantity(line.k1_min)} to {quantity(line.k1_max)}; {line.source}",
                )
            )
    rows += [
        *adjustment_rows(solution, estimate),
        ("Software", f"fieldcal {metadata.version('fieldcal')}, plotly {metadata.version('plotly')}"),
    ]
    return facts_section("provenance", "Where this comes from", rows)

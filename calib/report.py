"""The report of a check as one HTML file that needs nothing but a browser (``calib.html_page``)."""

from __future__ import annotations

import math
from importlib import metadata
from pathlib import Path

from calib.extra_pass import extra_pass_words
from calib.findings import Finding, State, Verdict
from calib.html_page import CROSS, TICK, drawn_sign, facts_section, html_page, sentence
from calib.photos.photo import Processing
from calib.propagation import parameter_sigmas
from calib.report_figures import figures_section
from calib.result import CheckResult
from calib.solution import Estimate, Solution
from calib.wording import (
    PARAMETERS,
    STATE_ORDER,
    VERDICT_WORDS,
    camera_name,
    finding_value,
    html_text,
    left_out_by_reason,
    ordered_findings,
    parameter_values,
    path_text,
    photos_given,
    quantity,
    rule_title,
    unit_text,
)

_GROUPS = {State.FLAG: "Not in order", State.UNKNOWN: "Not known", State.PASS: "In order"}
PROCESSING_WORDS = {
    Processing.RAW: "pixels as the sensor gave them",
    Processing.LENS_CORRECTED: "lens-corrected in the camera",
    Processing.UNKNOWN: "lens correction in the camera unknown",
}
SIGNS = {
    State.PASS: TICK,
    State.FLAG: CROSS,
    State.UNKNOWN: '<path d="M9 9.5a3 3 0 1 1 4.4 2.7c-1 .6-1.4 1.1-1.4 2.3M12 17.6v.2"/>',
}
VERDICT_SIGNS = {
    Verdict.TRUST: State.PASS,
    Verdict.REFLY: State.FLAG,
    Verdict.CANNOT_TELL: State.UNKNOWN,
}


def render_report(result: CheckResult) -> str:
    """The whole report as HTML text; the same result gives the same text."""
    title = f"{VERDICT_WORDS[result.verdict]}: {camera_name(result.camera)}"
    body = "\n".join(
        [
            _verdict(result),
            "<main>",
            _facts(result),
            _extra_pass(result),
            _what_to_fly(result),
            findings_section(result.findings),
            _left_out(result),
            figures_section(result),
            _parameters(result),
            _provenance(result),
            _exports(result),
            "</main>",
        ]
    )
    return html_page(title, body)


def _verdict(result: CheckResult) -> str:
    verdict = result.verdict
    return (
        f'<header class="verdict {verdict.value.lower()}"><h1>{drawn_sign(SIGNS[VERDICT_SIGNS[verdict]])}'
        f"<span>{VERDICT_WORDS[verdict]}</span></h1><p>{sentence(result.headline)}</p></header>"
    )


def _facts(result: CheckResult) -> str:
    network, solution = result.network, result.solution
    metric = solution.georeference.metric
    heights = ", ".join(f"{h:.0f}" for h in network.heights_agl_m if metric)
    parts = [
        camera_name(result.camera),
        f"{photos_given(result)} photos, {len(solution.photos)} aligned",
        f"{network.nadir} straight down, {network.convergent} convergent",
    ]
    if heights:
        parts.append(f"{heights} m above ground")
    if metric and math.isfinite(network.gsd_m):
        parts.append(f"{100 * network.gsd_m:.1f} cm per pixel")
    return f'<p class="facts">{sentence(" · ".join(parts))}</p>'


def _extra_pass(result: CheckResult) -> str:
    words = extra_pass_words(result)
    if words is None:
        return ""
    return (
        f'<section aria-labelledby="pass"><h2 id="pass">The extra pass</h2><p>{sentence(words)}</p></section>'
    )


def _what_to_fly(result: CheckResult) -> str:
    if result.what_to_fly is None:
        return ""
    return (
        f'<section class="fly" aria-labelledby="fly"><h2 id="fly">What to fly</h2>'
        f"<p>{sentence(result.what_to_fly)}</p></section>"
    )


def findings_section(findings: tuple[Finding, ...]) -> str:
    """All findings, what went wrong first."""
    parts = ['<section aria-labelledby="why"><h2 id="why">Why</h2>']
    for state in STATE_ORDER:
        chosen = ordered_findings(findings, state)
        if chosen:
            parts.append(f"<h3>{_GROUPS[state]} ({len(chosen)})</h3>")
            parts.append(f'<ul class="findings">{"".join(map(_finding, chosen))}</ul>')
    return "\n".join([*parts, "</section>"])


def _finding(finding: Finding) -> str:
    measure = [f"<b>{sentence(finding_value(finding))}</b>"]
    if finding.threshold is not None:
        measure.append(f"threshold {sentence(quantity(finding.threshold, None, unit_text(finding.unit)))}")
    if finding.source:
        measure.append(f"from {sentence(finding.source)}")
    return (
        f'<li class="{finding.state.value}">{drawn_sign(SIGNS[finding.state])}<div>'
        f"<h4>{html_text(rule_title(finding.rule))}</h4><p>{sentence(finding.message)}</p>"
        f'<p class="measure">{" · ".join(measure)}</p></div></li>'
    )


def _left_out(result: CheckResult) -> str:
    return left_out_section(left_out_by_reason(result))


def left_out_section(groups: dict[str, list[Path]]) -> str:
    """Photos that were left out, by the reason."""
    if not groups:
        return ""
    parts = ['<section aria-labelledby="left"><h2 id="left">Photos left out</h2>']
    for reason, paths in groups.items():
        names = "".join(f"<li><code>{html_text(path_text(path))}</code></li>" for path in paths)
        parts.append(
            f"<h3>{html_text(reason[:1].upper() + reason[1:])} ({len(paths)})</h3>"
            f'<ul class="names">{names}</ul>'
        )
    return "\n".join([*parts, "</section>"])


def _parameters(result: CheckResult) -> str:
    estimate = result.estimate
    held = None if result.reference is None else result.reference.brown
    values, sigmas = parameter_values(estimate.brown), parameter_sigmas(estimate)
    others = None if held is None or not result.solution.free.any() else parameter_values(held)
    rows = []
    for key, (name, unit) in PARAMETERS.items():
        if values[key] == 0 and not sigmas[key] > 0 and not (others and others[key]):
            continue
        shown = quantity(values[key], sigmas[key], unit, 6) + (" (held)" if sigmas[key] == 0 else "")
        other = "" if others is None else f"<td>{html_text(quantity(others[key], None, unit, 6))}</td>"
        rows.append(f'<tr><th scope="row">{html_text(name)}</th><td>{html_text(shown)}</td>{other}</tr>')
    column = "" if others is None else '<th scope="col">Reference</th>'
    return (
        '<section aria-labelledby="parameters"><h2 id="parameters">Parameters</h2><table>'
        "<caption>Brown's model fitted to the whole distortion, one standard deviation. K and P in focal "
        "units unless a unit is given; undistorted to distorted; image corner at (0, 0).</caption>"
        f'<thead><tr><th scope="col">Parameter</th><th scope="col">This flight</th>{column}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></section>"
    )


def _provenance(result: CheckResult) -> str:
    camera, solution, estimate = result.camera, result.solution, result.estimate
    georeference, reference, timing = solution.georeference, result.reference, result.timing
    size = f"{camera.width} × {camera.height} px, {PROCESSING_WORDS[camera.processing]}"
    rows: list[tuple[str, str]] = [
        ("Camera", f"{camera_name(camera)}, {size}"),
        ("Serial number", camera.serial or "not in the photos"),
    ]
    times = sorted(photo.time for photo in solution.photos if photo.time is not None)
    if times:
        rows.append(("Photos taken", f"{times[0]:%Y-%m-%d %H:%M:%S} to {times[-1]:%H:%M:%S}"))
    if reference is not None:
        rows.append(
            ("Reference", f"{reference.name}, {PROCESSING_WORDS[reference.processing]}; {reference.source}")
        )
    if result.reference_note:
        rows.append(("About the reference" if reference else "Reference", result.reference_note))
    if georeference.rms_xy_m is not None:
        vertical = quantity(georeference.rms_z_m, None, "m", 2)
        rows.append(
            (
                "Geotags against the block",
                f"{quantity(georeference.rms_xy_m, None, 'm', 2)} horizontal, {vertical} vertical (rms)",
            )
        )
    if georeference.fault:
        rows.append(("Geotags", georeference.fault))
    rows += [
        *adjustment_rows(solution, estimate),
        ("f by lens model", _models(estimate.models)),
    ]
    if estimate.rejected_models:
        rows.append(("Models that fit worse", _models(estimate.rejected_models)))
    rows += [
        (
            "Time",
            f"{quantity(timing.wall_s, None, 's', 2)}, {quantity(timing.cpu_s, None, 's', 2)} of computing, "
            f"{quantity(timing.photos_per_s, None, '', 2)} photos per second",
        ),
        ("Software", f"fieldcal {metadata.version('fieldcal')}, plotly {metadata.version('plotly')}"),
    ]
    return facts_section("provenance", "Where this comes from", rows)


def adjustment_rows(solution: Solution, estimate: Estimate) -> list[tuple[str, str]]:
    """How the block was solved and what the sigma of f is made of, for a table of provenance."""
    held = not solution.free.any()
    settled = "settled" if solution.converged else "did not settle"
    return [
        (
            "Adjustment",
            f"{len(solution.points_m)} points, {len(solution.observations)} observations, "
            f"{settled} after {solution.iterations} iterations, sigma0 {solution.sigma0:.2f}",
        ),
        (
            "Sigma of f",
            f"{quantity(estimate.sigma_f_px, None, 'px', 2)}, the reference's: the lens was held"
            if held
            else f"{quantity(estimate.sigma_f_px, None, 'px', 2)}, from a formal "
            f"{quantity(estimate.sigma_f_formal_px, None, 'px', 2)}, correlated residuals (variance "
            f"× {quantity(estimate.correlation_factor, None, '', 2)}) and a spread of "
            f"{quantity(estimate.spread_f_px, None, 'px', 2)} over lens models",
        ),
    ]


def _models(models: dict[str, float]) -> str:
    return ", ".join(f"{name} {f_px:.2f} px" for name, f_px in models.items()) or "none"


def _exports(result: CheckResult) -> str:
    if not result.exports:
        return ""
    items = "".join(
        f'<li>{html_text(name)}: <a href="{html_text(_relative_url(target))}">{html_text(target)}</a></li>'
        for name, target in result.exports.items()
    )
    return (
        '<section aria-labelledby="exports"><h2 id="exports">Files for other programs</h2>'
        f'<ul class="names">{items}</ul></section>'
    )


def _relative_url(target: str) -> str:
    # "./" keeps a name with a colon from being read as a scheme.
    return "./" + Path(target).as_posix()

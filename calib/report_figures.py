"""The report's figures with their captions, as HTML with the figures' data inside."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from calib.figures import (
    camera_network_figure,
    correlation_figure,
    coverage_figure,
    dome_figure,
    equifinal_figure,
    profile_figure,
    residual_figure,
)
from calib.figures.sensor import residual_exaggeration
from calib.figures.site import METRES, relative_unit
from calib.result import CheckResult
from calib.wording import html_text, quantity


def figures_section(result: CheckResult) -> str:
    estimate, solution, reference = result.estimate, result.solution, result.reference
    brown = estimate.brown
    tolerance = next((f.threshold for f in result.findings if f.rule == "equifinal-deviation"), None)
    against = "" if reference is None else f" The reference is {reference.name}."
    plane = f"K1 = {quantity(brown.k1_px)}, K2 = {quantity(brown.k2_px)} in pixel units."
    if result.line is not None:
        plane += (
            f" Along the equifinal line ({result.line.source}) different K1 and K2 "
            "give the same distortion; off the line the lens differs."
        )
    stretch = residual_exaggeration(solution)
    network = result.network
    metric = solution.georeference.metric
    unit = METRES if metric else relative_unit(result.dome.flying_height_m)
    entries: list[tuple[str, str, Any]] = [
        (
            "K1-K2 plane",
            plane + against,
            equifinal_figure(estimate, reference, result.line),
        ),
        (
            "Radial distortion",
            "Radial displacement over the image, to the corner, with the 95 % band of this flight."
            + against
            + (
                " The dotted difference has the best scale taken out, which a change of focal length absorbs."
                if reference is not None and reference.brown is not None
                else ""
            ),
            profile_figure(estimate, reference, tolerance),
        ),
        (
            "Sensor coverage",
            f"Where on the sensor the {len(solution.observations)} tie point observations lie (colour: "
            "number in a cell); "
            "empty edges and corners leave the distortion there to guessing.",
            coverage_figure(solution),
        ),
        (
            "Residuals on the sensor",
            f"Mean residual of each cell, drawn {stretch:g} times as long; the rms of all residuals is "
            f"{quantity(solution.rms_px, None, 'px', 2)}. "
            "Arrows that form a pattern show what the lens model misses.",
            residual_figure(solution),
        ),
        (
            "Camera network from above",
            f"{network.nadir} photos look down, {network.convergent or 'none'} are convergent (triangles); "
            "the strokes show where the cameras look. The tie points are coloured by their height."
            + (
                ""
                if metric
                else " Without believed geotags, lengths are in flying heights and north is unknown."
            ),
            camera_network_figure(solution, network, unit),
        ),
        (
            "Predicted dome",
            "Heights with this calibration minus heights with the reference, the middle against the rim: "
            + (f"{quantity(result.dome.amplitude_m, result.dome.sigma_m, 'm')}, " if metric else "")
            + f"{quantity(result.dome.amplitude_percent, None, '%')} of the flying height "
            "(positive: dome, negative: dish).",
            dome_figure(result.dome, unit),
        ),
        (
            "Correlations",
            "Correlations between the estimated parameters; near ±1 two of them cannot be told apart.",
            correlation_figure(estimate.covariance),
        ),
    ]
    drawn = [(title, caption, figure) for title, caption, figure in entries if figure is not None]
    return figures_html(drawn)


def figures_html(drawn: Sequence[tuple[str, str, Any]]) -> str:
    """The section of figures, each with title, caption and plotly figure."""
    figures = "\n".join(_figure(i, *entry) for i, entry in enumerate(drawn))
    return f'<section aria-labelledby="figures"><h2 id="figures">Figures</h2>{figures}</section>'


def _figure(number: int, title: str, caption: str, figure: Any) -> str:
    # In JSON "<" only occurs within strings, where the escape means the same.
    data = figure.to_json().replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
    height = int(figure.layout.height)
    return (
        f'<figure aria-labelledby="f{number}t"><h3 id="f{number}t">{html_text(title)}</h3>'
        f'<div class="plot" id="f{number}" role="img" style="height:{height}px" '
        f'aria-label="{html_text(title)}. {html_text(caption)}"></div>'
        f'<script type="application/json" data-plot="f{number}">{data}</script>'
        "<noscript><p>The drawing needs a browser with scripts; report.json has the numbers.</p></noscript>"
        f"<figcaption>{html_text(caption)}</figcaption></figure>"
    )

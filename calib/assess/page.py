"""An assessment as a page in the look of the check's report."""

from __future__ import annotations

from importlib import metadata
from typing import Any

import numpy as np

from calib.assess.model import SEVEN_NAMES
from calib.assess.register import PRIOR_SIGMAS
from calib.assess.study import CloudAssessment
from calib.assess.words import (
    SEVEN_WORDS,
    elevation_text,
    offset_text,
    precision_text,
    seven_rows,
    shape_text,
)
from calib.figures.assess import elevation_figure, eta_map_figure, profile_lines_figure
from calib.html_page import facts_section, html_page, sentence, table_section
from calib.report_figures import figures_html
from calib.wording import path_text, printable, quantity


def render_assessment(made: CloudAssessment) -> str:
    """The report as HTML text, in the look of the check's."""
    name = printable(made.cloud.file.path.name)
    head = (
        '<header class="verdict measured"><h1><span>Assessment</span></h1>'
        f"<p>{sentence(offset_text(made))} {sentence(shape_text(made))}</p></header>"
    )
    said = [text for text in (precision_text(made), elevation_text(made), *made.notes) if text]
    items = "".join(f"<li>{sentence(text)}</li>" for text in said)
    facts = (
        f"{name} · {made.cloud.total} points · {len(made.truth.names)} reference points, "
        f"{int(made.registration.used.sum())} used for the registration"
    )
    parts = [
        head,
        "<main>",
        f'<p class="facts">{sentence(facts)}</p>',
        f'<section class="fly"><h2>What there is to say</h2><ul class="names">{items}</ul></section>'
        if said
        else "",
        _seven_section(made),
        figures_html(_figures(made)),
        _points_section(made),
        _provenance(made),
        "</main>",
    ]
    return html_page(f"Assessment: {name}", "\n".join(parts))


def _seven_section(made: CloudAssessment) -> str:
    at = ", ".join(f"{v:.0f}" for v in made.registration.origin)
    open_ = [name for name, fixed in zip(SEVEN_NAMES, made.registration.determined, strict=True) if not fixed]
    caption = (
        "From the reference points to the cloud, one standard deviation, about the middle of the points "
        f"({at}). At the edge: what it comes to {quantity(made.site_radius_m, None, 'm', 2)} from the middle."
    )
    if open_:
        limits = ", ".join(
            f"{name} {PRIOR_SIGMAS[SEVEN_NAMES.index(name)]:g} {SEVEN_WORDS[name][1]}" for name in open_
        )
        caption += (
            f" Not determined: the ground is too flat, or the points lie too narrow ({limits} were assumed "
            "possible). Points picked in the cloud (--picked) would tell."
        )
    return table_section("Shift, turn, scale", caption, ("", "", "Value", "At the edge"), seven_rows(made))


def _figures(made: CloudAssessment) -> list[tuple[str, str, Any]]:
    return [
        (
            "Map of what is left",
            "How much higher (red) or lower (blue) the cloud is than the reference surface after shift, turn "
            "and scale. Circles: reference points; crosses: those left out.",
            eta_map_figure(made),
        ),
        (
            "Profiles",
            "The same along lines, mean and standard deviation. A dome bends upwards in the middle. "
            + "; ".join(
                f"{printable(p.line.name)}: {quantity(p.width_m, None, 'm', 2)} wide" for p in made.profiles
            )
            + ".",
            profile_lines_figure(made),
        ),
        (
            "Against elevation",
            "A slope of the line is an error of the vertical scale, as a wrong focal length makes it. "
            + (
                "The reference points lean by the noise of their own heights, which the line allows for."
                if made.trend is not None and made.trend.told
                else "There is none: the ground is too flat, or the points are too few. On flat ground the "
                "reference points lean by the noise of their own heights alone."
            ),
            elevation_figure(made),
        ),
    ]


def _points_section(made: CloudAssessment, most: int = 12) -> str:
    residual = made.registration.residual_m
    order = [int(i) for i in np.argsort(-np.abs(np.nan_to_num(residual))) if np.isfinite(residual[i])][:most]
    rows = [
        (
            printable(made.truth.names[i]),
            quantity(float(residual[i]), None, "m", 3),
            "left out"
            if made.registration.outlier[i]
            else ("used" if made.registration.used[i] else "check"),
        )
        for i in order
    ]
    return table_section(
        "Reference points that fit worst",
        "Height of the cloud minus height of the point, after shift, turn and scale.",
        ("Point", "Cloud minus point", ""),
        rows,
    )


def _provenance(made: CloudAssessment) -> str:
    file, registration = made.cloud.file, made.registration
    rows = [
        ("Cloud", f"{path_text(file.path)} ({file.kind.value}), {made.cloud.total} points"),
        ("Coordinate system", "not said by the file" if file.crs is None else printable(file.crs.name)),
        (
            "Registration",
            "on points picked in the cloud"
            if made.by_picked
            else f"on the cloud's surface (points within {quantity(registration.radius_m, None, 'm', 2)})",
        ),
        (
            "Left by the registration",
            f"{registration.seven.residual_mean_m:.3f} ± {registration.seven.residual_std_m:.3f} m "
            "(mean and deviation, vertical)",
        ),
        ("Neighbours share errors", f"variances times {registration.correlation:.2f}"),
        ("Points under eta_p", f"{made.eta.points}; {made.eta.outside} lie beyond the reference points"),
        ("Software", f"fieldcal {metadata.version('fieldcal')}, plotly {metadata.version('plotly')}"),
    ]
    return facts_section("provenance", "Where this comes from", rows)

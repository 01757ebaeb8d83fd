"""The sheet of an extra pass: one HTML file to print and to fly by hand from, that needs only a browser."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from calib.files import write_text_atomic
from calib.html_page import CROSS, TICK, drawn_sign, html_page, sentence
from calib.limits import percent
from calib.wording import html_text
from mission.limits import hard_violations
from mission.refly import Refly
from mission.refly_figures import k1_k2_figure, map_figure
from mission.refly_words import metres, time_words
from mission.rule import Finding
from mission.sheet import flight_facts, ground_facts, planned_from

_OPEN = '<path d="M12 6v7.5M12 17.2v.4"/>'
_EXTRA_CSS = """
table.stations { width: 100%; font-variant-numeric: tabular-nums; }
table.stations td, table.stations th { text-align: right; padding-right: .6rem; }
table.stations td:last-child { text-align: left; }
"""


def write_refly_sheet(pass_: Refly, path: Path) -> None:
    """Write the sheet, whole or not at all.

    Raises:
        OutputError: not writable.
    """
    write_text_atomic(path, render_refly_sheet(pass_))


def render_refly_sheet(pass_: Refly) -> str:
    """The sheet as HTML text; the same pass gives the same text."""
    parts = [_header(pass_), "<main>"]
    if pass_.found is not None:
        parts += [_numbers(pass_), _by_hand(pass_)]
    parts += [_others(pass_), _limits(pass_), _pictures(pass_), _provenance(pass_), "</main>"]
    return html_page(f"{pass_.flown.site.name} - extra pass", "\n".join(parts), _EXTRA_CSS)


def _header(pass_: Refly) -> str:
    if hard_violations(pass_.findings):
        kind, sign, word = "refly", CROSS, "DO NOT FLY"
    elif pass_.cures:
        kind, sign, word = "trust", TICK, "FLY THIS"
    elif pass_.helps:
        kind, sign, word = "cannot_tell", _OPEN, "NO CURE"
    else:
        kind, sign, word = "cannot_tell", _OPEN, "NOTHING TO FLY"
    return (
        f'<header class="verdict {kind}"><h1>{drawn_sign(sign)}<span>{word}</span></h1>'
        f"<p>{sentence(pass_.reason)}</p></header>"
    )


def _numbers(pass_: Refly) -> str:
    check, found = pass_.check, pass_.found
    if found is None:
        return ""
    rows = [
        ("Photos", "", str(len(found.stations))),
        ("In the air", "", time_words(pass_.duration_s)),
        ("Focal length known to", percent(check.sigma_f_percent), percent(found.worth.sigma_f_percent)),
        (
            "Possible dome or dish",
            f"{metres(check.dome_sigma_m)} ({percent(check.dome_percent)} of the height)",
            f"{metres(found.worth.dome_percent / 100 * check.height_agl_m)} "
            f"({percent(found.worth.dome_percent)} of the height)",
        ),
    ]
    cells = "".join(
        f'<tr><th scope="row">{html_text(name)}</th><td>{sentence(now)}</td><td>{sentence(then)}</td></tr>'
        for name, now, then in rows
    )
    return (
        '<section aria-labelledby="gain"><h2 id="gain">What it brings</h2>'
        '<table><thead><tr><th></th><th scope="col">now</th><th scope="col">with the pass</th></tr></thead>'
        f"<tbody>{cells}</tbody></table></section>"
    )


def _by_hand(pass_: Refly) -> str:
    """Every photo as a pilot finds it: how far and which way from the launch point, how high, its aim."""
    if pass_.found is None:
        return ""
    stations = pass_.found.stations
    places = pass_.flown.site.frame.geodetic(np.array([[s.east_m, s.north_m, s.height_m] for s in stations]))
    rows = []
    for number, (s, place) in enumerate(zip(stations, places, strict=True), 1):
        bearing = math.degrees(math.atan2(s.east_m, s.north_m)) % 360.0
        rows.append(
            f"<tr><td>{number}</td><td>{math.hypot(s.east_m, s.north_m):.0f} m</td><td>{bearing:.0f}°</td>"
            f"<td>{s.height_m:.0f} m</td><td>{s.yaw_deg % 360:.0f}°</td><td>{s.pitch_deg:.0f}°</td>"
            f"<td>{place[0]:.6f}, {place[1]:.6f}</td></tr>"
        )
    heads = ("photo", "from launch", "bearing", "height", "heading", "gimbal", "latitude, longitude")
    head = "".join(f'<th scope="col">{name}</th>' for name in heads)
    return (
        '<section aria-labelledby="hand"><h2 id="hand">To fly by hand</h2>'
        f'<table class="stations"><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table>'
        "<p>Heights are above the launch point, bearings and headings clockwise from true north; gimbal -90° "
        "looks straight down. Stand still for each photo. Some metres and degrees do not matter. Keep zoom "
        "and focus as they are. Then check the old and the new photos together: "
        "<code>fieldcal check OLD NEW</code>.</p></section>"
    )


def _others(pass_: Refly) -> str:
    items = [*(a.text for a in pass_.alternatives)]
    parts = []
    if items:
        listed = "".join(f"<li>{sentence(text)}</li>" for text in items)
        parts.append(
            '<section aria-labelledby="other"><h2 id="other">Instead</h2>'
            f'<ul class="names">{listed}</ul></section>'
        )
    if pass_.notes:
        listed = "".join(f"<li>{sentence(text)}</li>" for text in pass_.notes)
        parts.append(
            '<section class="fly" aria-labelledby="know"><h2 id="know">To know before the flight</h2>'
            f'<ul class="names">{listed}</ul></section>'
        )
    return "\n".join(parts)


def _limits(pass_: Refly) -> str:
    groups = [
        ("Forbids the flight", [f for f in pass_.findings if f.hard and not f.ok], "flag", CROSS),
        ("To think about", [f for f in pass_.findings if not f.hard and not f.ok], "unknown", _OPEN),
        ("In order", [f for f in pass_.findings if f.ok], "pass", TICK),
    ]
    if not pass_.findings:
        return ""
    parts = ['<section aria-labelledby="limits"><h2 id="limits">Limits</h2>']
    for title, chosen, kind, sign in groups:
        if chosen:
            listed = "".join(_limit(f, kind, sign) for f in chosen)
            parts.append(f'<h3>{title} ({len(chosen)})</h3><ul class="findings">{listed}</ul>')
    return "\n".join([*parts, "</section>"])


def _limit(finding: Finding, kind: str, sign: str) -> str:
    title = finding.rule.replace("-", " ").capitalize()
    return (
        f'<li class="{kind}">{drawn_sign(sign)}<div><h4>{html_text(title)}</h4>'
        f"<p>{sentence(finding.message)}</p></div></li>"
    )


def _pictures(pass_: Refly) -> str:
    figures: list[tuple[str, str, Any]] = [
        ("Map", "The pass, its photos in order, and the photos that there are.", map_figure(pass_)),
        (
            "K1 and K2",
            "The pair of distortion parameters is somewhere in the outer ellipse now, and will be in the "
            "inner one.",
            k1_k2_figure(pass_),
        ),
    ]
    parts = []
    for number, (title, caption, figure) in enumerate(figures, 1):
        if figure is None:
            continue
        data = figure.to_json().replace("<", "\\u003c")
        parts.append(
            f'<figure><h3>{title}</h3><div class="plot" id="plot{number}" role="img" '
            f'aria-label="{title}"></div>'
            f"<figcaption>{sentence(caption)}</figcaption>"
            f'<script type="application/json" data-plot="plot{number}">{data}</script></figure>'
        )
    if not parts:
        return ""
    heading = '<section aria-labelledby="figures"><h2 id="figures">Pictures</h2>'
    return "\n".join([heading, *parts, "</section>"])


def _provenance(pass_: Refly) -> str:
    site, check = pass_.flown.site, pass_.check
    survey = f"{len(check.photos)} photos, {check.height_agl_m:.0f} m above ground, {check.camera_name}"
    return planned_from(
        [("Survey", survey), *ground_facts(site.frame, site), *flight_facts(site.vehicle, site)]
    )

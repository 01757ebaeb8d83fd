"""The plan sheet: one HTML file for the field bag, that needs nothing but a browser.

Styles, script and policy are those of the report (``calib.html_page``).
"""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

from calib.files import write_text_atomic
from calib.findings import Verdict
from calib.frames import LocalFrame
from calib.html_page import CROSS, TICK, drawn_sign, facts_section, html_page, sentence
from calib.wording import VERDICT_WORDS, html_text, quantity
from mission.limits import hard_violations
from mission.plan import Vehicle
from mission.planned import Planned
from mission.rule import Finding
from mission.sheet_figures import figures
from mission.site import Site
from mission.timing import minutes

_SIGNS = {
    "pass": TICK,
    "flag": CROSS,
    "unknown": '<path d="M12 6v7.5M12 17.2v.4"/>',
}
_EXTRA_CSS = """
.two { display: grid; gap: 0 2rem; }
@media (min-width: 40rem) { .two { grid-template-columns: 1fr 1fr; } }
"""


def write_sheet(planned: Planned, path: Path) -> None:
    """Write the sheet, whole or not at all.

    Raises:
        OutputError: not writable.
    """
    write_text_atomic(path, render_sheet(planned))


def render_sheet(planned: Planned) -> str:
    """The sheet as HTML text; the same plan gives the same text."""
    body = "\n".join(
        [
            _header(planned),
            "<main>",
            _facts(planned),
            _notes(planned),
            _prediction(planned),
            _findings(planned),
            _figures(planned),
            _provenance(planned),
            "</main>",
        ]
    )
    return html_page(f"{planned.plan.name} - plan", body, _EXTRA_CSS)


def _header(planned: Planned) -> str:
    broken = hard_violations(planned.findings)
    if broken:
        kind, sign, word, text = "refly", "flag", "DO NOT FLY", broken[0].message
    elif planned.prediction.verdict is Verdict.TRUST:
        kind, sign, word, text = "trust", "pass", "READY", planned.prediction.reason
    else:
        word = f"{VERDICT_WORDS[planned.prediction.verdict]} EXPECTED"
        kind, sign, text = "cannot_tell", "unknown", planned.prediction.reason
    return (
        f'<header class="verdict {kind}"><h1>{drawn_sign(_SIGNS[sign])}<span>{word}</span></h1>'
        f"<p>{sentence(text)}</p></header>"
    )


def _facts(planned: Planned) -> str:
    cost, site = planned.timing, planned.site
    parts = [
        planned.plan.name,
        f"{cost.photos} photos with {planned.plan.camera_name}",
        f"{site.height_m:g} m above ground, {100 * planned.gsd_m:.1f} cm per pixel",
        f"{cost.length_m / 1000:.1f} km, {minutes(cost.duration_s)}",
        f"{100 * cost.battery_share:.0f} % of a battery",
    ]
    return f'<p class="facts">{sentence(" · ".join(parts))}</p>'


def _notes(planned: Planned) -> str:
    if not planned.notes:
        return ""
    items = "".join(f"<li>{sentence(note)}</li>" for note in planned.notes)
    return (
        '<section class="fly" aria-labelledby="know"><h2 id="know">To know before the flight</h2>'
        f'<ul class="names">{items}</ul></section>'
    )


def _prediction(planned: Planned) -> str:
    p = planned.prediction
    rows = [
        ("Verdict to expect", VERDICT_WORDS[p.verdict]),
        ("Focal length known to", quantity(p.sigma_f_percent, None, "%", 2)),
        (
            "Dome or dish, one sigma",
            f"{quantity(p.dome_percent, None, '%', 2)} of the height, {100 * p.dome_sigma_m:.2g} cm",
        ),
        (
            "K1, K2, K3, one sigma",
            ", ".join(f"{k:.1e} px^-{n}" for k, n in zip(p.sigma_k_px, (2, 4, 6), strict=True)),
        ),
        ("Correlation of K1 and K2", quantity(p.k1_k2_correlation, None, "", 3)),
        ("Convergent photos", quantity(100 * p.convergent_share, None, "%", 2)),
        ("Photos of the worst place", str(p.least_views)),
        ("Ground resolution, worst place", quantity(100 * p.gsd_worst_m, None, "cm", 2)),
    ]
    cells = "".join(
        f'<tr><th scope="row">{html_text(name)}</th><td>{sentence(value)}</td></tr>' for name, value in rows
    )
    return (
        '<section aria-labelledby="predicted"><h2 id="predicted">Predicted quality</h2>'
        f"<table><tbody>{cells}</tbody></table></section>"
    )


def _findings(planned: Planned) -> str:
    groups = [
        ("Forbids the flight", [f for f in planned.findings if f.hard and not f.ok], "flag"),
        ("To think about", [f for f in planned.findings if not f.hard and not f.ok], "unknown"),
        ("In order", [f for f in planned.findings if f.ok], "pass"),
    ]
    parts = ['<section aria-labelledby="limits"><h2 id="limits">Limits</h2>']
    for title, chosen, kind in groups:
        if chosen:
            parts.append(f"<h3>{title} ({len(chosen)})</h3>")
            parts.append(f'<ul class="findings">{"".join(_finding(f, kind) for f in chosen)}</ul>')
    return "\n".join([*parts, "</section>"])


def _finding(finding: Finding, kind: str) -> str:
    title = finding.rule.replace("-", " ")
    return (
        f'<li class="{kind}">{drawn_sign(_SIGNS[kind])}<div>'
        f"<h4>{html_text(title[:1].upper() + title[1:])}</h4>"
        f"<p>{sentence(finding.message)}</p></div></li>"
    )


def _figures(planned: Planned) -> str:
    parts = ['<section aria-labelledby="figures"><h2 id="figures">Pictures</h2>']
    for number, (title, caption, figure) in enumerate(figures(planned), 1):
        data = figure.to_json().replace("<", "\\u003c")
        parts.append(
            f'<figure><h3>{html_text(title)}</h3><div class="plot" id="plot{number}" role="img" '
            f'aria-label="{html_text(title)}"></div><figcaption>{sentence(caption)}</figcaption>'
            f'<script type="application/json" data-plot="plot{number}">{data}</script></figure>'
        )
    return "\n".join([*parts, "</section>"])


def _provenance(planned: Planned) -> str:
    site, plan = planned.site, planned.plan
    overlap = f"{100 * site.forward_overlap:.0f} % along, {100 * site.side_overlap:.0f} % across"
    return planned_from(
        [
            *ground_facts(plan.launch, site),
            ("Overlap", overlap),
            *flight_facts(plan.vehicle, site),
        ]
    )


def ground_facts(launch: LocalFrame, site: Site) -> list[tuple[str, str]]:
    """Where a mission starts, and over what ground it is planned."""
    return [
        ("Launch point", f"{launch.latitude_deg:.6f}, {launch.longitude_deg:.6f}"),
        ("Terrain", site.terrain.name),
    ]


def flight_facts(vehicle: Vehicle, site: Site) -> list[tuple[str, str]]:
    """Aircraft and wind that a mission is planned for."""
    return [
        (
            "Aircraft",
            f"{vehicle.speed_m_s:.1f} m/s, {vehicle.endurance_s / 60:.0f} min of a battery, "
            f"{100 * vehicle.reserve_share:.0f} % kept",
        ),
        ("Wind", f"{site.wind.speed_m_s:g} m/s from {site.wind.from_deg:g} degrees"),
    ]


def planned_from(rows: list[tuple[str, str]]) -> str:
    """The sheet's section of what a mission was planned from."""
    software = ("Software", f"fieldcal {metadata.version('fieldcal')}")
    return facts_section("from", "What it is planned from", [*rows, software], sentence)

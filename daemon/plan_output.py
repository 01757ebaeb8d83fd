"""What ``fieldcal plan`` says: on the terminal, and as JSON (fieldcal.plan/1)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from calib.wording import VERDICT_WORDS
from daemon.output import table
from mission.encode import SUFFIXES
from mission.plan import Plan, stations
from mission.planned import Planned
from mission.rule import Finding
from mission.split import worst_findings
from mission.timing import minutes

SCHEMA = "fieldcal.plan/1"
#: What is not a mission.
_SHEET_WORDS = {".html": "plan sheet, open it in a browser", ".png": "plan sheet, a picture"}


def plan_json(planned: Planned, parts: Sequence[Planned] = ()) -> dict[str, Any]:
    """The whole result as plain data; what is not known or not finite is null.

    ``parts``: the missions that it is flown as, where these are several.
    """
    plan, prediction, cost = planned.plan, planned.prediction, planned.timing
    several = list(parts) if len(parts) > 1 else []
    findings = worst_findings(several) if several else planned.findings
    return {
        "schema": SCHEMA,
        "name": plan.name,
        "camera": plan.camera_name,
        "launch": {"lat": plan.launch.latitude_deg, "lon": plan.launch.longitude_deg},
        "photos": cost.photos,
        "length_m": round(cost.length_m, 1),
        "duration_s": round(cost.duration_s, 1),
        "battery_share": _finite(round(cost.battery_share, 4)),
        "return_height_m": plan.return_height_m,
        "gsd_m": planned.gsd_m,
        "predicted": {
            "sigma_f_percent": _finite(prediction.sigma_f_percent),
            "sigma_k_px": [_finite(sigma) for sigma in prediction.sigma_k_px],
            "k1_k2_correlation": _finite(prediction.k1_k2_correlation),
            "dome_percent": _finite(prediction.dome_percent),
            "dome_m": _finite(prediction.dome_sigma_m),
            "convergent_share": _finite(prediction.convergent_share),
            "verdict": prediction.verdict.value,
            "reason": prediction.reason,
            "gsd_worst_m": _finite(prediction.gsd_worst_m),
            "least_views": prediction.least_views,
        },
        "findings": [_finding(f) for f in findings],
        "notes": list(planned.notes),
        "stations": _stations(plan),
        "parts": [_part(part) for part in several],
    }


def _part(planned: Planned) -> dict[str, Any]:
    """One of several missions."""
    cost = planned.timing
    return {
        "name": planned.plan.name,
        "photos": cost.photos,
        "length_m": round(cost.length_m, 1),
        "duration_s": round(cost.duration_s, 1),
        "battery_share": _finite(round(cost.battery_share, 4)),
        "return_height_m": planned.plan.return_height_m,
        "findings": [_finding(f) for f in planned.findings],
        "stations": _stations(planned.plan),
    }


def _stations(plan: Plan) -> list[dict[str, Any]]:
    photos = stations(plan)
    enu = np.array([[s.east_m, s.north_m, s.height_m] for s in photos]).reshape(-1, 3)
    return [
        {
            "lat": round(float(g[0]), 9),
            "lon": round(float((g[1] + 180) % 360 - 180), 9),
            "height_m": round(float(g[2]) - plan.launch.altitude_m, 3),
            "yaw_deg": round(s.yaw_deg % 360, 3),
            "pitch_deg": round(s.pitch_deg, 3),
            "pattern": s.pattern,
        }
        for g, s in zip(plan.launch.geodetic(enu), photos, strict=True)
    ]


def _finding(finding: Finding) -> dict[str, Any]:
    return {
        "rule": finding.rule,
        "hard": finding.hard,
        "ok": finding.ok,
        "value": None if finding.value is None else _finite(finding.value),
        "limit": None if finding.limit is None else _finite(finding.limit),
        "unit": finding.unit,
        "message": finding.message,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def headline(planned: Planned) -> str:
    """Photos, way, time and battery in a line."""
    cost = planned.timing
    way = f"{cost.length_m / 1000:.1f} km" if cost.length_m >= 1000 else f"{cost.length_m:.0f} m"
    return (
        f"{cost.photos} photos, {way}, {minutes(cost.duration_s)}, {100 * cost.battery_share:.0f} % "
        "of a battery; "
        f"{100 * planned.gsd_m:.1f} cm per pixel from {planned.site.height_m:g} m."
    )


def predicted(planned: Planned) -> str:
    """The prediction in a line."""
    p = planned.prediction
    return (
        f"Predicted: {VERDICT_WORDS[p.verdict]}. Focal length to {_percent(p.sigma_f_percent)}, dome "
        f"{_percent(p.dome_percent)} of the height, {100 * p.convergent_share:.0f} % of the photos "
        "convergent, "
        f"{p.least_views} views of the worst place."
    )


def print_plan(whole: Planned, parts: Sequence[Planned], out: Console) -> None:
    """Everything for the operator, mission by mission; broken rules come first."""
    if len(parts) == 1:
        out.print(f"{whole.plan.name}: {headline(whole)}")
    else:
        photos, seconds = (sum(p.timing.photos for p in parts), sum(p.timing.duration_s for p in parts))
        out.print(
            f"{whole.plan.name}: {len(parts)} missions, {photos} photos, {minutes(seconds)} in the air."
        )
    out.print(predicted(whole))
    out.print(whole.prediction.reason)
    for part in parts:
        out.print()
        if len(parts) > 1:
            out.print(f"{part.plan.name}: {headline(part)}")
        rows = table("", "", "")
        rows.show_header = False
        for finding in sorted(part.findings, key=lambda f: (f.ok, not f.hard)):
            sign = "✓" if finding.ok else ("✗" if finding.hard else "!")
            rows.add_row(sign, finding.rule, finding.message)
        out.print(rows)
    for note in dict.fromkeys(note for part in parts for note in part.notes):
        out.print(f"Note: {note}")


def print_ending(out: Console, written: list[Path], losses: list[str]) -> None:
    """What was written, and what the formats could not hold."""
    for loss in losses:
        out.print(f"Note: {loss}")
    for path in written:
        out.print(f"Wrote {path} ({(SUFFIXES | _SHEET_WORDS)[path.suffix.lower()]}).")


def _percent(value: float) -> str:
    return f"{value:.2g} %" if math.isfinite(value) else "an unknown amount"

"""What ``fieldcal plan`` says: on the terminal, and as JSON (fieldcal.plan/1)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from calib.wording import VERDICT_WORDS
from daemon.output import table
from mission.encode import SUFFIXES
from mission.plan import stations
from mission.planned import Planned
from mission.rule import Finding
from mission.timing import minutes

SCHEMA = "fieldcal.plan/1"
#: What is not a mission.
_SHEET_WORDS = {".html": "plan sheet, open it in a browser", ".png": "plan sheet, a picture"}


def plan_json(planned: Planned) -> dict[str, Any]:
    """The whole result as plain data; what is not known or not finite is null."""
    plan, prediction, cost = planned.plan, planned.prediction, planned.timing
    photos = stations(plan)
    enu = np.array([[s.east_m, s.north_m, s.height_m] for s in photos]).reshape(-1, 3)
    geodetic = plan.launch.geodetic(enu)
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
        "findings": [_finding(f) for f in planned.findings],
        "notes": list(planned.notes),
        "stations": [
            {
                "lat": round(float(g[0]), 9),
                "lon": round(float((g[1] + 180) % 360 - 180), 9),
                "height_m": round(float(g[2]) - plan.launch.altitude_m, 3),
                "yaw_deg": round(s.yaw_deg % 360, 3),
                "pitch_deg": round(s.pitch_deg, 3),
                "pattern": s.pattern,
            }
            for g, s in zip(geodetic, photos, strict=True)
        ],
    }


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


def print_plan(planned: Planned, out: Console, written: list[Path], losses: list[str]) -> None:
    """Everything for the operator; broken rules come first."""
    out.print(f"{planned.plan.name}: {headline(planned)}")
    out.print(predicted(planned))
    out.print(planned.prediction.reason)
    rows = table("", "", "")
    rows.show_header = False
    for finding in sorted(planned.findings, key=lambda f: (f.ok, not f.hard)):
        sign = "✓" if finding.ok else ("✗" if finding.hard else "!")
        rows.add_row(sign, finding.rule, finding.message)
    out.print()
    out.print(rows)
    for note in (*planned.notes, *losses):
        out.print(f"Note: {note}")
    for path in written:
        out.print(f"Wrote {path} ({(SUFFIXES | _SHEET_WORDS)[path.suffix.lower()]}).")


def _percent(value: float) -> str:
    return f"{value:.2g} %" if math.isfinite(value) else "an unknown amount"

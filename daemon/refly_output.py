"""What ``fieldcal refly`` says: on the terminal, and as JSON (fieldcal.refly/1)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from calib.flown_file import FlownCheck
from calib.frames import LocalFrame
from daemon.output import table
from mission.encode import SUFFIXES
from mission.plan import Station
from mission.refly import Alternative, Refly

SCHEMA = "fieldcal.refly/1"
SHEET_WORDS = "sheet to fly by hand from, open it in a browser"


def no_pass_json(check: FlownCheck, why: str) -> dict[str, Any]:
    """The result where nothing can be planned at all, in the same form."""
    return _json(check, 0, 0.0, None, None, why, False, False)


def refly_json(pass_: Refly) -> dict[str, Any]:
    """The whole result as plain data; what is not known or not finite is null."""
    found, frame = pass_.found, pass_.flown.site.frame
    after = None
    if found is not None:
        after = {
            "sigma_f_percent": _finite(found.worth.sigma_f_percent),
            "dome_percent": _finite(found.worth.dome_percent),
        }
    data = _json(
        pass_.check,
        0 if found is None else len(found.stations),
        pass_.duration_s,
        after,
        pass_.binding_limit,
        pass_.reason,
        pass_.helps,
        pass_.cures,
    )
    return data | {
        "launch": {"lat": frame.latitude_deg, "lon": frame.longitude_deg},
        "stations": [] if found is None else _stations(found.stations, frame),
        "alternatives": [_alternative(a, frame) for a in pass_.alternatives],
        "findings": [
            {"rule": f.rule, "hard": f.hard, "ok": f.ok, "message": f.message} for f in pass_.findings
        ],
        "notes": list(pass_.notes),
    }


def _json(
    check: FlownCheck,
    photos: int,
    duration_s: float,
    after: dict[str, float | None] | None,
    limit: str | None,
    reason: str,
    helps: bool,
    cures: bool,
) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "photos": photos,
        "duration_s": round(duration_s, 1),
        "before": {
            "sigma_f_percent": _finite(check.sigma_f_percent),
            "dome_percent": _finite(check.dome_percent),
        },
        "after": after,
        "flying_helps": helps,
        "cures": cures,
        "binding_limit": limit,
        "reason": reason,
        "launch": None,
        "stations": [],
        "alternatives": [],
        "findings": [],
        "notes": [],
    }


def _stations(stations: Sequence[Station], frame: LocalFrame) -> list[dict[str, Any]]:
    enu = np.array([[s.east_m, s.north_m, s.height_m] for s in stations]).reshape(-1, 3)
    return [
        {
            "lat": round(float(g[0]), 9),
            "lon": round(float((g[1] + 180) % 360 - 180), 9),
            "height_m": round(s.height_m, 3),
            "yaw_deg": round(s.yaw_deg % 360, 3),
            "pitch_deg": round(s.pitch_deg, 3),
        }
        for g, s in zip(frame.geodetic(enu), stations, strict=True)
    ]


def _alternative(alternative: Alternative, frame: LocalFrame) -> dict[str, Any]:
    found = alternative.found
    return {
        "text": alternative.text,
        "photos": 0 if found is None else len(found.stations),
        "duration_s": None if found is None else round(found.seconds, 1),
        "sigma_f_percent": None if found is None else _finite(found.worth.sigma_f_percent),
        "dome_percent": None if found is None else _finite(found.worth.dome_percent),
        "stations": [] if found is None else _stations(found.stations, frame),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def print_refly(pass_: Refly, out: Console, written: Sequence[Path], losses: Sequence[str]) -> None:
    """Everything for the operator: what to fly, what else would do, what is broken."""
    out.print(pass_.reason)
    for alternative in pass_.alternatives:
        out.print(f"Instead: {alternative.text}")
    broken = [f for f in pass_.findings if not f.ok]
    if broken:
        rows = table("", "", "")
        rows.show_header = False
        for finding in sorted(broken, key=lambda f: not f.hard):
            rows.add_row("✗" if finding.hard else "!", finding.rule, finding.message)
        out.print()
        out.print(rows)
    elif pass_.findings:
        out.print(f"All {len(pass_.findings)} limits are kept.")
    for note in (*pass_.notes, *losses):
        out.print(f"Note: {note}")
    for path in written:
        out.print(f"Wrote {path} ({SUFFIXES.get(path.suffix.lower(), SHEET_WORDS)}).")
    if pass_.cures:
        out.print(
            "After the flight: fieldcal check CARD. The photos of the pass are known again by themselves."
        )

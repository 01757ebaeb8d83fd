"""The verdict campaign's sigmas and domes against what came out, as Markdown."""

from __future__ import annotations

import math
from collections.abc import Sequence

from benchmarks.verdict_cases import FACTORS
from benchmarks.verdict_rates import dome_rate, rate, rms
from benchmarks.verdict_score import Score
from benchmarks.verdict_tables import WORST, median, table

#: The level of the GPS that claims more than it holds.
LATE = "RTK, late and offset"


def sigmas(scores: Sequence[Score]) -> list[str]:
    """Errors in units of the stated sigma; 1 where it is honest, below where it is too careful."""

    def row(label: str, group: Sequence[Score]) -> tuple[object, ...]:
        cells: list[str] = []
        for name in ("z_f", "z_k1", "z_k2", "z_k3"):
            size, spread, n = rms(float(getattr(s, name)) for s in group)
            cells.append(f"{size:.2f} ± {spread:.2f}" if n else "–")
        known = [s for s in group if math.isfinite(s.df_percent)]
        held = rate(known, lambda s: abs(s.z_f) <= 3)
        growth = median(s.sigma_percent / s.formal_percent for s in known)
        ideal = median(s.sigma_percent / s.ideal_sigma_percent for s in known)
        return (label, len(known), *cells, held, growth, ideal)

    undisturbed = [s for s in scores if s.case.error == "none"]
    # Positions that are worse than they claim are an error of their own.
    clean = [s for s in undisturbed if s.case.gps != LATE]
    rows = [row("no model error, honest GPS: all", clean)]
    rows += [
        row(f"no model error: {p}", [s for s in clean if s.case.pattern == p]) for p in FACTORS["pattern"]
    ]
    for error in list(FACTORS["error"])[1:]:
        rows.append(row(error, [s for s in scores if s.case.error == error and s.case.gps != LATE]))
    rows.append(row(LATE, [s for s in scores if s.case.gps == LATE]))
    header = (
        "group",
        "flights",
        "f",
        "K1",
        "K2",
        "K3",
        "f within 3 sigma",
        "sigma / formal",
        "sigma / ideal",
    )
    return table(header, rows)


def far_off(scores: Sequence[Score]) -> list[str]:
    """Calibrations that are farther off than their sigmas allow, whatever the verdict."""
    far = sorted((s for s in scores if abs(s.z_f) > 3), key=lambda s: -abs(s.z_f))
    rows = [
        (
            s.case.number,
            s.verdict,
            f"{s.case.pattern}, {s.case.gps}, {s.case.noise}, {s.case.error}",
            f"{s.df_percent:+.3f} ± {s.sigma_percent:.3f}",
            f"{s.ideal_sigma_percent:.3f}",
            f"{s.z_f:+.1f}",
        )
        for s in far[:WORST]
    ]
    return table(("case", "verdict", "flight", "error of f, %", "ideal sigma, %", "sigmas"), rows)


def domes(scores: Sequence[Score]) -> list[str]:
    """Predicted against true."""
    rows: list[tuple[object, ...]] = []
    groups: list[tuple[str, Sequence[Score]]] = [("all", scores)]
    groups += [(e, [s for s in scores if s.case.error == e]) for e in FACTORS["error"]]
    groups += [(p, [s for s in scores if s.case.pattern == p]) for p in FACTORS["pattern"]]
    for label, group in groups:
        true = [s for s in group if s.case.reference == "true" and math.isfinite(s.true_dome_percent)]
        apart = [
            (s.predicted_dome_percent - s.true_dome_percent) / max(s.sigma_dome_percent, 1e-9) for s in true
        ]
        size = rms(apart)[0]
        rows.append((label, dome_rate(group), dome_rate(group, 0.1), f"{size:.2f}" if true else "–"))
    return table(
        ("group", "within 25 % or 2 sigma", "the same, domes over 0.1 % H", "rms difference in sigmas"), rows
    )

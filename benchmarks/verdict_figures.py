"""The verdict campaign's figures."""

from __future__ import annotations

import math
from collections.abc import Sequence

from benchmarks import svg
from benchmarks.verdict_cases import FACTORS
from benchmarks.verdict_rates import VERDICTS, counts
from benchmarks.verdict_score import Score

_COLOURS = ("#3a9d5d", "#d9534f", "#e0b13c", "#888888")


def figures(scores: Sequence[Score], design: Sequence[Score]) -> dict[str, str]:
    """Name of the file -> SVG."""
    series = list(zip(VERDICTS, _COLOURS, strict=True))
    by_pattern = [
        (p, counts([s for s in design if s.case.pattern == p and s.case.reference == "true"]))
        for p in FACTORS["pattern"]
    ]
    by_reference = [(r, counts([s for s in design if s.case.reference == r])) for r in FACTORS["reference"]]
    true = [
        (s.true_dome_percent, s.predicted_dome_percent)
        for s in scores
        if s.case.reference == "true" and math.isfinite(s.true_dome_percent)
    ]
    clean = [s.z_f for s in scores if s.case.error == "none" and math.isfinite(s.z_f)]
    dirty = [s.z_f for s in scores if s.case.error != "none" and math.isfinite(s.z_f)]

    def normal(t: float) -> float:
        return math.exp(-t * t / 2) / math.sqrt(2 * math.pi)

    label = "error of f in stated sigmas"
    return {
        "verdict_pattern.svg": svg.stacked_bars(
            "Verdict by flight pattern, true reference", by_pattern, series
        ),
        "verdict_reference.svg": svg.stacked_bars("Verdict by reference, all patterns", by_reference, series),
        "verdict_dome.svg": svg.scatter(
            "Predicted against true dome, true reference",
            ("true, % H", "predicted, % H"),
            true,
            0.6,
            _COLOURS[0],
        ),
        "verdict_f.svg": svg.histogram(
            "No model error, and the normal curve", label, clean, 5, normal, "#9ecae1"
        ),
        "verdict_f_error.svg": svg.histogram("With a model error", label, dirty, 5, normal, "#fdae6b"),
    }

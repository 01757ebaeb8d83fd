"""The refly campaign's report as Markdown."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from benchmarks.refly_cases import FACTORS
from benchmarks.refly_score import Flown, LoopScore
from benchmarks.verdict_rates import Rate
from benchmarks.verdict_tables import WORST, median, table

#: The remedies, as they stand in the tables.
REMEDIES: dict[str, Callable[[LoopScore], Flown | None]] = {
    "the recommended pass": lambda s: s.offered if s.offered is not None and s.offered.was_flown else None,
    "[C&D]'s eight photos": lambda s: s.paper,
    "a plain orbit of 8-12 photos": lambda s: s.orbit,
}


def cured(flown: Iterable[Flown]) -> Rate:
    """TRUST after the pass."""
    hits = [one.cured for one in flown]
    return Rate(sum(hits), len(hits))


def promised(scores: Iterable[LoopScore]) -> list[Flown]:
    """Recommended passes that were to cure."""
    return [s.offered for s in scores if s.offered is not None and s.offered.promised]


def _of(scores: Iterable[LoopScore], remedy: Callable[[LoopScore], Flown | None]) -> list[Flown]:
    return [one for one in map(remedy, scores) if one is not None]


def _ratio(flown: Sequence[Flown], achieved: Callable[[Flown], float], said: Callable[[Flown], float]) -> str:
    """Achieved over predicted: 10 %, median, 90 %."""
    found = [achieved(one) / said(one) for one in flown if math.isfinite(achieved(one))]
    if not found:
        return "–"
    low, middle, high = np.percentile(found, [10, 50, 90])
    return f"{middle:.2f} ({low:.2f}–{high:.2f})"


def _row(name: str, flown: Sequence[Flown]) -> tuple[object, ...]:
    return (
        name,
        len(flown),
        cured(flown),
        median((one.planned for one in flown), 0),
        median((one.seconds for one in flown), 0),
        median((one.sigma_percent for one in flown), 3),
        median((one.check.sigma_percent for one in flown), 3),
    )


_HEADER = ("", "flown", "TRUST afterwards", "photos", "seconds", "predicted sigma f %", "achieved")


def summary(asked: Sequence[LoopScore]) -> list[str]:
    """The remedies beside each other."""
    sold = promised(asked)
    first = "the recommended pass, where it promised a cure"
    rows = [_row(first, sold), *(_row(name, _of(asked, remedy)) for name, remedy in REMEDIES.items())]
    lines = table(_HEADER, rows)
    f = _ratio(sold, lambda one: one.check.sigma_percent, lambda one: one.sigma_percent)
    dome = _ratio(sold, lambda one: one.check.sigma_dome_percent, lambda one: one.dome_percent)
    lines += [
        f"Achieved over predicted, median (10–90 %): sigma of f {f}, sigma of the dome {dome}. Predictions "
        "carry the model error factor; what the check states carries what it found of that itself.",
        "",
    ]
    return lines


def by_factor(asked: Sequence[LoopScore], factor: str) -> list[str]:
    """One factor's levels."""
    rows = []
    for level in FACTORS[factor]:
        group = [s for s in asked if s.case.level(factor) == level]
        sold = promised(group)
        rows.append(
            (
                level, len(group), len(sold), cured(sold),
                median((one.planned for one in sold), 0), median((one.seconds for one in sold), 0),
                cured(_of(group, REMEDIES["[C&D]'s eight photos"])),
                median((one.seconds for one in _of(group, REMEDIES["[C&D]'s eight photos"])), 0),
                cured(_of(group, REMEDIES["a plain orbit of 8-12 photos"])),
            )
        )  # fmt: skip
    header = (factor, "flights", "cure promised", "TRUST", "photos", "seconds", "eight photos: TRUST",
              "seconds", "orbit: TRUST")  # fmt: skip
    return table(header, rows)


def left(asked: Sequence[LoopScore]) -> list[str]:
    """Single flights that a promised pass did not cure, and why none was promised to others."""
    rows = [
        (s.case.number, s.case.level("area"), s.case.pattern, s.case.level("error"), one.photos,
         f"{one.sigma_percent:.3f} / {one.check.sigma_percent:.3f}",
         f"{one.dome_percent:.3f} / {one.check.sigma_dome_percent:.3f}",
         f"{one.check.verdict}: {', '.join(one.check.flagged or one.check.open)}")
        for s in asked
        if (one := s.offered) is not None and one.promised and not one.cured
    ][:WORST]  # fmt: skip
    lines = ["Promised, flown, and not trusted (predicted / achieved):", ""]
    lines += table(
        ("flight", "area", "pattern", "error", "photos flown", "sigma f %", "dome %", "verdict"), rows
    )
    none = Counter(
        "the best that can be had was not enough" if s.offered is not None else s.reason.split(":")[0][:90]
        for s in asked
        if s.offered is None or not s.offered.promised
    )
    lines += ["No cure was promised:", ""]
    lines += table(("why", "flights"), none.most_common())
    return lines


def _medians(asked: Sequence[LoopScore]) -> str:
    sold = promised(asked)
    return (
        f"{len(asked)} flights, a cure for {len(sold)}, median "
        f"{median((one.planned for one in sold), 0)} photos and {median((one.seconds for one in sold), 0)} s"
    )


def report(scores: Sequence[LoopScore], text: str) -> str:
    """Everything; ``text`` says what was done."""
    asked = [s for s in scores if s.asked]
    two = [
        s for s in asked
        if s.case.level("area") == "2 ha" and s.case.pattern == "nadir" and 50 <= s.height_m <= 70
    ]  # fmt: skip
    lines = [
        "# Does the extra pass cure?",
        "",
        *text.strip().splitlines(),
        "",
        f"{len(scores)} flights of {min(s.photos for s in scores)}-{max(s.photos for s in scores)} photos, "
        f"of which {len(asked)} got REFLY for their geometry. CPU seconds of a flight: median "
        f"{median((s.cpu_s for s in scores), 1)}, of the search for a pass "
        f"{median((s.refly_s for s in asked), 1)}. "
        "The whole way with rendered photos: refly_rendered.md.",
        "",
        *summary(asked),
        "## By area",
        "",
        *by_factor(asked, "area"),
        f"Of these 2 ha straight down from about 60 m: {_medians(two)}; without an error of the lens, the "
        f"shutter or the noise's shape: {_medians([s for s in two if s.case.level('error') == 'none'])}.",
        "",
        "## By what disturbs",
        "",
    ]
    for factor in ("error", "shutter", "matching", "tie points", "noise", "pattern", "relief", "gps", "lens"):
        lines += by_factor(asked, factor)
    lines += ["## What is left", "", *left(asked)]
    return "\n".join(lines)

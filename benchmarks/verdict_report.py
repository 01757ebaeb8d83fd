"""The verdict campaign's report: Markdown and figures."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import benchmarks.verdict_score as verdict_score
from benchmarks.verdict_cases import FACTORS, PAPERS
from benchmarks.verdict_figures import figures
from benchmarks.verdict_precision import domes, far_off, sigmas
from benchmarks.verdict_rates import (
    VERDICTS,
    cannot_tell,
    cannot_tell_though_clear,
    counts,
    false_refly,
    false_trust,
    open_at_best,
    rate,
    rules,
    trust_that_is_wrong,
    why_trust_wrong,
)
from benchmarks.verdict_score import Score
from benchmarks.verdict_tables import WORST, median, table
from calib.limits import FOCAL_SIGMA_PERCENT


def _open_at_best(scores: Sequence[Score]) -> str:
    return f"{open_at_best(scores):.1f}"


def headline(design: Sequence[Score], papers: Sequence[Score]) -> list[str]:
    """The rates that count, with their targets."""
    rows = [
        ("false TRUST, of flights where TRUST would be false", "0.5 %", false_trust),
        ("false TRUST, of all TRUST verdicts", "0.5 %", trust_that_is_wrong),
        ("false REFLY, of flights where REFLY would be false", "3 %", false_refly),
        (
            "CANNOT_TELL, where an ideal adjustment settles it (p >= 0.9)",
            "10 %",
            cannot_tell_though_clear,
        ),
        ("CANNOT_TELL, where sigma of f can be 0.051 % or less", "–", cannot_tell),
        (
            "the same flights, left open by an ideal adjustment (expected)",
            "–",
            lambda g: f"{open_at_best(g):.1f}",
        ),
    ]
    return table(
        ("what", "target at most", "balanced design", "the papers' flights"),
        [(name, target, of(design), of(papers)) for name, target, of in rows],
    )


def factors(design: Sequence[Score]) -> list[str]:
    """One table a factor, a row a level."""
    lines = []
    for factor, levels in FACTORS.items():
        rows = []
        for level in levels:
            group = [s for s in design if s.case.level(factor) == level]
            rows.append(
                (
                    level,
                    len(group),
                    ", ".join(map(str, counts(group))),
                    false_trust(group),
                    false_refly(group),
                    cannot_tell(group),
                )
            )
        header = (
            factor,
            "flights",
            "TRUST, REFLY, CANNOT_TELL, none",
            "false TRUST",
            "false REFLY",
            "CANNOT_TELL where f can be fixed",
        )
        lines += table(header, rows)
    return lines


def of_the_papers(papers: Sequence[Score]) -> list[str]:
    """[C&D]'s flights with a good reference, ordinary conditions."""
    wanted = {"A1": "REFLY", "B1": "REFLY"} | dict.fromkeys(("A3", "A4", "B3", "B4"), "TRUST")
    rows = []
    for name in PAPERS:
        lens = "dji-phantom-3-professional" if name[0] == "A" else "dji-inspire-1"
        group = [s for s in papers if s.case.lens == lens and s.case.pattern == "A" + name[1]]
        want = wanted.get(name)
        met = "–" if want is None else rate(group, lambda s, want=want: s.verdict == want)  # type: ignore[misc]
        sizes = median((abs(s.df_percent) for s in group), 3)
        sigma = median((s.sigma_percent for s in group), 3)
        rows.append(
            (
                name,
                *counts(group),
                want or "–",
                met,
                f"{sizes} / {sigma}",
            )
        )
    return table(
        ("flight", *VERDICTS, "wanted", "as wanted", "median abs error of f / sigma, %"),
        rows,
    )


def by_knowledge(scores: Sequence[Score]) -> list[str]:
    """Verdicts of good calibrations against a true reference by what the photos could know of f."""
    edges = (0.0, 0.01, 0.015, 0.02, 0.025, 0.03, 0.04, FOCAL_SIGMA_PERCENT)
    rows = []
    for low, high in itertools.pairwise(edges):
        group = [
            s
            for s in scores
            if s.case.reference == "true" and low <= s.ideal_sigma_percent < high and not s.calibration_bad()
        ]
        met = rate(group, lambda s: s.verdict == "TRUST")
        rows.append((f"{low:.3f}–{high:.3f}", len(group), ", ".join(map(str, counts(group))), met))
    header = ("ideal sigma of f, %", "flights", "TRUST, REFLY, CANNOT_TELL, none", "trusted")
    return table(header, rows)


def causes(scores: Sequence[Score]) -> list[str]:
    """Which rules were behind wrong and open verdicts."""
    wrong = [s for s in scores if s.false_trust]
    lines = ["False TRUST, by what was overlooked:", ""]
    lines += table(("overlooked", "flights"), rules(wrong, lambda s: (why_trust_wrong(s),)))
    lines += ["False REFLY, by the rules that were flagged:", ""]
    lines += table(("flagged", "flights"), rules([s for s in scores if s.false_refly], lambda s: s.flagged))
    lines += [
        "CANNOT_TELL where the photos can fix f, by what was left open (or, of alignment, flagged):",
        "",
    ]
    silent = [s for s in scores if s.should_tell and s.verdict == "CANNOT_TELL"]
    lines += table(("open", "flights"), rules(silent, lambda s: (*s.flagged, *s.open)))
    return lines


def severity(one: Score) -> float:
    """How wrong a wrong verdict is: the largest true excess over its limit, for ordering."""
    if one.false_refly:
        return 0.5
    sizes = [abs(one.df_percent), abs(one.true_dome_percent)]
    if one.decides:
        sizes += [abs(one.ref_df_percent), 0.1 * one.ref_deviation_px / one.tolerance_px]
    return max(size for size in sizes if math.isfinite(size)) / 0.1


def worst(scores: Sequence[Score]) -> list[str]:
    """The wrong verdicts, false TRUST first."""
    wrong = [s for s in scores if s.false_trust or s.false_refly]
    wrong.sort(key=lambda s: (not s.false_trust, -severity(s), s.case.number))
    rows = [
        (
            s.case.number,
            ("false " if s.false_trust or s.false_refly else "") + s.verdict,
            f"{s.case.pattern}, {s.case.lens}, {s.case.gps}, {s.case.noise}, {s.case.error}; "
            f"reference {s.case.reference}",
            f"{s.df_percent:+.3f} ± {s.sigma_percent:.3f}",
            f"{s.true_dome_percent:+.3f}",
            why_trust_wrong(s) if s.false_trust else ", ".join(s.flagged),
        )
        for s in wrong[:WORST]
    ]
    more = (
        [f"{len(wrong) - WORST} more wrong verdicts are in the raw numbers.", ""]
        if len(wrong) > WORST
        else []
    )
    return table(("case", "verdict", "flight", "error of f, %", "true dome, % H", "why"), rows) + more


def markdown(scores: Sequence[Score]) -> str:
    """The report."""
    design = [s for s in scores if s.case.part == "design"]
    papers = [s for s in scores if s.case.part == "papers"]
    definition = (verdict_score.__doc__ or "").split("\n\n", 1)[1].strip()
    cost = [s.cpu_s for s in scores if math.isfinite(s.cpu_s)]
    sections = [
        "# How often the verdict is right",
        "",
        f"{len(design)} simulated flights of a balanced random design and {len(papers)} of the papers' "
        "flights, each through the field check's own adjustment, uncertainty, evidence and rules, and then "
        "against its truth. Observation level: tie points with noise, no images. Shares are given with "
        "their 95 % intervals (Wilson). One flight in full: `python -m benchmarks.verdict --case N`.",
        "",
        definition,
        "",
        "## Rates",
        "",
        *headline(design, papers),
        "![by pattern](verdict_pattern.svg) ![by reference](verdict_reference.svg)",
        "",
        "## The papers' flights",
        "",
        "White GPS noise of 2.5 m, 0.5 px, 1 % mismatches, a reference as good as a calibration on site.",
        "",
        *of_the_papers(papers),
        "## By what the photos can know",
        "",
        "True reference, calibration truly within 0.1 %: all deserve TRUST. 95 % certainty of 0.1 % asks for "
        "a sigma well below the largest with which 0.1 % can be decided at all.",
        "",
        *by_knowledge(scores),
        "## By factor",
        "",
        "Every other factor is spread evenly over the levels of each.",
        "",
        *factors(design),
        "## Which rules",
        "",
        *causes(scores),
        "## Sigmas against scatter",
        "",
        "Rms of (found - true) / stated sigma over the flights; honest is 1, wanted is 0.77 to 1.3 without "
        "model error. Formal: before inflation. Ideal: an adjustment that knows what disturbs the flight.",
        "",
        *sigmas(scores),
        "![without model error](verdict_f.svg) ![with](verdict_f_error.svg)",
        "",
        "Farther off than 3 stated sigmas:",
        "",
        *far_off(scores),
        "## Predicted dome against true dome",
        "",
        "With a true reference; wanted is 95 %.",
        "",
        *domes(scores),
        "![dome](verdict_dome.svg)",
        "",
        "## The worst cases",
        "",
        *worst(scores),
        f"{sum(cost) / 3600:.1f} CPU-hours in all, {median(cost, 1)} s a flight.",
        "",
    ]
    return "\n".join(sections)


def write_report(scores: Sequence[Score], out: Path) -> None:
    """``verdict.md`` and its figures into the folder ``out``."""
    (out / "verdict.md").write_text(markdown(scores), encoding="utf-8")
    design = [s for s in scores if s.case.part == "design"]
    for name, content in figures(scores, design).items():
        (out / name).write_text(content, encoding="utf-8")

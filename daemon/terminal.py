"""The outcome of a check in the terminal: short, 80 columns, no markup from files."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.text import Text

from calib.extra_pass import extra_pass_words
from calib.findings import Finding, State, Verdict
from calib.result import CheckResult
from calib.wording import (
    NO_BREAK_SPACE,
    STATE_ORDER,
    VERDICT_WORDS,
    all_left_out,
    camera_name,
    left_out_by_reason,
    ordered_findings,
    path_text,
    photos_given,
    printable,
    with_bound_units,
)

_STYLES = {State.PASS: "green", State.FLAG: "bold red", State.UNKNOWN: "yellow"}
BADGES = {
    Verdict.TRUST: "bold white on green",
    Verdict.REFLY: "bold white on red",
    Verdict.CANNOT_TELL: "bold black on yellow",
}
_SIGNS = {State.PASS: "✓", State.FLAG: "✗", State.UNKNOWN: "?"}
#: For terminals that cannot show the signs above.
_PLAIN_SIGNS = {State.PASS: "ok", State.FLAG: "!!", State.UNKNOWN: "?"}
_WIDTH = 80
#: On narrower terminals a finding's words go below its name.
_NARROW = 60
#: Lines about photos left out, and names on each; the report lists them all.
_REASONS, _NAMES = 5, 3


def print_summary(
    result: CheckResult, console: Console, report: Path | None = None, notes: Sequence[str] = ()
) -> None:
    """Print verdict, headline, findings, what to fly and where the report is.

    ``report`` is the path of report.html (None: none was written), ``notes`` what the reading of the
    photos remarked. Colours and width follow ``console``; lines are at most 80 columns long.
    """
    say = partial(paragraph, console)
    for note in notes:
        say(note)
    console.print()
    print_headline(console, VERDICT_WORDS[result.verdict], result.verdict, result.headline)
    console.print()
    left_out = len(all_left_out(result))
    facts = (
        f"{camera_name(result.camera)}, {photos_given(result)} photos, {len(result.solution.photos)} aligned"
    )
    say(facts + (f", {left_out} left out" if left_out else ""), "dim")
    if result.reference is not None:
        say(result.reference_note, "dim")
    for line in _left_out(result):
        say(line, "dim", "  ")
    console.print()
    print_findings(result.findings, console)
    brought = extra_pass_words(result)
    if brought is not None:
        console.print()
        console.print(Text("The extra pass", style="bold"))
        say(brought, indent="  ")
    if result.what_to_fly is not None:
        console.print()
        console.print(Text("What to fly", style="bold"))
        say(result.what_to_fly, indent="  ")
    if report is not None:
        console.print()
        # One line however long, so that it can be copied.
        console.print(Text(f"Report: {path_text(report)}"), soft_wrap=True)


def columns(console: Console) -> int:
    """How wide words are set."""
    return max(min(console.width, _WIDTH), 20)


def paragraph(
    console: Console, text: str, style: str = "", indent: str = "", hanging: str | None = None
) -> None:
    """Words in lines that start with ``indent``, and from the second on with ``hanging`` (None: the same)."""
    for line in wrapped(text, columns(console), indent, indent if hanging is None else hanging):
        console.print(Text(line, style=style), soft_wrap=True)


def print_headline(console: Console, words: str, verdict: Verdict, headline: str) -> None:
    """What came out, on the verdict's colour, and the sentence behind it."""
    badge = f" {words} "
    first, *rest = wrapped(headline, columns(console), " " * (len(badge) + 2))
    console.print(Text.assemble((badge, BADGES[verdict]), first[len(badge) :]), soft_wrap=True)
    for line in rest:
        console.print(Text(line), soft_wrap=True)


def wrapped(text: str, width: int, first: str = "", others: str = "") -> list[str]:
    """Lines of at most ``width`` columns that start with ``first``, and then with ``others``."""
    bound = with_bound_units(printable(text))
    lines = textwrap.wrap(
        bound, width, initial_indent=first, subsequent_indent=others, break_on_hyphens=False
    )
    return [line.replace(NO_BREAK_SPACE, " ") for line in lines] or [first]


def _left_out(result: CheckResult) -> list[str]:
    """Which photos were left out and why, the commonest reasons first."""
    groups = sorted(left_out_by_reason(result).items(), key=lambda group: -len(group[1]))
    lines = []
    for reason, paths in groups[:_REASONS]:
        names = ", ".join(path_text(Path(path.name)) for path in paths[:_NAMES])
        more = f" and {len(paths) - _NAMES} more" if len(paths) > _NAMES else ""
        lines.append(f"{names}{more}: {reason}")
    others = sum(len(paths) for _, paths in groups[_REASONS:])
    return lines + ([f"{others} more, named in the report"] if others else [])


def _signs(console: Console) -> dict[State, str]:
    try:
        "".join(_SIGNS.values()).encode(console.encoding)
    except (UnicodeEncodeError, LookupError):
        return _PLAIN_SIGNS
    return _SIGNS


def print_findings(findings: tuple[Finding, ...], console: Console) -> None:
    """All findings, what went wrong first."""
    width = columns(console)
    signs = _signs(console)
    sign_width = max(map(len, signs.values())) + 1
    rules = [printable(finding.rule) for finding in findings]
    column = sign_width + max(map(len, rules), default=0) + 1
    beside = width >= _NARROW
    for state in STATE_ORDER:
        for finding in ordered_findings(findings, state):
            label = f"{signs[state]:<{sign_width}}{printable(finding.rule)}"
            indent = " " * (column if beside else sign_width)
            lines = wrapped(finding.message, width, indent, indent)
            if beside:
                lines[0] = lines[0][len(label) :]
                console.print(Text.assemble((label, _STYLES[state]), lines.pop(0)), soft_wrap=True)
            else:
                console.print(Text(label, style=_STYLES[state]), soft_wrap=True)
            for line in lines:
                console.print(Text(line), soft_wrap=True)

"""The outcome of a check in the terminal: short, 80 columns, no markup from files."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from calib.findings import State, Verdict
from calib.result import CheckResult
from calib.wording import (
    STATE_ORDER,
    VERDICT_WORDS,
    all_left_out,
    camera_name,
    ordered_findings,
    path_text,
    photos_given,
    printable,
)

_STYLES = {State.PASS: "green", State.FLAG: "bold red", State.UNKNOWN: "yellow"}
_VERDICT_STYLES = {
    Verdict.TRUST: "bold white on green",
    Verdict.REFLY: "bold white on red",
    Verdict.CANNOT_TELL: "bold black on yellow",
}
_SIGNS = {State.PASS: "✓", State.FLAG: "✗", State.UNKNOWN: "?"}
#: For terminals that cannot show the signs above.
_PLAIN_SIGNS = {State.PASS: "ok", State.FLAG: "!!", State.UNKNOWN: "?"}
_WIDTH = 80


def print_summary(result: CheckResult, console: Console, report: Path | None = None) -> None:
    """Print verdict, headline, findings, what to fly and where the report is.

    ``report`` is the path of report.html (None: none was written). Colours and width follow
    ``console``; lines are at most 80 columns long.
    """
    width = min(console.width, _WIDTH)
    solution = result.solution
    console.print()
    line = Text.assemble(
        (f" {VERDICT_WORDS[result.verdict]} ", _VERDICT_STYLES[result.verdict]),
        "  ",
        printable(result.headline),
    )
    console.print(line, width=width)
    left_out = len(all_left_out(result))
    facts = f"{camera_name(result.camera)}, {photos_given(result)} photos, {len(solution.photos)} aligned"
    facts += f", {left_out} left out" if left_out else ""
    console.print(Text(facts, style="dim"), width=width)
    console.print()
    console.print(_findings(result, _signs(console)), width=width)
    if result.what_to_fly is not None:
        console.print()
        console.print(Text("What to fly", style="bold"))
        console.print(Padding(Text(printable(result.what_to_fly)), (0, 0, 0, 2)), width=width)
    if report is not None:
        console.print()
        # One line however long, so that it can be copied.
        console.print(Text(f"Report: {path_text(report)}"), soft_wrap=True)


def _signs(console: Console) -> dict[State, str]:
    try:
        "".join(_SIGNS.values()).encode(console.encoding)
    except (UnicodeEncodeError, LookupError):
        return _PLAIN_SIGNS
    return _SIGNS


def _findings(result: CheckResult, signs: dict[State, str]) -> Table:
    table = Table.grid(padding=(0, 1))
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(ratio=1, overflow="fold")
    table.expand = True
    for state in STATE_ORDER:
        for finding in ordered_findings(result.findings, state):
            table.add_row(
                Text(signs[state], style=_STYLES[state]),
                Text(printable(finding.rule), style=_STYLES[state]),
                Text(printable(finding.message)),
            )
    return table

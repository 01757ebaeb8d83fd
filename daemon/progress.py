"""One progress line on stderr for long work."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn

#: Called with the stage's name, how much is done and how much there is (0: not known).
Report = Callable[[str, int, int], None]


def _nothing(stage: str, done: int, total: int) -> None:
    del stage, done, total


@contextmanager
def progress_line(hidden: bool, first: str) -> Iterator[Report]:
    """A line that names the stage, ``first`` until the first report; gone at the end."""
    if hidden:
        yield _nothing
        return
    bar = Progress(
        SpinnerColumn(),
        TextColumn("{task.description:<22}"),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        console=Console(stderr=True),
        transient=True,
    )
    with bar:
        task = bar.add_task(first, total=None)

        def report(stage: str, done: int, total: int) -> None:
            bar.update(task, description=stage, completed=done if total else 0, total=total or None)

        yield report


@contextmanager
def late_line(opened: Callable[[str], AbstractContextManager[Report]]) -> Iterator[Report]:
    """A line that appears with its first report, so that a question can be asked before."""
    line: Report | None = None
    with ExitStack() as stack:

        def report(stage: str, done: int, total: int) -> None:
            nonlocal line
            if line is None:
                line = stack.enter_context(opened(stage))
            line(stage, done, total)

        yield report

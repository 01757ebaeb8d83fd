"""Writing results where the user asked for them: terminal tables and JSON."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from calib.errors import OutputError

#: For commands that write what they tell as data.
JsonOption = Annotated[
    str | None,
    typer.Option("--json", metavar="FILE|-", help="Write JSON (-: to stdout and nothing else)."),
]


def console(to_stderr: bool = False) -> Console:
    """A console that prints text as it is: no markup, no emoji, no colouring of numbers."""
    return Console(markup=False, emoji=False, highlight=False, stderr=to_stderr)


def table(*columns: str, title: str | None = None, numbers: tuple[str, ...] = ()) -> Table:
    """A plain table for 80 columns; ``numbers`` are the columns set flush right."""
    made = Table(title=None if title is None else Text(title), title_justify="left", box=None, pad_edge=False)
    for column in columns:
        made.add_column(Text(column), justify="right" if column in numbers else "left", overflow="fold")
    return made


def write_json(data: object, target: str) -> None:
    """Write ``data`` to the file ``target``, or alone to stdout for "-".

    Raises:
        OutputError: the file cannot be written.
    """
    text = json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    if target == "-":
        write_stdout(text)
        return
    try:
        Path(target).write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{target} cannot be written: {error.strerror}.") from error


def write_stdout(text: str) -> None:
    """Write ``text`` to stdout as UTF-8, whatever the terminal's encoding: programs read it."""
    if sys.stdout is None:
        raise OutputError("Standard output is closed, so nothing can be written there.")
    sys.stdout.flush()
    sys.stdout.buffer.write(text.encode("utf-8"))
    sys.stdout.buffer.flush()

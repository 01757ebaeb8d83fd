"""Tables, raw results that survive a restart, and work spread over processes."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

Work = TypeVar("Work")


@dataclass
class Place:
    """Where a run writes: the folder of the figures and that of the raw results; and its processes."""

    figures: Path
    raw: Path
    workers: int = 2


@dataclass
class Section:
    """One part of the page: Markdown lines, figures by relative path."""

    title: str
    lines: list[str] = field(default_factory=list)

    def say(self, *paragraphs: str) -> None:
        for text in paragraphs:
            self.lines += [text, ""]

    def table(self, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        self.lines += [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
        self.lines += [f"| {' | '.join(row)} |" for row in rows]
        self.lines.append("")

    def figure(self, path: Path, caption: str) -> None:
        """``path`` lies in the folder of figures, which is beside the page."""
        self.lines += [f"![{caption}]({path.parent.name}/{path.name})", "", f"*{caption}*", ""]

    @property
    def text(self) -> str:
        return "\n".join([f"## {self.title}", "", *self.lines])


def computed(
    name: str,
    work: Callable[[Work], dict[str, Any]],
    cases: Sequence[Work],
    place: Place,
    chunk: int = 1,
) -> list[dict[str, Any]]:
    """``work`` of every case, in order; JSON lines of what is done already are kept and used again.

    Cases are dataclasses; ``work`` is a function of a module, for it runs in other processes.
    """
    place.raw.mkdir(parents=True, exist_ok=True)
    raw = place.raw / f"{name}.jsonl"
    done: dict[str, dict[str, Any]] = {}
    if raw.exists():
        text = raw.read_text(encoding="utf-8")
        for line in text.splitlines():
            try:
                entry = json.loads(line)
            except json.JSONDecodeError:
                continue  # A run that was stopped may leave half a line.
            done[entry["case"]] = entry["result"]
        if text and not text.endswith("\n"):
            raw.write_text(text + "\n", encoding="utf-8")
    keys = [json.dumps(asdict(case)) for case in cases]  # type: ignore[call-overload]
    todo = [(key, case) for key, case in zip(keys, cases, strict=True) if key not in done]
    if todo:
        started = time.monotonic()
        with ProcessPoolExecutor(place.workers) as pool, raw.open("a", encoding="utf-8") as out:
            results = pool.map(work, [case for _, case in todo], chunksize=chunk)
            for index, ((key, _), result) in enumerate(zip(todo, results, strict=True)):
                done[key] = result
                out.write(json.dumps({"case": key, "result": result}) + "\n")
                out.flush()
                left = (time.monotonic() - started) / (index + 1) * (len(todo) - index - 1)
                print(f"\r{name}: {index + 1} of {len(todo)}, {left:.0f} s left ", end="", file=sys.stderr)
        print(file=sys.stderr)
    return [done[key] for key in keys]


def sci(value: float, digits: int = 3) -> str:
    """1.234e-15 as papers print it."""
    return f"{value:.{digits}e}"


def percent_off(ours: float, theirs: float) -> str:
    return f"{100 * (ours / theirs - 1):+.1f} %"

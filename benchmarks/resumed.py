"""Rows of a campaign, one JSON line a flight, so that a run can be broken off and taken up again."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class Asked:
    """What a campaign's command line asks for; ``case``: one flight to be shown."""

    flights: int
    workers: int
    case: int | None
    out: Path


def asked(doc: str | None, flights: int, arguments: Sequence[str] | None, workers: int = 2) -> Asked:
    """Of ``flights`` at most, unless told otherwise, with results beside this file."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=flights)
    parser.add_argument("--workers", type=int, default=workers)
    parser.add_argument("--case", type=int, help="show this flight and write nothing")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    return Asked(**vars(parser.parse_args(arguments)))


def read_rows(raw: Path, made: Callable[[dict[str, Any]], T]) -> list[T]:
    """What is there already; without a line cut short and those of another design."""
    found = []
    for line in raw.read_text().splitlines() if raw.exists() else []:
        with contextlib.suppress(json.JSONDecodeError, TypeError, KeyError):
            found.append(made(json.loads(line)))
    return found


def run_rows(
    flights: int,
    raw: Path,
    workers: int,
    scored: Callable[[int], T],
    row: Callable[[T], Mapping[str, object]],
    known: Mapping[int, T],
) -> list[T]:
    """Flights 0 to ``flights`` - 1, those not ``known`` appended to ``raw`` (JSON lines) as they come."""
    done = dict(known)
    todo = [number for number in range(flights) if number not in done]
    started = time.monotonic()
    if raw.exists() and not raw.read_bytes().endswith(b"\n") and raw.stat().st_size:
        with raw.open("a") as out:
            out.write("\n")
    with contextlib.ExitStack() as stack:
        out = stack.enter_context(raw.open("a"))
        each = map if workers == 1 else stack.enter_context(ProcessPoolExecutor(workers)).map
        for index, (number, one) in enumerate(zip(todo, each(scored, todo), strict=True)):
            out.write(json.dumps(row(one)) + "\n")
            out.flush()
            done[number] = one
            left = (time.monotonic() - started) / (index + 1) * (len(todo) - index - 1)
            print(f"\r{index + 1} of {len(todo)}, {left / 60:.0f} min left ", end="", file=sys.stderr)
    if todo:
        print(file=sys.stderr)
    return [done[number] for number in range(flights)]

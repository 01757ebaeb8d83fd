"""How often is the verdict right? Thousands of simulated flights against truth.

    python -m benchmarks.verdict [--flights 2000] [--workers 2]
    python -m benchmarks.verdict --case N

Writes benchmarks/verdict.md with its figures, and the raw numbers beside it; flights that are
there already are kept, so a run can be broken off and taken up again. Observation level: tie
points with noise, no images. Everything behind the tie points is the field check's own code.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.resumed import asked, read_rows, run_rows
from benchmarks.verdict_cases import case
from benchmarks.verdict_report import write_report
from benchmarks.verdict_score import Score, from_row, score, to_row

HERE = Path(__file__).parent


def _score_number(number: int) -> Score:
    return score(case(number))


def read_scores(raw: Path) -> dict[int, Score]:
    """Flights already scored, by number; without those of another design."""
    rows = read_rows(raw, from_row)
    return {one.case.number: one for one in rows if one.case == case(one.case.number)}


def run(flights: int, raw: Path, workers: int, scored: Callable[[int], Score] = _score_number) -> list[Score]:
    """Scores of cases 0 to ``flights`` - 1, appended to ``raw`` (JSON lines) as they come."""
    return run_rows(flights, raw, workers, scored, to_row, read_scores(raw))


def show(number: int) -> None:
    """One flight in full, on standard output."""
    one = _score_number(number)
    for name, value in to_row(one).items():
        print(f"{name:24} {value}")
    for name in ("observable", "reference_bad", "trust_wrong", "refly_wrong", "false_trust", "false_refly"):
        print(f"{name:24} {getattr(one, name)}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the campaign, or show one case."""
    given = asked(__doc__, 2000, arguments)
    if given.case is not None:
        show(given.case)
        return
    write_report(run(given.flights, given.out / "verdict.jsonl", given.workers), given.out)


if __name__ == "__main__":
    main()

"""Does the recommended pass cure? Weak flights, the pass flown as people fly, checked again.

    python -m benchmarks.refly_loop [--flights 1000] [--workers 2]
    python -m benchmarks.refly_loop --case N

Writes benchmarks/refly.md, and the raw numbers beside it; flights that are there already are kept, so a
run can be broken off and taken up again.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from benchmarks.refly_cases import loop_case
from benchmarks.refly_report import report
from benchmarks.refly_score import LoopScore, from_row, score, to_row
from benchmarks.resumed import asked, read_rows, run_rows

HERE = Path(__file__).parent
WHAT = """
Weak flights of a balanced random design (`python -m benchmarks.refly_loop`; one flight in full: `--case
N`): checked, and where the geometry is at fault the pass that `fieldcal refly` recommends from the check's
own network.npz is flown with errors of 2 m and 2 degrees (standard deviations per axis) and 5 % of its
photos missing, and old and new photos are checked together, against a reference made on site. Beside it,
flown as badly, [C&D]'s eight photos on every sixth flight, and an orbit of 8, 10 or 12 photos 35 degrees
off nadir on every sixth; of recommended passes that promise no cure every fourth is flown. Photos of the
recommended pass are known again by the check, so it knows that they were taken standing. Half of the
cameras are known to have a mechanical shutter, none of those whose shutter rolls. Observation level: tie
points with noise, no images; 125 tie points a photo are simulated, measured as well as the means of the 250
or 500 that they stand for. Views from aside are matched as rarely as those of rendered photos, or fall off
at 0.85 or 1.15 times their angles. Time is from the ground at a launch point on the site's edge and back.
"""


def _score_number(number: int) -> LoopScore:
    return score(loop_case(number))


def run(flights: int, raw: Path, workers: int) -> list[LoopScore]:
    """Scores of flights 0 to ``flights`` - 1, appended to ``raw`` (JSON lines) as they come."""
    known = {one.case.number: one for one in read_rows(raw, from_row)}
    return run_rows(flights, raw, workers, _score_number, to_row, known)


def show(number: int) -> None:
    """One flight in full, on standard output."""
    for name, value in to_row(_score_number(number)).items():
        parts = value.items() if isinstance(value, dict) else [("", value)]
        for part, content in parts:
            print(f"{name:12} {part:18} {content}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the campaign, or show one flight."""
    given = asked(__doc__, 1000, arguments)
    if given.case is not None:
        show(given.case)
        return
    scores = run(given.flights, given.out / "refly_loop.jsonl", given.workers)
    (given.out / "refly.md").write_text(report(scores, WHAT))


if __name__ == "__main__":
    main()

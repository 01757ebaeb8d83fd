"""Markdown tables of the verdict campaign."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

#: At most so many single flights in a list.
WORST = 25


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> list[str]:
    """Rows as Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return [f"| {' | '.join(str(cell) for cell in line)} |" for line in lines] + [""]


def median(values: Iterable[float], digits: int = 2) -> str:
    """Median of the finite values; a dash where there are none."""
    finite = [v for v in values if math.isfinite(v)]
    return f"{np.median(finite):.{digits}f}" if finite else "–"

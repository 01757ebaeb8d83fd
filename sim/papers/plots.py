"""One look for all figures: readable at the width of a page on a code host."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

OURS, THEIRS, THIRD, FOURTH = "#b03000", "#00508c", "#00592b", "#7a3e9d"
GRID = "#d0d0d0"


def figure(columns: int, rows: int = 1, height: float = 4.2) -> tuple[Figure, list[Axes]]:
    """A figure of 10 inches width and its axes, row by row."""
    style: Any = {
        "font.size": 10,
        "axes.grid": True,
        "grid.color": GRID,
        "grid.linewidth": 0.6,
        "axes.axisbelow": True,
        "legend.fontsize": 9,
        "legend.framealpha": 0.9,
        "figure.constrained_layout.use": True,
    }
    with mpl.rc_context(style):
        made = Figure(figsize=(10, height * rows), layout="constrained")
        axes = made.subplots(rows, columns, squeeze=False)
    return made, [axis for row in axes for axis in row]


def save(made: Figure, folder: Path, name: str) -> Path:
    """Write ``name``.png without date or version: the same numbers make the same file."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.png"
    made.savefig(path, dpi=100, metadata={"Software": None})
    return path

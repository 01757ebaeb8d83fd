"""A flight as a map of characters: what is planned, what is photographed, where the drone is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

#: East and north of home, m.
Spot = tuple[float, float]
HOME, PLANNED, TAKEN, OBLIQUE, DRONE = "⌂", "·", "●", "◆", "✈"
#: A character is about twice as high as wide.
_ASPECT = 2.0


@dataclass(frozen=True)
class Flown:
    """``planned``, ``taken`` and ``oblique`` photos, and the drone, east and north of home in m."""

    planned: Sequence[Spot]
    taken: Sequence[Spot]
    oblique: Sequence[Spot]
    drone: Spot


def drawn(flown: Flown, columns: int = 46, rows: int = 16) -> str:
    """The map, north up; the scale fits everything in, home too. What came later covers what is below."""
    spots = [(0.0, 0.0), *flown.planned, *flown.taken, *flown.oblique, flown.drone]
    west, east = min(e for e, _ in spots), max(e for e, _ in spots)
    south, north = min(n for _, n in spots), max(n for _, n in spots)
    per_column_m = max((east - west) / (columns - 1), (north - south) / (_ASPECT * (rows - 1)), 1.0)
    middle = ((west + east) / 2, (south + north) / 2)
    cells = [[" "] * columns for _ in range(rows)]

    def put(spot: Spot, sign: str) -> None:
        column = round((spot[0] - middle[0]) / per_column_m + (columns - 1) / 2)
        row = round((rows - 1) / 2 - (spot[1] - middle[1]) / (_ASPECT * per_column_m))
        if 0 <= row < rows and 0 <= column < columns:
            cells[row][column] = sign

    for sign, some in ((PLANNED, flown.planned), (TAKEN, flown.taken), (OBLIQUE, flown.oblique)):
        for spot in some:
            put(spot, sign)
    put((0.0, 0.0), HOME)
    put(flown.drone, DRONE)
    scale_m = _round(8 * per_column_m)
    bar = "─" * max(round(scale_m / per_column_m), 1)
    return "\n".join(["".join(row).rstrip() for row in cells] + [f"{bar} {scale_m:g} m"])


def _round(length_m: float) -> float:
    """The nearest of 1, 2, 5, 10, 20, ... m below."""
    power = 10.0 ** math.floor(math.log10(length_m))
    return next(step * power for step in (5, 2, 1) if step * power <= length_m * (1 + 1e-9))

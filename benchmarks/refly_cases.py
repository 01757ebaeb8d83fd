"""Which flights the refly campaign flies: a random but balanced design of weak ones.

As in the verdict campaign every level comes as often as its weight says, independently of the other
factors, and flight N is the same whatever the length of the campaign. Only surveys that would take far more
photos than the others are replaced: from 20 ha on no second grid is flown, and 50 ha with a wide lens.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from benchmarks.verdict_cases import level_of

#: Number of this campaign among those with such a design.
CAMPAIGN = 6

#: Level -> weight, by factor.
FACTORS: dict[str, dict[str, int]] = {
    "area": {"0.5 ha": 1, "1 ha": 1, "2 ha": 2, "5 ha": 1, "10 ha": 1, "20 ha": 1, "50 ha": 1},
    "pattern": {
        "nadir": 5,
        "nadir, two heights": 1,
        "cross-hatch nadir": 1,
        "gently oblique 8°": 1,
        "nadir and one oblique": 1,
    },
    "height": {"40 m": 1, "60 m": 2, "80 m": 1, "120 m": 1},
    "lens": {
        "dji-phantom-3-professional": 2,
        "dji-inspire-1": 1,
        "canon-powershot-s110": 1,
        "nikon-d5200-18mm": 1,
    },
    "relief": {"0.5 m": 1, "2 m": 2, "8 m": 1, "20 m": 1},
    "gps": {"white 2.5 m": 3, "RTK": 1},
    "noise": {"0.3 px": 1, "0.5 px": 2, "0.8 px": 1},
    "tie points": {"250": 1, "500": 1},
    "mismatches": {"0 %": 1, "1 %": 1, "5 %": 1},
    "matching": {"as rendered": 3, "angles 0.85": 1, "angles 1.15": 1},
    "error": {
        "none": 2,
        "rolling shutter": 1,
        "pattern 1.5 px": 1,
        "correlated 0.3 px": 1,
    },
    "shutter": {"known to be mechanical": 1, "nothing known": 1},
}
TWO_GRIDS = ("nadir, two heights", "cross-hatch nadir")
HEIGHTS_M = (40.0, 60.0, 80.0, 100.0, 120.0)
LEAST_PHOTOS, MOST_PHOTOS = 15, 50
#: Share of a photo that the next one along and across shows again; fewer photos where there are too many.
FORWARD, SIDE = 0.75, 0.65


@dataclass(frozen=True)
class LoopCase:
    """One flight: its number (also its seed) and the level of every factor."""

    number: int
    levels: tuple[tuple[str, str], ...]

    def level(self, factor: str) -> str:
        """The level of a factor of ``FACTORS``."""
        return dict(self.levels)[factor]

    @property
    def pattern(self) -> str:
        """What is flown."""
        asked = self.level("pattern")
        return "nadir" if asked in TWO_GRIDS and self.area_ha >= 20 else asked

    @property
    def lens(self) -> str:
        """Name of the reference calibration that the true lens is like."""
        return "dji-phantom-3-professional" if self.area_ha >= 50 else self.level("lens")

    @property
    def model(self) -> str:
        """The camera's name in the files: one that is known to have no rolling shutter, or another."""
        mechanical = self.level("shutter") == "known to be mechanical"
        return "FC6310" if mechanical and self.level("error") != "rolling shutter" else "FC300X"

    @property
    def area_ha(self) -> float:
        """Of the square site."""
        return float(self.level("area").split()[0])

    @property
    def side_m(self) -> float:
        """Of the square site."""
        return 100.0 * math.sqrt(self.area_ha)


@dataclass(frozen=True)
class Lines:
    """The survey's lines and photos per line, ``height_m`` above the launch point."""

    height_m: float
    lines: int
    per_line: int


def loop_case(number: int) -> LoopCase:
    """Flight ``number`` (0, 1, ...)."""
    if number < 0:
        raise ValueError(f"flights are numbered from 0, not {number}")
    return LoopCase(number, tuple((name, level_of(FACTORS, name, number, CAMPAIGN)) for name in FACTORS))


def lines_of(case: LoopCase, footprint: tuple[float, float]) -> Lines:
    """A survey of between ``LEAST_PHOTOS`` and about ``MOST_PHOTOS`` photos.

    From the case's height, or higher where the area asks for it, with less overlap where that is not enough.

    Args:
        footprint: width and height of a photo on the ground, in flying heights.
    """
    asked = float(case.level("height").split()[0])
    times = 2 if case.pattern in TWO_GRIDS else 1
    heights = [h for h in HEIGHTS_M if h >= asked]
    for height in heights:
        found = _lines(case.side_m, height, footprint, 1.0)
        if times * found.lines * found.per_line <= MOST_PHOTOS:
            break
    spread = 1.0
    while times * found.lines * found.per_line > MOST_PHOTOS and spread < 1.6:
        spread += 0.05
        found = _lines(case.side_m, found.height_m, footprint, spread)
    while times * found.lines * found.per_line < LEAST_PHOTOS:
        spread -= 0.05
        found = _lines(case.side_m, found.height_m, footprint, spread)
    return found


def _lines(side_m: float, height_m: float, footprint: tuple[float, float], spread: float) -> Lines:
    across = spread * (1 - SIDE) * footprint[0] * height_m
    along = spread * (1 - FORWARD) * footprint[1] * height_m
    return Lines(height_m, max(math.ceil(side_m / across), 2), max(math.ceil(side_m / along), 3))


def number_of(level: str) -> float:
    """The number that a level's name holds: ``0.5 px`` -> 0.5."""
    return next(float(word.strip("°")) for word in level.split() if word[0].isdigit())


def generator(case: LoopCase, what: int) -> np.random.Generator:
    """Random numbers of one flight for one purpose."""
    return np.random.default_rng([CAMPAIGN, case.number, what])

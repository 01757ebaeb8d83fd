"""Which flights the verdict campaign flies: a random but balanced design.

Every level of every factor comes as often as its weight says, in every run of cases as long as
the factor has weighted levels, and independently of the other factors, so that a factor's effect
can be read off its margin. Case N is the same whatever the length of the campaign. Two of five
cases are of the papers' flights under ordinary conditions with a good reference instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

#: Of every ROUND cases the last OF_PAPERS are flights of [C&D]: 100 of each in a campaign of 2000.
ROUND, OF_PAPERS = 5, 2
#: Number of this campaign among those with such a design.
CAMPAIGN = 2
PAPERS = ("A1", "A2", "A3", "A4", "B1", "B2", "B3", "B4")

#: Level -> weight, by factor.
FACTORS: dict[str, dict[str, int]] = {
    "pattern": {
        "A1": 1,
        "A2": 1,
        "A3": 2,
        "A4": 2,
        "nadir, wide lines": 1,
        "cross-hatch 15°": 1,
        "cross-hatch nadir": 1,
        "orbit": 1,
        "gently oblique 10°": 1,
    },
    "lens": {
        "dji-phantom-3-professional": 1,
        "dji-inspire-1": 1,
        "canon-powershot-s110": 1,
        "lg-nexus-5": 1,
        "canon-eos-rebel-t2i": 1,
        "nikon-d5200-18mm": 1,
    },
    "relief": {"0.5 m": 1, "2 m": 1, "8 m": 1},
    "gps": {"white 2.5 m": 1, "drifting": 1, "RTK": 1, "RTK, late and offset": 1},
    "noise": {"0.3 px": 1, "0.5 px": 1, "1 px": 1},
    "mismatches": {"0 %": 1, "1 %": 1, "5 %": 1},
    "error": {
        "none": 2,
        "rolling shutter": 1,
        "pattern 1.5 px": 1,
        "aspect 0.5 %": 1,
        "correlated 0.3 px": 1,
    },
    "reference": {
        "true": 3,
        "f off by 0.05 %": 1,
        "f off by 0.2 %": 1,
        "f off by 0.5 %": 1,
        "f off by 2 %": 1,
        "K1 off by 6 px": 1,
        "none": 1,
        "wrong body": 1,
    },
}

#: Ground points simulated: a case costs 2 to 5 CPU-seconds; fewer where more photos see each of them.
POINTS = {
    "A1": 800,
    "A2": 600,
    "A3": 1200,
    "A4": 900,
    "nadir, wide lines": 900,
    "cross-hatch 15°": 500,
    "cross-hatch nadir": 500,
    "orbit": 700,
    "gently oblique 10°": 800,
}
#: The papers' flights, where TRUST is asked for, with as many as an alignment of photos has.
PAPERS_POINTS = {"A1": 800, "A2": 600, "A3": 3300, "A4": 1600}


@dataclass(frozen=True)
class Case:
    """One flight: its number (also its seed) and the level of every factor; ``part`` is ``design`` or
    ``papers``."""

    number: int
    part: str
    pattern: str
    lens: str
    relief: str
    gps: str
    noise: str
    mismatches: str
    error: str
    reference: str

    def level(self, factor: str) -> str:
        """The level of a factor of ``FACTORS``."""
        return str(getattr(self, factor))


def case(number: int) -> Case:
    """Case ``number`` (0, 1, ...)."""
    if number < 0:
        raise ValueError(f"cases are numbered from 0, not {number}")
    round_, place = divmod(number, ROUND)
    if place >= ROUND - OF_PAPERS:
        return _of_the_papers(number, OF_PAPERS * round_ + place - (ROUND - OF_PAPERS))
    index = (ROUND - OF_PAPERS) * round_ + place
    levels = {factor: level_of(FACTORS, factor, index) for factor in FACTORS}
    return Case(number, "design", **levels)


def _of_the_papers(number: int, index: int) -> Case:
    """[C&D] Table 3: block A with the Phantom 3, B with the Inspire 1, in this order again and again."""
    name = PAPERS[index % len(PAPERS)]
    return Case(
        number=number,
        part="papers",
        pattern="A" + name[1],
        lens="dji-phantom-3-professional" if name[0] == "A" else "dji-inspire-1",
        relief="2 m",
        gps="white 2.5 m",
        noise="0.5 px",
        mismatches="1 %",
        error="none",
        reference="true",
    )


def level_of(
    factors: Mapping[str, Mapping[str, int]], factor: str, index: int, campaign: int = CAMPAIGN
) -> str:
    """The level of a factor in flight ``index`` of a campaign's design."""
    deck = [name for name, weight in factors[factor].items() for _ in range(weight)]
    order = _shuffled(campaign, list(factors).index(factor), index // len(deck), len(deck))
    return deck[order[index % len(deck)]]


@lru_cache(maxsize=256)
def _shuffled(campaign: int, factor: int, round_: int, size: int) -> tuple[int, ...]:
    order = np.random.default_rng([campaign, factor, round_]).permutation(size)
    return tuple(int(i) for i in order)

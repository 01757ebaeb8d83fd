"""Flight patterns by name: a site in, pieces of path out."""

from __future__ import annotations

import difflib
from collections.abc import Callable

from calib.errors import InputError
from mission.patterns.around import fan_part, orbit_part
from mission.patterns.building import rings_part, wall_part
from mission.patterns.grid import Grid, best_heading_deg, grid_part
from mission.patterns.piece import Part
from mission.site import Site

#: [C&D] flew 60 and 80 m.
SECOND_HEIGHT = 80.0 / 60.0


def _nadir(site: Site) -> list[Part]:
    return [grid_part(site, Grid("nadir", site.height_m, best_heading_deg(site)))]


def _second_height(site: Site) -> list[Part]:
    height = site.options.second_height_m or SECOND_HEIGHT * site.height_m
    return [grid_part(site, Grid("height2", height, best_heading_deg(site)))]


def _crosshatch(site: Site) -> list[Part]:
    heading = best_heading_deg(site)
    return [
        grid_part(site, Grid("crosshatch", site.height_m, heading)),
        grid_part(site, Grid("crosshatch", site.height_m, (heading + 90) % 360)),
    ]


def _oblique(site: Site) -> list[Part]:
    tilt = site.options.oblique_tilt_deg
    if not 1 <= tilt <= 45:
        raise InputError(f"A gently oblique grid is tilted 1 to 45 degrees off nadir, not {tilt:g}.")
    return [grid_part(site, Grid("oblique", site.height_m, best_heading_deg(site), tilt))]


def _one(make: Callable[[Site], Part]) -> Callable[[Site], list[Part]]:
    return lambda site: [make(site)]


#: What each name flies. The order is that of a mission: straight down first.
PATTERNS: dict[str, Callable[[Site], list[Part]]] = {
    "nadir": _nadir,
    "height2": _second_height,
    "crosshatch": _crosshatch,
    "oblique": _oblique,
    "orbit": _one(orbit_part),
    "fan": _one(fan_part),
    "rings": _one(rings_part),
    "wall": _one(wall_part),
}
#: [C&D] Table 2: flight patterns 1-4.
COMPOSED = {
    "cd1": ("nadir",),
    "cd2": ("nadir", "height2"),
    "cd3": ("nadir", "fan"),
    "cd4": ("nadir", "height2", "fan"),
}
#: One line for each, for people.
DESCRIPTIONS = {
    "nadir": "parallel lines straight down",
    "height2": "the same from a second height, 4/3 of the first",
    "crosshatch": "two nadir grids at right angles",
    "oblique": "parallel lines, gently oblique (15 degrees forward)",
    "orbit": "a circle or arc around a point of interest",
    "fan": "eight convergent photos at the middle of the site, 40 degrees off nadir",
    "rings": "rings around a building at several heights",
    "wall": "pairs at +-45 degrees along a wall, about 10 m away",
    "cd1": "nadir",
    "cd2": "nadir+height2",
    "cd3": "nadir+fan",
    "cd4": "nadir+height2+fan",
}


def pattern_names(given: str) -> tuple[str, ...]:
    """ "nadir+orbit" -> the patterns it stands for, each once, in the order of a mission.

    Raises:
        InputError: no such pattern.
    """
    wanted: list[str] = []
    for word in given.lower().split("+"):
        name = word.strip()
        if name not in PATTERNS and name not in COMPOSED:
            close = difflib.get_close_matches(name, DESCRIPTIONS, n=1)
            hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(DESCRIPTIONS)}."
            raise InputError(f"There is no pattern named {name or 'nothing'}; {hint}")
        wanted += COMPOSED.get(name, (name,))
    return tuple(name for name in PATTERNS if name in wanted)


def pattern_parts(name: str, site: Site) -> list[Part]:
    """The parts of one pattern over a site.

    Raises:
        InputError: it cannot be flown there.
    """
    return PATTERNS[name](site)


__all__ = [
    "COMPOSED", "DESCRIPTIONS", "PATTERNS", "SECOND_HEIGHT", "Part", "pattern_names", "pattern_parts",
]  # fmt: skip

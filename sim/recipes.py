"""Named surveys: who flies what, with which camera, over which ground.

What the papers do not print is assumed here, and said in the recipe's notes. [C&D] gives flying
heights, the eight convergent photos and the sites' character, and that 60 m is half the site's
width; spacing and outlines are not printed.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from calib.camera import FloatArray
from calib.errors import InputError
from sim.cameras import PHANTOM_3, PHANTOM_4_PRO, WIRIS_PRO, CameraModel
from sim.flights import Flight, convergent, flight_plan, grid
from sim.shapes import block, ring, wall_pairs

#: Makes the flight from a scale (1: as flown) and, where the recipe allows it, a number of photos.
Plan = Callable[[float, int], Flight]

_SITE_M = 120.0
#: Site A: a triangle about as wide as twice the flying height, that holds figure 7's profile of 132 m.
SITE_A = np.array([[-70.0, -60.0], [70.0, -60.0], [-5.0, 72.0]])
#: Site B: "significantly narrower"; the levee closes it to the north.
SITE_B = np.array([[-60.0, -32.0], [60.0, -32.0], [60.0, 32.0], [-60.0, 32.0]])
_CORRIDOR = np.array([[-150.0, -20.0], [150.0, -20.0], [150.0, 20.0], [-150.0, 20.0]])
_SQUARE = np.array([[-60.0, -60.0], [60.0, -60.0], [60.0, 60.0], [-60.0, 60.0]])
_WALL = np.array([[-15.0, -12.0], [15.0, -12.0], [15.0, 2.0], [-15.0, 2.0]])
_BUILDING = np.array([[-12.0, -12.0], [12.0, -12.0], [12.0, 12.0], [-12.0, 12.0]])


@dataclass(frozen=True)
class Recipe:
    """A survey by name.

    ``summary``: one line for lists. ``photos``: as flown; ``countable``: another number may be asked for.
    ``world``: kind of ground (``sim.worlds.KINDS``), or ``site-a`` and ``site-b``. ``outline_m``: (n, 2)
    corners of the site east and north, where heights count. ``nearest_m``: how near the camera comes to
    what it photographs. ``reach_m``: how far from the middle ground is textured. ``interval_s``: least
    time between photos.
    """

    name: str
    summary: str
    plan: Plan
    photos: int
    outline_m: FloatArray
    notes: str = ""
    camera: CameraModel = PHANTOM_3
    world: str = "rolling"
    roughness: float = 0.02
    nearest_m: float = 60.0
    reach_m: float = 150.0
    speed_m_s: float = 8.0
    interval_s: float = 2.0
    countable: bool = False
    fixed_scale: bool = False

    def flight(self, scale: float = 1.0, photos: int | None = None) -> Flight:
        """The flight, undisturbed; ``scale`` multiplies all distances where the recipe allows it.

        Raises:
            InputError: another number of photos than the recipe allows; one sentence.
        """
        wanted = self.photos if photos is None else photos
        if wanted != self.photos and not self.countable:
            names = ", ".join(name for name, recipe in RECIPES.items() if recipe.countable)
            raise InputError(
                f"The number of photos of {self.name} is fixed ({self.photos}); it can be chosen for {names}."
            )
        if not 4 <= wanted <= max(self.photos, 200):
            raise InputError(
                f"{wanted} photos of {self.name} are not possible; choose from 4 to {max(self.photos, 200)}."
            )
        return self.plan(1.0 if self.fixed_scale else scale, wanted)


def find_recipe(name: str) -> Recipe:
    """A recipe by its name.

    Raises:
        InputError: there is none; the sentence names those that are nearest.
    """
    if name in RECIPES:
        return RECIPES[name]
    known = {known.lower(): known for known in RECIPES}
    close = [known[match] for match in difflib.get_close_matches(name.lower(), known, n=3, cutoff=0.6)]
    hint = f"Did you mean {' or '.join(close)}?" if close else "`fieldcal sim list` shows all."
    raise InputError(f"There is no survey recipe named {name}. {hint}")


# -- the papers' flights --------------------------------------------------------------------------


def _papers(outline_m: FloatArray, heading_deg: float, *parts: str) -> Plan:
    """[C&D] Table 2: nadir at 60 m, at 80 m, and eight convergent photos at 60 m.

    Lines half a flying height apart and photos a quarter along them: overlaps of about 70 and 80 %.
    The convergent photos look at the middle of the site from 40 degrees off nadir.
    """

    def nadir(scale: float, height_m: float) -> Flight:
        return block(
            scale * outline_m,
            scale * height_m,
            between_lines_m=scale * height_m / 2,
            along_line_m=scale * height_m / 4,
            heading_deg=heading_deg,
        )

    def plan(scale: float, photos: int) -> Flight:
        del photos
        flights = {
            "60": lambda: nadir(scale, 60.0),
            "80": lambda: nadir(scale, 80.0),
            "convergent": lambda: convergent(8, 40.0, 60.0 * scale),
        }
        first, *others = (flights[part]() for part in parts)
        for other in others:
            first = first + other
        return first

    return plan


_PATTERNS = {
    "1": (("60",), "nadir 60 m"),
    "2": (("60", "80"), "nadir 60+80 m"),
    "3": (("60", "convergent"), "nadir 60 m, 8 convergent"),
    "4": (("60", "80", "convergent"), "nadir 60+80 m, 8 convergent"),
}


def _paper_recipes() -> list[Recipe]:
    made = []
    for site, outline, heading, ground, notes in (
        ("A", SITE_A, 0.0, "sloping field", "Assumed: outline, a fall of 9 m eastwards, spacing."),
        ("B", SITE_B, 90.0, "lawn with a levee", "Assumed: 120 x 64 m, spacing; the levee is 1 m high."),
    ):
        for number, (parts, pattern) in _PATTERNS.items():
            plan = _papers(outline, heading, *parts)
            made.append(
                Recipe(
                    f"{site}{number}",
                    f"{ground}, {pattern} [C&D]",
                    plan,
                    len(plan(1.0, 0)),
                    outline,
                    notes,
                    world=f"site-{site.lower()}",
                    # A lawn and a field have small bumps; site B is flat otherwise.
                    roughness=0.02 if site == "A" else 0.005,
                )
            )
    return made


def _rings(*rings: tuple[float, float, float]) -> Plan:
    """Circles around a building: share of the photos, radius (m), height (m).

    They look at different heights of it, so that it is not in the middle of all photos.
    """

    def plan(scale: float, photos: int) -> Flight:
        del scale
        ends = np.rint(np.cumsum([share for share, _, _ in rings]) * photos).astype(int)
        counts = np.diff(ends, prepend=0)
        flights = [
            ring(
                int(count),
                radius,
                height,
                np.array([0.0, 0.0, 3.0 + 1.5 * (i % 3)]),
                first_azimuth_deg=7.0 * i,
            )
            for i, (count, (_, radius, height)) in enumerate(zip(counts, rings, strict=True))
            if count
        ]
        first, *others = flights
        for other in others:
            first = first + other
        return first

    return plan


def _wall(scale: float, photos: int) -> Flight:
    del scale
    return wall_pairs(photos // 2, 10.0, 6.0, 4.0)


# -- flights by older names, and others -----------------------------------------------------------


def _named(name: str) -> Plan:
    def plan(scale: float, photos: int) -> Flight:
        del photos
        return flight_plan(name, _SITE_M * scale)

    return plan


def _orbit(scale: float, photos: int) -> Flight:
    return convergent(photos, 40.0, _SITE_M / 2 * scale)


def _oblique(scale: float, photos: int) -> Flight:
    del photos
    return grid(4, 8, _SITE_M / 2 * scale, _SITE_M * scale, off_nadir_deg=20.0)


def _corridor(scale: float, photos: int) -> Flight:
    del photos
    return block(
        scale * _CORRIDOR,
        60.0 * scale,
        between_lines_m=20.0 * scale,
        along_line_m=20.0 * scale,
        heading_deg=90.0,
    )


def _others() -> list[Recipe]:
    old = [
        ("demo", "12 nadir and 8 convergent photos, as in `make demo`"),
        ("demo_nadir", "the 12 nadir photos of demo"),
        ("nadir_one_height", "nadir at one height, as most people fly"),
        ("crosshatch", "two grids at right angles, 15 degrees off nadir"),
        ("crosshatch_nadir", "two grids at right angles, straight down"),
    ]
    # These are as they were before there were bumps: benchmarks hold earlier results against them.
    made = [
        Recipe(name, summary, _named(name), len(flight_plan(name)), _SQUARE, roughness=0.0)
        for name, summary in old
    ]
    building = replace(
        Recipe("", "", _wall, 0, _BUILDING),
        world="building",
        nearest_m=12.0,
        reach_m=45.0,
        speed_m_s=2.0,
        interval_s=3.0,
        countable=True,
        fixed_scale=True,
    )
    rgb = _rings((0.34, 18.0, 5.0), (0.33, 22.0, 14.0), (0.33, 27.0, 24.0))
    thermal = _rings((0.26, 17.0, 5.0), (0.25, 21.0, 12.0), (0.25, 25.0, 20.0), (0.24, 30.0, 28.0))
    made += [
        Recipe("oblique", "one grid, 20 degrees off nadir", _oblique, 32, _SQUARE),
        Recipe("orbit", "a circle looking inwards at 40 degrees", _orbit, 36, _SQUARE, countable=True),
        Recipe(
            "corridor",
            "two lines over a strip of 300 x 40 m, nadir",
            _corridor,
            len(_corridor(1.0, 0)),
            _CORRIDOR,
            reach_m=230.0,
        ),
        Recipe(
            "wall",
            "flat wall from 10 m, 12 pairs at +-45 degrees [C&D]",
            _wall,
            24,
            _WALL,
            "Assumed: camera level at half the wall's height; 30 m of wall (the paper's has about 50 m).",
            world="wall",
            nearest_m=10.0,
            reach_m=40.0,
            speed_m_s=1.0,
            fixed_scale=True,
        ),
        replace(
            building,
            name="building-rgb",
            summary="circles around a building, Phantom 4 Pro [SEN]",
            plan=rgb,
            photos=101,
            notes="Assumed: three circles of 18, 22 and 27 m radius at 5, 14 and 24 m.",
            camera=PHANTOM_4_PRO,
        ),
        replace(
            building,
            name="building-thermal",
            summary="circles around a building, thermal WIRIS Pro [SEN]",
            plan=thermal,
            photos=158,
            notes="Assumed: four circles of 17 to 30 m radius at 5 to 28 m; grey photos stand for heat.",
            camera=WIRIS_PRO,
        ),
    ]
    return made


RECIPES: dict[str, Recipe] = {recipe.name: recipe for recipe in [*_others(), *_paper_recipes()]}

"""Named surveys: who flies what, with which camera, over which ground.

What the papers do not print is assumed, and said in the recipe's notes. [C&D] gives flying heights,
the eight convergent photos and the sites' character, and that 60 m is half the site's width; spacing
and outlines are not printed.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass, replace

from calib.camera import FloatArray
from calib.errors import InputError
from sim import plans
from sim.cameras import PHANTOM_3, PHANTOM_4_PRO, WIRIS_PRO, CameraModel
from sim.flights import Flight, flight_plan
from sim.plans import SITE_A, SITE_B, Plan


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
            plan = plans.papers(outline, heading, *parts)
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


def _others() -> list[Recipe]:
    old = [
        ("demo", "12 nadir and 8 convergent photos, as in `make demo`"),
        ("demo_nadir", "the 12 nadir photos of demo"),
        ("demo_crosshatch", "two grids of 12 photos at right angles, straight down"),
        ("nadir_one_height", "nadir at one height, as most people fly"),
        ("crosshatch", "two grids at right angles, 15 degrees off nadir"),
        ("crosshatch_nadir", "two grids at right angles, straight down"),
    ]
    # These are as they were before there were bumps: benchmarks hold earlier results against them.
    made = [
        Recipe(name, summary, plans.named(name), len(flight_plan(name)), plans.SQUARE, roughness=0.0)
        for name, summary in old
    ]
    building = replace(
        Recipe("", "", plans.wall, 0, plans.BUILDING),
        world="building",
        nearest_m=12.0,
        reach_m=45.0,
        speed_m_s=2.0,
        interval_s=3.0,
        countable=True,
        fixed_scale=True,
    )
    rgb = plans.rings((0.34, 18.0, 5.0), (0.33, 22.0, 14.0), (0.33, 27.0, 24.0))
    thermal = plans.rings((0.26, 17.0, 5.0), (0.25, 21.0, 12.0), (0.25, 25.0, 20.0), (0.24, 30.0, 28.0))
    made += [
        Recipe("oblique", "one grid, 20 degrees off nadir", plans.oblique, 32, plans.SQUARE),
        Recipe(
            "orbit", "a circle looking inwards at 40 degrees", plans.orbit, 36, plans.SQUARE, countable=True
        ),
        Recipe(
            "corridor",
            "two lines over a strip of 300 x 40 m, nadir",
            plans.corridor,
            len(plans.corridor(1.0, 0)),
            plans.CORRIDOR,
            reach_m=230.0,
        ),
        Recipe(
            "wall",
            "flat wall from 10 m, 12 pairs at +-45 degrees [C&D]",
            plans.wall,
            24,
            plans.WALL,
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

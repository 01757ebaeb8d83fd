"""What the recipes fly: outlines of sites, and flights over them by scale and number of photos."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib.camera import FloatArray
from sim.flights import Flight, convergent, flight_plan, grid
from sim.shapes import block, ring, wall_pairs

#: Makes the flight from a scale (1: as flown) and, where the recipe allows it, a number of photos.
Plan = Callable[[float, int], Flight]

SITE_M = 120.0
#: Site A: a triangle about as wide as twice the flying height, that holds figure 7's profile of 132 m.
SITE_A = np.array([[-70.0, -60.0], [70.0, -60.0], [-5.0, 72.0]])
#: Site B: "significantly narrower"; the levee closes it to the north.
SITE_B = np.array([[-60.0, -32.0], [60.0, -32.0], [60.0, 32.0], [-60.0, 32.0]])
CORRIDOR = np.array([[-150.0, -20.0], [150.0, -20.0], [150.0, 20.0], [-150.0, 20.0]])
SQUARE = np.array([[-60.0, -60.0], [60.0, -60.0], [60.0, 60.0], [-60.0, 60.0]])
WALL = np.array([[-15.0, -12.0], [15.0, -12.0], [15.0, 2.0], [-15.0, 2.0]])
BUILDING = np.array([[-12.0, -12.0], [12.0, -12.0], [12.0, 12.0], [-12.0, 12.0]])


def papers(outline_m: FloatArray, heading_deg: float, *parts: str) -> Plan:
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


def rings(*rings: tuple[float, float, float]) -> Plan:
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


def wall(scale: float, photos: int) -> Flight:
    """[C&D]'s pairs in front of the wall of :mod:`sim.worlds`."""
    del scale
    return wall_pairs(photos // 2, 10.0, 6.0, 4.0)


def named(name: str) -> Plan:
    """A flight of :func:`sim.flights.flight_plan`."""

    def plan(scale: float, photos: int) -> Flight:
        del photos
        return flight_plan(name, SITE_M * scale)

    return plan


def orbit(scale: float, photos: int) -> Flight:
    """One circle at 60 m that looks at the middle."""
    return convergent(photos, 40.0, SITE_M / 2 * scale)


def oblique(scale: float, photos: int) -> Flight:
    """Lines that look ahead, and so against each other."""
    del photos
    return grid(4, 8, SITE_M / 2 * scale, SITE_M * scale, off_nadir_deg=20.0)


def corridor(scale: float, photos: int) -> Flight:
    """Two lines straight down."""
    del photos
    return block(
        scale * CORRIDOR,
        60.0 * scale,
        between_lines_m=20.0 * scale,
        along_line_m=20.0 * scale,
        heading_deg=90.0,
    )

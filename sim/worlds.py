"""Worlds by name: kinds of ground and structures, made from a seed."""

from __future__ import annotations

from pathlib import Path

from calib.errors import InputError
from sim import buildings, ground_paint
from sim.dem import dem_ground, ortho_colours
from sim.facet import Facet
from sim.landforms import Levelled, Plane, Ridge, Sum, levee, valley
from sim.relief import HeightField, Relief
from sim.texture import ByteImage, pyramid_of
from sim.world import LEVELS, World, farmland

KINDS: tuple[str, ...] = ("rolling", "flat", "levee", "valley", "building", "wall", "dem")

#: Rasters of the ground have at most so many texels each way (200 MB, and as much again while they
#: are made); what is finer is made up where photos are near enough to see it.
_LARGEST = 8192


def build_world(
    kind: str,
    seed: int,
    *,
    half_m: float,
    texel_m: float,
    relief_m: float = 2.0,
    roughness: float = 0.02,
    dem: Path | None = None,
    ortho: Path | None = None,
) -> World:
    """The world of a kind, the same for the same arguments.

    x east, y north, z up (m) around the origin. The ground's texture reaches at least ``half_m`` each
    way and is mirrored beyond. ``texel_m``: size of its texels and of those of structures, coarser
    where that would be too big for the memory; finer detail is made up from the seed. ``relief_m``: no
    rolling ground is farther from level than this; a levee is twice, a valley five times as high.
    ``roughness``: rms slope (m/m) of bumps 3 to 25 m long. A ``building`` (12.5 x 7.5 m, 10.5 m high)
    stands around the origin, a ``wall`` (30 x 8 m) along x in the plane y = 0 with its face to the
    south; the ground is level there. ``dem``, ``ortho``: GeoTIFFs for the kind ``dem``; its origin is
    the DEM's middle, z = 0 its height there; relief and roughness are the DEM's own.

    Raises:
        InputError: no such kind, or a DEM or orthophoto that is missing or cannot be used.
    """
    if kind not in KINDS:
        raise InputError(f"There is no world of the kind '{kind}': choose one of {', '.join(KINDS)}.")
    if half_m <= 0 or texel_m <= 0:
        raise InputError(f"A world needs a size and texels above 0 m, not {half_m:g} and {texel_m:g}.")
    if (kind == "dem") != (dem is not None):
        need = "needs a DEM file" if dem is None else "takes no DEM file: choose the kind 'dem'"
        raise InputError(f"A world of the kind '{kind}' {need}.")
    if ortho is not None and dem is None:
        raise InputError(f"The orthophoto {ortho} needs a DEM to lie on.")
    texel = max(texel_m, 2 * half_m / _LARGEST)
    origin = None
    relief: HeightField
    if dem is not None:
        relief, origin = dem_ground(dem, half_m)
    else:
        relief = ground(kind, seed, relief_m, roughness)
    if ortho is not None and origin is not None:
        # A photo has its light and shadows in it.
        canvas = ortho_colours(ortho, origin, farmland(seed, half_m, texel), texel)
    else:
        canvas = farmland(seed, half_m, texel)
        _paint(kind, canvas, texel, relief)
        ground_paint.shade(canvas, texel, relief)
    facets = _structures(kind, seed, texel_m)
    if facets:
        ground_paint.shadows(canvas, texel, facets)
    return World(relief, pyramid_of(canvas, LEVELS), texel, facets, seed, origin)


def ground(kind: str, seed: int, relief_m: float, roughness: float) -> HeightField:
    """The heights of a kind other than ``dem``, without its structures."""
    bumps = (Relief.rough(seed, roughness),) if roughness > 0 else ()
    if kind == "flat":
        return Sum(bumps) if bumps else Plane()
    if kind == "levee":
        return Sum((levee(seed, 2 * relief_m), Relief.random(seed, 0.2 * relief_m), *bumps))
    if kind == "valley":
        depth_m = 5 * relief_m
        return Sum((Plane(depth_m), *valley(seed, depth_m), Relief.random(seed, 0.3 * relief_m), *bumps))
    rolling = Relief.random(seed, relief_m)
    if kind in ("building", "wall"):
        return Levelled(Sum((rolling, *bumps)), 45.0)
    return Sum((rolling, *bumps)) if bumps else rolling


def _structures(kind: str, seed: int, texel_m: float) -> tuple[Facet, ...]:
    if kind == "building":
        return buildings.lodge(seed, texel_m)
    return buildings.wall(seed, texel_m) if kind == "wall" else ()


def _paint(kind: str, canvas: ByteImage, texel_m: float, relief: HeightField) -> None:
    """What belongs to the kind: the track on a levee, the river of a valley, the yard of a house."""
    ridges = [part for part in getattr(relief, "parts", ()) if isinstance(part, Ridge)]
    if kind == "levee":
        bank = ridges[0]
        ground_paint.strip(canvas, texel_m, bank.course, bank.half_foot_m, (106, 128, 66), 0.7, 0.8)
        ground_paint.strip(canvas, texel_m, bank.course, 1.5, (172, 160, 136), 0.75)
    elif kind == "valley":
        bed = ridges[1]
        ground_paint.strip(canvas, texel_m, bed.course, bed.half_foot_m + 2.0, (168, 162, 148), 0.8, 1.2)
        ground_paint.strip(canvas, texel_m, bed.course, bed.half_crest_m + 0.5, (66, 84, 78), 0.8, 0.5)
    elif kind == "building":
        ground_paint.yard(canvas, texel_m, (buildings.LODGE_M[0] / 2 + 2, buildings.LODGE_M[1] / 2 + 2))
    elif kind == "wall":
        ground_paint.yard(canvas, texel_m, (buildings.WALL_M[0] / 2 + 1, 2.5))

"""Worlds by name: kinds of ground and structures, made from a seed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from calib.errors import InputError
from sim.landforms import Levelled, Plane, Sum, levee, valley
from sim.relief import HeightField, Relief
from sim.world import World, make_world

KINDS: tuple[str, ...] = ("rolling", "flat", "levee", "valley", "building", "wall", "dem")


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

    x east, y north, z up (m) around the origin; texture of ``texel_m`` reaches ``half_m`` each way.
    ``relief_m``: no rolling ground is farther from level than this; a levee is twice, a valley five
    times as high. ``roughness``: rms slope (m/m) of bumps 3 to 25 m long. ``dem`` and ``ortho``:
    GeoTIFFs of the kind ``dem``.

    Raises:
        InputError: no such kind, or a DEM or orthophoto that cannot be used.
    """
    if kind not in KINDS:
        raise InputError(f"There is no world of the kind '{kind}': choose one of {', '.join(KINDS)}.")
    if dem is not None or ortho is not None or kind == "dem":
        raise InputError("Worlds from a DEM are not there yet.")
    world = make_world(seed, half_m=half_m, texel_m=texel_m, relief_m=relief_m)
    return replace(world, relief=ground(kind, seed, relief_m, roughness))


def ground(kind: str, seed: int, relief_m: float, roughness: float) -> HeightField:
    """The heights of a kind without its structures."""
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

"""Pieces: what patterns are made of, and what ``compose`` puts in order.

A piece is flown without interruption: one line of a grid, one station, one ring.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.camera import FloatArray
from mission.plan import Shot, Waypoint


@dataclass(frozen=True)
class Piece:
    """Waypoints flown one after the other.

    ``reversible``: may be flown backwards. ``turning``: then the camera looks the other way, as on
    the lines of a grid. ``loop``: a closed ring that may begin at any of its waypoints.
    """

    waypoints: tuple[Waypoint, ...]
    reversible: bool = True
    turning: bool = False
    loop: bool = False

    @property
    def ends_m(self) -> FloatArray:
        """First and last place, (2, 3)."""
        return np.array([self.waypoints[0].enu_m, self.waypoints[-1].enu_m])


@dataclass(frozen=True)
class Part:
    """One pattern's pieces, and what the operator should know about them."""

    pattern: str
    pieces: tuple[Piece, ...]
    notes: tuple[str, ...] = ()


def backwards(piece: Piece) -> Piece:
    """The piece flown from its end: photos at the same places."""
    found: list[Waypoint] = []
    old = piece.waypoints
    for index in range(len(old) - 1, -1, -1):
        here, before = old[index], old[index - 1] if index > 0 else None
        if before is not None and before.shot is Shot.LINE:
            looks = replace(before, east_m=here.east_m, north_m=here.north_m, height_m=here.height_m)
        elif here.shot is Shot.LINE:
            looks = replace(here, shot=Shot.NONE, spacing_m=0.0)
        else:
            looks = here
        if piece.turning:
            looks = replace(looks, yaw_deg=(looks.yaw_deg + 180) % 360)
        found.append(looks)
    return replace(piece, waypoints=tuple(found))


def begun_at(piece: Piece, index: int) -> Piece:
    """A loop that begins at its waypoint ``index``."""
    return replace(piece, waypoints=piece.waypoints[index:] + piece.waypoints[:index])

"""Structures to calibrate on: a lodge and a long wall.

The lodge has the size of the building of Senn et al. (2020): 12.5 x 7.5 m, 10.5 m high.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calib.camera import FloatArray
from sim import masonry
from sim.facet import Facet
from sim.texture import ByteImage, Texture, pyramid_of

LODGE_M = (12.5, 7.5, 10.5)  # east-west, north-south, height of the ridge
WALL_M = (30.0, 8.0)  # length, height
#: Where the light comes from (unit vector): the south-west, 45 degrees up.
SUN = np.array([-0.42, -0.57, 0.707]) / np.linalg.norm([-0.42, -0.57, 0.707])

_EAVES_M = 6.2
_OVERHANG_M = 0.35
_BELOW_M = 0.5  # walls go so deep into the ground
_REVEAL_M = 0.18  # windows and doors lie so deep in the wall
_UP = np.array([0.0, 0.0, 1.0])
_Paint = Callable[[int, float, float, float], ByteImage]


@dataclass(frozen=True)
class _Opening:
    """A window or door by its lower left corner and size on the wall (m)."""

    s: float
    t: float
    width: float
    height: float
    door: bool = False

    @property
    def rectangle(self) -> tuple[float, float, float, float]:
        return self.s, self.t, self.s + self.width, self.t + self.height


def light_on(front: FloatArray) -> float:
    """Brightness of a surface with a unit normal (3,), level ground being 1."""
    return float((0.5 + 0.7 * max(front @ SUN, 0.0)) / (0.5 + 0.7 * SUN[2]))


def wall(seed: int, texel_m: float) -> tuple[Facet, ...]:
    """A flat wall along x in the plane y = 0, from the ground to 8 m, its face looking south.

    The left part is of brick, the right of stone.
    """
    length, height = WALL_M
    texel = masonry.texel_for(length, height, texel_m)
    brick = masonry.brickwork(seed, 0.45 * length, height, texel)
    stone = masonry.stonework(seed, length - 0.45 * length, height, texel)
    rows = min(len(brick), len(stone))
    face = np.concatenate([brick[:rows], stone[:rows]], axis=1)
    east = np.array([1.0, 0, 0])
    texture = _texture(face, texel, -length / 2, height, east, _UP, seed)
    return (Facet(np.zeros(3), east, _UP, _rectangle(-length / 2, 0.0, length / 2, height), texture),)


def lodge(seed: int, texel_m: float) -> tuple[Facet, ...]:
    """A house around the origin on the ground: stone walls, slate roof, windows and doors in reveals."""
    length, width, ridge = LODGE_M
    facets: list[Facet] = []
    for side, (right, span, gable) in enumerate(
        [((1, 0), length, False), ((0, 1), width, True), ((-1, 0), length, False), ((0, -1), width, True)]
    ):
        along = np.array([right[0], right[1], 0.0])
        front = np.cross(along, _UP)
        origin = front * (width if not gable else length) / 2
        half = span / 2
        outline = [(-half, -_BELOW_M), (half, -_BELOW_M), (half, _EAVES_M)]
        outline += [(0.0, ridge), (-half, _EAVES_M)] if gable else [(-half, _EAVES_M)]
        facets += _pierced_wall(
            seed * 10 + side,
            origin,
            along,
            np.array(outline),
            _openings(gable, front_door=side == 0),
            texel_m,
        )
    facets += _roof(seed, texel_m)
    return tuple(facets)


def _openings(gable: bool, front_door: bool) -> list[_Opening]:
    if gable:
        ground = [_Opening(s, 0.9, 1.0, 1.7) for s in (-2.4, 1.4)]
        return [*ground, _Opening(-0.5, 3.9, 1.0, 1.5), _Opening(-0.35, 7.0, 0.7, 1.0)]
    upper = [_Opening(s - 0.5, 3.9, 1.0, 1.5) for s in (-4.6, -1.6, 1.6, 4.6)]
    lower = [_Opening(s - 0.5, 0.9, 1.0, 1.7) for s in (-4.6, 4.6)]
    lower.append(_Opening(-2.1, 0.9, 1.0, 1.7) if front_door else _Opening(1.1, 0.9, 1.0, 1.7))
    lower.append(_Opening(1.1 if front_door else -2.1, 0.0, 1.0, 2.2, door=True))
    return upper + lower


def _pierced_wall(
    seed: int,
    origin: FloatArray,
    along: FloatArray,
    outline: FloatArray,
    openings: list[_Opening],
    texel_m: float,
) -> list[Facet]:
    """A wall with its openings, the panes behind them and the four reveals of each."""
    front = np.cross(along, _UP)
    low, high = outline.min(axis=0), outline.max(axis=0)
    size = high - low
    texel = masonry.texel_for(size[0], size[1], texel_m)
    face = masonry.stonework(seed, size[0], size[1], texel)
    texture = _texture(face, texel, low[0], high[1], along, _UP, seed)
    holes = np.array([opening.rectangle for opening in openings])
    out = [Facet(origin, along, _UP, outline, texture, holes)]
    plain = masonry.stonework(seed + 1, 2.4, 2.4, texel, course_m=0.6)
    # Sill, left jamb, lintel and right jamb run so, each reaching from the front inwards.
    runs = (along, -_UP, -along, _UP)
    reveals = [_texture(plain, texel, 0.0, 2.4, run, -front, seed) for run in runs]
    for i, opening in enumerate(openings):
        s0, t0, s1, t1 = opening.rectangle
        paint = masonry.door if opening.door else masonry.window
        pane = paint(seed * 100 + i, opening.width, opening.height, texel)
        behind = origin - _REVEAL_M * front
        out.append(
            Facet(
                behind,
                along,
                _UP,
                _rectangle(s0, t0, s1, t1),
                _texture(pane, texel, s0, t1, along, _UP, seed, (s1 - s0) / pane.shape[1]),
            )
        )
        corners = ((s0, t0), (s0, t1), (s1, t1), (s1, t0))
        spans = (s1 - s0, t1 - t0, s1 - s0, t1 - t0)
        for corner, run, span, reveal in zip(corners, runs, spans, reveals, strict=True):
            at = origin + corner[0] * along + corner[1] * _UP
            out.append(Facet(at, run, -front, _rectangle(0.0, 0.0, span, _REVEAL_M), reveal))
    return out


def _roof(seed: int, texel_m: float) -> list[Facet]:
    length, width, ridge = LODGE_M
    rise, run = ridge - _EAVES_M, width / 2
    slope = float(np.hypot(rise, run))
    half = length / 2 + _OVERHANG_M
    reach = slope * (1 + _OVERHANG_M / run)  # from the ridge down past the eaves
    texel = masonry.texel_for(2 * half, reach, texel_m)
    out = []
    for side, sign in enumerate((1.0, -1.0)):
        along = np.array([sign, 0.0, 0.0])
        up = np.array([0.0, sign * run, rise]) / slope
        face = masonry.slates(seed * 10 + side, 2 * half, reach, texel)
        texture = _texture(face, texel, -half, 0.0, along, up, seed)
        top = np.array([0.0, 0.0, ridge])
        out.append(Facet(top, along, up, _rectangle(-half, -reach, half, 0.0), texture))
    return out


def _rectangle(s0: float, t0: float, s1: float, t1: float) -> FloatArray:
    return np.array([[s0, t0], [s1, t0], [s1, t1], [s0, t1]])


def _texture(
    face: ByteImage,
    texel_m: float,
    left_m: float,
    top_m: float,
    along: FloatArray,
    up: FloatArray,
    seed: int,
    actual_texel_m: float | None = None,
) -> Texture:
    """The raster lit as its direction asks for."""
    light = light_on(np.cross(along, up))
    lit = np.clip(face * np.float32(light), 0, 255).astype(np.uint8)
    # Padded, so that the halving of rasters loses nothing of the surface.
    rows, columns = (-(-n // 32) * 32 for n in lit.shape[:2])
    lit = np.pad(lit, ((0, rows - len(lit)), (0, columns - lit.shape[1]), (0, 0)), mode="symmetric")
    return Texture(pyramid_of(lit), actual_texel_m or texel_m, left_m, top_m, seed)

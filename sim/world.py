"""Ground to photograph: relief with a texture of fields, paths, stones and bushes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from calib.camera import FloatArray
from sim.facet import Facet, dotted
from sim.relief import HeightField, Relief
from sim.texture import ByteImage, Image32, Texture, pyramid_of

#: The raster's side is a multiple of this, so that every level of the pyramid covers the same ground.
LEVELS = 6


@dataclass(frozen=True)
class World:
    """Relief, texture and structures around the origin; x east, y north, z up (metres).

    ``pyramid``: RGB rasters (side, side, 3), row 0 northernmost, each level half the one before.
    The raster reaches ``half_m`` east, west, north and south; beyond it the texture is mirrored.
    ``facets``: structures that stand on the ground. ``detail_seed``: see :class:`~sim.texture.Texture`.
    ``origin_wgs84``: latitude, longitude (deg) and height (m, as the DEM has it) of the origin, where
    the world has a place on Earth.
    """

    relief: HeightField
    pyramid: tuple[ByteImage, ...]
    texel_m: float
    facets: tuple[Facet, ...] = ()
    detail_seed: int | None = None
    origin_wgs84: tuple[float, float, float] | None = None

    @property
    def half_m(self) -> float:
        return 0.5 * self.texel_m * len(self.pyramid[0])

    @property
    def texture(self) -> Texture:
        """The ground's texture; its s is east, its t north."""
        return Texture(self.pyramid, self.texel_m, -self.half_m, self.half_m, self.detail_seed)

    def height_m(self, east_m: FloatArray, north_m: FloatArray, *, structures: bool = False) -> FloatArray:
        """Height of the ground at positions of any (equal) shape; with ``structures`` of the highest
        thing there, as a roof."""
        east, north = np.asarray(east_m, float), np.asarray(north_m, float)
        height = self.relief.height_m(east, north)
        if structures:
            for facet in self.facets:
                height = np.maximum(height, facet.height_m(east, north))
        return height

    def points_m(self, east_north_m: FloatArray) -> FloatArray:
        """Ground points (n, 3) at positions (n, 2)."""
        east, north = east_north_m.T
        return np.column_stack([east_north_m, self.relief.height_m(east, north)])

    def with_dots(self, east_north_m: FloatArray, sigma_m: float) -> World:
        """Grey ground with white round dots (Gaussian of ``sigma_m``) at positions (n, 2): for tests."""
        side = self.pyramid[0].shape[0]
        where = np.column_stack([east_north_m[:, 0] + self.half_m, self.half_m - east_north_m[:, 1]])
        grey = dotted((side, side), where / self.texel_m, sigma_m / self.texel_m)
        return replace(self, pyramid=pyramid_of(grey, LEVELS), detail_seed=None)


def make_world(seed: int, *, half_m: float = 150.0, texel_m: float = 0.08, relief_m: float = 2.0) -> World:
    """A piece of farmland, the same for the same arguments; making it takes about a second per
    ten million texels."""
    return World(Relief.random(seed, relief_m), pyramid_of(farmland(seed, half_m, texel_m), LEVELS), texel_m)


def farmland(seed: int, half_m: float, texel_m: float) -> ByteImage:
    """Colours (side, side, 3) of fields, paths, bushes and stones, row 0 northernmost."""
    rng = np.random.default_rng([seed, 5])
    step = 2**LEVELS
    side = step * int(np.ceil(2 * half_m / texel_m / step))
    canvas = _fields(rng, side, texel_m)
    shade = _multi_scale(rng, side, texel_m)
    for first in range(0, side, 256):  # in bands: a fine world is hundreds of megabytes as it is
        band = np.s_[first : first + 256]
        canvas[band] = np.clip(canvas[band] * (1 + np.float32(0.16) * shade[band, :, None]), 0, 255)
    _paths(rng, canvas, texel_m)
    _bushes(rng, canvas, texel_m)
    _stones(rng, canvas, texel_m)
    return canvas


def _noise(rng: np.random.Generator, side: int, cells: int) -> Image32:
    """Smooth noise of unit variance at the nodes, ``cells`` of them along each side."""
    nodes = rng.standard_normal((cells + 2, cells + 2), dtype=np.float32)
    if cells + 2 >= side:
        return nodes[:side, :side]
    return np.asarray(cv2.resize(nodes, (side, side), interpolation=cv2.INTER_CUBIC), np.float32)


def _multi_scale(rng: np.random.Generator, side: int, texel_m: float) -> Image32:
    """Brightness at all scales from 60 m down to a texel; neighbouring scales alike in strength."""
    total = np.zeros((side, side), np.float32)
    size = 60.0
    while size >= 0.9 * texel_m:
        noise = _noise(rng, side, max(int(side * texel_m / size), 2))
        noise *= np.float32(0.6 if size > 4 else 0.8)  # in place: each copy is hundreds of megabytes
        total += noise
        del noise
        size /= 2
    total *= np.float32(0.5)
    return total


def _fields(rng: np.random.Generator, side: int, texel_m: float) -> ByteImage:
    """Colours (side, side, 3) of meadows, stubble and bare soil with soft, crooked borders."""
    palette = np.array(
        [[96, 116, 62], [124, 132, 78], [150, 136, 98], [118, 98, 74], [86, 104, 66], [164, 152, 112]]
    )
    coarse = int(side * texel_m / 0.5)
    half = side * texel_m / 2
    count = int((2 * half / 45) ** 2)
    middles = rng.uniform(-half, half, (count, 2))
    kinds = rng.integers(0, len(palette), count)
    ticks = np.linspace(-half, half, coarse)
    where = np.stack(np.meshgrid(ticks, ticks), axis=-1)
    bend = np.stack([_noise(rng, coarse, max(coarse // 30, 2)) for _ in range(2)], axis=-1)
    warped = where + 2.5 * bend
    nearest = np.zeros((coarse, coarse), int)
    best = np.full((coarse, coarse), np.inf)
    for i, (middle, kind) in enumerate(zip(middles, kinds, strict=True)):
        # Oblong cells, as fields are; none of them reaches farther than 80 m.
        turn = 0.6 + (i % 3) * 0.5
        first, last = np.searchsorted(ticks, [middle - 80, middle + 80])
        window = np.s_[first[1] : last[1], first[0] : last[0]]
        d = (warped[window] - middle) @ np.array(
            [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        )
        distance = d[..., 0] ** 2 + 2.0 * d[..., 1] ** 2
        closer = distance < best[window]
        best[window][closer], nearest[window][closer] = distance[closer], kind
    tint = palette.astype(np.uint8)[nearest]
    return np.asarray(cv2.resize(tint, (side, side), interpolation=cv2.INTER_LINEAR), np.uint8)


def _paths(rng: np.random.Generator, canvas: ByteImage, texel_m: float) -> None:
    side = canvas.shape[0]
    length = side * texel_m
    for _ in range(max(int(length / 60), 3)):
        start, end = rng.uniform(0, length, (2, 2)), rng.uniform(0, length, (2, 2))
        a, b, c, d = start[0], start[1], end[0], end[1]
        t = np.linspace(-0.3, 1.3, 80)[:, None]
        curve = (1 - t) ** 3 * a + 3 * (1 - t) ** 2 * t * b + 3 * (1 - t) * t**2 * c + t**3 * d
        points = np.rint(curve / texel_m * 16).astype(np.int32)
        width = max(int(rng.uniform(0.8, 2.5) / texel_m), 1)
        colour = (rng.uniform(0.85, 1.1) * np.array([178, 164, 138])).tolist()
        # Paths are blended, so that the ground's texture goes on under them.
        mask = np.zeros((side, side), np.uint8)
        cv2.polylines(mask, [points], False, 255, width, cv2.LINE_AA, 4)
        on = mask > 0
        weight = 0.65 * mask[on].astype(np.float32)[:, None] / 255
        canvas[on] = (canvas[on] * (1 - weight) + np.array(colour, np.float32) * weight).astype(np.uint8)


def _bushes(rng: np.random.Generator, canvas: ByteImage, texel_m: float) -> None:
    side = canvas.shape[0]
    for _ in range(int((side * texel_m) ** 2 / 350)):
        middle = rng.uniform(0, side, 2)
        size = rng.uniform(0.5, 2.2)
        green = np.array([52, 74, 40]) * rng.uniform(0.7, 1.2)
        for _ in range(14):
            at = middle + rng.normal(size=2) * size / texel_m * 0.5
            light = rng.uniform(0.6, 1.5)
            _disc(canvas, at, rng.uniform(0.2, 0.55) * size / texel_m * 0.6, np.clip(green * light, 0, 255))


def _stones(rng: np.random.Generator, canvas: ByteImage, texel_m: float) -> None:
    side = canvas.shape[0]
    area = (side * texel_m) ** 2
    # Those that a texel swallows are left out of wide, coarse worlds.
    for _ in range(int(area / 5 * min(1.0, (0.16 / texel_m) ** 2))):
        at = rng.uniform(0, side, 2)
        radius = 0.06 * rng.pareto(2.2) + 0.08  # many small, few large
        if radius > 0.6:
            continue
        grey = rng.uniform(90, 225) * np.array([1.0, 0.98, 0.93])
        shadow = rng.uniform(30, 60) * np.ones(3)
        _disc(canvas, at + 0.45 * radius / texel_m, radius / texel_m, shadow)
        _disc(canvas, at, radius / texel_m, np.clip(grey, 0, 255))


def _disc(canvas: ByteImage, at: FloatArray, radius: float, colour: FloatArray) -> None:
    """An anti-aliased disc at sub-texel position (OpenCV's fixed point with 4 bits)."""
    centre = (int(at[0] * 16), int(at[1] * 16))
    cv2.circle(canvas, centre, max(int(radius * 16), 8), colour.tolist(), -1, cv2.LINE_AA, 4)

"""Photos of a :class:`~sim.world.World` through a known lens.

Every pixel's ray is intersected with the ground and with the structures on it, from the place where
the camera was when that pixel's row was read; what is hit first is seen. Its texture is averaged over
the pixel's footprint, and pixels on the outline of a structure over what their parts see.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from calib.camera import FloatArray
from calib.field import Lens
from sim.facet import Facet
from sim.sensor import THERMAL, RenderOptions, exposed
from sim.texture import ByteImage, Image32, as_list, folded
from sim.trace import FARTHEST_M, GroundMap, directions, ground_map, newton, trace
from sim.world import World

__all__ = ["THERMAL", "RenderOptions", "lens_rays", "render"]

_STEP = 8  # px between the nodes on which smooth maps are computed before they are interpolated
_BAND = 64  # rows worked on together
_SKY_COLOUR = np.array([188, 203, 219], np.float32)
_SKY = -1
_GROUND = 0
_PARTS = (-0.375, -0.125, 0.125, 0.375)  # where a pixel on an outline is sampled, each way (px)
_NEAREST_M = 0.05  # structures nearer to the camera than this are not drawn


def lens_rays(lens: Lens, pattern: Callable[[FloatArray], FloatArray] | None = None) -> FloatArray:
    """The ray of every pixel's centre, (height, width, 2): made once, used for all photos of a lens.

    ``pattern`` is what the total mapping has beyond ``lens``: pixels = lens(ray) + pattern(lens(ray)).
    """
    width, height = lens.brown.width, lens.brown.height
    u, v = _nodes(width), _nodes(height)
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    behind = pixels
    if pattern is not None:
        for _ in range(30):  # the pattern's slope is below 1 %: two digits a round
            behind = pixels - pattern(behind)
    rays = lens.unproject(behind)
    # (0.5, 0.5) is the centre of the first pixel.
    centres_u, centres_v = np.arange(width) + 0.5, np.arange(height) + 0.5
    return np.stack([RectBivariateSpline(v, u, rays[..., a])(centres_v, centres_u) for a in (0, 1)], axis=-1)


def _nodes(size: int) -> FloatArray:
    return np.linspace(0.5, size - 0.5, max(size // _STEP, 8))


def render(
    world: World,
    rays: FloatArray,
    rotation_cam_from_world: FloatArray,
    centre_m: FloatArray,
    *,
    velocity_m_s: FloatArray | None = None,
    options: RenderOptions | None = None,
    seed: int = 0,
) -> ByteImage:
    """One photo, RGB (height, width, 3).

    rays: (height, width, 2) from :func:`lens_rays`. rotation (3, 3), centre (3,) of the middle row, in
    the middle of its exposure; velocity (3,) matters with a rolling shutter or an exposure time.
    """
    options = options or RenderOptions()
    height = len(rays)
    time_s = ((np.arange(height) + 0.5) / height - 0.5) * options.readout_s
    moving = np.zeros(3) if velocity_m_s is None else np.asarray(velocity_m_s, float)
    start_m = centre_m + time_s[:, None] * moving
    shot = _Shot(
        world,
        rays,
        rotation_cam_from_world,
        start_m,
        ground_map(world.relief, start_m, rays, rotation_cam_from_world, _STEP),
    )
    seen = shot.visible_facets()
    image = np.empty((*rays.shape[:2], 3), np.float32)
    for first in range(0, height, _BAND):
        last = min(first + _BAND, height)
        image[first:last] = shot.band(first, last, seen)
    way_px = None
    if options.exposure_s > 0 and moving.any():
        way_px = shot.image_motion(moving, seen) * options.exposure_s
    return exposed(image, options, way_px, seed)


@dataclass(frozen=True)
class _Visible:
    """A facet that may be in the photo. cells: where, by the cells between the map's nodes."""

    number: int
    facet: Facet
    cells: NDArray[np.bool_]


@dataclass(frozen=True)
class _Shot:
    """What one photo is made from; start_m (h, 3): where the camera is when each row is read."""

    world: World
    rays: FloatArray
    rotation: FloatArray
    start_m: FloatArray
    ground: GroundMap

    def visible_facets(self) -> list[_Visible]:
        nodes = self.rays[np.ix_(self.ground.rows, self.ground.columns)]
        corners = np.stack([nodes[:-1, :-1], nodes[1:, :-1], nodes[:-1, 1:], nodes[1:, 1:]])
        low, high = corners.min(axis=0), corners.max(axis=0)
        # Cells are a little larger than their corners say, their borders being curved.
        margin = 0.2 * (high - low)
        low, high = low - margin, high + margin
        out = []
        for number, facet in enumerate(self.world.facets, start=1):
            cells = np.zeros(low.shape[:2], bool)
            ends = [
                _ray_bounds((facet.corners_m - start) @ self.rotation.T) for start in self.start_m[[0, -1]]
            ]
            bounds = [end for end in ends if end is not None]
            if not bounds:
                continue
            least, most = np.min([b[0] for b in bounds], axis=0), np.max([b[1] for b in bounds], axis=0)
            cells = ((high >= least) & (low <= most)).all(axis=-1)
            if cells.any():
                out.append(_Visible(number, facet, cells))
        return out

    def band(self, first: int, last: int, seen: list[_Visible]) -> Image32:
        """Light (last - first, w, 3) on the rows from ``first`` to before ``last``."""
        height, width = self.rays.shape[:2]
        low, high = max(first - 1, 0), min(last + 1, height)  # a row more for slopes and outlines
        rays = self.rays[low:high]
        direction = directions(rays, self.rotation)
        start = self.start_m[low:high]
        nearest = np.full(direction.shape[:2], np.inf)
        what = np.full(direction.shape[:2], _SKY, np.int32)
        here = [visible for visible in seen if self._cells(visible, low, high).any()]
        for visible in here:
            v, u = self._pixels(visible, low, high)
            distance, s, t = visible.facet.hit(start[v], direction[v, u])
            nearer = (distance < nearest[v, u]) & visible.facet.covers(s, t)
            v, u = v[nearer], u[nearer]
            nearest[v, u] = distance[nearer]
            what[v, u] = visible.number
        to_ground = self.ground.band(low, self.world.relief, start, direction, nearest)
        what[to_ground < nearest] = _GROUND

        inner = slice(first - low, last - low)
        image = np.empty((last - first, width, 3), np.float32)
        image[:] = _SKY_COLOUR
        if (what[inner] == _GROUND).any():
            reach = np.where(np.isfinite(to_ground), to_ground, 0.0)
            east = start[:, 0:1] + reach * direction[..., 0]
            north = start[:, 1:2] + reach * direction[..., 1]
            e_v, e_u, n_v, n_u = (
                np.asarray(slope)[inner] for ground in (east, north) for slope in np.gradient(ground)
            )
            colours = self.world.texture.colours(east[inner], north[inner], (e_u, e_v, n_u, n_v))
            _haze(colours, reach[inner])
            on_ground = (what[inner] == _GROUND)[..., None]
            np.copyto(image, colours, where=on_ground)
        if here:
            # What a ray changes from pixel to pixel.
            by_v, by_u = (np.asarray(slope) for slope in np.gradient(rays, axis=(0, 1)))
            steps = tuple(slope @ self.rotation[:2] for slope in (by_u, by_v))
            for visible in here:
                v, u = np.nonzero(what[inner] == visible.number)
                if len(v):
                    at = v + (first - low)
                    image[v, u] = _facet_colours(
                        visible.facet, start[at], direction[at, u], (steps[0][at, u], steps[1][at, u])
                    )
            v, u = np.nonzero(_outlines(what)[inner])
            if len(v):
                at = v + (first - low)
                cell = self.ground.cell_rows(v + first), self.ground.cell_columns(u)
                behind = to_ground[at, u]
                hidden = self.ground.care[cell] == 2  # searched only as far as the structure
                behind[hidden], _ = trace(self.world.relief, start[at[hidden]], direction[at, u][hidden])
                candidates = [(visible, visible.cells[cell]) for visible in here]
                image[v, u] = self._in_parts(
                    start[at],
                    direction[at, u],
                    (steps[0][at, u], steps[1][at, u]),
                    behind,
                    [(visible, pixels) for visible, pixels in candidates if pixels.any()],
                )
        return image

    def _cells(self, visible: _Visible, low: int, high: int) -> NDArray[np.bool_]:
        top, bottom = self.ground.cell_rows(np.array([low, high - 1]))
        return visible.cells[top : bottom + 1]

    def _pixels(self, visible: _Visible, low: int, high: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows (counted from ``low``) and columns of the pixels in a facet's cells."""
        columns = self.ground.columns
        used = np.flatnonzero(self._cells(visible, low, high).any(axis=0))
        first, last = columns[used[0]], columns[used[-1] + 1] + 1
        row = self.ground.cell_rows(np.arange(low, high))
        v, u = np.nonzero(visible.cells[np.ix_(row, self.ground.cell_columns(np.arange(first, last)))])
        return v, u + first

    def _in_parts(
        self,
        start: FloatArray,
        direction: FloatArray,
        steps: tuple[FloatArray, FloatArray],
        to_ground: FloatArray,
        candidates: list[tuple[_Visible, NDArray[np.bool_]]],
    ) -> Image32:
        """Colours (n, 3) of pixels on outlines: the mean over their parts, each seen for itself.

        candidates: facets and which of the n pixels are in their cells.
        """
        count = len(start)
        parts = len(_PARTS) ** 2
        # All parts of all pixels as one list: the first part of every pixel, then the second...
        du, dv = (np.repeat(n.ravel(), count)[:, None] for n in np.meshgrid(_PARTS, _PARTS))
        right, down, towards, start = (np.tile(n, (parts, 1)) for n in (*steps, direction, start))
        towards = towards + du * right + dv * down
        small = (0.25 * right, 0.25 * down)
        nearest = np.tile(to_ground, parts)
        below = np.flatnonzero(np.isfinite(nearest))
        if len(below):
            nearest[below] = newton(self.world.relief, start[below], towards[below], nearest[below])
        what = np.where(np.isfinite(nearest), _GROUND, _SKY)
        for visible, pixels in candidates:
            here = np.flatnonzero(np.tile(pixels, parts))
            distance, s, t = visible.facet.hit(start[here], towards[here])
            nearer = (distance < nearest[here]) & visible.facet.covers(s, t)
            nearest[here[nearer]], what[here[nearer]] = distance[nearer], visible.number
        colours = np.empty((len(start), 3), np.float32)
        colours[:] = _SKY_COLOUR
        on = np.flatnonzero(what == _GROUND)
        if len(on):
            colours[on] = self._ground_colours(
                start[on], towards[on], (small[0][on], small[1][on]), nearest[on]
            )
        for visible, _ in candidates:
            on = np.flatnonzero(what == visible.number)
            if len(on):
                colours[on] = _facet_colours(
                    visible.facet, start[on], towards[on], (small[0][on], small[1][on])
                )
        mean: Image32 = colours.reshape(parts, count, 3).mean(axis=0)
        return mean

    def _ground_colours(
        self,
        start: FloatArray,
        direction: FloatArray,
        steps: tuple[FloatArray, FloatArray],
        distance: FloatArray,
    ) -> Image32:
        """Colours (n, 3) of single rays that hit the ground at ``distance`` (n,)."""
        at = start + distance[:, None] * direction
        _, by_east, by_north = self.world.relief.height_and_gradient(at[:, 0], at[:, 1])
        normal = np.stack([-by_east, -by_north, np.ones(len(at))], axis=-1)
        facing = np.minimum(np.sum(normal * direction, axis=-1), -1e-3)
        slopes = []
        for axis in (0, 1):
            for step in steps:
                moved = step - direction * (np.sum(normal * step, axis=-1) / facing)[:, None]
                slopes.append(folded(distance * moved[:, axis]))
        colours = self.world.texture.colours(
            folded(at[:, 0]), folded(at[:, 1]), (slopes[0], slopes[1], slopes[2], slopes[3])
        )
        colours = colours.reshape(-1, 3)[: len(at)]
        _haze(colours, distance)
        return colours

    def image_motion(self, velocity_m_s: FloatArray, seen: list[_Visible]) -> FloatArray:
        """By how much the scene moves over the image at the map's nodes, px/s (a, b, 2)."""
        rows, columns = self.ground.rows, self.ground.columns
        nodes = self.rays[np.ix_(rows, columns)]
        direction = directions(nodes, self.rotation)
        inverse = self.ground.inverse.copy()
        for visible in seen:
            distance, s, t = visible.facet.hit(self.start_m[rows][:, None], direction)
            nearer = (1 / distance > inverse) & visible.facet.covers(s, t)
            inverse[nearer] = 1 / distance[nearer]
        right, down, ahead = self.rotation @ velocity_m_s
        # A point at depth Z moves by -v against the camera; its ray X / Z accordingly.
        x_rate = (nodes[..., 0] * ahead - right) * inverse
        y_rate = (nodes[..., 1] * ahead - down) * inverse
        by_v, by_u = (np.asarray(slope) for slope in np.gradient(nodes, rows, columns, axis=(0, 1)))
        determinant = by_u[..., 0] * by_v[..., 1] - by_v[..., 0] * by_u[..., 1]
        return np.stack(
            [
                (x_rate * by_v[..., 1] - y_rate * by_v[..., 0]) / determinant,
                (y_rate * by_u[..., 0] - x_rate * by_u[..., 1]) / determinant,
            ],
            axis=-1,
        )


def _facet_colours(
    facet: Facet, start: FloatArray, direction: FloatArray, steps: tuple[FloatArray, FloatArray]
) -> Image32:
    """Colours (n, 3) of rays (n, 3) that hit a facet; ``steps``: their change per px right and down."""
    distance, s, t = facet.hit(start, direction)
    facing = direction @ facet.front
    slopes = []
    for axis in (facet.along, facet.up):
        for step in steps:
            moved = step @ axis - (direction @ axis) * (step @ facet.front) / facing
            slopes.append(folded(distance * moved))
    colours = facet.texture.colours(folded(s), folded(t), (slopes[0], slopes[1], slopes[2], slopes[3]))
    assert colours.shape[:2] == as_list(len(s))
    return colours.reshape(-1, 3)[: len(s)]


def _outlines(what: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Pixels of a structure that have something else beside them, and what is beside them there."""
    edge = np.zeros(what.shape, bool)
    for one, other in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        border = (what[one] != what[other]) & ((what[one] > _GROUND) | (what[other] > _GROUND))
        edge[one] |= border
        edge[other] |= border
    return edge


def _haze(colours: Image32, distance: FloatArray) -> None:
    """Fade ground far away into the sky, so that the place where it ends is not seen."""
    if float(distance.max()) > FARTHEST_M / 4:
        clear = np.clip((FARTHEST_M - distance) / (0.75 * FARTHEST_M), 0, 1).astype(np.float32)[..., None]
        colours *= clear
        colours += _SKY_COLOUR * (1 - clear)


def _ray_bounds(corners_m: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Least and largest rays (2,) of a polygon (p, 3) in the camera frame; None if it is behind."""
    kept = []
    for one, other in zip(corners_m, np.roll(corners_m, -1, axis=0), strict=True):
        if one[2] >= _NEAREST_M:
            kept.append(one)
        if (one[2] >= _NEAREST_M) != (other[2] >= _NEAREST_M):
            kept.append(one + (other - one) * ((_NEAREST_M - one[2]) / (other[2] - one[2])))
    if not kept:
        return None
    points = np.array(kept)
    rays = points[:, :2] / points[:, 2:]
    return rays.min(axis=0), rays.max(axis=0)

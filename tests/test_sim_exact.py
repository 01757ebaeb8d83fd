"""Truth points projected by the truth camera land on the rendered feature, within 0.05 px everywhere."""

from __future__ import annotations

import io
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from dots import Eye, Surface, centroids
from PIL import Image
from scipy.spatial import cKDTree

from calib.camera import BrownCamera, FloatArray
from calib.field import Lens
from sim.buildings import lodge, wall
from sim.facet import Facet
from sim.flights import phantom3, rotation_looking
from sim.landforms import Plane
from sim.pattern import random_pattern
from sim.render import RenderOptions, lens_rays, render
from sim.world import World
from sim.worlds import ground

CLEAN = RenderOptions(blur_px=0.5, noise_levels=0.0, vignetting=0.0)
BLANK = (np.zeros((4096, 4096, 3), np.uint8),)


def looking(centre_m: tuple[float, float, float], target_m: tuple[float, float, float], **kw: object) -> Eye:
    """An eye at a place that looks at another, its image level."""
    east, north, up = np.subtract(target_m, centre_m)
    off_nadir = np.degrees(np.arctan2(np.hypot(east, north), -up))
    yaw = np.degrees(np.arctan2(east, north))
    rotation = rotation_looking(np.array([yaw]), np.array([off_nadir]))[0]
    return Eye(rotation, np.array(centre_m, float), **kw)  # type: ignore[arg-type]


def check(
    world: World,
    eye: Eye,
    surfaces: list[tuple[Surface, FloatArray]],
    sigma_m: float,
    *,
    options: RenderOptions = CLEAN,
    reach_px: int = 9,
    at_least: int = 40,
    spread: float = 0.5,
    jpeg: bool = False,
) -> None:
    """Render the world and compare all measurable dots with where they must be."""
    image = render(
        world,
        lens_rays(Lens(eye.camera), eye.pattern),
        eye.rotation,
        eye.centre_m,
        velocity_m_s=eye.velocity_m_s,
        options=replace(options, readout_s=eye.readout_s),
    )
    if jpeg:
        file = io.BytesIO()
        Image.fromarray(image).save(file, "JPEG", quality=93, subsampling=0)
        image = np.asarray(Image.open(file))
    expected, seen = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for surface, where in surfaces:
        if len(where):
            pixels, depth = eye.project(surface(where))
            seen.append(pixels[depth > 0])
            chosen = where[eye.usable(world, surface, where, sigma_m, reach_px)]
            expected.append(eye.expected(surface, chosen, sigma_m))
    must_be = np.concatenate(expected)
    # The nearest dot is itself; another must not reach into its box.
    apart = cKDTree(np.concatenate(seen)).query(must_be, k=2)[0][:, 1]
    must_be = must_be[apart > 2.2 * reach_px]
    assert len(must_be) >= at_least
    error = centroids(image[..., 1].astype(float), must_be, reach_px) - must_be
    assert np.abs(error).max() < 0.05
    assert np.abs(error.mean(axis=0)).max() < 0.01
    # The whole image is meant, not its middle only.
    assert (np.ptp(must_be, axis=0) > spread * eye.size).all()


def scattered(half_m: float, step_m: float) -> FloatArray:
    ticks = np.arange(-half_m, half_m, step_m)
    where = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    return where + np.random.default_rng(0).uniform(-0.1, 0.1, where.shape) * step_m


@lru_cache(maxsize=2)
def dotted_ground(kind: str, roughness: float = 0.03) -> tuple[World, FloatArray]:
    where = scattered(96, 6.0)
    return World(ground(kind, 3, 2.0, roughness), BLANK, 0.05).with_dots(where, 0.15), where


@pytest.mark.parametrize("kind", ["flat", "rolling", "levee", "valley"])
@pytest.mark.parametrize("view", [(0.0, 0.0, 50.0), (28.0, -20.0, 42.0)])
def test_grounds(kind: str, view: tuple[float, float, float]) -> None:
    world, where = dotted_ground(kind)
    check(world, looking(view, (0.5, 0.5, 0.0)), [(world.points_m, where)], 0.15)


SMALL = {"thermal": (640, 512), "full": (1000, 750), "portrait": (600, 800)}


@pytest.mark.parametrize("size", SMALL)
@pytest.mark.parametrize(("patterned", "readout_s"), [(False, 0.0), (True, 0.0), (True, 0.06)])
def test_lenses_and_shutters(size: str, readout_s: float, patterned: bool) -> None:
    width, height = SMALL[size]
    camera = replace(
        BrownCamera.ideal(width, height, 0.62 * width), k1=-0.1, k2=0.05, k3=-0.008, p1=4e-4, p2=-7e-4
    )
    camera = replace(camera, cx_px=camera.cx_px + 4.3, cy_px=camera.cy_px - 2.7, b1_px=1.1, b2_px=-0.4)
    pattern = random_pattern(2, camera, 2.0) if patterned else None
    world, where = dotted_ground("rolling")
    eye = looking(
        (3.0, -20.0, 42.0),
        (0.0, 0.0, 0.0),
        camera=camera,
        pattern=pattern,
        velocity_m_s=np.array([9.0, 6.0, -1.0]),
        readout_s=readout_s,
    )
    check(world, eye, [(world.points_m, where)], 0.15)


@pytest.mark.parametrize("readout_s", [0.0, 0.04])
def test_motion_blur_leaves_centres(readout_s: float) -> None:
    """Smeared by 3 px; the pose is the middle of the exposure, so that the centres stay."""
    world, where = dotted_ground("rolling")
    velocity = np.array([10.0, -5.0, 0.0])
    eye = looking((3.0, 2.0, 45.0), (0.0, 0.0, 0.0), velocity_m_s=velocity, readout_s=readout_s)
    exposure_s = 3.0 * 45.0 / eye.camera.f_px / 11.2
    check(
        world,
        eye,
        [(world.points_m, where)],
        0.15,
        options=replace(CLEAN, exposure_s=exposure_s),
        reach_px=11,
    )


def test_everything_at_once_and_through_jpeg() -> None:
    world, where = dotted_ground("levee")
    eye = looking(
        (-12.0, 25.0, 45.0),
        (0.0, 0.0, 0.0),
        pattern=random_pattern(5, phantom3(1000, 750), 1.5),
        velocity_m_s=np.array([-6.0, 6.0, 0.5]),
        readout_s=0.03,
    )
    options = RenderOptions(
        blur_px=0.8, noise_levels=0.0, vignetting=0.15, exposure_s=0.01, gain=0.9, white_balance=(1.1, 1, 0.9)
    )
    check(world, eye, [(world.points_m, where)], 0.15, options=options, reach_px=10, jpeg=True)


@pytest.mark.slow
def test_full_size() -> None:
    world, where = dotted_ground("rolling")
    eye = looking((4.0, 3.0, 50.0), (0.0, 8.0, 0.0), camera=phantom3())
    check(world, eye, [(world.points_m, where)], 0.15, reach_px=26)


def on_facet(facet: Facet, step_m: float, sigma_m: float) -> FloatArray:
    """Dots on a facet that are wholly on it."""
    low, high = facet.outline_m.min(axis=0), facet.outline_m.max(axis=0)
    ticks = [np.arange(a + 0.4 * step_m, b, step_m) for a, b in zip(low, high, strict=True)]
    where = np.stack(np.meshgrid(*ticks), axis=-1).reshape(-1, 2)
    whole = np.ones(len(where), bool)
    for angle in np.arange(0, 2 * np.pi, 0.3):
        s, t = (where + 5 * sigma_m * np.array([np.cos(angle), np.sin(angle)])).T
        whole &= facet.covers(s, t)
    return where[whole]


@lru_cache(maxsize=1)
def dotted_lodge(sigma_m: float) -> tuple[World, list[tuple[Surface, FloatArray]]]:
    facets, surfaces = [], []
    for facet in lodge(1, 0.012):
        where = on_facet(facet, 0.6, sigma_m)
        dotted = facet.with_dots(where, sigma_m)
        facets.append(dotted)
        surfaces.append((dotted.points_m, where))
    world = World(Plane(), BLANK, 0.05, tuple(facets)).with_dots(np.zeros((0, 2)), sigma_m)
    return world, surfaces


@pytest.mark.parametrize(("azimuth_deg", "readout_s"), [(20, 0.0), (110, 0.05), (200, 0.05), (290, 0.0)])
def test_lodge(azimuth_deg: float, readout_s: float) -> None:
    """Walls, roof and panes behind them, from all sides."""
    world, surfaces = dotted_lodge(0.03)
    a = np.radians(azimuth_deg)
    centre = (14.0 * np.sin(a), 11.0 * np.cos(a), 8.0)
    velocity = 4.0 * np.array([np.cos(a), -np.sin(a), 0.3])
    eye = looking(centre, (0.0, 0.0, 5.4), velocity_m_s=velocity, readout_s=readout_s)
    check(world, eye, surfaces, 0.03, reach_px=10, at_least=30, spread=0.4)


@lru_cache(maxsize=1)
def dotted_wall() -> tuple[World, Facet, FloatArray]:
    (bare,) = wall(1, 0.015)
    where = on_facet(bare, 0.7, 0.04)
    facet = bare.with_dots(where, 0.04)
    return World(Plane(-0.5), BLANK, 0.05, (facet,)).with_dots(np.zeros((0, 2)), 0.05), facet, where


@pytest.mark.parametrize(
    ("east_m", "patterned", "exposure_s"), [(-9.0, False, 0.0), (0.0, True, 0.01), (9.0, True, 0.0)]
)
def test_wall(east_m: float, patterned: bool, exposure_s: float) -> None:
    """From 10 m away, square on and at 45 degrees, as for a calibration."""
    world, facet, where = dotted_wall()
    eye = looking(
        (east_m, -10.0, 4.0),
        (0.0, 0.0, 4.2),
        pattern=random_pattern(3, phantom3(1000, 750), 1.5) if patterned else None,
        velocity_m_s=np.array([3.0, 0.0, 1.0]),
        readout_s=0.03,
    )
    options = replace(CLEAN, exposure_s=exposure_s)
    check(world, eye, [(facet.points_m, where)], 0.04, options=options, reach_px=11, spread=0.3)

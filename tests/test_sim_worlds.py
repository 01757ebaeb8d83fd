"""Worlds by name: heights, what hides what, repeatability, and worlds from GeoTIFFs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from rasterio.transform import from_origin

from calib.camera import FloatArray
from calib.errors import InputError
from calib.field import Lens
from calib.frames import LocalFrame
from sim.buildings import LODGE_M, WALL_M
from sim.flights import phantom3, rotation_looking
from sim.render import THERMAL, RenderOptions, lens_rays, render
from sim.trace import trace
from sim.world import World
from sim.worlds import KINDS, build_world, ground

CLEAN = RenderOptions(blur_px=0.0, noise_levels=0.0, vignetting=0.0)
MADE = [kind for kind in KINDS if kind != "dem"]


def small(kind: str, seed: int = 1, **options: float) -> World:
    return build_world(kind, seed, half_m=25.0, texel_m=0.1, **options)


@pytest.mark.parametrize("kind", MADE)
def test_the_same_for_a_seed_and_others_for_others(kind: str) -> None:
    one, two, other = small(kind), small(kind), small(kind, 2)
    assert np.array_equal(one.pyramid[0], two.pyramid[0])
    assert (one.pyramid[0] != other.pyramid[0]).mean() > 0.5
    where = np.linspace(-20, 20, 50)
    assert np.array_equal(one.height_m(where, where), two.height_m(where, where))
    assert len(one.facets) == len(two.facets)
    for a, b in zip(one.facets, two.facets, strict=True):
        assert np.array_equal(a.texture.pyramid[0], b.texture.pyramid[0])


@pytest.mark.parametrize("kind", MADE)
def test_grounds_keep_their_promises(kind: str) -> None:
    field = ground(kind, 4, 3.0, 0.03)
    rng = np.random.default_rng(0)
    east, north = rng.uniform(-250, 250, (2, 4000))
    height, by_east, by_north = field.height_and_gradient(east, north)
    assert np.array_equal(height, field.height_m(east, north)) or np.allclose(
        height, field.height_m(east, north), atol=1e-12
    )
    assert field.lowest_m - 1e-9 <= height.min()
    assert height.max() <= field.highest_m + 1e-9
    assert np.hypot(by_east, by_north).max() <= field.steepest
    step = 1e-4
    assert np.allclose(
        by_east,
        (field.height_m(east + step, north) - field.height_m(east - step, north)) / (2 * step),
        atol=1e-6,
    )
    assert np.allclose(
        by_north,
        (field.height_m(east, north + step) - field.height_m(east, north - step)) / (2 * step),
        atol=1e-6,
    )


def test_kinds_have_their_shapes() -> None:
    ticks = np.linspace(-150, 150, 601)
    east, north = np.meshgrid(ticks, ticks)
    flat, levee, valley, rolling = (
        ground(kind, 2, 2.0, 0.0).height_m(east, north) for kind in ("flat", "levee", "valley", "rolling")
    )
    assert not flat.any()
    assert 3.5 < np.ptp(levee) < 5.0
    assert 0.01 < (levee > 3.0).mean() < 0.1  # a bank, not a hill
    assert 9.0 < np.ptp(valley) < 13.0
    assert 1.0 < np.ptp(rolling) < 4.0
    rough = ground("flat", 2, 2.0, 0.05)
    slope = np.hypot(*rough.height_and_gradient(east, north)[1:])
    assert np.sqrt((slope**2).mean()) == pytest.approx(0.05, rel=0.1)


def test_lodge_has_the_papers_size() -> None:
    world = small("building")
    length, width, ridge = LODGE_M
    corners = np.concatenate([facet.corners_m for facet in world.facets])
    upright = [facet for facet in world.facets if abs(facet.front[2]) < 1e-9]
    walls = np.concatenate([facet.corners_m for facet in upright])
    assert np.ptp(walls[:, 0]) == pytest.approx(length)
    assert np.ptp(walls[:, 1]) == pytest.approx(width)
    assert corners[:, 2].max() == pytest.approx(ridge)
    at = np.array([0.0, 0.0, 3.0, 3.0, 20.0]), np.array([0.0, 1.5, 1.5, -1.5, 0.0])
    roof = world.height_m(*at, structures=True)
    slope = (ridge - 6.2) / (width / 2)
    assert roof[:4] == pytest.approx([ridge, ridge - 1.5 * slope, ridge - 1.5 * slope, ridge - 1.5 * slope])
    assert roof[4] == world.height_m(*at)[4]
    assert np.abs(world.height_m(*at)[:4]).max() < 0.01  # the ground below


def test_wall_is_where_it_is_said_to_be() -> None:
    (face,) = small("wall").facets
    assert np.ptp(face.corners_m, axis=0) == pytest.approx([WALL_M[0], 0.0, WALL_M[1]])
    assert face.corners_m[:, 1] == pytest.approx(0.0)
    assert face.corners_m[:, 2].min() == 0.0
    assert face.front == pytest.approx([0.0, -1.0, 0.0])


def test_rays_miss_no_hill() -> None:
    """Against a search in small steps, over rough ground at flat angles."""
    field = ground("levee", 5, 3.0, 0.06)
    rng = np.random.default_rng(1)
    start = np.column_stack([rng.uniform(-80, 80, (200, 2)), rng.uniform(8, 30, 200)])
    angle, fall = rng.uniform(0, 2 * np.pi, 200), rng.uniform(-0.6, 0.01, 200)
    towards = np.column_stack([np.cos(angle), np.sin(angle), fall])
    found, _ = trace(field, start, towards)
    steps = np.arange(0, 400, 0.05)
    for ray in range(200):
        at = start[ray] + steps[:, None] * towards[ray]
        under = np.flatnonzero(at[:, 2] < field.height_m(at[:, 0], at[:, 1]))
        if len(under):
            assert steps[under[0]] - 0.06 < found[ray] < steps[under[0]] + 1e-6
        else:
            assert found[ray] > 399


def view(
    world: World, centre: tuple[float, float, float], yaw: float, tilt: float, **options: object
) -> FloatArray:
    camera = phantom3(480, 360)
    rotation = rotation_looking(np.array([yaw]), np.array([tilt]))[0]
    image = render(
        world,
        lens_rays(Lens(camera)),
        rotation,
        np.array(centre),
        options=RenderOptions(**options) if options else CLEAN,  # type: ignore[arg-type]
    )
    return image.astype(float)


def painted(world: World, number: int, colour: int) -> World:
    """The world with the ground dark grey and one structure in one tone, for telling them apart."""
    dark = tuple(np.full_like(level, 20) for level in world.pyramid)
    facets = []
    for i, facet in enumerate(world.facets):
        tone = colour if i == number else 100
        levels = tuple(np.full_like(level, tone) for level in facet.texture.pyramid)
        facets.append(replace(facet, texture=replace(facet.texture, pyramid=levels, detail_seed=None)))
    return replace(world, pyramid=dark, facets=tuple(facets), detail_seed=None)


def test_the_lodge_hides_what_is_behind_it() -> None:
    """The north wall is seen from the north, not from the south; and the lodge hides the ground."""
    world = small("building")
    (north,) = [
        i for i, f in enumerate(world.facets) if f.front[1] > 0.9 and len(f.openings_m) and f.origin_m[1] > 3
    ]
    marked = painted(world, north, 250)
    from_south = view(marked, (0.0, -22.0, 8.0), 0.0, 80.0)
    from_north = view(marked, (0.0, 22.0, 8.0), 180.0, 80.0)
    assert (from_south[..., 0] > 240).sum() == 0
    assert (from_north[..., 0] > 240).mean() > 0.03
    from_top = view(marked, (0.0, 0.0, 40.0), 0.0, 0.0)
    assert (from_top[..., 0] > 240).sum() == 0
    length, width, ridge = LODGE_M
    area_px = (length + 0.7) * (width + 0.7) * phantom3(480, 360).f_px ** 2  # nearer to the eye at the ridge
    seen_px = float(((from_top[..., 0] > 60) & (from_top[..., 0] < 150)).sum())
    assert area_px / 34.5**2 < seen_px < area_px / (40 - ridge) ** 2


def test_a_levee_hides_what_is_behind_it() -> None:
    field = ground("levee", 3, 2.0, 0.0)
    world = build_world("levee", 3, half_m=120.0, texel_m=0.2, roughness=0.0)
    # Two points on both feet of the bank, seen from low down on one side.
    ticks = np.linspace(-60, 60, 2401)
    heights = field.height_m(ticks, -ticks)
    crest = int(heights.argmax())
    near, far = ticks[crest] + 14.0, ticks[crest] - 14.0
    eye = np.array([near + 15, -near - 15, heights[crest] * 0.8])
    points = world.points_m(np.array([[near, -near], [far, -far]]))
    found, _ = trace(field, np.tile(eye, (2, 1)), points - eye)
    assert found[0] == pytest.approx(1.0, abs=1e-6)
    assert found[1] < 0.8


def test_detail_at_all_distances() -> None:
    """From 5 m to 1 km there is something to match: contrast from one pixel to the next."""
    world = build_world("rolling", 1, half_m=500.0, texel_m=0.25)
    for height in (5.0, 20.0, 100.0, 1000.0):
        image = view(world, (0.0, 0.0, height), 0.0, 0.0)[..., 1]
        assert 3.0 < np.abs(np.diff(image, axis=1)).mean() < 30.0
    (face,) = small("wall").facets
    assert face.texture.detail_seed is not None


def test_exposure_white_balance_and_the_thermal_preset() -> None:
    world = small("building")
    pose = ((-3.0, -18.0, 9.0), 10.0, 70.0)
    clean = view(world, *pose)
    bright = view(
        world, *pose, blur_px=0.0, noise_levels=0.0, vignetting=0.0, gain=0.5, white_balance=(1.2, 1, 0.8)
    )
    ratio = (bright / np.maximum(clean, 1))[clean.min(axis=2) > 40]
    assert np.median(ratio, axis=0) == pytest.approx([0.6, 0.5, 0.4], abs=0.01)
    thermal = render(
        world,
        lens_rays(Lens(phantom3(640, 480))),
        rotation_looking(np.array([10.0]), np.array([70.0]))[0],
        np.array(pose[0]),
        velocity_m_s=np.array([2.0, 0, 0]),
        options=THERMAL,
    )
    assert np.array_equal(thermal[..., 0], thermal[..., 2])
    assert thermal.std() < 0.6 * clean.std()


def test_motion_blur_is_as_long_as_the_way() -> None:
    """A dot's second moment along the motion grows by that of a box of the way's length."""
    world = World(ground("flat", 1, 0.0, 0.0), (np.zeros((1024, 1024, 3), np.uint8),), 0.05)
    world = world.with_dots(np.zeros((1, 2)), 0.15)
    camera = phantom3(480, 360)
    variance = []
    for exposure in (0.0, 0.05):
        image = render(
            world,
            lens_rays(Lens(camera)),
            rotation_looking(np.zeros(1), np.zeros(1))[0],
            np.array([0.0, 0, 20]),
            velocity_m_s=np.array([10.0, 0, 0]),
            options=RenderOptions(blur_px=0.5, noise_levels=0, vignetting=0, exposure_s=exposure),
        )
        weight = np.maximum(image[150:210, 200:280, 1] - 61.0, 0)
        across = np.arange(80) - 39.5
        variance.append(float((weight.sum(axis=0) * across**2).sum() / weight.sum()))
    way_px = 10.0 * 0.05 / 20 * camera.f_px
    assert variance[1] - variance[0] == pytest.approx(way_px**2 / 12, rel=0.1)


# Worlds from GeoTIFFs.

UTM = "EPSG:32630"
EAST, NORTH, POST = 430_000.0, 5_632_000.0, 2.0


def hills(x: FloatArray, y: FloatArray) -> FloatArray:
    """Heights at places in the DEM's own coordinates, m from its middle."""
    return 80 + 4 * np.sin(x / 23) + 3 * np.cos(y / 31 + x / 50)


def write_dem(path: Path, **changes: object) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A DEM of 140 x 160 posts; its posts' coordinates and heights."""
    columns, rows = 160, 140
    x = (np.arange(columns) + 0.5 - columns / 2) * POST
    y = -(np.arange(rows) + 0.5 - rows / 2) * POST
    grid_x, grid_y = np.meshgrid(x, y)
    heights = hills(grid_x, grid_y).astype(np.float32)
    profile: dict[str, object] = {
        "driver": "GTiff",
        "width": columns,
        "height": rows,
        "count": 1,
        "dtype": "float32",
        "crs": UTM,
        "nodata": -9999.0,
        "transform": from_origin(EAST + x[0] - POST / 2, NORTH + y[0] + POST / 2, POST, POST),
    }
    hole = changes.pop("hole", None)
    written = heights.copy()
    if hole is not None:
        written[hole] = -9999.0  # type: ignore[index]
    profile.update(changes)
    with rasterio.open(path, "w", **profile) as out:
        out.write(written.astype(str(profile["dtype"])), 1)
    return grid_x + EAST, grid_y + NORTH, heights


def local(world: World, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """East and north in the world of places in the DEM's coordinates."""
    assert world.origin_wgs84 is not None
    latitude, longitude, _ = world.origin_wgs84
    there_lon, there_lat = Transformer.from_crs(UTM, "EPSG:4326", always_xy=True).transform(
        x.ravel(), y.ravel()
    )
    enu = LocalFrame(latitude, longitude).enu(
        np.asarray(there_lat), np.asarray(there_lon), np.zeros(len(there_lat))
    )
    return enu[:, 0], enu[:, 1]


def test_dem_world_has_the_dems_heights(tmp_path: Path) -> None:
    x, y, heights = write_dem(tmp_path / "dem.tif")
    world = build_world("dem", 1, half_m=120.0, texel_m=0.5, dem=tmp_path / "dem.tif")
    assert world.origin_wgs84 is not None
    east, north = local(world, x, y)
    inside = (np.abs(east) < 120) & (np.abs(north) < 120)
    found = world.height_m(east[inside], north[inside]) + world.origin_wgs84[2]
    assert np.abs(found - heights.ravel()[inside]).max() < 2e-4
    # Between the posts too, where the spline follows the smooth hills.
    off_x, off_y = x[60:80, 60:80] + 0.7, y[60:80, 60:80] - 0.9
    between = world.height_m(*local(world, off_x, off_y)) + world.origin_wgs84[2]
    assert np.abs(between - hills(off_x - EAST, off_y - NORTH).ravel()).max() < 5e-3
    assert world.height_m(np.zeros(1), np.zeros(1))[0] == pytest.approx(0.0, abs=1e-9)


def test_dem_ground_keeps_its_promises(tmp_path: Path) -> None:
    write_dem(tmp_path / "dem.tif")
    field = build_world("dem", 1, half_m=60.0, texel_m=0.5, dem=tmp_path / "dem.tif").relief
    east, north = np.random.default_rng(0).uniform(-100, 100, (2, 2000))
    height, by_east, by_north = field.height_and_gradient(east, north)
    assert field.lowest_m <= height.min()
    assert height.max() <= field.highest_m
    assert np.hypot(by_east, by_north).max() <= field.steepest
    step = 1e-3
    slope = (field.height_m(east + step, north) - field.height_m(east - step, north)) / (2 * step)
    assert np.allclose(by_east, slope, atol=1e-5)
    assert np.isfinite(field.height_m(np.array([900.0]), np.array([-900.0]))).all()  # beyond its border


def test_dem_with_holes_is_filled_from_beside_them(tmp_path: Path) -> None:
    x, y, heights = write_dem(tmp_path / "dem.tif", hole=np.s_[60:66, 100:104])
    world = build_world("dem", 1, half_m=120.0, texel_m=0.5, dem=tmp_path / "dem.tif")
    assert world.origin_wgs84 is not None
    east, north = local(world, x[63:64, 101:102], y[63:64, 101:102])
    assert world.height_m(east, north)[0] + world.origin_wgs84[2] == pytest.approx(heights[63, 101], abs=2.0)


def test_orthophoto_lies_where_it_belongs(tmp_path: Path) -> None:
    write_dem(tmp_path / "dem.tif")
    side = 400
    photo = np.zeros((3, side, side), np.uint8)
    photo[0, :200] = 200  # the north half is red
    photo[2, :, 200:] = 150  # the east half has blue
    with rasterio.open(
        tmp_path / "ortho.tif",
        "w",
        driver="GTiff",
        width=side,
        height=side,
        count=3,
        dtype="uint8",
        crs=UTM,
        transform=from_origin(EAST - 100, NORTH + 100, 0.5, 0.5),
    ) as out:
        out.write(photo)
    world = build_world(
        "dem", 1, half_m=60.0, texel_m=0.25, dem=tmp_path / "dem.tif", ortho=tmp_path / "ortho.tif"
    )
    raster = world.pyramid[0].astype(int)
    quarter = len(raster) // 4
    assert raster[quarter, quarter].tolist() == [200, 0, 0]
    assert raster[quarter, 3 * quarter].tolist() == [200, 0, 150]
    assert raster[3 * quarter, 3 * quarter].tolist() == [0, 0, 150]


def test_bad_files_are_told_in_one_sentence(tmp_path: Path) -> None:
    def fails(match: str, **arguments: object) -> None:
        given: dict[str, object] = {"half_m": 30.0, "texel_m": 0.5, **arguments}
        with pytest.raises(InputError, match=match) as told:
            build_world(str(given.pop("kind", "dem")), 1, **given)  # type: ignore[arg-type]
        assert str(told.value).count("\n") == 0

    good, bad = tmp_path / "good.tif", tmp_path / "bad.tif"
    write_dem(good)
    fails("is not there", dem=tmp_path / "none.tif")
    fails("is not there", dem=tmp_path)
    bad.write_bytes(b"II*\0 not a tiff at all")
    fails("cannot be read as a GeoTIFF", dem=bad)
    bad.write_bytes(good.read_bytes()[:3000])
    fails("damaged|cannot be read", dem=bad)
    write_dem(bad, crs=None)
    fails("coordinate reference system", dem=bad)
    write_dem(bad, hole=np.s_[:])
    fails("no heights", dem=bad)
    fails("orthophoto.*is not there", dem=good, ortho=tmp_path / "none.tif")
    fails("8 or 16 bits", dem=good, ortho=good)
    fails("needs a DEM", dem=None)
    fails("takes no DEM", kind="flat", dem=good)
    fails("needs a DEM to lie on", kind="flat", ortho=good)
    fails("no world of the kind 'moon'", kind="moon")
    fails("above 0 m", kind="flat", half_m=0.0)

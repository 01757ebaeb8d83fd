"""Recipes: who flies what; the cameras they fly with."""

from __future__ import annotations

import numpy as np
import pytest

from calib.camera import FloatArray
from calib.equifinal_published import LINE_6
from calib.errors import InputError
from calib.frames import rotation_tilt_deg
from calib.references import load_reference
from sim.cameras import CAMERAS, INSPIRE_1, PHANTOM_4_PRO, WIRIS_PRO
from sim.flights import flight_plan, phantom3
from sim.plans import SITE_A, SITE_B
from sim.recipes import RECIPES, find_recipe
from sim.shapes import block, looking_at

NAMES = list(RECIPES)


def tilts(name: str) -> FloatArray:
    return np.array([rotation_tilt_deg(r) for r in find_recipe(name).flight().rotations_cam_from_world])


@pytest.mark.parametrize("name", NAMES)
def test_every_recipe_flies_what_it_states(name: str) -> None:
    recipe = RECIPES[name]
    flight = recipe.flight()
    assert len(flight) == recipe.photos
    r = flight.rotations_cam_from_world
    assert np.allclose(r @ r.transpose(0, 2, 1), np.eye(3), atol=1e-12)
    assert np.allclose(np.linalg.det(r), 1)
    assert np.allclose(np.linalg.norm(flight.track, axis=1), 1)
    assert len(recipe.summary) < 56
    assert np.abs(recipe.outline_m).max() < recipe.reach_m


@pytest.mark.parametrize("name", ["demo", "demo_nadir", "nadir_one_height", "crosshatch_nadir"])
def test_older_names_fly_as_before(name: str) -> None:
    """Benchmarks hold their results against earlier ones."""
    for scale in (1.0, 0.5):
        mine, before = find_recipe(name).flight(scale), flight_plan(name, 120.0 * scale)
        assert np.array_equal(mine.centres_m, before.centres_m)
        assert np.array_equal(mine.rotations_cam_from_world, before.rotations_cam_from_world)
    assert find_recipe(name).roughness == 0
    assert find_recipe(name).world == "rolling"


@pytest.mark.parametrize("site", ["A", "B"])
def test_papers_patterns(site: str) -> None:
    """[C&D] Table 2."""
    for number, heights, oblique in (
        ("1", {60}, 0),
        ("2", {60, 80}, 0),
        ("3", {60}, 8),
        ("4", {60, 80}, 8),
    ):
        flight = find_recipe(site + number).flight()
        assert set(np.round(flight.centres_m[:, 2])) == heights
        tilt = tilts(site + number)
        assert (tilt > 1).sum() == oblique
        assert tilt[tilt > 1] == pytest.approx(40.0)
        if oblique:
            assert flight.centres_m[-8:, 2] == pytest.approx(60.0)
            assert oblique / len(flight) > 0.1
    assert len(find_recipe(site + "4").flight()) == len(find_recipe(site + "2").flight()) + 8


@pytest.mark.parametrize(("site", "outline"), [("A", SITE_A), ("B", SITE_B)])
def test_nadir_photos_lie_over_the_site_and_overlap(site: str, outline: FloatArray) -> None:
    flight = find_recipe(site + "1").flight()
    side = np.roll(outline, -1, axis=0) - outline
    offset = flight.centres_m[:, None, :2] - outline
    assert (side[:, 0] * offset[..., 1] - side[:, 1] * offset[..., 0] > -1e-9).all()
    camera = phantom3()
    half = 60.0 * 0.5 * np.array([camera.width, camera.height]) / camera.f_px
    steps = np.diff(flight.centres_m[:, :2], axis=0)
    same_line = (flight.track[1:] == flight.track[:-1]).all(axis=1)
    along = np.linalg.norm(steps[same_line], axis=1)
    assert 0.75 < 1 - along.max() / (2 * half[1]) < 0.9
    across = np.abs(
        np.cross(np.append(flight.track[0, :2], 0), np.column_stack([steps, np.zeros(len(steps))]))
    )
    between = across[~same_line].max()
    assert 0.65 < 1 - between / (2 * half[0]) < 0.85
    # Every place of the site is in at least three photos.
    inside = outline.mean(axis=0) + 0.98 * (outline - outline.mean(axis=0))
    offsets = inside[:, None] - flight.centres_m[None, :, :2]
    ahead = flight.track[:, :2]
    right = np.column_stack([ahead[:, 1], -ahead[:, 0]])
    seen = (np.abs(np.sum(offsets * right, axis=-1)) < half[0]) & (
        np.abs(np.sum(offsets * ahead, axis=-1)) < half[1]
    )
    assert seen.sum(axis=1).min() >= 3


def test_wall_pairs_meet_on_the_wall_at_45_degrees() -> None:
    flight = find_recipe("wall").flight()
    assert len(flight) == 24
    forward = flight.rotations_cam_from_world[:, 2]
    meet = flight.centres_m + forward * (-flight.centres_m[:, 1] / forward[:, 1])[:, None]
    assert meet[0::2] == pytest.approx(meet[1::2])
    assert np.abs(meet[:, 0]).max() < 15
    assert flight.centres_m[:, 1] == pytest.approx(-10.0)
    normal = np.array([0.0, 1.0, 0.0])
    assert np.degrees(np.arccos(forward @ normal)) == pytest.approx(45.0)
    assert np.sum(forward[0::2] * forward[1::2], axis=1) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(("name", "photos"), [("building-rgb", 101), ("building-thermal", 158)])
def test_building_circles(name: str, photos: int) -> None:
    recipe = find_recipe(name)
    flight = recipe.flight()
    assert len(flight) == photos
    assert len(set(np.round(flight.centres_m[:, 2], 3))) >= 3
    distance = np.hypot(flight.centres_m[:, 0], flight.centres_m[:, 1])
    assert distance.min() - np.hypot(12.5, 7.5) / 2 > 8  # off the walls
    camera = recipe.camera.lens()
    # The building's corners are in most photos, and its middle in all of them.
    corners = np.array([[x, y, z] for x in (-6.25, 6.25) for y in (-3.75, 3.75) for z in (0, 10.5)])
    for points, least in ((np.array([[0.0, 0.0, 5.0]]), 1.0), (corners, 0.6)):
        local = np.einsum(
            "kij,kmj->kmi", flight.rotations_cam_from_world, points[None] - flight.centres_m[:, None]
        )
        pixels = camera.project(local[..., :2] / local[..., 2:])
        inside = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(axis=-1)
        assert inside.mean() >= least
    fewer = recipe.flight(photos=20)
    assert len(fewer) == 20
    assert len(set(np.round(fewer.centres_m[:, 2], 3))) >= 3


def test_oblique_lines_look_against_each_other_and_the_corridor_is_long() -> None:
    assert tilts("oblique") == pytest.approx(20.0)
    ahead = find_recipe("oblique").flight().rotations_cam_from_world[:, 2, 1]
    assert (ahead > 0).sum() == (ahead < 0).sum() == 16
    span = np.ptp(find_recipe("corridor").flight().centres_m, axis=0)
    assert span[0] > 10 * span[1] > 0


def test_block_stays_on_a_turned_outline() -> None:
    turned = np.array([[0.0, 0.0], [80.0, 60.0], [50.0, 100.0], [-30.0, 40.0]])  # 100 x 50 m
    flight = block(turned, 50.0, between_lines_m=25.0, along_line_m=20.0, heading_deg=53.130102354)
    assert len(flight) == 2 * 6
    assert np.linalg.norm(np.diff(flight.centres_m[:6, :2], axis=0), axis=1) == pytest.approx(20.0)
    assert flight.centres_m[:, :2].min() >= -30 - 1e-9
    assert flight.track[0, :2] == pytest.approx([0.8, 0.6])
    assert flight.track[6, :2] == pytest.approx([-0.8, -0.6])


def test_looking_at_puts_the_aim_into_the_middle() -> None:
    centres = np.array([[30.0, 0, 5], [0, -20, 30], [-7, 9, 2]])
    aim = np.array([1.0, 2.0, 4.0])
    local = np.einsum("kij,kj->ki", looking_at(centres, aim), aim - centres)
    assert local[:, :2] == pytest.approx(0, abs=1e-12)
    assert (local[:, 2] > 0).all()


def test_number_of_photos() -> None:
    assert len(find_recipe("orbit").flight(photos=12)) == 12
    with pytest.raises(InputError, match=r"fixed \(37\); it can be chosen for orbit, building-rgb"):
        find_recipe("A3").flight(photos=12)
    for photos in (3, 0, -1, 100_000):
        with pytest.raises(InputError, match="from 4 to 200"):
            find_recipe("orbit").flight(photos=photos)


@pytest.mark.parametrize(
    ("wrong", "hint"), [("a3", "Did you mean A3"), ("waal", "wall"), ("xyzzy", "sim list")]
)
def test_unknown_recipe(wrong: str, hint: str) -> None:
    with pytest.raises(InputError, match=hint):
        find_recipe(wrong)


# -- cameras ----------------------------------------------------------------------------------------


def test_inspire_lies_on_its_published_line() -> None:
    """[C&D] eq. 6 and its domain; f from the text."""
    lens = INSPIRE_1.lens()
    assert lens.f_px == 2326.07
    assert LINE_6.k1_min < lens.k1_px < LINE_6.k1_max
    assert LINE_6.k2_min < lens.k2_px < LINE_6.k2_max
    assert lens.k2_px == pytest.approx(LINE_6.slope * lens.k1_px + LINE_6.intercept, rel=1e-9)
    assert lens.k3 == 0  # the line holds for models without K3


@pytest.mark.parametrize(
    ("camera", "reference"), [(PHANTOM_4_PRO, "dji-phantom-4-pro"), (WIRIS_PRO, "workswell-wiris-pro")]
)
def test_senn_cameras_are_those_of_the_library(camera: object, reference: str) -> None:
    bundled = load_reference(reference).brown
    assert bundled is not None
    assert camera.lens().vector == pytest.approx(bundled.vector, rel=1e-8)  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", list(CAMERAS))
def test_every_pixel_has_a_ray(name: str) -> None:
    camera = CAMERAS[name].at(*CAMERAS[name].default_size)
    corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]], float)
    assert np.isfinite(camera.unproject(corners)).all()


@pytest.mark.parametrize(
    ("size", "why"),
    [((1000, 1000), "another shape"), ((100, 75), "nothing is left"), ((8000, 6000), "takes 4000x3000 px")],
)
def test_silly_sizes(size: tuple[int, int], why: str) -> None:
    CAMERAS["phantom-3"].check_size(1000, 750)
    with pytest.raises(InputError, match=why):
        CAMERAS["phantom-3"].check_size(*size)

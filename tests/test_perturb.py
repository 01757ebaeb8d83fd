"""The perturbation experiment on small exact blocks of the wall: the truth lies on the zero line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.align.adjust import Adjustment, State
from calib.camera import BrownCamera
from calib.equifinal import Radial, equifinal_region
from calib.equifinal_published import P3P_WALL
from calib.errors import InputError
from calib.perturb import Perturber, cubic_through, held_at, perturb, quadric, zero_k2_px, zero_tangent
from calib.wall import wall_block, wall_poses
from sim.flights import phantom3


@pytest.fixture(scope="module")
def wall() -> tuple[Adjustment, State]:
    return wall_block(phantom3(), 150)


def test_wall_is_as_published() -> None:
    camera = phantom3()
    wall = wall_poses(camera)
    assert len(wall.centres_m) == 24
    # [C&D] discussion: the distance was roughly 20 % of the wall's width.
    assert 0.15 < 10 / wall.width_m < 0.25
    axis = wall.rotations_cam_from_world[:, 2]
    assert np.degrees(np.arccos(-axis[:, 2])) == pytest.approx(45)
    spots = wall.centres_m + axis * (wall.centres_m[:, 2:] / -axis[:, 2:])
    assert spots[::2] == pytest.approx(spots[1::2])
    assert np.linalg.det(wall.rotations_cam_from_world) == pytest.approx(1)


def test_quadric_of_a_known_surface() -> None:
    x, y = np.meshgrid(np.linspace(-25, 25, 21), np.linspace(-4, 4, 9))
    z = 0.2 * (x / 25) ** 2 - 0.1 * x * y / 625 + 0.01 * x
    found = quadric(np.column_stack([x.ravel(), y.ravel(), z.ravel()]))
    assert found.x2 * 25 == pytest.approx(0.2, rel=1e-9)
    assert found.r2 == pytest.approx(1)
    with pytest.raises(InputError):
        quadric(np.zeros((20, 3)))


def test_truth_is_flat_and_both_sides_of_it_are_not(wall: tuple[Adjustment, State]) -> None:
    block = Perturber(*wall)
    lens = wall[1].lens
    truth = block.surface(held_at(lens, P3P_WALL.k1_px, P3P_WALL.k2_px)).x2
    above = block.surface(held_at(lens, P3P_WALL.k1_px, P3P_WALL.k2_px + 2e-16)).x2
    below = block.surface(held_at(lens, P3P_WALL.k1_px, P3P_WALL.k2_px - 2e-16)).x2
    assert abs(truth) < 1e-6
    # Too large a K2 bulges towards the cameras, as in the corners of [C&D] fig. 6.
    assert above < -1e-4
    assert below > 1e-4


def test_grid_root_and_tangent_agree(wall: tuple[Adjustment, State]) -> None:
    """Three ways to the zero line: a grid, roots at single K1, and the linearisation."""
    adjustment, state = wall
    tangent = zero_tangent(adjustment, state)
    k1 = np.array([-2.7e-8, -2.6e-8, -2.5e-8, -2.4e-8])
    grid = perturb(adjustment, state, k1, np.linspace(3.4e-15, 4.6e-15, 7))
    line = grid.zero_line()
    assert line[:, 0] == pytest.approx(k1)
    assert grid.x2[0].min() > 0 > grid.x2[-1].max()
    assert grid.r2.min() > 0.5
    block = Perturber(adjustment, state)
    for one, k2 in line:
        root = zero_k2_px(block, state.lens, float(one), float(k2), 4e-16)
        assert k2 == pytest.approx(root, abs=6e-18)
    slope = np.polyfit(line[:, 0], line[:, 1], 1)[0]
    assert slope == pytest.approx(tangent.slope, rel=0.02)
    assert np.polyval(cubic_through(line), P3P_WALL.k1_px) == pytest.approx(P3P_WALL.k2_px, abs=1e-17)
    middle = tangent.intercept(P3P_WALL.k3_px) + tangent.slope * P3P_WALL.k1_px
    assert middle == pytest.approx(P3P_WALL.k2_px, rel=1e-12)


def test_the_line_without_k3_is_where_the_tangent_puts_it(wall: tuple[Adjustment, State]) -> None:
    adjustment, state = wall
    bare = replace(state, lens=held_at(state.lens, P3P_WALL.k1_px, P3P_WALL.k2_px, 0.0))
    tangent = zero_tangent(adjustment, state)
    expected = tangent.intercept(0.0) + tangent.slope * -2.43e-8
    found = zero_k2_px(Perturber(adjustment, state), bare.lens, -2.43e-8, expected, 4e-16)
    assert found == pytest.approx(expected, rel=0.01)
    assert found < P3P_WALL.k2_px - 3e-16


def test_slope_goes_with_the_closed_form_of_the_radius_reached(wall: tuple[Adjustment, State]) -> None:
    adjustment, state = wall
    slope = zero_tangent(adjustment, state).slope
    closed = equifinal_region(P3P_WALL, 2000.0, 2.0, P3P_WALL.k3_px).slope
    radius = 2000 * np.sqrt(closed / slope)
    reached = np.linalg.norm(adjustment.obs.pixels - [2000, 1500], axis=1)
    assert np.percentile(reached, 90) < radius < reached.max()
    follows = zero_tangent(adjustment, state, free_f=True).slope
    assert abs(follows / slope - 1) < 0.15
    assert follows != pytest.approx(slope, rel=0.005)


def test_what_has_no_zero_line_says_so(wall: tuple[Adjustment, State]) -> None:
    adjustment, state = wall
    with pytest.raises(InputError, match="does not vanish"):
        zero_k2_px(Perturber(adjustment, state), state.lens, -2.5e-8, 8e-15, 1e-16)
    with pytest.raises(InputError, match="fewer than four"):
        cubic_through(np.zeros((3, 2)))
    with pytest.raises(InputError, match="too little"):
        wall_block(BrownCamera.ideal(4000, 3000, 2320.0), 10)
    assert Radial.of(state.lens.brown).k1_px == pytest.approx(P3P_WALL.k1_px)

"""Each section of docs/papers.md on a tiny configuration, with bounds on both sides."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.equifinal import equifinal_region, without_scale
from calib.equifinal_published import LINE_5, P3P_WALL
from sim.papers import lines, orbit, published, senn_rows, survey, walls
from sim.papers.__main__ import renewed
from sim.papers.common import Place, Section, computed
from sim.papers.flights import FLIGHTS, Case, fly, plan_of
from sim.papers.tables import gathered, k2_error_e15


@pytest.fixture
def place(tmp_path: Path) -> Place:
    return Place(tmp_path / "papers", tmp_path / "raw", 1)


def test_equation_5(place: Place) -> None:
    """The closed form is flatter than (5), by less than 4 %, and a little smaller radius restores it."""
    slope = equifinal_region(P3P_WALL, 2000.0, 2.0).slope
    assert 0.96 < slope / LINE_5.slope < 0.99
    assert 1950 < lines.best_radius_px(P3P_WALL, LINE_5.slope) < 1990
    text = lines.section(place, draws=20_000).text
    assert "theirs (5)" in text
    assert "theirs (6)" in text
    assert {path.name for path in place.figures.iterdir()} == {"profiles.png", "equifinal.png"}


def test_deviation_map_is_the_regions() -> None:
    region = equifinal_region(P3P_WALL, 2000.0, 2.0)
    k1, k2 = region.corners[:: len(region.corners) // 7].T
    edge = np.diag(lines.deviation_px(P3P_WALL, k1, k2))
    assert edge == pytest.approx(2.0, abs=0.01)


def test_wall_experiment(place: Place) -> None:
    """Zero line through the calibration found, and its slope near the linearised one."""
    found = walls.experiment(place, "Phantom 3", (6, 6), points=120)
    line = found.zero_line()
    assert 4 <= len(line) <= 6
    _, state = walls.wall_of("Phantom 3", 0.5, 120, 0)
    brown = state.lens.brown
    assert brown.f_px == pytest.approx(2320.06, rel=2e-3)
    fitted = np.polyfit(line[:, 0], line[:, 1], 1)
    assert np.polyval(fitted, brown.k1_px) == pytest.approx(brown.k2_px, rel=0.02)
    assert -3.1e-7 < fitted[0] < -2.3e-7
    # What is done already is not done again.
    assert walls.experiment(place, "Phantom 3", (6, 6), points=120).x2 == pytest.approx(found.x2)
    assert len((place.raw / "wall.jsonl").read_text().splitlines()) == 6


def test_table_3_follows_from_equation_7_six_times(place: Place) -> None:
    page = Section("")
    walls._table_3(page, walls.experiment(place, "Phantom 3", (5, 5), points=120))
    assert "6 of 8 follow from (7)" in page.text


def test_flights_are_those_of_table_2() -> None:
    tilted = {}
    for name in FLIGHTS:
        plan = plan_of(name)
        heights = {round(float(h)) for h in plan.centres_m[:, 2]}
        assert heights == ({60, 80} if name[1] in "24" else {60})
        tilt = np.degrees(np.arccos(np.clip(-plan.rotations_cam_from_world[:, 2, 2], -1, 1)))
        tilted[name] = int((tilt > 20).sum())
        width = np.ptp(plan.centres_m[tilt < 20][:, 0])
        assert (width < 40) == (name[0] == "B")
    assert tilted == {name: 8 if name[1] in "34" else 0 for name in FLIGHTS}


@pytest.fixture(scope="module")
def flown() -> dict[str, dict[str, Any]]:
    """One flight each of A1 (nadir, Brown's lens) and B4 (convergent), with ours on the latter."""
    return {"A1": fly(Case("A1", 0.0, 3, False)), "B4": fly(Case("B4", 1.5, 3, True))}


def test_convergent_photos_hold_f_and_nadir_ones_do_not(flown: dict[str, dict[str, Any]]) -> None:
    nadir, both = flown["A1"]["plain"], flown["B4"]["plain"]
    assert nadir["sigma_f"] > 5 * both["sigma_f"]
    assert abs(both["f"] / 2320.06 - 1) < 0.01
    assert abs(nadir["f"] / 2320.06 - 1) < 0.02
    assert abs(flown["B4"]["ours"]["f"] / 2320.06 - 1) < 0.003
    assert gathered([flown["A1"]], "ours", "f").size == 0


def test_seven_parameters_and_precision(flown: dict[str, dict[str, Any]]) -> None:
    for result in flown.values():
        tx, ty, tz, phi, theta, psi, scale = result["plain"]["seven"]
        assert max(abs(v) for v in (tx, ty, tz)) < 4
        assert max(abs(v) for v in (phi, theta, psi)) < 3
        assert 95 < scale < 105
        assert 0.005 < result["plain"]["eta_p"] < 0.3
        assert all(sigma > 0 for sigma in result["plain"]["seven_sigma"])
        assert k2_error_e15([result], "plain")[0] < 0.5


def test_moving_k_onto_the_line_raises_the_residuals(flown: dict[str, dict[str, Any]]) -> None:
    for result in flown.values():
        assert 1.05 < result["line"]["sigma0"] / result["plain"]["sigma0"] < 3
        assert 1.2 < result["line, f held"]["sigma0"] / result["plain"]["sigma0"] < 3
    assert flown["A1"]["wall"]["sigma0"] == pytest.approx(flown["A1"]["plain"]["sigma0"], rel=0.02)


@pytest.mark.parametrize("name", ["canon-eos-rebel-t2i", "lg-nexus-5", "microdrone-2-hd"])
def test_lines_of_other_lenses_agree(name: str) -> None:
    """Closed form, Monte Carlo and the flat wall's zero line, as the theory in the page says."""
    found = survey.compared(survey.Lens(name, points=150, draws=100_000))
    assert found["opposite"]
    assert found["sampled"] == pytest.approx(found["closed"], rel=0.01)
    assert found["roots"] == pytest.approx(found["held"], rel=0.01)
    radius = np.sqrt(found["closed"] / found["held"])
    assert 0.9 < radius < 1.2
    assert 1.0 < found["reached"] < 1.25


def test_all_of_table_5_have_opposite_signs() -> None:
    assert len(published.TABLE_5) == 11
    for name in published.TABLE_5:
        camera, _ = survey.camera_of(name)
        assert camera.k1 * camera.k2 < 0


def test_building_in_steps() -> None:
    flown = orbit.fly("RGB add6", 1)
    stages = orbit.staged(flown)
    sigma0 = [one.sigma0 for _, one in stages]
    assert all(later < earlier * 1.005 for earlier, later in pairwise(sigma0))
    assert 1.0 < sigma0[-1] < 3.0
    last, truth = stages[-1][1], flown.camera
    sigma = np.sqrt(np.diag(last.covariance))
    free = sigma > 0
    off = (last.camera.vector - truth.vector)[free] / sigma[free]
    # The targets' errors are common to all photos: more than sigma says, but not much more.
    assert 0.3 < np.sqrt(np.mean(off**2)) < 4
    solved, correlation = orbit.with_k4(flown, last)
    assert -0.9999 < correlation < -0.97
    assert solved.sigma0 == pytest.approx(last.sigma0, rel=0.02)


def test_clean_marks_give_the_lens_back() -> None:
    """Without noise in marks and targets the building gives the lens itself."""
    flown = orbit.fly("thermal add6", 2)
    exact = _without_noise(flown)
    last = orbit.staged(exact)[-1][1]
    assert last.camera.vector == pytest.approx(flown.camera.vector, rel=1e-5, abs=1e-4)
    assert last.control_rms_px < 1e-5


def _without_noise(flown: orbit.Orbit) -> orbit.Orbit:
    offset = flown.targets_m[flown.target] - flown.centres_m[flown.photo]
    in_cam = np.einsum("nij,nj->ni", flown.rotations_cam_from_world[flown.photo], offset)
    return replace(flown, pixels=flown.camera.project(in_cam[:, :2] / in_cam[:, 2:]))


def test_table_2_agrees_in_shape_in_one_direction(place: Place) -> None:
    """[SEN] fig. 5: printed K1 have opposite signs, the RGB profiles one shape to 2 px of 5472."""
    cameras = {key: senn_rows.camera_of(key)[0] for key in published.TABLE_2}
    assert all(camera.k1 < 0 for camera in cameras.values())
    radius = np.linspace(0, 2736, 101)[1:]
    for pair in ("subset", "add6"):
        one, other = (cameras["RGB", program, pair] for program in ("VMS", "Metashape"))
        difference = senn_rows.profile_px(one, radius) - senn_rows.profile_px(other, radius)
        assert 0.2 < np.abs(without_scale(difference, radius)).max() < 2
        naive = senn_rows.camera_of(("RGB", "VMS", pair), flipped=True)[0]
        assert senn_rows.mapping_px(naive, other) > 1.03 * senn_rows.mapping_px(one, other)
    assert "| RGB: VMS subset, Metashape subset |" in senn_rows.section(place).text


def test_sections_are_renewed_alone() -> None:
    text = "# T\n\nhead\n\n## 1. A\n\na\n\n## 2. B\n\nb\n"
    assert renewed(text, {}) == text
    made = renewed(text, {2: "## 2. B\n\nc\n", 3: "## 3. C\n\nd\n"})
    assert made == "# T\n\nhead\n\n## 1. A\n\na\n\n## 2. B\n\nc\n\n## 3. C\n\nd\n"


def test_half_a_line_of_raw_results_is_done_again(place: Place) -> None:
    cases = [survey.Lens("lg-nexus-5", 100, 2000)]
    place.raw.mkdir(parents=True)
    (place.raw / "x.jsonl").write_text('{"case": "{\\"na')
    (one,) = computed("x", _name, cases, place)
    assert one == {"name": "lg-nexus-5"}
    assert computed("x", _fails, cases, place) == [one]


def _name(case: survey.Lens) -> dict[str, Any]:
    return {"name": case.name}


def _fails(case: survey.Lens) -> dict[str, Any]:
    raise AssertionError(case.name)

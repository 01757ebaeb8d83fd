"""Calibrating on site: walls at observation level, what is said about them, the reference that comes out."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.align.adjust import Adjustment, Priors, State
from calib.align.child import Outcome
from calib.align.flatness import find_plane
from calib.camera import BrownCamera
from calib.errors import InputError
from calib.field import LENS_NAMES, Lens
from calib.findings import State as Answer
from calib.onsite import (
    Acceptance,
    Calibration,
    Kind,
    calibration_reference,
    concluded,
    default_name,
)
from calib.onsite_json import CalibrationReport, calibration_json
from calib.onsite_report import render_calibration
from calib.onsite_rules import bend
from calib.photos import Sorted
from calib.photos.photo import CameraIdentity
from calib.references import find_reference, load_reference, save_reference
from calib.result import Timing
from calib.wall import wall_block
from daemon import cli
from sim.flights import phantom3
from sim.survey import write_survey
from sim.wall_block import WallOptions, wall_outcome


def judged(outcome: Outcome, kind: Kind = Kind.WALL) -> Calibration:
    photos = Sorted(outcome.solution.photos, (), ())
    return concluded(outcome, kind, photos, Timing(1.0, 1.0, 1.0), 11.5)


def state_of(calibration: Calibration, rule: str) -> Answer:
    (finding,) = [f for f in calibration.findings if f.rule == rule]
    return finding.state


@pytest.fixture(scope="module")
def flat() -> Calibration:
    return judged(wall_outcome(3, WallOptions(points=1100, advised=True)))


@pytest.fixture(scope="module")
def bent() -> Calibration:
    return judged(wall_outcome(3, WallOptions(points=1100, advised=True, bend_percent=0.25)))


def test_a_flat_wall_is_accepted(flat: Calibration) -> None:
    assert flat.acceptance is Acceptance.ACCEPTED, flat.headline
    assert flat.what_to_do == ()
    flatness = flat.flatness
    assert flatness is not None
    ratio = flatness.terms_percent / flatness.sigmas_percent
    assert np.all(np.abs(ratio) < 3.5)
    assert np.all((flatness.sigmas_percent > 0.002) & (flatness.sigmas_percent < 0.05))
    assert flatness.chance > 0.005
    # 41 m from 10 m, half a picture high.
    assert 2 * flatness.half_size == pytest.approx([4.1, 0.86], rel=0.1)
    truth, brown = phantom3(), flat.estimate.brown
    sigma = float(np.sqrt(flat.estimate.covariance[0, 0]))
    assert abs(brown.f_px - truth.f_px) < 3.5 * sigma
    assert sigma < 0.0001 * truth.f_px


def test_a_bent_wall_is_not(bent: Calibration) -> None:
    assert bent.acceptance is Acceptance.RETAKE
    assert "bends along its length" in bent.headline
    flatness = bent.flatness
    assert flatness is not None
    value, sigma = float(flatness.terms_percent[0]), float(flatness.sigmas_percent[0])
    assert value == pytest.approx(-0.25, abs=4 * sigma + 0.01)
    assert state_of(bent, "wall-bend-up") is Answer.PASS
    assert bent.what_to_do[0].startswith("Try another wall")
    # The lens does not care whether the wall is flat.
    assert state_of(bent, "focal-sigma") is Answer.PASS


def test_power_is_stated(flat: Calibration) -> None:
    assert flat.flatness is not None
    finding = bend(flat.flatness, 0)
    assert "would have shown with 95 % certainty" in finding.message
    assert finding.threshold == 0.1
    vague = replace(flat.flatness, covariance=flat.flatness.covariance * 100)
    assert bend(vague, 0).state is Answer.UNKNOWN


def test_missing_sides_are_named() -> None:
    made = judged(wall_outcome(5, WallOptions(points=500, one_sided=True)))
    assert state_of(made, "wall-angles") is Answer.FLAG
    (message,) = [f.message for f in made.findings if f.rule == "wall-angles"]
    assert "more from the" in message
    assert message in made.what_to_do
    assert made.acceptance is not Acceptance.ACCEPTED


def test_clutter_is_no_wall(flat: Calibration) -> None:
    rng = np.random.default_rng(0)
    cloud = rng.uniform(-1, 1, (900, 3)) * [20, 3, 6]
    cloud[:300, 2] = 0.0
    cameras = rng.uniform(-1, 1, (10, 3)) * [20, 1, 1] + [0, 0, 12]
    plane, near = find_plane(cloud, cameras)
    assert abs(plane.axes[2] @ [0, 0, 1]) > 0.999
    assert near[:300].all()
    assert near[300:].mean() < 0.2
    assert flat.flatness is not None
    few = replace(flat.flatness, on_wall=np.arange(len(flat.flatness.on_wall)) % 4 == 0)
    from calib.onsite_rules import wall_share

    assert wall_share(few).state is Answer.FLAG
    assert "calibrate orbit" in wall_share(few).message


def test_covariance_of_functions_is_that_of_the_whole_block() -> None:
    """Against the inverse of the whole normal matrix, assembled by differences."""
    camera = phantom3()
    full, state = wall_block(camera, points=90, seed=1)
    k, m = len(state.centres_m), len(state.points_m)
    sigma = np.full(len(LENS_NAMES), np.inf)
    free = np.array([name in ("f", "cx") for name in LENS_NAMES])
    priors = Priors(
        state.centres_m, np.full((k, 3), 0.5), state.rotations, np.full(k, 0.02), np.zeros(35), sigma
    )
    block = Adjustment(full.obs, k, m, priors, robust_positions=False)
    adjusted = block.run(state, free, 3, reweightings=0)
    rng = np.random.default_rng(2)
    gradients = rng.normal(size=(m, 3, 2))
    mine = block.functional_covariance(adjusted, gradients) / adjusted.sigma0**2
    columns = []
    at = adjusted.state

    def rows(moved: State) -> np.ndarray:
        image = block.residuals_px(moved) / full.obs.sigma_px[:, None]
        place = (priors.centres_m - moved.centres_m) / 0.5
        turn = block._rotation_terms(moved)
        return np.concatenate([image.ravel(), place.ravel(), turn.ravel()])

    def difference(change: object, step: float) -> None:
        assert callable(change)
        columns.append((rows(change(step)) - rows(change(-step))) / (2 * step))

    from calib.align.adjust import rotation_exp

    for i in range(k):
        for axis in range(3):

            def turned(step: float, i: int = i, axis: int = axis) -> State:
                omega = np.zeros((k, 3))
                omega[i, axis] = step
                return replace(at, rotations=rotation_exp(omega) @ at.rotations)

            def shifted(step: float, i: int = i, axis: int = axis) -> State:
                centres = at.centres_m.copy()
                centres[i, axis] += step
                return replace(at, centres_m=centres)

            difference(turned, 1e-6)
            difference(shifted, 1e-5)
    for name in ("f", "cx"):

        def other_lens(step: float, name: str = name) -> State:
            vector = at.lens.vector
            vector[LENS_NAMES.index(name)] += step
            return replace(at, lens=at.lens.with_vector(vector))

        difference(other_lens, 1e-3)
    for i in range(m):
        for axis in range(3):

            def point(step: float, i: int = i, axis: int = axis) -> State:
                points = at.points_m.copy()
                points[i, axis] += step
                return replace(at, points_m=points)

            difference(point, 1e-5)
    design = np.stack(columns, axis=1)
    scale = np.linalg.norm(design, axis=0)
    inverse = np.linalg.inv((design / scale).T @ (design / scale)) / np.outer(scale, scale)
    by_point = gradients.reshape(3 * m, 2)
    expected = by_point.T @ inverse[-3 * m :, -3 * m :] @ by_point
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert mine / size == pytest.approx(expected / size, abs=3e-3)


def test_reference_serves_the_check(
    flat: Calibration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))
    made = calibration_reference(flat, "my-p3")
    save_reference(made)
    read = load_reference("my-p3")
    assert read.covariance is not None
    assert read.covariance.shape == (35, 35)
    assert read.covariance == pytest.approx(flat.estimate.lens_covariance)
    assert read.temperature_c == 11.5
    assert "flat wall" in read.source
    assert "bend along" in read.provenance
    line = read.line
    assert line is not None
    k1 = flat.estimate.brown.k1_px
    assert line.k1_min < k1 < line.k1_max
    assert line.slope * k1 + line.intercept == pytest.approx(flat.estimate.brown.k2_px, abs=line.band_k2_px)
    assert line.slope == pytest.approx(-2.7e-7, rel=0.08)  # [C&D] eq. 5
    found, note = find_reference(flat.camera)
    assert found is not None
    assert found.name == "my-p3", note


def test_json_and_page(flat: Calibration, bent: Calibration) -> None:
    for made, saved in ((flat, "my-p3"), (bent, None)):
        data = json.loads(calibration_json(made, saved))
        report = CalibrationReport.model_validate(data)
        assert report.saved_as == saved
        assert report.wall is not None
        assert set(report.wall.terms_percent) == {"x2", "xy", "y2"}
        page = render_calibration(made, saved)
        assert made.acceptance.words in page
        assert "The wall from the front" in page
        assert page.count("data-plot") >= 6
    assert "What to do" in render_calibration(bent)
    assert "What to do" not in render_calibration(flat)


def test_names() -> None:
    assert default_name(CameraIdentity("DJI", "FC300X", "0K8T/1", 4000, 3000)) == "fc300x-0k8t-1"
    assert default_name(CameraIdentity("", "", None, 1, 1)) == "camera"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["wall", "nowhere"], "no file or folder"),
        (["orbit", ".", "--name", "Not Good"], "cannot be named"),
        (["orbit", ".", "--name", "dji-inspire-1"], "comes with fieldcal"),
        (["wall", ".", "--temperature", "300"], "no air temperature"),
        (["wall", "."], "no photos"),
    ],
)
def test_refused_in_one_sentence(
    words: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))
    assert cli.run(["calibrate", *words]) == InputError.exit_code
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1
    assert not (tmp_path / "fieldcal-out").exists()


def test_orbit_from_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))
    from sim.options import SurveyOptions

    truth = write_survey(
        "orbit", tmp_path / "photos", 2, size=(480, 360), options=SurveyOptions(photos=12), workers=1
    )
    out = tmp_path / "out"
    code = cli.run(
        [
            "calibrate",
            "orbit",
            str(tmp_path / "photos"),
            "--out",
            str(out),
            "--name",
            "orbit-1",
            "--json",
            "-",
        ]
    )
    data = json.loads(capsys.readouterr().out)
    CalibrationReport.model_validate(data)
    assert code == {"ACCEPTED": 0, "RETAKE": 3, "CANNOT_TELL": 4}[data["acceptance"]]
    assert data["kind"] == "orbit"
    assert data["wall"] is None
    f, sigma = data["calibration"]["f_px"], data["calibration"]["sigma"]["f_px"]
    assert abs(f - truth.camera.f_px) < 3.5 * sigma
    assert (out / "calibration.html").is_file()
    assert (out / "reference.json").is_file() == (code == 0)
    assert (data["saved_as"] == "orbit-1") == (code == 0)


def test_ideal_lens_has_no_line() -> None:
    from calib.onsite import equifinal_lines

    made = judged(wall_outcome(3, WallOptions(points=400, pairs=8)))
    plain = replace(made.estimate, brown=BrownCamera.ideal(4000, 3000, 2320.0))
    assert equifinal_lines(plain) == (None, None)
    assert Lens(plain.brown).vector.shape == (35,)

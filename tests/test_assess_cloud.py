"""Clouds with a known M7 and eta against their reference points, and the command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer

from calib.assess.data import AssessmentReport
from calib.assess.model import Surface
from calib.assess.register import register
from calib.assess.study import CloudAssessment, assess_cloud
from calib.errors import InputError
from daemon import cli
from tests.cloud_cases import EPSG, OFFSET, Case, ground_m, made, write_las, write_points


def _assessed(case: Case) -> CloudAssessment:
    return assess_cloud(case.cloud, case.truth)


def _between_m(case: Case) -> float:
    """Standard deviation of the ground about the surface between the reference points."""
    at = np.random.default_rng(0).uniform(-60, 60, (40_000, 2))
    height = Surface((case.truth.xyz_m - OFFSET)[~case.bad]).height_m(at)
    return float(np.nanstd(ground_m(*at.T) - height))


def test_fifty_known_clouds_within_their_sigmas() -> None:
    """Bounds on both sides: neither larger errors than said, nor sigmas that are too careful."""
    z, z_eta, ratio = [], [], []
    for seed in range(50):
        eta = 0.05 + 0.002 * seed
        case = made(seed, eta)
        found = _assessed(case)
        seven = found.registration.seven
        assert found.registration.determined.all()
        z.append((seven.values - case.about(found.registration.origin)) / seven.sigmas)
        # The reference points do not show all of the relief between them; that is part of eta.
        expected = float(np.hypot(eta, _between_m(case)))
        z_eta.append((found.eta.eta_p_m - expected) / found.eta.sigma_m)
        ratio.append(found.eta.eta_p_m / expected)
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    assert 0.8 < np.sqrt(np.mean(np.square(z))) < 1.2
    assert np.all((rms > 0.65) & (rms < 1.4))
    assert np.abs(z).max() < 4.5
    assert 0.9 < min(ratio) < np.median(ratio) < 1.1
    assert max(ratio) < 1.3
    assert 0.4 < np.sqrt(np.mean(np.square(z_eta))) < 1.6


def test_one_point_in_ten_wrong_changes_little_and_is_named() -> None:
    z = []
    for seed in range(100, 108):
        case = made(seed, outliers=0.1, references=200)
        found = _assessed(case)
        seven = found.registration.seven
        z.append((seven.values - case.about(found.registration.origin)) / seven.sigmas)
        assert case.bad.sum() > 5
        assert found.registration.outlier[case.bad].all()
        assert found.registration.outlier[~case.bad].sum() <= 3
        assert 0.9 < found.eta.eta_p_m / np.hypot(0.1, _between_m(case)) < 1.15
        assert any("too far off" in note for note in found.notes)
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.4


@pytest.mark.parametrize("dome", [0.3, -0.3, 0.0])
def test_dome_and_dish_are_told_with_significance(dome: float) -> None:
    found = _assessed(made(7, dome_m=dome))
    bowl = found.bowl
    assert bowl is not None
    at_rim = dome * (bowl.radius_m / 60) ** 2
    assert abs(bowl.amplitude_m - at_rim) < 3.5 * bowl.sigma_m
    assert bowl.sigma_m < 0.04
    assert (bowl.chance < 0.001) == (dome != 0)
    middle = found.profiles[0].eta_m[25:35].mean() - found.profiles[0].eta_m[[0, 1, 2, -3, -2, -1]].mean()
    assert np.sign(middle) == np.sign(dome) or dome == 0


def test_vertical_scale_shows_against_elevation() -> None:
    case = made(8, 0.02, values=np.array([0, 0, 0, 0, 0, 0, 100.0]))
    stretched = case.cloud.xyz * np.array([1, 1, 1.05], np.float32)
    cloud = type(case.cloud)(case.cloud.file, OFFSET, stretched, len(stretched), 0, 1)
    picked = case.truth.xyz_m.copy()
    found = assess_cloud(cloud, case.truth, picked_m=picked)
    assert found.trend is not None
    assert found.trend.slope == pytest.approx(0.05, abs=0.005)
    assert found.trend.slope > 10 * found.trend.sigma


def test_flat_ground_fixes_height_and_tilt_alone() -> None:
    case = made(9, 0.05, flat=True)
    found = _assessed(case).registration
    assert found.determined.tolist() == [False, False, True, False, True, True, False]
    error = np.abs(found.seven.values - case.about(found.origin))[[2, 4, 5]]
    assert np.all(error < 3.5 * found.seven.sigmas[[2, 4, 5]])


def test_picked_points_fix_all_seven_on_flat_ground() -> None:
    case = made(10, 0.02, flat=True, references=40)
    true = case.about(OFFSET)
    from calib.assess.model import similarity_of

    rng = np.random.default_rng(1)
    picked = similarity_of(true).apply(case.truth.xyz_m - OFFSET) + OFFSET + 0.01 * rng.normal(size=(40, 3))
    picked[3] += [0, 2, 0]
    picked[5] = np.nan
    found = register(case.truth.xyz_m, case.cloud, np.ones(40, bool), picked_m=picked)
    assert found.outlier.tolist() == [i == 3 for i in range(40)]
    assert found.determined.all()
    z = (found.seven.values - case.about(found.origin)) / found.seven.sigmas
    assert np.abs(z).max() < 4


def test_too_few_points_are_refused() -> None:
    case = made(11, references=5)
    with pytest.raises(InputError, match="at least 8"):
        _assessed(case)
    with pytest.raises(InputError, match="at least 3"):
        assess_cloud(case.cloud, case.truth, picked_m=np.full((5, 3), np.nan))


# --- The command -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("assess")
    case = made(20, 0.05, dome_m=0.3, references=150)
    write_las(folder / "cloud.laz", case.cloud.xyz + case.cloud.origin)
    write_points(folder / "truth.csv", case.truth.xyz_m)
    return folder


def _run(files: Path, tmp_path: Path, *more: str, truth: Path | None = None) -> int:
    points = truth or files / "truth.csv"
    return cli.run(
        ["assess", str(files / "cloud.laz"), "--truth", str(points), "--out", str(tmp_path), *more]
    )


def test_command_writes_report_and_data(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = [
        "--profile",
        "P1,P2",
        "--profile",
        "499960,5600000,500040,5600000",
        "--on",
        "P1*,P2*",
        "--height",
        "60",
    ]
    assert _run(files, tmp_path, *more, "--json", "-") == 0
    printed = capsys.readouterr().out
    report = AssessmentReport.model_validate(json.loads(printed))
    assert printed == (tmp_path / "assessment.json").read_text()
    assert report.kind == "LAZ"
    assert report.dome is not None
    assert report.dome.amplitude_m > 3 * report.dome.sigma_m
    assert report.dome.percent_of_height == pytest.approx(report.dome.amplitude_m / 0.6)
    assert [profile.name for profile in report.profiles] == ["P1 to P2", "499960,5600000,500040,5600000"]
    assert {p.name for p in report.points if p.used} <= {
        p.name for p in report.points if p.name[:2] in ("P1", "P2")
    }
    page = (tmp_path / "assessment.html").read_text()
    assert "dome" in page
    assert "http://" not in page.split("<script>")[0]


def test_points_in_degrees_are_carried_over(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    case = made(20, 0.05, dome_m=0.3, references=150)
    lon, lat = Transformer.from_crs(EPSG, 4326, always_xy=True).transform(*case.truth.xyz_m[:, :2].T)
    write_points(
        tmp_path / "deg.csv", np.column_stack([lon, lat, case.truth.xyz_m[:, 2]]), "name,lon,lat,height"
    )
    assert _run(files, tmp_path, "--crs", "EPSG:4326", "--quiet", truth=tmp_path / "deg.csv") == 0
    one = json.loads((tmp_path / "assessment.json").read_text())
    assert _run(files, tmp_path, "--crs", str(EPSG), "--quiet") == 0
    two = json.loads((tmp_path / "assessment.json").read_text())
    for name, value in one["seven"].items():
        assert value["value"] == pytest.approx(two["seven"][name]["value"], abs=0.02)
    capsys.readouterr()


@pytest.mark.parametrize(
    ("change", "header", "more", "says"),
    [
        (lambda p: p[:, [1, 0, 2]], "name,x,y,z", (), "swap the columns"),
        (lambda p: p + np.array([0, 1e7, 0]), "name,x,y,z", (), "zone's half is wrong"),
        (lambda p: p + np.array([300_000, 0, 0]), "name,x,y,z", (), "300 km east"),
        (lambda p: p / [0.3048, 0.3048, 1], "name,x,y,z", (), "in feet"),
        (lambda p: p * 0 + [1.5, 50, 0] + (p - p.mean(0)) * [1e-3, 1e-3, 1], "name,x,y,z", (), "degrees"),
        (lambda p: p, "name,x,y", (), "no column z"),
        (lambda p: p[:0], "name,x,y,z", (), "no points"),
        (lambda p: np.where(p == p[3], np.nan, p), "name,x,y,z", (), "not a number"),
        (lambda p: p, "name,x,y,z", ("--on", "Q1"), "no reference point of that name"),
        (lambda p: p, "name,x,y,z", ("--profile", "P1,Q2"), "no reference point of that name"),
        (lambda p: p, "name,x,y,z", ("--profile", "1,2,3"), "neither two names"),
        (lambda p: p, "name,x,y,z", ("--crs", "EPSG:1"), "no coordinate system"),
        (lambda p: p, "name,x,y,z", ("--radius", "-1"), "positive"),
    ],
)  # fmt: skip
def test_mistakes_are_said(change, header, more, says, files, tmp_path, capsys) -> None:  # type: ignore[no-untyped-def]
    case = made(20, 0.05, dome_m=0.3, references=150)
    write_points(tmp_path / "t.csv", change(case.truth.xyz_m), header)
    assert _run(files, tmp_path, *more, truth=tmp_path / "t.csv") == 2
    said = capsys.readouterr().err
    assert says in said
    assert "Traceback" not in said
    assert not (tmp_path / "assessment.html").exists()

"""Calibration on control points: against simulated truth, blunders by name, files of marks, bad input."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from calib.camera import BROWN_NAMES, FloatArray
from calib.control import ControlCalibration, calibrate_control, coverage_hint, free_parameters, prepare
from calib.control_adjust import MarkSet
from calib.control_files import ControlPoint, Mark, read_marks, read_points
from calib.control_output import ControlReport
from calib.control_subset import photo_information, subsets
from calib.errors import FormatError, InputError
from calib.photos.photo import CameraIdentity, Photo
from daemon import cli
from sim.papers.orbit import TARGET_M, Orbit, fly, solve

ALL = ("f", "k1", "k2", "k3", "cx", "cy", "p1", "p2", "b1", "b2")


@lru_cache(maxsize=8)
def flown(name: str, seed: int) -> Orbit:
    return fly(name, seed)


def _far(xyz: FloatArray) -> tuple[float, float, float]:
    x, y, z = np.add(xyz, [4e5, 5.6e6, 100.0]).tolist()
    return x, y, z


def given(orbit: Orbit) -> tuple[tuple[Photo, ...], tuple[ControlPoint, ...], tuple[Mark, ...]]:
    """What a user would have: photos, points and marks by name, coordinates far from the origin."""
    camera = orbit.camera
    identity = CameraIdentity("DJI", "FC6310", "S1", camera.width, camera.height)
    photos = tuple(Photo(Path(f"IMG_{i:03d}.JPG"), identity) for i in range(len(orbit.centres_m)))
    points = tuple(
        ControlPoint(
            f"T{i:03d}",
            _far(xyz),
            (TARGET_M,) * 3,
            not control,
        )
        for i, (xyz, control) in enumerate(zip(orbit.targets_m, orbit.control, strict=True))
    )
    marks = tuple(
        Mark(photos[p].path.name, points[t].name, *map(float, uv))
        for p, t, uv in zip(orbit.photo, orbit.target, orbit.pixels, strict=True)
    )
    return photos, points, marks


def solved(orbit: Orbit, marks: tuple[Mark, ...] | None = None, **changes: object) -> ControlCalibration:
    photos, points, own = given(orbit)
    used, kept, chosen, notes = prepare(photos, points, marks or own)
    used = replace(used, **changes)  # type: ignore[arg-type]
    return calibrate_control(used, kept, chosen, 0.97 * orbit.camera.f_px, notes)


def test_truth_is_found_within_its_sigma() -> None:
    """Several seeds of both sensors: bounds both ways."""
    ratios = []
    for seed in range(4):
        for name in ("RGB add6", "thermal add6"):
            orbit = flown(name, seed)
            made = solved(orbit)
            assert made.blunders == (), name
            assert 0.8 < made.fit.sigma0 < 1.2
            names = free_parameters(made)
            assert {"f", "k1", "k2", "k3"} <= set(names)
            sigma = float(np.sqrt(made.fit.covariance[0, 0]))
            ratios.append((made.camera.f_px - orbit.camera.f_px) / sigma)
            assert made.rms_px(check=True) < 3 * orbit.camera.f_px * TARGET_M / 13 + 1
            assert np.all(made.rmse_m(check=True) < 0.03)
    assert np.max(np.abs(ratios)) < 3.5
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 1.6


def test_agrees_with_the_independent_adjustment() -> None:
    """Points held, the same parameters: another implementation gives the same numbers."""
    orbit = flown("thermal add6", 1)
    theirs = solve(orbit, None, ("f", "k1", "k2", "k3"))
    theirs = solve(orbit, theirs, ALL)
    photos, points, marks = given(orbit)
    used, kept, _, _ = prepare(photos, points, marks)
    assert len(kept) == len(photos)
    from calib.control_adjust import adjust, resected

    held = replace(used, sigmas_m=np.zeros_like(used.sigmas_m))
    block, _ = resected(held, replace(orbit.camera, k1=0, k2=0, k3=0, p1=0, p2=0, b1_px=0, b2_px=0))
    on_control = held.control[held.point]
    fit = adjust(held, adjust(held, block, ALL[:4], on_control).block, ALL, on_control)
    sigma = np.sqrt(np.diag(theirs.covariance))
    mine, other = fit.block.camera.vector, theirs.camera.vector
    free = sigma > 0
    assert np.all(np.abs(mine - other)[free] < 0.1 * sigma[free])
    assert np.sqrt(np.diag(fit.covariance))[free] == pytest.approx(sigma[free], rel=0.02)
    assert fit.sigma0 == pytest.approx(theirs.sigma0, rel=1e-3)


def test_release_is_told_step_by_step() -> None:
    made = solved(flown("RGB add6", 2))
    assert [s.name for s in made.steps][:2] == ["poses", "f and K1-K3"]
    assert made.steps[0].chance is None
    assert made.steps[0].control_rms_px > 3 * made.steps[1].control_rms_px
    for step in made.steps[1:]:
        assert step.chance is not None
        assert step.kept == (step.chance < 0.01 or "f" in step.parameters)
    kept = {n for s in made.steps if s.kept for n in s.parameters}
    assert kept == set(free_parameters(made))


def test_swapped_names_are_found() -> None:
    orbit = flown("RGB add6", 0)
    _, _, marks = given(orbit)
    first = marks[0].photo
    here = [i for i, m in enumerate(marks) if m.photo == first and orbit.control[int(m.point[1:])]]
    a, b = here[0], here[3]
    wrong = list(marks)
    wrong[a], wrong[b] = replace(marks[a], point=marks[b].point), replace(marks[b], point=marks[a].point)
    made = solved(orbit, tuple(wrong))
    names = sorted((marks[a].point, marks[b].point))
    assert any(
        all(n in text for n in names) and "swapped" in text and first in text for text in made.blunders
    )
    assert len(made.blunders) == 1
    sigma = float(np.sqrt(made.fit.covariance[0, 0]))
    assert abs(made.camera.f_px - orbit.camera.f_px) < 3.5 * sigma


def test_slips_and_wrong_coordinates_are_found() -> None:
    orbit = flown("thermal add6", 0)
    photos, points, marks = given(orbit)
    often = np.bincount(orbit.target, minlength=len(points)) * orbit.control
    bad = int(often.argmax())
    shifted = tuple(
        replace(p, xyz_m=(p.xyz_m[0] + 0.8, p.xyz_m[1], p.xyz_m[2])) if i == bad else p
        for i, p in enumerate(points)
    )
    slip = next(i for i, m in enumerate(marks) if int(m.point[1:]) != bad and orbit.control[int(m.point[1:])])
    wrong = list(marks)
    wrong[slip] = replace(marks[slip], u_px=marks[slip].u_px + 9)
    used, kept, chosen, notes = prepare(photos, shifted, wrong)
    made = calibrate_control(used, kept, chosen, 0.97 * orbit.camera.f_px, notes)
    assert any(points[bad].name in text and "coordinates" in text for text in made.blunders)
    assert any(marks[slip].point in text and marks[slip].photo in text for text in made.blunders)
    sigma = float(np.sqrt(made.fit.covariance[0, 0]))
    assert abs(made.camera.f_px - orbit.camera.f_px) < 4 * sigma


def test_the_most_telling_photos_alone_agree_with_all() -> None:
    """[SEN]: 14 or 20 photos, chosen for what they add, do nearly as well as the whole campaign."""
    worst = []
    for seed in range(3):
        made = solved(flown("RGB add6", seed))
        few, more = subsets(made)
        assert (len(few.photos), len(more.photos)) == (14, 20)
        assert more.photos[:14] == few.photos
        sigmas = [float(np.sqrt(c[0, 0])) for c in (few.covariance, more.covariance, made.fit.covariance)]
        assert sigmas[0] > sigmas[1] > sigmas[2]
        assert sigmas[0] < 3 * sigmas[2]
        worst.append(few.apart_sigmas)
        # Chosen ones know more than the first ones by name.
        info = photo_information(made.marks, made.fit.block, free_parameters(made), made.used)
        chosen, first = (np.linalg.slogdet(info[list(p)].sum(axis=0))[1] for p in (few.photos, range(14)))
        assert chosen > first + 1
    assert 0 < max(worst) < 4


def test_empty_edges_are_told() -> None:
    made = solved(flown("RGB add6", 0))
    middle = made.camera.width / 2
    marks = replace(made.marks, pixels=made.marks.pixels.copy())
    marks.pixels[:, 0] = np.clip(marks.pixels[:, 0], 0.2 * made.camera.width, 2 * middle)
    hint = coverage_hint(replace(made, marks=marks))
    assert hint is not None
    assert "left" in hint


def test_names_of_parameters() -> None:
    assert set(ALL) <= set(BROWN_NAMES)


# --- Files ---------------------------------------------------------------------------------------

XML = """<?xml version="1.0" encoding="UTF-8"?>
<document version="1.2.0"><chunk>
<cameras><camera id="0" label="IMG_1.JPG"/><camera id="4" label="b/IMG_2.JPG"/></cameras>
<markers>
<marker id="0" label="A"><reference x="1.5" y="2" z="3" enabled="true"/></marker>
<marker id="1" label="B"><reference x="9.5" y="2" z="3" enabled="false"/></marker>
</markers>
<frames><frame id="0"><markers>
<marker marker_id="0"><location camera_id="0" pinned="true" x="10.5" y="20.25"/>
<location camera_id="4" pinned="false" x="1" y="2"/></marker>
<marker marker_id="1"><location camera_id="4" x="30" y="40"/></marker>
</markers></frame></frames></chunk></document>"""


def test_files_of_marks(tmp_path: Path) -> None:
    xml = tmp_path / "m.xml"
    xml.write_text(XML)
    found = read_marks(xml)
    assert found.marks == (Mark("IMG_1.JPG", "A", 10.5, 20.25), Mark("IMG_2.JPG", "B", 30, 40))
    assert [p.check for p in found.points] == [False, True]
    odm = tmp_path / "gcp_list.txt"
    odm.write_text(
        "EPSG:32630\n500000.5 5630000 12.5 100 200 IMG_1.JPG gcp1\n# no\n500010 5630000 12 5 6 x/IMG_2.JPG\n"
    )
    found = read_marks(odm)
    assert found.marks[0] == Mark("IMG_1.JPG", "gcp1", 100, 200)
    assert found.points[1].xyz_m == (500010, 5630000, 12)
    assert found.marks[1].photo == "IMG_2.JPG"
    table = tmp_path / "m.csv"
    table.write_text("Photo;Point;u_px;v_px\nC:\\card\\IMG_1.JPG;A;1.5;2.5\n\n")
    assert read_marks(table).marks == (Mark("IMG_1.JPG", "A", 1.5, 2.5),)
    # Pix4D names no columns.
    table.write_text("C:\\card\\IMG_1.JPG,A,1.5,2.5,1.2\nIMG_2.JPG,A,7,8,0.6\n")
    assert read_marks(table).marks == (Mark("IMG_1.JPG", "A", 1.5, 2.5), Mark("IMG_2.JPG", "A", 7, 8))
    points = tmp_path / "p.csv"
    points.write_text("A,1,2,3,0.02,0.05\n7,4,5,6,0.02,0.05\n")
    assert read_points(points)[0] == ControlPoint("A", (1, 2, 3), (0.02, 0.02, 0.05))
    assert read_points(points)[1].name == "7"
    points.write_text("name,x,y,z,sigma_m,role\nA,1,2,3,0.002,control\nB,4,5,6,,check\n")
    a, b = read_points(points)
    assert a == ControlPoint("A", (1, 2, 3), (0.002,) * 3)
    assert b == ControlPoint("B", (4, 5, 6), None, True)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name,x,y\nA,1,2\n", "no column z"),
        ("name,x,y,z\nA,1,2,nan\n", "is not a number"),
        ("name,x,y,z\nA,1,2\n", "4 columns are expected"),
        ("name,x,y,z\nA,1,2,3\nA,1,2,4\n", "two points named A"),
        ("name,x,y,z,role\nA,1,2,3,boss\n", "control or check"),
        ("name,x,y,z,sigma_m\nA,1,2,3,-1\n", "cannot be negative"),
        ("name,x,y,z\nA,-1.2301,54.1,3\nB,-1.2302,54.1001,3\nC,-1.2303,54.1,3\n", "look like degrees"),
        ("hello\n", "not a CSV table"),
        ("name,x,y,z\n", "holds no points"),
    ],
)
def test_bad_points(text: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "p.csv"
    file.write_text(text)
    with pytest.raises(FormatError, match=said):
        read_points(file)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('<!DOCTYPE d [<!ENTITY e SYSTEM "file:///etc/passwd">]><document>&e;</document>', "document type"),
        ("<document><chunk></chunk></document>", "not a file of markers"),
        ("<document>", "not valid XML"),
        ("photo,point,u,v\na.jpg,A,1,2\nA.JPG,A,1,3\n", "marked twice"),
        ("EPSG:4326\n1 2 3 4\n", "are expected"),
        (
            "101  -3.1423   2.0871  0.0004\n102   1.2210  -0.4410  0.0004\n",
            "VMS and Australis .* photo,point",
        ),
    ],
)
def test_bad_marks(text: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "m.txt"
    file.write_text(text)
    with pytest.raises(FormatError, match=said):
        read_marks(file)


def test_bad_sets() -> None:
    orbit = flown("thermal add6", 0)
    photos, points, marks = given(orbit)
    with pytest.raises(InputError, match="another photo set"):
        prepare(photos, points, [replace(m, photo="DSC" + m.photo) for m in marks])
    with pytest.raises(InputError, match="check the names"):
        prepare(photos, points, [replace(m, point="x" + m.point) for m in marks])
    line = [replace(p, xyz_m=(float(i), 2.0 * i, 1.0)) for i, p in enumerate(points)]
    with pytest.raises(InputError, match="on one line"):
        prepare(photos, line, marks)
    with pytest.raises(InputError, match="are needed"):
        prepare(photos, points[:5], marks)
    with pytest.raises(InputError, match="another size"):
        prepare(photos, points, [replace(m, u_px=m.u_px * 10) for m in marks])
    width, height = photos[0].camera.width, photos[0].camera.height
    in_mm = [replace(m, u_px=(m.u_px - width / 2) * 0.017, v_px=(height / 2 - m.v_px) * 0.017) for m in marks]
    with pytest.raises(InputError, match=r"are they in mm .* column = width / 2"):
        prepare(photos, points, in_mm)
    swapped = [replace(p, xyz_m=(p.xyz_m[1], p.xyz_m[0], p.xyz_m[2])) for p in points]
    used, kept, chosen, _ = prepare(photos, swapped, marks)
    assert isinstance(used, MarkSet)
    assert len(kept) > 2
    with pytest.raises(InputError, match="x and y swapped"):
        calibrate_control(used, kept, chosen, orbit.camera.f_px)


def test_from_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))
    orbit = flown("thermal add6", 0)
    photos, points, marks = given(orbit)
    folder = tmp_path / "photos"
    folder.mkdir()
    # Every file another grey, or they would be copies of each other.
    for i, photo in enumerate(photos):
        Image.new("L", (orbit.camera.width, orbit.camera.height), i).save(folder / photo.path.name)
    rows = [f"{p.name},{','.join(map(str, p.xyz_m))},{'check' if p.check else 'control'}" for p in points]
    (tmp_path / "points.csv").write_text("\n".join(["name,x,y,z,role", *rows]))
    rows = [f"{m.photo},{m.point},{m.u_px},{m.v_px}" for m in marks]
    (tmp_path / "marks.csv").write_text("\n".join(["photo,point,u,v", *rows]))
    files = ["--points", str(tmp_path / "points.csv"), "--marks", str(tmp_path / "marks.csv")]
    words = ["calibrate", "control", str(folder), *files, "--out", str(tmp_path / "out"), "--name", "wiris"]
    assert cli.run(words) == 2
    assert "--focal-px" in capsys.readouterr().err
    code = cli.run([*words, "--focal-px", "760", "--json", "-"])
    report = ControlReport.model_validate_json(capsys.readouterr().out)
    sigma = report.sigma["f_px"]
    assert abs(report.parameters["f_px"] - orbit.camera.f_px) < 3.5 * sigma
    assert code == (0 if sigma <= 0.0005 * report.parameters["f_px"] else 3)
    assert (report.saved_as == "wiris") == (code == 0)
    assert report.check.points > 5
    page = (tmp_path / "out" / "control.html").read_text(encoding="utf-8")
    assert "Release in steps" in page
    assert page.count("data-plot") >= 3


@pytest.mark.parametrize("axes", [[1, 0, 2], [0, 2, 1]])
def test_swapped_axes_are_said(axes: list[int]) -> None:
    photos, points, marks = given(flown("thermal add6", 1))
    turned = tuple(replace(p, xyz_m=(p.xyz_m[axes[0]], p.xyz_m[axes[1]], p.xyz_m[axes[2]])) for p in points)
    used, kept, chosen, notes = prepare(photos, turned, marks)
    with pytest.raises(InputError, match="only mirrored, as with x and y swapped"):
        calibrate_control(used, kept, chosen, 770.0, notes)


def test_other_units_are_asked_about() -> None:
    """Millimetres: the lens comes out right, for scale does not matter to it, but the distances are odd."""
    orbit = flown("thermal add6", 1)
    photos, points, marks = given(orbit)
    x, y, z = 1000 * np.array([point.xyz_m for point in points]).T
    large = tuple(
        replace(point, xyz_m=(float(a), float(b), float(c)))
        for point, a, b, c in zip(points, x, y, z, strict=True)
    )
    used, kept, chosen, notes = prepare(photos, large, marks)
    made = calibrate_control(used, kept, chosen, 0.97 * orbit.camera.f_px, notes)
    assert any("coordinates in metres?" in note for note in made.notes)
    assert not any("in metres?" in note for note in solved(orbit).notes)

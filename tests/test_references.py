"""The bundled library, the user's store, and which reference may be held against which photos."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from calib.brownfit import fit_brown
from calib.camera import BrownCamera, radial_profile_px
from calib.equifinal_published import CUBIC_8, LINE_5, LINE_6, P3P_WALL, implied_optimum
from calib.errors import FieldcalError, FormatError, InputError, OutputError
from calib.field import Lens
from calib.limits import FOCAL_SIGMA_PERCENT
from calib.photos.photo import CameraIdentity, Processing
from calib.reference import Reference
from calib.reference_file import read_reference_file, reference_json, write_reference_file
from calib.reference_match import convert_reference, match_reference
from calib.references import (
    bundled_names,
    bundled_references,
    find_reference,
    history,
    load_reference,
    reference_from_camera,
    save_reference,
    store_folder,
    stored_names,
    stored_references,
)

P3P = CameraIdentity("DJI", "FC300X", None, 4000, 3000, Processing.RAW, 3.61)
MINE = replace(P3P, serial="B7")


@pytest.fixture(autouse=True)
def store(tmp_path, monkeypatch):
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))
    return tmp_path / "store"


def own(name: str = "mine", **changes) -> Reference:
    rng = np.random.default_rng(7)
    root = rng.normal(size=(35, 35)) * 1e-3
    made = Reference(
        name=name,
        make="DJI",
        model="FC300X",
        width=4000,
        height=3000,
        processing=Processing.RAW,
        source="a wall",
        brown=BrownCamera(4000, 3000, 2321.5, 1990.0, 1510.0, -0.136, 0.115, -0.018, p1=1e-4, p2=-2e-4),
        field_px=rng.normal(size=24) * 0.1,
        sigma={"f": 0.3, "k1": 1e-5},
        covariance=root @ root.T,
        serial="B7",
        date="2024-05-31",
        exif_models=("FC300X",),
    )
    return replace(made, **changes)


# --- The library ---------------------------------------------------------------------------------


def test_the_library_holds_the_published_cameras():
    names = set(bundled_names())
    assert {
        "dji-phantom-3-professional",
        "dji-inspire-1",
        "dji-phantom-4-pro",
        "workswell-wiris-pro",
    } <= names
    assert len(names) == 15  # and the eleven of [C&D] Table 5
    for reference in bundled_references():
        assert reference.source
        assert reference.provenance
        assert reference.f_px is not None
        # Of another body, no published calibration can decide 0.1 %.
        assert 100 * reference.sigma["f"] / reference.f_px > FOCAL_SIGMA_PERCENT


def test_phantom_3_has_the_published_numbers():
    reference = load_reference("dji-phantom-3-professional")
    assert reference.brown is not None
    assert reference.brown.f_px == 2320.06
    assert reference.processing is Processing.RAW
    published = (P3P_WALL.k1_px, P3P_WALL.k2_px, P3P_WALL.k3_px)
    assert (reference.brown.k1_px, reference.brown.k2_px, reference.brown.k3_px) == pytest.approx(published)
    assert reference.line == LINE_5


def test_inspire_1_has_its_lines_and_what_follows_from_them():
    reference = load_reference("dji-inspire-1")
    assert reference.brown is None
    assert reference.f_px == 2326.07
    assert reference.line == LINE_6
    assert reference.implied_radial_px == pytest.approx(
        tuple(implied_optimum(LINE_6, CUBIC_8).vector), rel=1e-3
    )


@pytest.mark.parametrize(
    ("name", "pitch_mm", "f_px"),
    [("dji-phantom-4-pro", 2.41e-3, 3672.2), ("workswell-wiris-pro", 17e-3, 771.76)],
)
def test_cameras_given_in_mm_follow_from_the_chosen_row(name, pitch_mm, f_px):
    reference = load_reference(name)
    assert [row.label for row in reference.published] == [
        "VMS subset",
        "VMS add6",
        "Metashape subset",
        "Metashape add6",
    ]
    (row,) = [row.values for row in reference.published if row.chosen]
    brown = reference.brown
    assert brown is not None
    assert brown.f_px == pytest.approx(f_px, rel=1e-4)
    assert brown.cx_px == pytest.approx(brown.width / 2 + row["xp_mm"] / pitch_mm)
    assert brown.cy_px == pytest.approx(brown.height / 2 - row["yp_mm"] / pitch_mm)
    r_mm = np.linspace(0, brown.width / 2 * pitch_mm, 9)
    in_mm = row["k1_mm"] * r_mm**3 + row["k2_mm"] * r_mm**5 + row["k3_mm"] * r_mm**7
    in_px = radial_profile_px(brown.k1_px, brown.k2_px, brown.k3_px, r_mm / pitch_mm)
    assert in_px == pytest.approx(in_mm / pitch_mm, abs=1e-6)
    # The rows of the other program run the other way: same lens, other sign.
    other = reference.published[0].values
    assert np.sign(other["k1_mm"]) == -np.sign(row["k1_mm"])


def test_table_5_has_opposite_signs_throughout():
    table_5 = [r for r in bundled_references() if r.source.endswith("Table 5")]
    assert len(table_5) == 11
    assert all(r.brown is not None and r.brown.k1 * r.brown.k2 < 0 for r in table_5)


# --- The file ------------------------------------------------------------------------------------


def test_a_saved_reference_comes_back_bit_for_bit(store):
    reference = own()
    path = save_reference(reference)
    assert path.parent == store
    back = load_reference("mine")
    assert reference_json(back) == reference_json(reference)
    assert back.lens is not None
    assert reference.lens is not None
    rays = np.random.default_rng(0).uniform(-0.8, 0.8, (50, 2))
    assert np.array_equal(back.lens.project(rays), reference.lens.project(rays))
    assert list(store.glob(".*")) == []


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=50, deadline=None)
@given(st.lists(st.floats(-1e6, 1e6), min_size=8, max_size=8), st.text(max_size=40))
def test_round_trip_through_projection(tmp_path, numbers, text):
    brown = BrownCamera(4000, 3000, 2300.0, *numbers)
    path = tmp_path / "any.json"
    write_reference_file(own(brown=brown, field_px=None, provenance=text, source=text), path)
    back = read_reference_file(path)
    assert back.brown == brown
    assert back.provenance == text


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{}",
        "[1, 2]",
        "not json",
        '{"schema": "fieldcal.reference/1"}',
        '{"schema": "fieldcal.reference/2"}',
        "\xff\xfe",
        "{" * 5000,
    ],
)
def test_broken_files_are_refused_in_one_sentence(tmp_path, text):
    path = tmp_path / "broken.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(FormatError, match="broken"):
        read_reference_file(path)


@pytest.mark.parametrize(
    "change",
    [
        {"sigma": {"f": -1.0}},
        {"sigma": {"focal": 1.0}},
        {"serail": "B7"},
        {"width": -4},
        {"brown": {"f_px": 0.0, "cx_px": 1.0, "cy_px": 1.0}},
        {"brown": {"f_px": float("nan"), "cx_px": 1.0, "cy_px": 1.0}},
        {"field_px": [1.0, 2.0]},
        {"covariance": [[1.0]]},
        {"processing": "cooked"},
        {"brown": None, "line": None},
    ],
)
def test_wrong_values_are_refused(tmp_path, change):
    data = json.loads(reference_json(own())) | change
    path = tmp_path / "wrong.json"
    path.write_text(json.dumps(data))
    with pytest.raises(FormatError, match=r"wrong\.json"):
        read_reference_file(path)


def test_values_that_are_not_numbers_are_not_saved(store):
    with pytest.raises(OutputError):
        save_reference(own(temperature_c=float("nan")))
    assert not store.exists() or not list(store.iterdir())


# --- The store -----------------------------------------------------------------------------------


def test_saving_again_keeps_the_older_ones():
    for year in (2022, 2023, 2024):
        save_reference(own(date=f"{year}-05-31"))
    assert stored_names() == ("mine",)
    assert load_reference("mine").date == "2024-05-31"
    assert [read_reference_file(path).date for path in history("mine")] == ["2022-05-31", "2023-05-31"]


@pytest.mark.parametrize("name", ["", "../evil", "Mine", "a/b", ".hidden", "x" * 200, "dji-inspire-1"])
def test_names_that_cannot_be_used(name):
    with pytest.raises(InputError):
        save_reference(own(name))


def test_a_broken_file_in_the_store_is_reported_and_does_not_hide_the_others(store):
    save_reference(own())
    (store / "broken.json").write_text("{")
    references, faults = stored_references()
    assert [r.name for r in references] == ["mine"]
    assert len(faults) == 1
    assert "broken.json" in faults[0]


def test_a_store_that_cannot_be_written(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "file"))
    with pytest.raises(OutputError, match="cannot be written"):
        save_reference(own())


def test_unknown_names_suggest_known_ones(tmp_path):
    with pytest.raises(InputError, match="dji-phantom-4-pro"):
        load_reference("dji-phantom-4pro")
    with pytest.raises(InputError, match="folder"):
        load_reference(tmp_path)
    with pytest.raises(FieldcalError):
        load_reference("nothing/like/it.json")


def test_the_store_follows_the_environment(monkeypatch, store):
    assert store_folder() == store
    monkeypatch.delenv("FIELDCAL_STORE")
    assert store_folder().name == "references"


# --- Which photos it may be held against -----------------------------------------------------------


def test_a_raw_reference_is_never_held_against_corrected_photos():
    corrected = replace(P3P, processing=Processing.LENS_CORRECTED)
    found, note = find_reference(corrected)
    assert found is None
    assert "raw" in note
    assert "corrected" in note
    for named in (False, True):
        used, note = match_reference(load_reference("dji-phantom-3-professional"), corrected, named)
        assert used is None
        assert note.count(". ") == 0


def test_the_model_is_found_and_said_to_be_of_another_body():
    found, note = find_reference(P3P)
    assert found is not None
    assert found.name == "dji-phantom-3-professional"
    assert "does not name a camera body" in note


def test_an_unknown_camera_has_no_reference():
    found, note = find_reference(replace(P3P, model="FC300S"))
    assert found is None
    assert "No reference" in note


def test_ones_own_body_comes_first_and_another_body_is_refused():
    save_reference(own())
    save_reference(own("other", serial="X1", date="2025-01-01"))
    found, note = find_reference(MINE)
    assert found is not None
    assert found.name == "mine"
    found, note = find_reference(replace(P3P, serial="Z9"))
    assert found is not None
    assert found.name == "dji-phantom-3-professional"
    used, note = match_reference(own(), replace(P3P, serial="Z9"))
    assert used is None
    assert "another body" in note
    used, note = match_reference(own(), replace(P3P, serial="Z9"), named=True)
    assert used is not None
    assert "another body" in note
    assert 100 * used.sigma["f"] / used.brown.f_px > FOCAL_SIGMA_PERCENT


def test_unknown_processing_needs_the_users_word():
    unknown = replace(P3P, processing=Processing.UNKNOWN)
    assert match_reference(own(), unknown)[0] is None
    used, note = match_reference(own(), unknown, named=True)
    assert used is not None
    assert "photos" in note
    assert match_reference(own(processing=Processing.UNKNOWN), unknown)[0] is not None


def test_another_zoom_setting_is_refused():
    used, note = match_reference(own(focal_mm=18.0), replace(P3P, focal_mm=24.0), named=True)
    assert used is None
    assert "18 mm" in note
    assert "24 mm" in note


def test_a_crop_is_converted_and_said():
    used, note = match_reference(own(field_px=None), replace(MINE, height=2250))
    assert used is not None
    assert used.brown == replace(own().brown, height=2250, cy_px=1510.0 - 375)
    assert "2250" in note
    used, note = match_reference(own(), replace(MINE, width=1234, height=2250))
    assert used is None
    assert "1234x2250" in note


@pytest.mark.parametrize(("width", "height"), [(2000, 1500), (4000, 2250)])
def test_conversion_keeps_the_total_mapping(width, height):
    reference = own()
    converted, _ = convert_reference(reference, width, height)
    assert converted.lens is not None
    rays = np.random.default_rng(2).uniform([-0.7, -0.4], [0.7, 0.4], (200, 2))
    scale = width / 4000
    expected = reference.lens.project(rays) * scale - [0, (3000 * scale - height) / 2]
    worst = np.abs(converted.lens.project(rays) - expected).max()
    if height * 4 == width * 3:
        assert worst < 1e-9
        assert converted.sigma["f"] == pytest.approx(0.15)
    else:
        # A crop moves part of the field into shift and scale, which stay with the principal point and f.
        assert worst < 0.5
        no_field, _ = convert_reference(own(field_px=None), width, height)
        assert no_field.lens is not None
    assert converted.sigma["k1"] == reference.sigma["k1"]


def test_a_bare_calibration_gets_a_stated_precision():
    reference = reference_from_camera("bare", BrownCamera.ideal(4000, 3000, 2000.0), "a file")
    assert reference.sigma == {"f": pytest.approx(0.4)}
    assert "0.02 %" in reference.provenance
    used, note = match_reference(reference, P3P, named=True)
    assert used is not None
    assert "not known of the reference" in note


def test_brown_fitted_to_the_total_mapping_is_what_is_compared():
    lens = own().lens
    assert isinstance(lens, Lens)
    fitted, _ = fit_brown(lens)
    reference = own(fitted_brown=fitted)
    assert reference.comparable_brown == fitted
    assert reference.f_px == fitted.f_px
    assert own().comparable_brown == own().brown

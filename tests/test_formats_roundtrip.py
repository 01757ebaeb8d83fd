"""Every format, written and read back: the same pixel for every ray within 0.01 px."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibrations import P3P, cameras, difference_px
from hypothesis import given, settings

from calib.camera import BrownCamera
from calib.errors import FormatError, OutputError
from calib.formats import (
    FORMATS,
    ReadOptions,
    WriteOptions,
    detect_format,
    format_named,
    read_calibration,
    write_calibration,
)

BOUND_PX = 0.01
FORWARD = [name for name in FORMATS if name != "vms"]
#: Formats by the terms that they hold without fitting.
HOLDS_K4 = ("json", "metashape", "micmac")
HOLDS_LITTLE_K4 = ("opencv-yaml", "opencv-xml", "colmap")
HOLDS_ASPECT = ("json", "metashape", "odm", "australis", "opencv-yaml", "opencv-xml", "colmap")
HOLDS_SHEAR = ("json", "metashape", "australis")


def back(name: str, camera: BrownCamera) -> BrownCamera:
    text = FORMATS[name].write(camera, None)
    assert detect_format(text).name == name
    return FORMATS[name].read(text, None)


@pytest.mark.parametrize("name", FORWARD)
@settings(deadline=None, max_examples=15)
@given(camera=cameras())
def test_radial_and_decentring_terms_survive(name: str, camera: BrownCamera) -> None:
    assert difference_px(camera, back(name, camera)) <= 1e-6


@pytest.mark.parametrize("name", HOLDS_K4)
@settings(deadline=None, max_examples=15)
@given(camera=cameras(k4=0.01))
def test_k4_survives(name: str, camera: BrownCamera) -> None:
    assert difference_px(camera, back(name, camera)) <= 1e-6


@pytest.mark.parametrize("name", HOLDS_LITTLE_K4)
@settings(deadline=None, max_examples=15)
@given(camera=cameras(k4=0.001))
def test_a_little_k4_goes_into_the_denominator(name: str, camera: BrownCamera) -> None:
    assert difference_px(camera, back(name, camera)) <= BOUND_PX


@pytest.mark.parametrize("name", HOLDS_ASPECT)
@settings(deadline=None, max_examples=15)
@given(camera=cameras(affine=True))
def test_different_focal_lengths_survive(name: str, camera: BrownCamera) -> None:
    assert difference_px(camera, back(name, camera)) <= 1e-6


@pytest.mark.parametrize("name", HOLDS_SHEAR)
@settings(deadline=None, max_examples=15)
@given(camera=cameras(affine=True, shear=True))
def test_shear_survives(name: str, camera: BrownCamera) -> None:
    assert difference_px(camera, back(name, camera)) <= 1e-6


@settings(deadline=None, max_examples=15)
@given(camera=cameras(weak=True, affine=True, shear=True))
def test_micmac_holds_the_affine_terms_of_a_weak_lens(camera: BrownCamera) -> None:
    assert difference_px(camera, back("micmac", camera)) <= BOUND_PX


@settings(deadline=None, max_examples=40)
@given(camera=cameras(weak=True))
def test_vms_holds_what_an_in_camera_correction_leaves(camera: BrownCamera) -> None:
    """The other direction of the distortion, through two fits."""
    assert difference_px(camera, back("vms", camera)) <= BOUND_PX


@pytest.mark.parametrize("name", list(FORMATS))
@settings(deadline=None, max_examples=15)
@given(camera=cameras(k4=0.01, affine=True, shear=True))
def test_any_lens_is_held_to_the_bound_or_refused(name: str, camera: BrownCamera) -> None:
    refused = None
    try:
        found = back(name, camera)
    except FormatError as error:
        refused = str(error)
    if refused is None:
        assert difference_px(camera, found) <= BOUND_PX
    else:
        assert name not in ("json", "metashape")
        assert "0.01 px allowed" in refused
        assert "\n" not in refused


@pytest.mark.parametrize(
    ("name", "camera"),
    [
        ("colmap", replace(P3P, b2_px=1.0)),
        ("opencv-yaml", replace(P3P, b2_px=1.0)),
        ("opencv-xml", replace(P3P, b2_px=1.0)),
        ("odm", replace(P3P, k4=0.002)),
        ("odm", replace(P3P, b2_px=1.0)),
        ("australis", replace(P3P, k4=0.002)),
        ("pix4d", replace(P3P, b1_px=2.0)),
        ("micmac", replace(P3P, b1_px=10.0)),
        ("vms", P3P),
    ],
)
def test_a_lens_that_a_format_cannot_hold_is_refused_with_the_cost(name: str, camera: BrownCamera) -> None:
    with pytest.raises(FormatError, match=r"up to [\d.]+ px.* 0\.01 px allowed"):
        FORMATS[name].write(camera, None)


def test_a_term_too_small_to_matter_is_dropped() -> None:
    assert 0 < difference_px(replace(P3P, b2_px=0.005), back("colmap", replace(P3P, b2_px=0.005))) < BOUND_PX


def test_a_larger_loss_may_be_allowed() -> None:
    text = FORMATS["vms"].write(P3P, WriteOptions(tolerance_px=2.0))
    with pytest.raises(FormatError, match=r"0\.001 px allowed"):
        FORMATS["vms"].read(text, ReadOptions(tolerance_px=0.001))
    assert 0.1 < difference_px(P3P, FORMATS["vms"].read(text, None)) < 2.0


@pytest.mark.parametrize("name", list(FORMATS))
def test_files_go_out_and_in(name: str, tmp_path: Path) -> None:
    camera = BrownCamera(4000, 3000, 2900.0, 2010.25, 1490.5, -0.01, 0.006, p1=1e-5, p2=-2e-5)
    path = tmp_path / f"camera{FORMATS[name].suffix}"
    write_calibration(camera, name, path, WriteOptions(pixel_size_mm=0.00158, make="DJI", model="FC300S"))
    found, read = read_calibration(path)
    assert found == name
    assert difference_px(camera, read) <= BOUND_PX


def test_numbers_from_numpy_are_written_as_numbers() -> None:
    camera = replace(P3P, width=np.int64(4000), f_px=np.float64(2320.06), k1=np.float64(-0.1))
    for name in FORWARD:
        text = FORMATS[name].write(camera, None)
        assert "np." not in text
        assert FORMATS[name].read(text, None).f_px == pytest.approx(2320.06, rel=1e-12)


def test_a_folder_that_is_not_there_is_an_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        write_calibration(P3P, "json", tmp_path / "missing" / "camera.json")


def test_format_names() -> None:
    assert format_named("opencv") is FORMATS["opencv-yaml"]
    with pytest.raises(FormatError, match="no calibration format 'agisoft'; there are json, odm"):
        format_named("agisoft")


@pytest.mark.parametrize("name", list(FORMATS))
def test_a_calibration_that_is_not_one_is_not_written(name: str) -> None:
    for broken in (replace(P3P, f_px=float("nan")), replace(P3P, f_px=-1.0), replace(P3P, b1_px=3000.0)):
        with pytest.raises(FormatError):
            FORMATS[name].write(broken, None)


def test_a_lens_that_folds_in_the_corners_can_still_be_exported() -> None:
    folding = replace(P3P, k1=-0.25, k2=0.0, k3=0.0)
    for name in FORWARD:
        found = back(name, folding)
        assert (found.k1, found.f_px) == pytest.approx((-0.25, P3P.f_px), rel=1e-9)

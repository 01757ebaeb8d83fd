import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import result_factory

from calib.findings import Verdict
from calib.photos.photo import LeftOut
from calib.report_json import CheckReport, report_dict, report_json

VARIANTS = {
    "refly": lambda: result_factory.build(points=300),
    "trust": lambda: result_factory.build(Verdict.TRUST, points=300),
    "no reference": lambda: result_factory.build(Verdict.CANNOT_TELL, reference=False, points=300),
    "no gps": lambda: result_factory.build(gps=False, points=300),
    "not finite": lambda: result_factory.with_nan_sigmas(result_factory.build(points=300)),
}


def _refuse(constant: str) -> Any:
    raise AssertionError(f"{constant} is no JSON")


@pytest.mark.parametrize("variant", VARIANTS)
def test_strict_json_of_the_schema(variant: str) -> None:
    result = VARIANTS[variant]()
    text = report_json(result)
    data = json.loads(text, parse_constant=_refuse)
    assert data == report_dict(result)
    CheckReport.model_validate_json(text, strict=True)
    text.encode("utf-8")


def test_the_interface_is_there() -> None:
    data = report_dict(result_factory.build(points=300))
    assert data["schema"] == "fieldcal.check/1"
    assert data["verdict"] == "REFLY"
    assert set(data["findings"][0]) == {
        "rule",
        "state",
        "value",
        "sigma",
        "unit",
        "threshold",
        "source",
        "message",
    }
    assert set(data["camera"]) == {"make", "model", "serial", "width", "height", "processing"}
    numbers = {"f_px", "cx_px", "cy_px", "k1", "k2", "k3", "p1", "p2", "k1_px", "k2_px", "k3_px"}
    assert numbers <= set(data["calibration"])
    assert set(data["calibration"]["sigma"]) == set(data["calibration"]) - {"sigma", "correlation"}
    assert set(data["reference"]) == {"name", "source", "processing", "f_px", "note"}
    assert {"photos", "used", "aligned", "components", "points", "observations"} <= set(data["alignment"])
    assert set(data["alignment"]["left_out"][0]) == {"path", "reason"}
    assert set(data["network"]) == {"nadir", "convergent", "heights_agl_m", "gsd_m"}
    assert {"crs", "rms_xy_m", "rms_z_m", "trusted", "fault"} == set(data["georeference"])
    assert set(data["dome"]) == {"amplitude_m", "amplitude_percent", "sigma_m"}
    assert set(data["timing"]) == {"wall_s", "cpu_s", "photos_per_s"}
    assert data["exports"] == {}


def test_the_numbers_are_the_results() -> None:
    result = result_factory.build(points=300)
    data = report_dict(result)
    calibration, brown = data["calibration"], result.estimate.brown
    assert calibration["f_px"] == brown.f_px
    assert calibration["k1_px"] == pytest.approx(brown.k1 / brown.f_px**2)
    assert calibration["sigma"]["f_px"] == pytest.approx(0.55)
    assert 0 < calibration["sigma"]["k1_px"] < abs(calibration["k1_px"])
    assert calibration["correlation"]["k1"]["k2"] == pytest.approx(-0.96)
    assert calibration["correlation"]["k2"]["k1"] == calibration["correlation"]["k1"]["k2"]
    assert data["alignment"]["reprojection_rms_px"] == pytest.approx(0.4 * np.sqrt(2), rel=0.05)
    assert data["dome"]["amplitude_percent"] == pytest.approx(100 * 0.092 / 60)
    assert data["reference"]["f_px"] == result_factory.REFERENCE_F_PX


def test_every_photo_is_counted_once() -> None:
    result = result_factory.build(points=300)
    lost = LeftOut(Path("DCIM/100MEDIA/DJI_0030.JPG"), "not joined to the block")
    solution = replace(result.solution, left_out=(lost,))
    # Whether or not the list of the whole check repeats what the alignment left out.
    for whole in (result.left_out, (*result.left_out, lost)):
        alignment = report_dict(replace(result, solution=solution, left_out=whole))["alignment"]
        assert (alignment["photos"], alignment["used"], alignment["aligned"]) == (30, 27, 26)
        assert len(alignment["left_out"]) == 4


def test_no_reference_is_null() -> None:
    data = report_dict(result_factory.build(Verdict.CANNOT_TELL, reference=False, points=300))
    assert data["reference"] is None
    assert data["dome"]["amplitude_m"] is None
    assert data["dome"]["amplitude_percent"] is None
    assert "No reference" in data["reference_note"]


def test_what_is_not_finite_is_null() -> None:
    data = report_dict(result_factory.with_nan_sigmas(result_factory.build(points=300)))
    assert data["findings"][0]["value"] is None
    assert data["findings"][0]["sigma"] is None
    assert set(data["calibration"]["sigma"].values()) == {None}
    assert data["calibration"]["correlation"] == {}
    assert data["timing"] == {"wall_s": None, "cpu_s": 0.0, "photos_per_s": None}


def test_no_lengths_without_a_scale() -> None:
    """Without believed geotags only proportions mean anything."""
    known = report_dict(result_factory.build(points=300))
    assert known["network"]["heights_agl_m"] == [60.0]
    assert known["dome"]["amplitude_m"] == pytest.approx(0.092)
    blind = report_dict(result_factory.build(gps=False, points=300))
    assert blind["network"]["heights_agl_m"] == []
    assert blind["network"]["gsd_m"] is None
    assert blind["dome"]["amplitude_m"] is None
    assert blind["dome"]["sigma_m"] is None
    assert blind["dome"]["amplitude_percent"] == known["dome"]["amplitude_percent"]

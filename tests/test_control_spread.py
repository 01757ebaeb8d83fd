"""Sigmas of calibrations on control points where the model is not the lens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.camera import BROWN_NAMES, BrownCamera
from calib.control import ControlCalibration, calibrate_control, free_parameters, prepare
from calib.control_output import control_reference, control_report
from calib.targets import DETECTED_SIGMA_PX, parse_board
from sim.control_block import Campaign, board_campaign, campaign
from sim.flights import phantom3
from sim.papers.orbit import TARGET_M, fly

CX = BROWN_NAMES.index("cx")


def made(given: Campaign, camera: BrownCamera, sigma_px: float) -> ControlCalibration:
    photos, points, marks = given
    used, kept, chosen, notes = prepare(photos, points, marks, sigma_px)
    return calibrate_control(used, kept, chosen, 0.97 * camera.f_px, notes)


def test_decentring_that_was_left_out_is_in_the_principal_points_sigma() -> None:
    """The thermal lens has decentring that few marks cannot prove; held at none it moves cx by 5 sigma."""
    orbit = fly("thermal add6", 2)
    found = made(campaign(orbit, TARGET_M), orbit.camera, 0.5)
    assert "p1" not in free_parameters(found)
    miss = abs(found.camera.cx_px - orbit.camera.cx_px)
    assert miss > 4 * np.sqrt(found.fit.covariance[CX, CX])
    assert 0.2 < miss / np.sqrt(found.covariance[CX, CX]) < 3
    # The reference does not claim to know that there is none; the report's own list has what was estimated.
    reference = control_reference(found, "thermal", None)
    assert reference.sigma["p1"] > 0
    assert "p1" not in control_report(found).sigma
    assert not found.spread.beyond_brown


@pytest.mark.parametrize("pattern_px", [0.0, 0.5])
def test_a_lens_beyond_brown_is_said_and_allowed_for(pattern_px: float) -> None:
    camera = replace(phantom3(), cx_px=2004.0, cy_px=1493.0, p1=2e-4, p2=-1e-4)
    given = board_campaign(parse_board("9x7,60,45"), camera, 14, DETECTED_SIGMA_PX, pattern_px, 0)
    found = made(given, camera, DETECTED_SIGMA_PX)
    formal, whole = (np.sqrt(np.diag(c)[:6]) for c in (found.fit.covariance, found.covariance))
    off = np.abs(found.camera.vector - camera.vector)[:6]
    assert np.all(off < 3 * whole)
    assert found.spread.beyond_brown == (pattern_px > 0)
    assert any("departs from Brown's model" in note for note in found.notes) == (pattern_px > 0)
    if pattern_px > 0:
        assert np.max(off / formal) > 3
        assert 0.03 < found.spread.field_rms_px < 0.5
    else:
        assert whole[0] == pytest.approx(formal[0], rel=0.3)

"""Units, the other direction, and calibrations brought to other images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibrations import P3P, P3P_RADIAL_PX, cameras, difference_px, image_rays
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.camera import BROWN_NAMES, BrownCamera, radial_profile_px
from calib.convert import (
    cropped,
    decentring_in_focal_units,
    decentring_per_length,
    fit_brown,
    radial_in_focal_units,
    radial_mm_to_px,
    radial_per_length,
    radial_px_to_mm,
    rotated,
    to_image_size,
)
from calib.correction import CorrectionModel, fit_correction, fit_from_correction, to_correction
from calib.errors import FormatError, InputError

# --- Units ---------------------------------------------------------------------------------------


def test_pixel_units_of_the_published_wall_calibration() -> None:
    """[C&D] eq. 1-3: K (focal) = K (px) f^2, f^4, f^6; about -0.136, 0.115, -0.018 for the P3P."""
    assert (P3P.k1, P3P.k2, P3P.k3) == pytest.approx((-0.13618, 0.11473, -0.017935), rel=1e-4)
    assert (P3P.k1_px, P3P.k2_px, P3P.k3_px) == pytest.approx(P3P_RADIAL_PX, rel=1e-12)
    assert radial_per_length((P3P.k1, P3P.k2, P3P.k3), P3P.f_px) == pytest.approx(P3P_RADIAL_PX, rel=1e-12)


def test_pixel_units_give_displacements_in_pixels() -> None:
    radius_px = np.array([500.0, 1500.0, 2000.0])
    rays = np.stack([radius_px / P3P.f_px, np.zeros(3)], -1)
    moved = P3P.project(rays)[:, 0] - P3P.cx_px - radius_px
    assert radial_profile_px(*P3P_RADIAL_PX, radius_px) == pytest.approx(moved, rel=1e-9)


def test_millimetres_give_displacements_in_millimetres() -> None:
    pitch_mm = 0.00158
    k_mm = radial_px_to_mm(P3P_RADIAL_PX, pitch_mm)
    radius_px = np.array([800.0, 1900.0])
    in_mm = radial_profile_px(*k_mm, radius_px * pitch_mm)
    assert in_mm / pitch_mm == pytest.approx(radial_profile_px(*P3P_RADIAL_PX, radius_px), rel=1e-9)
    assert radial_mm_to_px(k_mm, pitch_mm) == pytest.approx(P3P_RADIAL_PX, rel=1e-12)


@given(
    st.lists(st.floats(-1, 1, allow_subnormal=False), min_size=1, max_size=4),
    st.floats(1.0, 10_000.0),
)
def test_units_go_both_ways(radial: list[float], focal: float) -> None:
    back = radial_in_focal_units(radial_per_length(radial, focal), focal)
    assert back == pytest.approx(radial, rel=1e-9, abs=1e-12)
    assert decentring_in_focal_units(decentring_per_length(radial[0], focal), focal) == pytest.approx(
        radial[0]
    )


# --- Fit -------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=25)
@given(cameras(k4=0.01, affine=True, shear=True))
def test_fit_recovers_the_camera_that_made_the_pixels(camera: BrownCamera) -> None:
    rays = image_rays(camera)
    pixels = camera.project(rays)
    start = BrownCamera.ideal(camera.width, camera.height, camera.f_px * 1.01)
    fit = fit_brown(rays, pixels, start, BROWN_NAMES)
    assert fit.misfit_px < 1e-6
    assert fit.camera.f_px == pytest.approx(camera.f_px, rel=1e-7)
    assert fit.camera.k1 == pytest.approx(camera.k1, abs=1e-6)


def test_fit_reports_what_it_cannot_hold() -> None:
    rays = image_rays(P3P)
    fit = fit_brown(rays, P3P.project(rays), replace(P3P, k2=0.0, k3=0.0), ("k1",))
    worst = np.hypot(*(fit.camera.project(rays) - P3P.project(rays)).T).max()
    assert fit.misfit_px == pytest.approx(worst)
    assert 5 < fit.misfit_px < 150


# --- Other direction -----------------------------------------------------------------------------


@settings(deadline=None, max_examples=40)
@given(cameras())
def test_correction_says_honestly_what_it_costs(camera: BrownCamera) -> None:
    """The stated misfit bounds the error at rays that the fit has not seen, and is not padded."""
    fit = fit_correction(camera, 3)
    rays = image_rays(camera)
    pixels = camera.project(rays)
    error_px = np.hypot(*(camera.project(fit.model.unproject(pixels)) - pixels).T).max()
    assert error_px <= fit.misfit_px * 1.05 + 1e-9
    assert error_px >= fit.misfit_px * 0.5 - 1e-9


@settings(deadline=None, max_examples=40)
@given(cameras(weak=True, affine=True, shear=True))
def test_weak_distortion_goes_both_ways_within_the_bound(camera: BrownCamera) -> None:
    there = to_correction(camera, 4, tolerance_px=0.05)
    back = fit_from_correction(there.model)
    assert difference_px(camera, back.camera) <= there.misfit_px + back.misfit_px + 1e-6
    assert back.camera.cx_px == pytest.approx(camera.cx_px, abs=1e-9)
    assert back.camera.f_px == pytest.approx(camera.f_px, rel=3e-5)


def test_more_terms_miss_less_and_a_flipped_sign_misses_grossly() -> None:
    misfits = [fit_correction(P3P, n).misfit_px for n in (1, 2, 3, 4, 5)]
    assert misfits == sorted(misfits, reverse=True)
    assert misfits[4] < 0.6 < misfits[2]
    flipped = CorrectionModel(
        P3P.width, P3P.height, P3P.f_px, P3P.cx_px, P3P.cy_px, (-P3P.k1, -P3P.k2, -P3P.k3)
    )
    pixels = P3P.project(image_rays(P3P))
    error_px = np.hypot(*(P3P.project(flipped.unproject(pixels)) - pixels).T).max()
    assert error_px > 5 * misfits[2]


def test_correction_is_the_inverse_to_first_order() -> None:
    camera = replace(BrownCamera.ideal(4000, 3000, 3000.0), k1=1e-4, p1=2e-6, p2=-3e-6)
    fit = to_correction(camera, 3)
    assert fit.model.radial[0] == pytest.approx(-1e-4, rel=1e-3)
    # P1 goes with x in Fraser's order, with y in Brown's here.
    assert (fit.model.p1, fit.model.p2) == pytest.approx((3e-6, -2e-6), rel=1e-2)


def test_correction_is_refused_above_the_stated_bound() -> None:
    needed = fit_correction(P3P, 3).misfit_px
    with pytest.raises(FormatError, match=r"miss this lens by up to .* px"):
        to_correction(P3P, 3, tolerance_px=needed * 0.99)
    assert to_correction(P3P, 3, tolerance_px=needed * 1.01).misfit_px == needed


def test_a_lens_that_folds_within_the_image_has_no_correction() -> None:
    with pytest.raises(FormatError, match="folds back"):
        fit_correction(replace(P3P, k1=-0.5, k2=0.0, k3=0.0))


#: [SEN] Table 2: c, xp, yp mm; K1-K3 mm^-2..; P1, P2 mm^-1 (subset and add6 of each sensor).
SEN_VMS = {
    "thermal": [
        (13.10, -1.25e-1, -1.63e-1, 5.34e-4, -3.76e-5, 8.90e-7, -5.36e-5, -6.47e-4),
        (13.09, -1.02e-1, -3.15e-2, 2.35e-4, -1.11e-5, 3.26e-7, -8.64e-5, -2.56e-4),
    ],
    "rgb": [
        (8.84, 1.82e-2, -3.20e-3, 1.80e-4, -1.15e-5, 1.96e-7, 3.01e-5, 1.85e-5),
        (8.84, 2.04e-2, -7.60e-3, 2.04e-4, -1.25e-5, 2.11e-7, 3.46e-5, 4.15e-6),
    ],
}
SEN_METASHAPE = {
    "thermal": [(-1.11e-4, 1.19e-5, -4.12e-7), (-2.98e-5, 3.69e-6, -2.41e-7)],
    "rgb": [(-1.30e-4, 8.24e-6, -1.43e-7), (-1.18e-4, 7.16e-6, -1.20e-7)],
}
SEN_SENSOR = {"thermal": (640, 512, 0.017), "rgb": (5472, 3648, 0.00241)}


@pytest.mark.parametrize("sensor", ["thermal", "rgb"])
@pytest.mark.parametrize("row", [0, 1])
def test_vms_rows_agree_with_metashape_rows_after_conversion(sensor: str, row: int) -> None:
    """[SEN] Table 2: as printed K1-K3 have opposite signs, in one direction they have the same."""
    width, height, pitch_mm = SEN_SENSOR[sensor]
    c, xp, yp, k1, k2, k3, p1, p2 = SEN_VMS[sensor][row]
    metashape = SEN_METASHAPE[sensor][row]
    assert all(np.sign((k1, k2, k3)) == -np.sign(metashape))
    model = CorrectionModel(
        width,
        height,
        c / pitch_mm,
        width / 2 + xp / pitch_mm,
        height / 2 - yp / pitch_mm,
        radial_in_focal_units((k1, k2, k3), c),
        p1 * c,
        -p2 * c,
    )
    fit = fit_from_correction(model)
    *converted, k4 = radial_per_length((fit.camera.k1, fit.camera.k2, fit.camera.k3, fit.camera.k4), c)
    assert all(np.sign(converted) == np.sign(metashape))
    assert 0.05 < fit.misfit_px < 0.5
    r_mm = np.hypot(width, height) / 2 * pitch_mm * np.array([0.3, 0.5, 0.7, 0.9])
    ours = radial_profile_px(*converted, r_mm) + k4 * r_mm**9
    theirs = radial_profile_px(*metashape, r_mm)
    assert (ours < 0).all()
    assert (theirs < 0).all()
    if sensor == "rgb":
        # The same lens by two programs: VMS lies above Metashape in the paper's Figure 5, too.
        assert (ours / theirs > 0.9).all()
        assert (ours / theirs < 2.2).all()
        # P1 has opposite signs in the table (-1.4e-5, -1.6e-5 by Metashape), the same once converted.
        assert -4e-5 < fit.camera.p2 / c < -1e-5


# --- Other images ------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=25)
@given(cameras(k4=0.01, affine=True, shear=True), st.integers(0, 300), st.integers(0, 200))
def test_a_crop_shows_the_same_rays_at_shifted_pixels(camera: BrownCamera, left: int, top: int) -> None:
    part = cropped(camera, left, top, camera.width - 320, camera.height - 250)
    rays = image_rays(camera)
    assert part.project(rays) == pytest.approx(camera.project(rays) - [left, top], abs=1e-9)
    assert (part.width, part.height) == (camera.width - 320, camera.height - 250)


@pytest.mark.parametrize("window", [(-1, 0, 100, 100), (0, 0, 4001, 10), (3990, 0, 20, 10), (0, 0, 0, 10)])
def test_a_window_outside_the_image_is_refused(window: tuple[int, int, int, int]) -> None:
    with pytest.raises(InputError, match="does not lie within"):
        cropped(P3P, *window)


@settings(deadline=None, max_examples=40)
@given(cameras(k4=0.01, affine=True, shear=True), st.integers(-5, 5))
def test_a_turned_image_is_exact_through_projection(camera: BrownCamera, turns: int) -> None:
    turned = rotated(camera, turns)
    rays = image_rays(camera)
    pixels = camera.project(rays)
    size = (camera.width, camera.height)
    for _ in range(turns % 4):
        # One turn clockwise: (u, v) -> (height - v, u); directions likewise about the axis.
        pixels = np.stack([size[1] - pixels[:, 1], pixels[:, 0]], -1)
        rays = np.stack([-rays[:, 1], rays[:, 0]], -1)
        size = (size[1], size[0])
    cos, sin = np.cos(turned.roll_rad), np.sin(turned.roll_rad)
    rays = rays @ np.array([[cos, sin], [-sin, cos]])
    assert (turned.camera.width, turned.camera.height) == size
    assert turned.camera.project(rays) == pytest.approx(pixels, abs=1e-6)


@settings(deadline=None, max_examples=25)
@given(cameras(k4=0.01, affine=True))
def test_without_shear_a_turn_needs_no_roll_and_four_turns_are_none(camera: BrownCamera) -> None:
    assert rotated(camera, 1).roll_rad == 0.0
    around = camera
    for _ in range(4):
        around = rotated(around, 1).camera
    assert difference_px(camera, around) < 1e-8
    assert rotated(camera, 1).camera.f_px == pytest.approx(camera.fy_px)


def test_the_roll_of_a_sheared_camera_is_its_shear_angle() -> None:
    turned = rotated(replace(P3P, b2_px=2.0), 1)
    assert abs(turned.roll_rad) == pytest.approx(2.0 / P3P.f_px, rel=1e-5)


def test_same_proportions_are_scaled() -> None:
    resized = to_image_size(P3P, 2000, 1500)
    rays = image_rays(P3P)
    assert resized.camera.project(rays) == pytest.approx(P3P.project(rays) / 2, abs=1e-9)
    assert "scaled by 0.5" in resized.how
    rounded = to_image_size(replace(P3P, width=5472, height=3648), 1368, 911)
    assert "scaled" in rounded.how


def test_a_16_to_9_image_is_a_centred_crop_of_the_sensor() -> None:
    resized = to_image_size(P3P, 4000, 2250)
    assert resized.camera == replace(P3P, height=2250, cy_px=P3P.cy_px - 375)
    assert "375 rows" in resized.how
    narrow = to_image_size(P3P, 3000, 3000)
    assert narrow.camera == replace(P3P, width=3000, cx_px=P3P.cx_px - 500)
    assert "500 columns" in narrow.how
    assert to_image_size(P3P, 4000, 3000).camera == P3P


@pytest.mark.parametrize(
    ("width", "height", "why"),
    [
        (3000, 4000, "turned by 90 degrees"),
        (4000, 4000, "more of the sensor"),
        (5000, 3000, "more of the sensor"),
        (3840, 2160, "neither"),
        (0, 0, "cannot exist"),
    ],
)
def test_sizes_that_cannot_be_converted_are_refused_in_words(width: int, height: int, why: str) -> None:
    with pytest.raises(InputError, match=why):
        to_image_size(P3P, width, height)

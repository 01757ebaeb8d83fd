"""A case as a simulated survey, and the reference that it is held against, both with their truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from benchmarks.verdict_cases import PAPERS_POINTS, POINTS, Case
from calib.brownfit import fit_brown
from calib.camera import BROWN_NAMES, BrownCamera, FloatArray
from calib.equifinal import Radial, image_radius_px, profile_deviation
from calib.field import FIELD_NAMES, Lens, field_basis
from calib.reference import Reference
from calib.reference_match import OTHER_BODY_SIGMA_EDGE, OTHER_BODY_SIGMA_F, match_reference
from calib.references import load_reference
from sim.flights import Flight, convergent, flight_plan, grid, jittered
from sim.network import SimBlock, SimOptions, observe
from sim.pattern import pixel_grid
from sim.solution import identity_of
from sim.solve import calibrate_block

SITE_M = 120.0
#: An ordinary consumer drone: 30 ms for a frame, 5 m/s; positions logged 0.1 s late.
READOUT_S, SPEED_M_S, LATE_S = 0.03, 5.0, 0.1
#: Constant error of the second RTK's base, and the size of a slow drift.
BASE_OFFSET_M, DRIFT_M = (3.0, -2.0, 5.0), 3.0
_FLIGHTS = {
    "nadir, wide lines": "nadir_one_height",
    "cross-hatch 15°": "crosshatch",
    "cross-hatch nadir": "crosshatch_nadir",
}


@dataclass(frozen=True)
class TrueReference:
    """A reference as the check gets it, and how far it truly is from the camera that flew.

    ``reference`` None: there is none. ``df_percent``: its f against the camera's;
    ``deviation_px``: its radial profile against the camera's over the half width.
    """

    reference: Reference | None
    note: str
    df_percent: float
    deviation_px: float


def _number(level: str) -> float:
    """The number that a level's name holds: ``K1 off by 6 px`` -> 6."""
    return next(float(word) for word in level.split() if word[0].isdigit() and word[-1].isdigit())


@lru_cache(maxsize=16)
def nominal_camera(lens_name: str) -> BrownCamera:
    """The published lens, principal point in the middle, no decentring."""
    reference = load_reference(lens_name)
    width, height, f = reference.width, reference.height, reference.f_px
    assert f is not None
    if reference.brown is not None:
        k1, k2, k3 = reference.brown.k1, reference.brown.k2, reference.brown.k3
    else:  # Of the Inspire 1 only f and what follows from its lines is published.
        assert reference.implied_radial_px is not None
        k1, k2, k3 = (k * f**n for k, n in zip(reference.implied_radial_px, (2, 4, 6), strict=True))
    return replace(BrownCamera.ideal(width, height, f), k1=k1, k2=k2, k3=k3)


def true_camera(case: Case) -> BrownCamera:
    """The lens of the case's model, with a principal point and decentring of its own."""
    camera = nominal_camera(case.lens)
    rng = np.random.default_rng([case.number, 21])
    shift = 0.002 * camera.width * rng.normal(size=2)
    p1, p2 = 1e-4 * rng.normal(size=2)
    return replace(
        camera,
        cx_px=camera.cx_px + float(shift[0]),
        cy_px=camera.cy_px + float(shift[1]),
        p1=float(p1),
        p2=float(p2),
    )


def flight_of(case: Case) -> Flight:
    """Its planned poses."""
    if case.pattern.startswith("gently"):
        return grid(4, 8, SITE_M / 2, SITE_M, off_nadir_deg=10.0)
    return flight_plan(_FLIGHTS.get(case.pattern, case.pattern), SITE_M)


def options_of(case: Case, camera: BrownCamera) -> SimOptions:
    """What disturbs it."""
    # A longer lens sees less ground: as many points in a photo as with the papers' wide one.
    narrow = (camera.f_px / camera.width / 0.58) ** 2
    shutter = case.error == "rolling shutter"
    return SimOptions(
        n_points=round((PAPERS_POINTS if case.part == "papers" else POINTS)[case.pattern] * narrow),
        noise_px=_number(case.noise),
        mismatch_rate=_number(case.mismatches) / 100,
        gps_sigma_m={"white 2.5 m": 2.5, "drifting": 0.5}.get(case.gps, 0.03),
        relief_m=_number(case.relief),
        pattern_px=1.5 if case.error.startswith("pattern") else 0.0,
        readout_s=READOUT_S if shutter else 0.0,
        speed_m_s=SPEED_M_S if shutter else 0.0,
        aspect=0.005 if case.error.startswith("aspect") else 0.0,
        correlated_px=0.3 if case.error.startswith("correlated") else 0.0,
        site_m=SITE_M,
    )


def survey_of(case: Case) -> SimBlock:
    """The simulated survey."""
    camera = true_camera(case)
    options = options_of(case, camera)
    flight = jittered(
        flight_of(case),
        case.number,
        options.position_jitter_m,
        options.height_jitter_m,
        options.attitude_jitter_deg,
    )
    block = observe(case.pattern, flight, camera, case.number, options)
    k = len(flight)
    if case.gps == "drifting":
        # The receiver does not know; the files state no accuracy.
        wrong = slow_drift_m(case.number, k)
        return replace(block, gps_m=block.gps_m + wrong, gps_sigma_m=np.full((k, 3), 2.5))
    if case.gps.endswith("offset"):
        late = LATE_S * SPEED_M_S * flight.track
        return replace(block, gps_m=block.gps_m + late + np.array(BASE_OFFSET_M))
    return block


def slow_drift_m(seed: int, photos: int) -> FloatArray:
    """(photos, 3): two slow waves over the flight in each axis, ``DRIFT_M`` in size."""
    rng = np.random.default_rng([seed, 22])
    t = np.linspace(0, 1, photos)[:, None]
    cycles, phase = rng.uniform(0.3, 1.5, (2, 3)), rng.uniform(0, 2 * np.pi, (2, 3))
    waves = np.sin(2 * np.pi * (t * cycles[0] + phase[0])) + np.sin(2 * np.pi * (t * cycles[1] + phase[1]))
    return np.asarray(DRIFT_M / np.sqrt(2) * waves)


def true_lens(block: SimBlock) -> Lens:
    """The true total mapping in the terms that a calibration has: a pattern as a residual field."""
    brown = block.lens.brown
    pixels = pixel_grid(brown.width, brown.height)
    pattern = block.pattern(pixels)
    if not pattern.any():
        return block.lens
    st = 2 * pixels / [brown.width, brown.height] - 1
    design = np.column_stack([field_basis(pixels, brown.width, brown.height), np.ones(len(st)), st])
    terms = np.linalg.lstsq(design, pattern, rcond=None)[0][: len(FIELD_NAMES) // 2]
    return Lens(brown, np.asarray(terms.T.ravel()))


@lru_cache(maxsize=16)
def site_covariance(lens_name: str) -> FloatArray:
    """Covariance (35, 35) over ``LENS_NAMES`` of a good calibration of this lens on site.

    12 photos straight down and 24 on two circles, 25 and 40 degrees off, ordinary noise.
    """
    camera = nominal_camera(lens_name)
    flight = grid(3, 4, SITE_M / 2, SITE_M) + convergent(12, 40.0, SITE_M / 2)
    flight = jittered(flight + convergent(12, 25.0, SITE_M / 1.5, first_azimuth_deg=15.0), 0, 1.0, 0.5, 1.5)
    points = round(1500 * (camera.f_px / camera.width / 0.58) ** 2)
    block = observe("on site", flight, camera, 0, SimOptions(n_points=points))
    return calibrate_block(block, 1.01 * camera.f_px, 0).adjusted.covariance


@lru_cache(maxsize=32)
def reference_sigma_f_percent(lens_name: str, reference: str) -> float:
    """Standard deviation of f that the check gives the references of :func:`reference_of`."""
    camera = nominal_camera(lens_name)
    to_brown = fit_brown(Lens(camera))[1][0]
    own = float(np.sqrt(to_brown @ site_covariance(lens_name) @ to_brown)) / camera.f_px
    return 100 * float(np.hypot(own, OTHER_BODY_SIGMA_F if reference == "wrong body" else 0.0))


def reference_of(case: Case, block: SimBlock) -> TrueReference:
    """A calibration on site, wrong by what its own covariance says, and on top what the case asks for."""
    if case.reference == "none":
        return TrueReference(None, "No reference calibration of this camera is known.", 0.0, 0.0)
    rng = np.random.default_rng([case.number, 23])
    lens = true_lens(block)
    truth = fit_brown(lens)[0]
    radius = image_radius_px(truth)
    covariance = site_covariance(case.lens)
    made = lens.with_vector(rng.multivariate_normal(lens.vector, covariance, method="eigh"))
    way, first, second = float(rng.choice([-1.0, 1.0])), *rng.normal(size=2)
    per_px = truth.f_px**2 / radius**3  # K1 in focal units for a pixel at the half width
    f_factor, k1_more, serial = 1.0, 0.0, "SIM"
    if case.reference.startswith("f off"):
        f_factor += way * _number(case.reference) / 100
    elif case.reference.startswith("K1 off"):
        k1_more = way * _number(case.reference) * per_px
    elif case.reference == "wrong body":
        f_factor += OTHER_BODY_SIGMA_F * first
        k1_more = OTHER_BODY_SIGMA_EDGE * radius * second * per_px
        serial = "OTHER"
    brown = replace(made.brown, f_px=made.brown.f_px * f_factor, k1=made.brown.k1 + k1_more)
    made = replace(made, brown=brown)
    fitted, jacobian = fit_brown(made)
    fitted_covariance = jacobian @ covariance @ jacobian.T
    sigma = np.sqrt(np.diag(fitted_covariance))
    camera = identity_of(block)
    reference = Reference(
        name="on-site",
        make=camera.make,
        model=camera.model,
        width=truth.width,
        height=truth.height,
        processing=camera.processing,
        source="simulated",
        brown=made.brown,
        field_px=made.field_px,
        sigma={name: float(s) for name, s in zip(BROWN_NAMES, sigma, strict=True) if s > 0},
        covariance=covariance,
        serial=serial,
        fitted_brown=fitted,
        fitted_covariance=fitted_covariance,
    )
    used, note = match_reference(reference, camera, named=True)
    return TrueReference(
        used,
        note,
        100 * (fitted.f_px / truth.f_px - 1),
        profile_deviation(Radial.of(truth), Radial.of(fitted), radius).raw_px,
    )

"""A realistic synthetic CheckResult: a Phantom 3 Professional over gentle relief.

18 nadir photos at 60 m and 8 convergent ones (30 degrees off nadir), 2000 points, 0.4 px noise,
geotags good to 1.5 m. ``build(...)`` varies it; everything is deterministic.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from calib.camera import BROWN_NAMES, BrownCamera, FloatArray
from calib.field import FIELD_NAMES, LENS_NAMES, Lens
from calib.findings import Finding, State, Verdict
from calib.photos.photo import CameraIdentity, GimbalAngles, LeftOut, Photo, Position, Processing
from calib.reference import EquifinalLine, Reference
from calib.result import CheckResult, Timing
from calib.solution import Dome, Estimate, Georeference, Network, Observations, Solution

WIDTH, HEIGHT = 4000, 3000
ORIGIN = (50.83, -0.12, 104.0)
REFERENCE_F_PX = 2320.06

#: [C&D] eq. 5.
LINE = EquifinalLine(
    slope=-2.7364e-7,
    intercept=-3.4086e-15,
    k1_min=-2.56e-8,
    k1_max=-2.35e-8,
    k2_min=2.97e-15,
    k2_max=3.62e-15,
    band_k2_px=6.2e-17,
    source="Carbonneau & Dietrich 2017, eq. 5",
)

SIGMAS = {
    "f": 0.55,
    "cx": 0.6,
    "cy": 0.7,
    "k1": 2.5e-4,
    "k2": 7e-4,
    "k3": 6e-4,
    "p1": 3e-5,
    "p2": 3e-5,
}


def p3p_camera(f_px: float = REFERENCE_F_PX) -> BrownCamera:
    """The flat-wall calibration of the Phantom 3 Professional ([C&D])."""
    return BrownCamera(
        WIDTH,
        HEIGHT,
        f_px,
        2004.3,
        1496.1,
        k1=-2.53e-8 * f_px**2,
        k2=3.96e-15 * f_px**4,
        k3=-1.15e-22 * f_px**6,
        p1=2e-4,
        p2=-1e-4,
    )


def brown_covariance(scale: float = 1.0) -> FloatArray:
    """(11, 11) over ``BROWN_NAMES``; K4, b1, b2 held. Radial terms correlate as they do in life."""
    correlation = np.eye(len(BROWN_NAMES))
    pairs = {
        ("k1", "k2"): -0.96,
        ("k1", "k3"): 0.90,
        ("k2", "k3"): -0.985,
        ("f", "k1"): 0.3,
        ("f", "k2"): -0.2,
    }
    pairs |= {("cx", "p2"): 0.8, ("cy", "p1"): 0.8, ("f", "k3"): 0.15}
    for (a, b), value in pairs.items():
        i, j = BROWN_NAMES.index(a), BROWN_NAMES.index(b)
        correlation[i, j] = correlation[j, i] = value
    sigma = np.array([SIGMAS.get(name, 0.0) for name in BROWN_NAMES]) * scale
    return correlation * np.outer(sigma, sigma)


def _pose(yaw_deg: float, pitch_deg: float) -> FloatArray:
    """cam_from_world (3, 3) of a gimbal with roll 0, world east-north-up."""
    yaw, pitch = np.radians([yaw_deg, pitch_deg])
    forward = np.array([np.cos(pitch) * np.sin(yaw), np.cos(pitch) * np.cos(yaw), np.sin(pitch)])
    right = np.array([np.cos(yaw), -np.sin(yaw), 0.0])
    return np.stack([right, np.cross(forward, right), forward])


def _stations(convergent: int) -> list[tuple[FloatArray, GimbalAngles]]:
    out = []
    for row in range(3):
        for column in range(6):
            east = 18.0 * (column if row % 2 == 0 else 5 - column) - 45.0
            yaw = 90.0 if row % 2 == 0 else -90.0
            out.append((np.array([east, 28.0 * (row - 1), 60.0]), GimbalAngles(yaw, -90.0, 0.0)))
    for i in range(convergent):
        angle = 2 * np.pi * i / max(convergent, 1)
        centre = np.array([36 * np.sin(angle), 36 * np.cos(angle), 60.0])
        out.append((centre, GimbalAngles(float(np.degrees(angle)) % 360 - 180.0, -60.0, 0.0)))
    return out


def _block(
    lens: Lens, identity: CameraIdentity, convergent: int, points: int, gps: bool
) -> tuple[Solution, FloatArray]:
    rng = np.random.default_rng(7)
    ground = rng.uniform([-75, -60], [75, 60], (points, 2))
    height = 2.5 * np.sin(ground[:, 0] / 18) * np.cos(ground[:, 1] / 23) + rng.normal(0, 0.3, points)
    world = np.column_stack([ground, height])
    stations = _stations(convergent)
    rotations = np.array([_pose(angles.yaw_deg, angles.pitch_deg) for _, angles in stations])
    centres = np.array([centre for centre, _ in stations])
    seen: list[tuple[int, int, FloatArray]] = []
    for k in range(len(stations)):
        in_camera = (world - centres[k]) @ rotations[k].T
        rays = in_camera[:, :2] / in_camera[:, 2:]
        pixels = lens.project(rays)
        inside = (in_camera[:, 2] > 1) & (np.hypot(*rays.T) < 1.15)
        inside &= (pixels > 2).all(axis=1) & (pixels < [WIDTH - 2, HEIGHT - 2]).all(axis=1)
        seen += [(int(i), k, pixels[i]) for i in np.flatnonzero(inside)]
    counts = np.bincount([point for point, _, _ in seen], minlength=points)
    new_index = np.cumsum(counts >= 2) - 1
    seen = sorted((item for item in seen if counts[item[0]] >= 2), key=lambda item: item[:2])
    pixels = np.array([item[2] for item in seen])
    noise = rng.normal(0, 0.4, pixels.shape)
    start = datetime(2024, 5, 4, 10, 30, tzinfo=UTC)
    photos = []
    for k, (centre, angles) in enumerate(stations):
        tag = centre + rng.normal(0, 1.5, 3)
        position = Position(
            ORIGIN[0] + tag[1] / 111_200,
            ORIGIN[1] + tag[0] / (111_200 * np.cos(np.radians(ORIGIN[0]))),
            ORIGIN[2] + tag[2],
            sigma_horizontal_m=1.5,
            sigma_vertical_m=3.0,
        )
        photos.append(
            Photo(
                Path(f"DCIM/100MEDIA/DJI_{k + 1:04d}.JPG"),
                identity,
                position if gps else None,
                angles if gps else None,
                start + timedelta(seconds=2 * k),
            )
        )
    covariance = np.zeros((len(LENS_NAMES), len(LENS_NAMES)))
    covariance[:11, :11] = brown_covariance(0.5)
    solution = Solution(
        photos=tuple(photos),
        lens=lens,
        free=np.array([name not in ("k4", "b1", "b2") for name in LENS_NAMES]),
        covariance=covariance,
        rotations_cam_from_world=rotations,
        centres_m=centres,
        points_m=world[counts >= 2],
        observations=Observations(
            photo=np.array([item[1] for item in seen]),
            point=np.array([new_index[item[0]] for item in seen]),
            pixels=pixels + noise,
            sigma_px=np.full(len(seen), 0.5),
        ),
        residuals_px=noise,
        weights=np.ones(len(seen)),
        sigma0=0.8,
        georeference=Georeference(ORIGIN, "EPSG:32630", 1.4, 1.1, True)
        if gps
        else Georeference(None, None, None, None, False, "The photos carry no positions."),
        photos_used=len(photos) + 1,
        components=(len(photos),),
        iterations=14,
    )
    tilt = np.array([90 + angles.pitch_deg for _, angles in stations])
    return solution, tilt


def _dome(amplitude_m: float | None) -> Dome:
    axis = np.linspace(-70, 70, 41)
    east, north = np.meshgrid(axis, axis)
    if amplitude_m is None:
        return Dome(None, 0.04, 0.04, 60.0, 70.0)
    shape = 0.5 - (east**2 + north**2) / 70**2
    shape[np.hypot(east, north) > 72] = np.nan
    return Dome(amplitude_m, 0.015, 0.015, 60.0, 70.0, axis, axis, amplitude_m * shape)


def findings(verdict: Verdict) -> tuple[Finding, ...]:
    """One finding for every rule, coherent with the verdict."""
    known = State.UNKNOWN if verdict is Verdict.CANNOT_TELL else State.PASS
    bad = {Verdict.REFLY: State.FLAG, Verdict.TRUST: State.PASS, Verdict.CANNOT_TELL: State.UNKNOWN}[verdict]
    drift = 0.031 if verdict is Verdict.TRUST else 0.214
    dome = 0.03 if verdict is Verdict.TRUST else 0.16
    cd = "Carbonneau & Dietrich 2017"
    good = State.PASS
    rows: list[tuple[str, State, float | None, float | None, str, float | None, str, str]] = [
        ("focal-drift", bad, drift, 0.024, "%", 0.1, f"{cd}, Table 3", f"The focal length is {drift} % off."),
        ("equifinal-deviation", known, 0.84, 0.31, "px", 2.0, cd, "The lens agrees with the reference."),
        (
            "equifinal-line",
            known,
            3.1e-17,
            1.2e-17,
            "px⁻⁴",
            6.2e-17,
            f"{cd}, eq. 5",
            "K1, K2 are on the line.",
        ),
        ("opposite-signs", good, -1.0, None, "", 0.0, f"{cd}, section 4", "K1 and K2 have opposite signs."),
        (
            "convergent-share",
            good,
            30.8,
            None,
            "%",
            10.0,
            cd,
            "8 of 26 photos look at the ground at an angle.",
        ),
        ("predicted-dome", bad, dome, 0.025, "%", 0.1, "0.1 % of height", "The model would bend by 9 cm."),
        ("focal-sigma", good, 0.024, None, "%", 0.03, "0.1 % at three sigma", "The sigma is small enough."),
        ("cross-validation", good, 1.1, None, "sigma", 2.5, "odd and even photos", "Two halves agree."),
        ("model-sensitivity", good, 0.01, None, "%", 0.03, "nested models", "Defensible lens models agree."),
        ("coverage", State.UNKNOWN, None, None, "%", 80.0, "grid of 10 x 8", "Corner points are thin."),
        ("alignment", good, 96.3, None, "%", 90.0, "registered share", "26 of 27 photos were joined."),
    ]
    return tuple(Finding(*row) for row in rows)


def build(
    verdict: Verdict = Verdict.REFLY,
    *,
    reference: bool = True,
    gps: bool = True,
    convergent: int = 8,
    points: int = 2000,
    make: str = "DJI",
    model: str = "FC300X",
) -> CheckResult:
    """A coherent result for ``verdict``."""
    f_px = REFERENCE_F_PX * (1.0003 if verdict is Verdict.TRUST else 1.00214)
    truth = p3p_camera()
    brown = replace(truth, f_px=f_px, k1=truth.k1 * 0.992, k2=truth.k2 * 0.985)
    lens = Lens(brown, np.random.default_rng(3).normal(0, 0.03, len(FIELD_NAMES)))
    identity = CameraIdentity(make, model, "0K8TD1234", WIDTH, HEIGHT, Processing.RAW, 3.61)
    solution, tilt = _block(lens, identity, convergent, points, gps)
    held = None
    if reference:
        held = Reference(
            "dji-phantom-3-professional",
            "DJI",
            "Phantom 3 Professional",
            WIDTH,
            HEIGHT,
            Processing.RAW,
            "Carbonneau & Dietrich 2017, flat wall",
            brown=truth,
            line=LINE,
            exif_models=("FC300X",),
        )
    covariance = brown_covariance()
    lens_covariance = solution.covariance.copy()
    lens_covariance[:11, :11] = covariance
    return CheckResult(
        verdict=verdict,
        headline={
            Verdict.TRUST: "The calibration can be trusted: it agrees with the reference.",
            Verdict.REFLY: "Do not use this calibration: the focal length is 0.21 % off the reference.",
            Verdict.CANNOT_TELL: "There is no reference for this camera to hold the calibration against.",
        }[verdict],
        findings=findings(verdict),
        camera=identity,
        solution=solution,
        estimate=Estimate(
            brown=brown,
            covariance=covariance,
            lens=lens,
            lens_covariance=lens_covariance,
            sigma_f_formal_px=0.3,
            spread_f_px=0.2,
            models={"brown": f_px, "brown-k3": f_px + 0.15, "brown+field": f_px - 0.05},
            rejected_models={"no-decentring": f_px + 14.0},
            split_f_px=0.4,
            split_sigma_f_px=0.8,
            split_profile_ratio=1.1,
            correlation_factor=1.6,
        ),
        network=Network(
            tilt, np.full(len(tilt), 60.0), 0.0259, (60.0,), int((tilt < 10).sum()), int((tilt >= 20).sum())
        ),
        dome=_dome(0.092 if reference and verdict is Verdict.REFLY else (0.018 if reference else None)),
        reference=held,
        reference_note="Same camera model; the serial number of the reference is not known."
        if reference
        else "No reference for DJI FC300X is stored.",
        line=LINE if reference else None,
        what_to_fly=None
        if verdict is Verdict.TRUST
        else "Fly one circle of 12 photos around the middle of the site, 36 m from it and 60 m high, "
        "with the camera tilted 30 degrees off nadir and looking at the middle. It takes about 3 minutes.",
        left_out=(
            LeftOut(Path("DCIM/100MEDIA/DJI_0027.JPG"), "taken below 10 m, at take-off or landing"),
            LeftOut(Path("DCIM/100MEDIA/DJI_0028.JPG"), "the horizon is in the picture"),
            LeftOut(Path("DCIM/100MEDIA/DJI_0029.JPG"), "the horizon is in the picture"),
        ),
        timing=Timing(21.4, 36.2, 1.26),
    )


def with_nan_sigmas(result: CheckResult) -> CheckResult:
    """The same check where the covariance could not be had and some numbers are not finite."""
    unknown = np.full((11, 11), np.nan)
    spoiled = tuple(replace(f, sigma=float("nan"), value=float("inf")) for f in result.findings[:2])
    return replace(
        result,
        estimate=replace(result.estimate, covariance=unknown),
        dome=replace(result.dome, sigma_m=float("nan")),
        findings=spoiled + result.findings[2:],
        timing=Timing(float("nan"), 0.0, float("inf")),
    )

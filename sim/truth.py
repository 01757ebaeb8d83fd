"""``truth.json``: everything that a rendered survey was made from, for any program to be held against."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import Proj

from calib.camera import BrownCamera, FloatArray
from calib.field import field_basis
from calib.files import write_text_atomic
from calib.frames import LocalFrame, project, utm_crs
from calib.photos.photo import CameraIdentity, Processing
from calib.reference import Reference
from sim.pattern import Pattern, pixel_grid

TRUTH_FILE = "truth.json"
SCHEMA = "fieldcal.sim/2"

_FRAMES = {
    "world": "x east, y north, z up in metres, tangent to the WGS84 ellipsoid at origin_wgs84",
    "origin_wgs84": "latitude and longitude in degrees, altitude in metres above the ellipsoid; z = 0 there",
    "camera": "x right, y down, z forward; ray = rotation_cam_from_world @ (point_m - centre_m)",
    "pixels": "u right, v down; the centre of the first pixel is (0.5, 0.5)",
    "brown": "undistorted to distorted, K and P in focal units: x = X/Z, y = Y/Z, r2 = x*x + y*y, "
    "radial = 1 + k1 r2 + k2 r2^2 + k3 r2^3 + k4 r2^4, xd = x radial + 2 p1 x y + p2 (r2 + 2 x^2), "
    "yd = y radial + p1 (r2 + 2 y^2) + 2 p2 x y, u = cx_px + f_px xd + b2_px yd, "
    "v = cy_px + (f_px - b1_px) yd",
    "pattern": "added to (u, v) after brown: sum of coefficients_px[i][j] P_i(s) P_j(t) with Legendre "
    "polynomials P, s = 2 u / width - 1, t = 2 v / height - 1, each held within -1.05..1.05; null: none",
    "rolling_shutter": "poses are those of the middle row; rows are read top to bottom over readout_s, "
    "while the camera moves at velocity_m_s",
    "heights": "z_m[i][j] is the height of what is seen from above at north_m[i], east_m[j]",
    "check_points": "ground points with their WGS84 altitude above the ellipsoid and UTM coordinates",
    "utm": "grid north lies meridian_convergence_deg clockwise of true north; grid lengths are scale times "
    "true ones",
}


@dataclass(frozen=True)
class HeightGrid:
    """True heights over the site: axes east_m (c,), north_m (r,), rising; z_m (r, c)."""

    east_m: FloatArray
    north_m: FloatArray
    z_m: FloatArray


@dataclass(frozen=True)
class SurveyTruth:
    """What a rendered survey was made from.

    photos: k paths relative to the survey's folder; rotations_cam_from_world (k, 3, 3),
    centres_m (k, 3), in the frame at ``origin_wgs84`` (ground level, x east, y north, z up).
    ``velocity_m_s`` (k, 3) matters while a rolling shutter reads for ``readout_s``. ``check_points_m``
    (n, 3): ground points well inside the site. ``take_off``: those of ``photos`` that were taken on the
    ground. ``identity``: what the files say of the camera.
    """

    recipe: str
    seed: int
    camera: BrownCamera
    pattern: Pattern | None
    photos: tuple[str, ...]
    rotations_cam_from_world: FloatArray
    centres_m: FloatArray
    origin_wgs84: tuple[float, float, float]
    velocity_m_s: FloatArray | None = None
    readout_s: float = 0.0
    heights: HeightGrid | None = None
    check_points_m: FloatArray | None = None
    take_off: tuple[str, ...] = ()
    identity: CameraIdentity | None = None

    def total_px(self, rays: FloatArray) -> FloatArray:
        """Rays (..., 2) -> pixels (..., 2): the true total mapping."""
        brown_px = self.camera.project(rays)
        return brown_px if self.pattern is None else brown_px + self.pattern(brown_px)


def lens_reference(
    name: str, camera: BrownCamera, identity: CameraIdentity | None, field_px: FloatArray | None = None
) -> Reference:
    """A true lens as the reference that a perfect calibration on site would have given."""
    return Reference(
        name=name,
        make="" if identity is None else identity.make,
        model="" if identity is None else identity.model,
        width=camera.width,
        height=camera.height,
        processing=Processing.UNKNOWN if identity is None else identity.processing,
        source="the simulator's true lens",
        brown=camera,
        field_px=field_px,
        serial=None if identity is None else identity.serial,
        provenance="rendered survey: known exactly",
        exif_models=() if identity is None else (identity.model,),
    )


def true_reference(truth: SurveyTruth, name: str) -> Reference:
    """:func:`lens_reference` of a survey's lens.

    Of a pattern it holds what the residual field of :mod:`calib.field` can follow.
    """
    field_px = None
    if truth.pattern is not None:
        pixels = pixel_grid(truth.camera.width, truth.camera.height)
        basis = field_basis(pixels, truth.camera.width, truth.camera.height)
        shift = truth.pattern(pixels)
        field_px = np.concatenate([np.linalg.lstsq(basis, shift[:, a], rcond=None)[0] for a in (0, 1)])
    return lens_reference(name, truth.camera, truth.identity, field_px)


def write_truth(path: Path, truth: SurveyTruth, extra: dict[str, Any] | None = None) -> None:
    """Write ``truth.json``, whole or not at all; ``extra`` are further keys for people (the options).

    Raises:
        OutputError: it cannot be written.
    """
    frame = LocalFrame(*truth.origin_wgs84)
    crs = utm_crs(*truth.origin_wgs84[:2])
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "recipe": truth.recipe,
        "seed": truth.seed,
        **(extra or {}),
        "frames": _FRAMES,
        "camera": asdict(truth.camera),
        "camera_pixel_units": {
            "f_px": truth.camera.f_px,
            "fy_px": truth.camera.fy_px,
            "k1_px": truth.camera.k1_px,
            "k2_px": truth.camera.k2_px,
            "k3_px": truth.camera.k3_px,
        },
        "pattern": None if truth.pattern is None else truth.pattern.coefficients.tolist(),
        "files": None if truth.identity is None else _identity_json(truth.identity),
        "readout_s": truth.readout_s,
        "origin_wgs84": truth.origin_wgs84,
        "poses": _poses_json(truth, frame),
        "heights": None,
        "check_points": None,
        "utm": _utm_json(truth.origin_wgs84, crs),
    }
    if truth.heights is not None:
        grid = truth.heights
        content["heights"] = {
            "east_m": _rounded(grid.east_m, 3),
            "north_m": _rounded(grid.north_m, 3),
            "z_m": _rounded(grid.z_m, 3),
        }
    if truth.check_points_m is not None:
        content["check_points"] = _points_json(truth.check_points_m, frame, crs)
    write_text_atomic(path, json.dumps(content) + "\n")


def read_truth(folder: Path) -> SurveyTruth:
    """The truth of a survey that :func:`sim.survey.write_survey` wrote into ``folder``.

    Raises:
        FileNotFoundError: there is none, or the survey was not finished.
        KeyError: the file is another program's or of an older version.
    """
    content = json.loads((folder / TRUTH_FILE).read_text(encoding="utf-8"))
    camera = BrownCamera(**content["camera"])
    coefficients = content["pattern"]
    poses = content["poses"]
    heights, points, files = content["heights"], content["check_points"], content["files"]
    latitude, longitude, altitude = content["origin_wgs84"]
    return SurveyTruth(
        recipe=content["recipe"],
        seed=content["seed"],
        camera=camera,
        pattern=None
        if coefficients is None
        else Pattern(camera.width, camera.height, np.array(coefficients)),
        photos=tuple(pose["name"] for pose in poses),
        rotations_cam_from_world=np.array([pose["rotation_cam_from_world"] for pose in poses]),
        centres_m=np.array([pose["centre_m"] for pose in poses]),
        origin_wgs84=(latitude, longitude, altitude),
        velocity_m_s=np.array([pose["velocity_m_s"] for pose in poses]),
        readout_s=content["readout_s"],
        heights=None
        if heights is None
        else HeightGrid(*(np.array(heights[key]) for key in ("east_m", "north_m", "z_m"))),
        check_points_m=None if points is None else np.array(points["enu_m"]),
        take_off=tuple(pose["name"] for pose in poses if pose["take_off"]),
        identity=None
        if files is None
        else CameraIdentity(**{**files, "processing": Processing(files["processing"])}),
    )


def _poses_json(truth: SurveyTruth, frame: LocalFrame) -> list[dict[str, Any]]:
    k = len(truth.photos)
    velocity = np.zeros((k, 3)) if truth.velocity_m_s is None else truth.velocity_m_s
    return [
        {
            "name": name,
            "centre_m": centre,
            "rotation_cam_from_world": rotation,
            "wgs84": wgs84,
            "velocity_m_s": speed,
            "take_off": name in truth.take_off,
        }
        for name, centre, rotation, wgs84, speed in zip(
            truth.photos,
            truth.centres_m.tolist(),
            truth.rotations_cam_from_world.tolist(),
            frame.geodetic(truth.centres_m).tolist(),
            velocity.tolist(),
            strict=True,
        )
    ]


def _points_json(points_m: FloatArray, frame: LocalFrame, crs: str) -> dict[str, Any]:
    wgs84 = frame.geodetic(points_m)
    utm = project(crs, wgs84[:, 0], wgs84[:, 1])
    return {
        "enu_m": _rounded(points_m, 4),
        "wgs84": wgs84.tolist(),
        "utm_m": _rounded(np.column_stack([utm, wgs84[:, 2]]), 4),
    }


def _utm_json(origin_wgs84: tuple[float, float, float], crs: str) -> dict[str, Any]:
    latitude, longitude, _ = origin_wgs84
    easting, northing = project(crs, np.array([latitude]), np.array([longitude]))[0]
    factors = Proj(crs).get_factors(longitude, latitude)
    return {
        "crs": crs,
        "origin_easting_m": float(easting),
        "origin_northing_m": float(northing),
        "meridian_convergence_deg": float(factors.meridian_convergence),
        "scale": float(factors.meridional_scale),
    }


def _identity_json(identity: CameraIdentity) -> dict[str, Any]:
    return {**asdict(identity), "processing": identity.processing.value}


def _rounded(values: FloatArray, digits: int) -> Any:
    return np.round(values, digits).tolist()

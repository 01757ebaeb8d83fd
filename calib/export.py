"""Files for other programs: geotags for ODM, references for Metashape, the COLMAP model, calibrations."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.brownfit import fit_brown
from calib.camera import BROWN_NAMES, BrownCamera
from calib.errors import FormatError
from calib.export_colmap import COLMAP_FILES, write_colmap
from calib.formats import FORMATS, WriteOptions
from calib.frames import rotation_cam_from_world
from calib.photos.photo import GimbalAngles, Photo, Position
from calib.result import CheckResult
from calib.solution import Estimate
from calib.wording import printable

#: Calibration files that every check writes: name of the export -> (format, file name).
CALIBRATIONS = {
    "calibration": ("json", "calibration.json"),
    "odm_cameras": ("odm", "cameras.json"),
    "metashape_calibration": ("metashape", "metashape_calibration.xml"),
    "opencv": ("opencv-yaml", "opencv.yml"),
    "pix4d": ("pix4d", "pix4d.cam"),
    "micmac": ("micmac", "micmac_autocal.xml"),
    "australis": ("australis", "australis.txt"),
}
GEO, METASHAPE_REFERENCE, COLMAP = "geo.txt", "metashape_reference.csv", "colmap"
#: Says which of the files could not be written, and why.
NOT_WRITTEN = "not_written.txt"
#: Every file that :func:`write_exports` may write; a later check clears away those it did not renew.
EXPORT_FILES = (
    *(file_name for _, file_name in CALIBRATIONS.values()),
    GEO,
    METASHAPE_REFERENCE,
    NOT_WRITTEN,
    *(f"{COLMAP}/{name}" for name in COLMAP_FILES),
)

#: What a format may cost where it cannot hold the lens exactly; said in ``not_written.txt``.
EXPORT_TOLERANCE_PX = 1.0

_NED_FROM_WORLD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
#: Body of a drone whose camera looks down, image top forward: camera x = body y, y = -body x.
_CAM_FROM_BODY = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def write_exports(result: CheckResult, folder: Path) -> dict[str, str]:
    """Write every file that this result supports into ``folder`` (made if need be).

    Geotags go out as they were read and believed, never as the adjustment moved them. What cannot
    be written (a lens that a format cannot hold, geotags that were not believed) is named with its
    reason in ``not_written.txt``.

    Returns:
        name of the export -> file or folder, relative to ``folder``.

    Raises:
        OSError: the folder cannot be written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    solution = result.solution
    written: dict[str, str] = {}
    missing: list[str] = []
    brown, options = exported_camera(result.estimate), _options(result)
    for name, (format_name, file_name) in CALIBRATIONS.items():
        try:
            text = FORMATS[format_name].write(brown, options)
        except FormatError as error:
            try:
                text = FORMATS[format_name].write(brown, replace(options, tolerance_px=EXPORT_TOLERANCE_PX))
            except FormatError:
                missing.append(f"{file_name}: {error}")
                continue
            missing.append(f"{file_name} is written all the same, though it is not exact. {error}")
        _write(folder / file_name, text)
        written[name] = file_name
    write_colmap(result, folder / COLMAP)
    written["colmap"] = COLMAP
    if not any(photo.position for photo in solution.photos):
        missing.append(f"{GEO}, {METASHAPE_REFERENCE}: The photos carry no positions.")
    elif not solution.georeference.trusted:
        fault = solution.georeference.fault or "They do not fit the photos."
        missing.append(f"{GEO}, {METASHAPE_REFERENCE}: The geotags were not believed. {fault}")
    else:
        _write(folder / GEO, odm_geo(solution.photos))
        written["odm_geo"] = GEO
        _write(folder / METASHAPE_REFERENCE, metashape_reference(solution.photos))
        written["metashape_reference"] = METASHAPE_REFERENCE
    if missing:
        _write(folder / NOT_WRITTEN, "\n".join(missing) + "\n")
        written["not_written"] = NOT_WRITTEN
    return written


def exported_camera(estimate: Estimate) -> BrownCamera:
    """The camera for other programs: affinity and skew that are not significant are left out.

    Most formats cannot hold them; the other parameters of the fit make up for what they did.
    """
    index = [BROWN_NAMES.index("b1"), BROWN_NAMES.index("b2")]
    size, sigma = estimate.brown.vector[index], np.sqrt(np.diag(estimate.covariance)[index])
    if not size.any() or (np.abs(size) > 3 * sigma).any():
        return estimate.brown
    return fit_brown(estimate.lens, keep_k4=estimate.brown.k4 != 0, affinity=False)[0]


def _options(result: CheckResult) -> WriteOptions:
    """Names for the files that want them, and the sensor's pitch where the photos imply it."""
    camera = result.camera
    focal_px = next((photo.focal_px for photo in result.solution.photos if photo.focal_px), None)
    pitch_mm = camera.focal_mm / focal_px if camera.focal_mm and focal_px else None
    return WriteOptions(
        pixel_size_mm=pitch_mm,
        make=printable(camera.make) or "unknown",
        model=printable(camera.model) or "unknown",
    )


def _write(path: Path, text: str) -> None:
    # File names are bytes on this system: what is not UTF-8 in them is written as it was.
    path.write_text(text, encoding="utf-8", errors="surrogateescape", newline="\n")


def odm_geo(photos: tuple[Photo, ...]) -> str:
    """ODM's ``geo.txt``: image, longitude, latitude, altitude and, where known, the accuracies.

    ODM splits lines at spaces and finds photos by name alone, so photos whose names have spaces
    or occur twice are left to their own EXIF and named in a comment. The angles' columns are zero
    (ODM's sign for "not known") where accuracies follow them.
    """
    lines = ["EPSG:4326"]
    seen: set[str] = set()
    for photo in photos:
        name, position = photo.path.name, photo.position
        if position is None:
            continue
        if any(c.isspace() for c in name) or name in seen or name.startswith("#"):
            lines.append(f"# left out, its name cannot stand here: {' '.join(name.split())}")
            continue
        seen.add(name)
        fields = [name, f"{position.longitude_deg:.9f}", f"{position.latitude_deg:.9f}"]
        if position.altitude_m is not None:
            fields.append(f"{position.altitude_m:.4f}")
            horizontal, vertical = position.sigma_horizontal_m, position.sigma_vertical_m
            if horizontal is not None and vertical is not None:
                fields += ["0", "0", "0", f"{horizontal:.4f}", f"{vertical:.4f}"]
        lines.append(" ".join(fields))
    return "\n".join(lines) + "\n"


def metashape_reference(photos: tuple[Photo, ...]) -> str:
    """Metashape's reference table as CSV, degrees and metres; unknown cells stay empty."""
    out = io.StringIO()
    table = csv.writer(out, lineterminator="\n")
    table.writerow(
        ["#Label", "Longitude", "Latitude", "Altitude", "Yaw", "Pitch", "Roll", "Accuracy_XY", "Accuracy_Z"]
    )
    for photo in photos:
        angles = None if photo.gimbal is None else metashape_angles_deg(photo.gimbal)
        table.writerow(
            [photo.path.name, *_position_cells(photo.position)]
            + (["", "", ""] if angles is None else [f"{a:.4f}" for a in angles])
            + _accuracy_cells(photo.position)
        )
    return out.getvalue()


def _position_cells(position: Position | None) -> list[str]:
    if position is None:
        return ["", "", ""]
    altitude = "" if position.altitude_m is None else f"{position.altitude_m:.4f}"
    return [f"{position.longitude_deg:.9f}", f"{position.latitude_deg:.9f}", altitude]


def _accuracy_cells(position: Position | None) -> list[str]:
    sigmas = (None, None) if position is None else (position.sigma_horizontal_m, position.sigma_vertical_m)
    return ["" if sigma is None else f"{sigma:.4f}" for sigma in sigmas]


def metashape_angles_deg(gimbal: GimbalAngles) -> tuple[float, float, float]:
    """Yaw, pitch, roll as Metashape's reference pane has them: all zero looks straight down, image
    top to the north; the angles turn a north-east-down body whose camera looks along its z axis."""
    cam_from_ned = rotation_cam_from_world(gimbal) @ _NED_FROM_WORLD.T
    ned_from_body = cam_from_ned.T @ _CAM_FROM_BODY
    pitch = np.arcsin(np.clip(-ned_from_body[2, 0], -1, 1))
    if abs(ned_from_body[2, 0]) > 1 - 1e-9:
        # Looking at the horizon, yaw and roll turn about the same axis: all of it is yaw.
        yaw = np.arctan2(-ned_from_body[0, 1], ned_from_body[1, 1])
        return float(np.degrees(yaw) % 360), float(np.degrees(pitch)), 0.0
    yaw = np.arctan2(ned_from_body[1, 0], ned_from_body[0, 0])
    roll = np.arctan2(ned_from_body[2, 1], ned_from_body[2, 2])
    return float(np.degrees(yaw) % 360), float(np.degrees(pitch)), float(np.degrees(roll))

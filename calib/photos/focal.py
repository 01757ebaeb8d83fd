"""Nominal focal length in px of one image, from the best that its file offers.

In this order:

1. the maker's own calibration in px (DJI DewarpData for uncorrected images, CalibratedFocalLength,
   Skydio's), as long as it agrees with 2-4 within 15 %: some firmwares write that of another mode;
2. EXIF focal length over the pixel pitch of a known sensor;
3. EXIF focal length over EXIF's focal plane resolution: exact where right, but kept unchanged by
   programs that resize (undone here when EXIF still has the original size), and sometimes nonsense;
4. the 35 mm equivalent: whole millimetres, so 20 mm is good to 2.5 %. It compares diagonals
   (CIPA DCG-001: 43.27 mm), and makers keep the full sensor's number on a 16:9 crop, so the
   diagonal is that of the full 4:3 (or 3:2) frame of this width, not the crop's.
"""

from __future__ import annotations

import math

from calib.photos.exif import ExifTags, positive, whole
from calib.photos.sensors import Sensor, find_sensor

FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
_UNIT_MM = {1: 25.4, 2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
#: Fields of view of 3 to 150 degrees along the long side.
_SANE = (0.13, 20.0)


def nominal_focal_px(
    make: str, model: str, width: int, height: int, tags: ExifTags, maker_px: float | None
) -> float | None:
    """Focal length in px of an image as stored, or None; ``maker_px`` is the maker's own, if any."""
    long = max(width, height)
    focal_mm = positive(tags.photo.get(0x920A))
    zoom = digital_zoom(tags)
    sensor = find_sensor(make, model)
    candidates = [
        None if sensor is None or focal_mm is None else zoom * _by_pitch(sensor, focal_mm, width, height),
        None if focal_mm is None else _by_focal_plane(tags, focal_mm * zoom, width, height),
        _by_equivalent(tags, width, height, sensor),
    ]
    plausible = [f for f in candidates if f is not None and _SANE[0] < f / long < _SANE[1]]
    if maker_px is None or not _SANE[0] < maker_px / long < _SANE[1]:
        return plausible[0] if plausible else None
    agrees = not plausible or any(abs(maker_px / f - 1) < 0.15 for f in plausible)
    return maker_px if agrees else plausible[0]


def digital_zoom(tags: ExifTags) -> float:
    """Digital zoom factor; 1 where none is given or it is no zoom (0, NaN)."""
    zoom = positive(tags.photo.get(0xA404))
    return zoom if zoom is not None and 1 < zoom <= 64 else 1.0


def _by_pitch(sensor: Sensor, focal_mm: float, width: int, height: int) -> float:
    return focal_mm / (sensor.pitch_um * 1e-3) * sensor.scale(width, height)


def _by_focal_plane(tags: ExifTags, focal_mm: float, width: int, height: int) -> float | None:
    """EXIF 2.32 section 4.6.5, FocalPlaneXResolution: px per unit at the recorded image size."""
    resolution = positive(tags.photo.get(0xA20E))
    unit = _UNIT_MM.get(whole(tags.photo.get(0xA210)) or 2)
    if resolution is None or unit is None:
        return None
    recorded = (positive(tags.photo.get(0xA002)), positive(tags.photo.get(0xA003)))
    recorded_long = max(r or 0.0 for r in recorded) or float(max(width, height))
    sensor_mm = recorded_long / resolution * unit
    if not 1.0 < sensor_mm < 120.0:
        return None
    return focal_mm * resolution / unit * max(width, height) / recorded_long


def _by_equivalent(tags: ExifTags, width: int, height: int, sensor: Sensor | None) -> float | None:
    equivalent = positive(tags.photo.get(0xA405))
    if equivalent is None:
        return None
    long, short = float(max(width, height)), float(min(width, height))
    if sensor is not None:
        frame = sensor.scale(width, height) * math.hypot(sensor.width, sensor.height)
    elif long / short > 1.6:
        frame = math.hypot(long, 0.75 * long)
    else:
        frame = math.hypot(long, short)
    return equivalent / FILM_DIAGONAL_MM * frame

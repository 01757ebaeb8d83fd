"""One photo file -> :class:`Photo`; many -> those that can be read, and what was left out."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

from calib.errors import PhotoError
from calib.photos import makers
from calib.photos.container import Container, open_container
from calib.photos.exif import ExifTags, clock, degrees, gps_clock, parse_time, positive, real, text, whole
from calib.photos.focal import digital_zoom, nominal_focal_px
from calib.photos.photo import CameraIdentity, LeftOut, Photo, Position, Radiometric
from calib.photos.radiometric import parse_fff, with_levels
from calib.photos.xmp import parse_packet


def read_photo(path: Path) -> Photo:
    """Read one photo's metadata; its pixels are not decoded and the file is only read.

    Broken EXIF or XMP leave the photo usable, with less known about it.

    Raises:
        PhotoError: the file is no JPEG, TIFF or PNG, raw or HEIC, truncated, empty or unreadable.
    """
    container = open_container(path)
    tags, xmp = container.exif, parse_packet(container.xmp)
    width, height = container.width, container.height
    make = text(tags.main.get(0x010F)) or xmp.get("tiff:make", "")
    model = text(tags.main.get(0x0110)) or xmp.get("tiff:model", "")
    done = makers.processing(xmp, make, model, container.format, text(tags.main.get(0x0131)))
    factory = makers.factory_calibration(xmp, width, height)
    maker_px = makers.maker_focal_px(factory, done, width)
    focal_mm = positive(tags.photo.get(0x920A))
    radiometric, wide_deg = _radiometric(container, make)
    focal_px = nominal_focal_px(make, model, width, height, tags, maker_px)
    if focal_px is None and wide_deg is not None:
        focal_px = width / 2 / math.tan(math.radians(wide_deg) / 2)
    moment, resolution_s = _time(tags, xmp)
    orientation = whole(tags.main.get(0x0112)) or 1
    return Photo(
        path=path,
        camera=CameraIdentity(
            make=make,
            model=model,
            serial=_serial(tags, xmp),
            width=width,
            height=height,
            processing=done,
            focal_mm=None if focal_mm is None else focal_mm * digital_zoom(tags),
            band=makers.band(xmp),
        ),
        position=_position(tags, xmp, make),
        gimbal=makers.gimbal_angles(xmp, make, model),
        time=moment,
        time_resolution_s=resolution_s,
        focal_px=focal_px,
        factory=factory,
        orientation=orientation if 1 <= orientation <= 8 else 1,
        aircraft=makers.aircraft_angles(xmp),
        fingerprint=container.fingerprint,
        radiometric=radiometric,
    )


def read_photos(
    paths: Iterable[Path], progress: Callable[[int], None] | None = None
) -> tuple[list[Photo], list[LeftOut]]:
    """Read many photos; those that cannot be read are left out with the reason, never an error.

    Thermal photos get one stretch of their counts for the set. ``progress`` is called with the number of
    files done.
    """
    photos: list[Photo] = []
    left_out: list[LeftOut] = []
    for done, path in enumerate(paths, start=1):
        try:
            photos.append(read_photo(path))
        except PhotoError as error:
            # The path stands beside the reason already: "/card/DJI_0003.JPG is truncated (...)."
            reason = str(error).removeprefix(f"{path} ").removeprefix("is ").rstrip(".")
            left_out.append(LeftOut(path, reason))
        if progress is not None:
            progress(done)
    return with_levels(photos), left_out


def _radiometric(container: Container, make: str) -> tuple[Radiometric | None, float | None]:
    """Raw counts in the file, and the field of view across it in degrees, where FLIR's records state it."""
    size = (container.width, container.height)
    if container.flir:
        raw = parse_fff(container.flir)
        if raw is None:
            return None, None
        kind = Radiometric("FLIR radiometric JPEG")
        if (raw.width, raw.height) != size:
            why = f"their raw image has another size ({raw.width} x {raw.height} px)"
            return replace(kind, unread=why), raw.field_of_view_deg
        return kind, raw.field_of_view_deg
    if container.app3 and make.upper() == "DJI":
        kind = Radiometric("DJI R-JPEG")
        if len(container.app3) != 2 * size[0] * size[1]:
            return replace(kind, unread="their raw data are of another size"), None
        return kind, None
    if container.bits >= 16:
        return Radiometric(f"{container.bits}-bit {container.format}", hidden=False), None
    return None, None


def _serial(tags: ExifTags, xmp: makers.Xmp) -> str | None:
    # BodySerialNumber, then DNG's CameraSerialNumber, which some JPEGs keep.
    for value in (text(tags.photo.get(0xA431)), text(tags.main.get(0xC62F))):
        if value.strip("0 -"):
            return value
    return makers.serial(xmp)


def _position(tags: ExifTags, xmp: makers.Xmp, make: str) -> Position | None:
    latitude = degrees(tags.gps.get(2), tags.gps.get(1), "S")
    longitude = degrees(tags.gps.get(4), tags.gps.get(3), "W")
    altitude, reference = real(tags.gps.get(6)), whole(tags.gps.get(5))
    if altitude is not None and reference in (1, 3):
        altitude = -abs(altitude)
    # A receiver that says it had no fix repeats its last one.
    void = text(tags.gps.get(9)).upper() == "V"
    exif = None if void or latitude is None or longitude is None else (latitude, longitude)
    return makers.position(xmp, make, exif, altitude, reference, positive(tags.gps.get(31)))


def _time(tags: ExifTags, xmp: makers.Xmp) -> tuple[datetime | None, float]:
    """Camera clock, sharpened by the receiver's time where that is finer.

    Receiver time is only taken where it tells fractions of a second and agrees with the camera's
    whole seconds in some time zone (zones are multiples of 15 minutes); else a stale fix would
    shift single photos. Where the camera has no clock it stands alone.
    """
    own = clock(tags)
    exposure = parse_time(xmp.get("drone-dji:utcatexposure", ""))
    receiver = exposure or gps_clock(tags)
    if own is None:
        if receiver is None:
            return None, 1.0
        return receiver, 1e-3 if receiver.microsecond else 1.0
    moment, resolution_s = own
    if receiver is None or resolution_s < 1 or receiver.microsecond == 0:
        return own
    quarters = round((moment - receiver) / timedelta(minutes=15))
    sharpened = receiver + quarters * timedelta(minutes=15)
    return (sharpened, 1e-3) if abs(sharpened - moment) < timedelta(seconds=1.5) else own

"""JPEG files with tags as drone cameras write them: DJI's EXIF and XMP, or plain EXIF.

Cameras that an autopilot triggers over MAVLink know a position at best: no XMP, no gimbal angles.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from calib.camera import FloatArray
from calib.photos.photo import GimbalAngles
from sim.texture import ByteImage


@dataclass(frozen=True)
class PhotoTags:
    """What the vehicle believes about one photo. Altitudes in m, angles in degrees, WGS84.

    ``serial`` None writes no serial number, as the first Phantoms did. ``flight``: attitude of the
    aircraft, in the same angles as the gimbal's. ``lens_corrected`` goes into DewarpFlag, as newer
    cameras write it: without it (None) readers have to guess. ``dji_xmp``: whether XMP is written at
    all. ``rtk_sigma_m``: what an RTK receiver states of itself, east, north, up. ``subseconds``: whether
    EXIF has them; ``gps``: whether it has a position.
    """

    time: datetime
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    height_above_launch_m: float
    gimbal: GimbalAngles
    flight: GimbalAngles
    make: str = "DJI"
    model: str = "FC300X"
    serial: str | None = "FIELDCALSIM0001"
    lens_corrected: bool | None = False
    dji_xmp: bool = True
    rtk_sigma_m: tuple[float, float, float] | None = None
    focal_mm: float = 3.61
    focal_35mm: int = 20
    subseconds: bool = True
    gps: bool = True


def level_gimbal(rotation_cam_from_world: FloatArray) -> GimbalAngles:
    """The gimbal angles without roll that come nearest to a rotation (3, 3).

    A gimbal keeps its roll axis level and writes roll 0 whatever remains of it.
    """
    right, _, forward = rotation_cam_from_world
    yaw = np.arctan2(-right[1], right[0])
    ahead = forward[0] * np.sin(yaw) + forward[1] * np.cos(yaw)
    return GimbalAngles(float(np.degrees(yaw)), float(np.degrees(np.arctan2(forward[2], ahead))), 0.0)


def write_photo(path: Path, image: ByteImage, tags: PhotoTags, *, quality: int = 93) -> None:
    """Write an RGB image (height, width, 3) with its tags.

    Raises:
        OSError: the file cannot be written.
    """
    exif = _exif(image, tags).tobytes()
    xmp = {"xmp": _xmp(tags)} if tags.dji_xmp else {}
    Image.fromarray(image).save(path, format="JPEG", quality=quality, subsampling=0, exif=exif, **xmp)


def _exif(image: ByteImage, tags: PhotoTags) -> Image.Exif:
    base, gps = ExifTags.Base, ExifTags.GPS
    stamp = tags.time.strftime("%Y:%m:%d %H:%M:%S")
    exif = Image.Exif()
    exif[base.Make], exif[base.Model] = tags.make, tags.model
    if tags.dji_xmp:
        exif[base.Software] = "v01.09.0060"
    exif[base.Orientation] = 1
    exif[base.DateTime] = stamp
    details = exif.get_ifd(ExifTags.IFD.Exif)
    details[base.DateTimeOriginal] = details[base.DateTimeDigitized] = stamp
    if tags.subseconds:
        details[base.SubsecTimeOriginal] = details[base.SubsecTime] = f"{tags.time.microsecond // 1000:03d}"
    details[base.ExposureTime] = IFDRational(1, 640)
    details[base.FNumber] = IFDRational(28, 10)
    details[base.ISOSpeedRatings] = 100
    details[base.FocalLength] = IFDRational(round(tags.focal_mm * 100), 100)
    details[base.FocalLengthIn35mmFilm] = tags.focal_35mm
    details[base.ExifImageWidth], details[base.ExifImageHeight] = image.shape[1], image.shape[0]
    if tags.serial is not None:
        details[base.BodySerialNumber] = tags.serial
    if not tags.gps:
        return exif
    place = exif.get_ifd(ExifTags.IFD.GPSInfo)
    place[gps.GPSVersionID] = b"\x02\x03\x00\x00"
    place[gps.GPSLatitudeRef] = "N" if tags.latitude_deg >= 0 else "S"
    place[gps.GPSLatitude] = _degrees_minutes_seconds(tags.latitude_deg)
    place[gps.GPSLongitudeRef] = "E" if tags.longitude_deg >= 0 else "W"
    place[gps.GPSLongitude] = _degrees_minutes_seconds(tags.longitude_deg)
    place[gps.GPSAltitudeRef] = b"\x00" if tags.altitude_m >= 0 else b"\x01"
    place[gps.GPSAltitude] = IFDRational(round(abs(tags.altitude_m) * 1000), 1000)
    if tags.rtk_sigma_m is not None and not tags.dji_xmp:
        error_mm = round(1000 * max(tags.rtk_sigma_m[:2]))
        place[gps.GPSHPositioningError] = IFDRational(error_mm, 1000)
    return exif


def _degrees_minutes_seconds(angle_deg: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    """Seconds to 1e-4, which is 3 mm on the ground."""
    ticks = round(abs(angle_deg) * 3600 * 10_000)
    minutes, ticks = divmod(ticks, 600_000)
    return IFDRational(minutes // 60, 1), IFDRational(minutes % 60, 1), IFDRational(ticks, 10_000)


def _xmp(tags: PhotoTags) -> bytes:
    values = {
        "AbsoluteAltitude": tags.altitude_m,
        "RelativeAltitude": tags.height_above_launch_m,
        "GimbalRollDegree": tags.gimbal.roll_deg,
        "GimbalYawDegree": _wrapped(tags.gimbal.yaw_deg),
        "GimbalPitchDegree": tags.gimbal.pitch_deg,
        "FlightRollDegree": tags.flight.roll_deg,
        "FlightYawDegree": _wrapped(tags.flight.yaw_deg),
        "FlightPitchDegree": tags.flight.pitch_deg,
    }
    # DJI writes millimetres where it knows them.
    digits = 2 if tags.rtk_sigma_m is None else 3
    lines = [f'   drone-dji:{name}="{value:+.{digits}f}"' for name, value in values.items()]
    lines += [f'   drone-dji:{name}="{value}"' for name, value in _rtk(tags).items()]
    if tags.lens_corrected is not None:
        lines.append(f'   drone-dji:DewarpFlag="{int(tags.lens_corrected)}"')
    if tags.serial is not None:
        lines.append(f'   drone-dji:CameraSerialNumber="{tags.serial}"')
    body = "\n".join(lines)
    return f"""<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about="DJI Meta Data"
   xmlns:tiff="http://ns.adobe.com/tiff/1.0/"
   xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"
   tiff:Make="{tags.make}"
   tiff:Model="{tags.model}"
{body}>
  </rdf:Description>
 </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>""".encode()


def _rtk(tags: PhotoTags) -> dict[str, str]:
    """A fixed RTK solution as DJI's drones state it, with the position to a tenth of a millimetre."""
    if tags.rtk_sigma_m is None:
        return {}
    east, north, up = tags.rtk_sigma_m
    return {
        "GpsStatus": "RTK",
        "AltitudeType": "RtkAlt",
        "GpsLatitude": f"{tags.latitude_deg:+.9f}",
        "GpsLongitude": f"{tags.longitude_deg:+.9f}",
        "RtkFlag": "50",
        "RtkStdLon": f"{east:.5f}",
        "RtkStdLat": f"{north:.5f}",
        "RtkStdHgt": f"{up:.5f}",
    }


def _wrapped(yaw_deg: float) -> float:
    return (yaw_deg + 180.0) % 360.0 - 180.0

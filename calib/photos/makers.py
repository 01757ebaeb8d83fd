"""What drone makers write into XMP, by namespace prefix.

* ``drone-dji``: DJI's user manuals (Matrice 4, Mavic 3 Enterprise: photo file fields); angles
  are north-east-down in the order ZYX; RtkFlag 16 single, 32-49 float, 50 fixed; DewarpFlag 1
  "dewarped"; DewarpData date; fx, fy, cx, cy, k1, k2, p1, p2, k3 in px about the image centre.
* ``camera`` (Pix4D's public namespace, also senseFly's): pitch 0 is nadir, see
  :func:`calib.frames.gimbal_from_downward_body`. Autel's later models write DJI's pitch there.
* ``drone-parrot``, ``drone-skydio``, ``drone`` (Autel): DJI's convention under other names.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from calib import frames
from calib.photos.photo import AltitudeDatum, GimbalAngles, Position, Processing
from calib.photos.xmp import number, numbers

Xmp = Mapping[str, str]

_GIMBAL = (
    ("drone-dji:gimbalyawdegree", "drone-dji:gimbalpitchdegree", "drone-dji:gimbalrolldegree"),
    ("drone:gimbalyawdegree", "drone:gimbalpitchdegree", "drone:gimbalrolldegree"),
    ("drone-parrot:camerayawdegree", "drone-parrot:camerapitchdegree", "drone-parrot:camerarolldegree"),
    (
        "drone-skydio:cameraorientationned/yaw",
        "drone-skydio:cameraorientationned/pitch",
        "drone-skydio:cameraorientationned/roll",
    ),
)
_AIRCRAFT = (
    ("drone-dji:flightyawdegree", "drone-dji:flightpitchdegree", "drone-dji:flightrolldegree"),
    ("drone:flightyawdegree", "drone:flightpitchdegree", "drone:flightrolldegree"),
    ("drone-parrot:droneyawdegree", "drone-parrot:dronepitchdegree", "drone-parrot:dronerolldegree"),
    (
        "drone-skydio:vehicleorientationned/yaw",
        "drone-skydio:vehicleorientationned/pitch",
        "drone-skydio:vehicleorientationned/roll",
    ),
)
_DEWARP = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")
#: DJI cameras with exchangeable lenses or of which it is not known whether their JPEGs are corrected.
_DJI_UNKNOWN = (
    "fc550",
    "fc6310r",
    "fc6360",
    "fc65",
    "zenmuse",
    "zh",
    "h20",
    "h30",
    "m3",
    "m4",
    "m30",
    "mavic2-",
)
_DJI_LENS_MAKERS = ("dji", "hasselblad")
_EDITORS = ("lightroom", "photoshop", "camera raw", "capture one", "darktable", "rawtherapee", "dxo")


def gimbal_angles(xmp: Xmp, make: str, model: str) -> GimbalAngles | None:
    """Camera attitude in DJI's convention; None where none was written.

    Three zeros are not an attitude but its absence (Mini 2, Zenmuse P1 with some firmwares).
    """
    for keys in _GIMBAL:
        angles = _angles(xmp, *keys)
        if angles is not None:
            return None if angles == GimbalAngles(0.0, 0.0, 0.0) else angles
    angles = _angles(xmp, "camera:yaw", "camera:pitch", "camera:roll")
    if angles is None:
        return None
    autel = "autel" in (make + xmp.get("tiff:make", "")).lower() or model.lower() == "xl715"
    if autel and angles.pitch_deg < -5:
        # Backwards past nadir would be the meaning by the book; these models write DJI's pitch.
        return angles
    # senseFly counts roll the other way (so OpenDroneMap's reader of their files has it).
    roll = -angles.roll_deg if make.lower().startswith("sensefly") else angles.roll_deg
    return frames.gimbal_from_downward_body(angles.yaw_deg, angles.pitch_deg, roll)


def aircraft_angles(xmp: Xmp) -> GimbalAngles | None:
    """Attitude of the aircraft, None where none was written."""
    for keys in _AIRCRAFT:
        angles = _angles(xmp, *keys)
        if angles is not None:
            return angles
    return None


def _angles(xmp: Xmp, yaw_key: str, pitch_key: str, roll_key: str) -> GimbalAngles | None:
    yaw, pitch = number(xmp, yaw_key), number(xmp, pitch_key)
    roll = number(xmp, roll_key) or 0.0
    if yaw is None or pitch is None or max(abs(yaw), abs(pitch), abs(roll)) > 360:
        return None
    return GimbalAngles(_wrapped(yaw), _wrapped(pitch), _wrapped(roll))


def _wrapped(angle_deg: float) -> float:
    return angle_deg if abs(angle_deg) <= 180 else (angle_deg + 180) % 360 - 180


def coordinates(xmp: Xmp) -> tuple[float, float] | None:
    """Latitude and longitude in degrees from XMP, where the maker writes them there, with sign."""
    for prefix in ("drone-dji", "drone-skydio", "drone"):
        latitude = number(xmp, f"{prefix}:gpslatitude", f"{prefix}:latitude")
        # "Longtitude" is how the Phantom 4 generation spells it.
        longitude = number(xmp, f"{prefix}:gpslongitude", f"{prefix}:gpslongtitude", f"{prefix}:longitude")
        if latitude is not None and longitude is not None:
            return latitude, longitude
    return None


def altitude_m(xmp: Xmp) -> float | None:
    """Absolute altitude from XMP."""
    return number(
        xmp, "drone-dji:absolutealtitude", "drone-skydio:absolutealtitude", "drone:absolutealtitude"
    )


def height_above_launch_m(xmp: Xmp) -> float | None:
    """Height above the take-off point from XMP."""
    return number(
        xmp,
        "drone-dji:relativealtitude",
        "drone-skydio:relativealtitude",
        "drone:relativealtitude",
        "camera:abovegroundaltitude",
    )


def altitude_datum(xmp: Xmp, make: str, gps_altitude_ref: int | None) -> AltitudeDatum:
    """What the absolute altitude counts from, where the file or the maker's manual says it."""
    vertical = (xmp.get("camera:vertcs", "") + xmp.get("camera:verticaldatum", "")).lower()
    if "ellipsoid" in vertical or gps_altitude_ref in (2, 3):  # EXIF 3.0
        return AltitudeDatum.ELLIPSOID
    if any(name in vertical for name in ("5773", "3855", "egm", "msl", "5703")):
        return AltitudeDatum.SEA_LEVEL
    rtk = number(xmp, "drone-dji:rtkflag") or 0
    if xmp.get("drone-dji:altitudetype", "").lower() == "rtkalt" or rtk >= 16:
        return AltitudeDatum.ELLIPSOID
    return AltitudeDatum.ELLIPSOID if make.lower() == "skydio" else AltitudeDatum.UNKNOWN


def sigmas_m(xmp: Xmp) -> tuple[float | None, float | None]:
    """Horizontal (per axis) and vertical standard deviation as the receiver states them."""
    flag = number(xmp, "drone-dji:rtkflag")
    east, north = number(xmp, "drone-dji:rtkstdlon"), number(xmp, "drone-dji:rtkstdlat")
    up = number(xmp, "drone-dji:rtkstdhgt")
    if east is not None and north is not None and (flag is None or flag >= 16):
        # Metre-level single positions state optimistic deviations.
        floor = 1.0 if flag is not None and flag < 32 else 0.005
        return max(east, north, floor), None if up is None else max(up, floor)
    horizontal, vertical = number(xmp, "camera:gpsxyaccuracy"), number(xmp, "camera:gpszaccuracy")
    return (
        horizontal if horizontal is not None and horizontal > 0 else None,
        vertical if vertical is not None and vertical > 0 else None,
    )


def serial(xmp: Xmp) -> str | None:
    """Serial number of the camera, else of the drone it is built into."""
    for key in (
        "drone-dji:cameraserialnumber",
        "aux:serialnumber",
        "exifex:bodyserialnumber",
        "drone-skydio:cameraserial",
        "camera:serialnumber",
        "drone-parrot:serialnumber",
        "drone-dji:droneserialnumber",
    ):
        value = xmp.get(key, "").strip()
        if value.strip("0 -"):
            return value
    return None


def band(xmp: Xmp) -> str:
    """Which camera of a body with several: multispectral band or DJI's image source, "" if unsaid."""
    for key in ("camera:bandname", "drone-dji:bandname", "drone-dji:imagesource"):
        if xmp.get(key):
            return xmp[key]
    return ""


def factory_calibration(xmp: Xmp, width: int, height: int) -> dict[str, float]:
    """Factory calibration as written, in px of this image (cx, cy from its upper left corner).

    ``fx_px, fy_px, cx_px, cy_px, k1, k2, p1, p2, k3`` from DewarpData (OpenCV's order and
    direction), ``calibrated_f_px, calibrated_cx_px, calibrated_cy_px`` from CalibratedFocalLength,
    ``dewarp_flag``; ``pix4d_*`` in mm from Pix4D's namespace.
    """
    factory: dict[str, float] = {}
    dewarp = numbers(xmp.get("drone-dji:dewarpdata", "").rpartition(";")[2])
    if len(dewarp) == len(_DEWARP) and dewarp[0] > 0:
        factory |= dict(zip(_DEWARP, dewarp, strict=True))
        factory["cx_px"] += width / 2
        factory["cy_px"] += height / 2
    flag = number(xmp, "drone-dji:dewarpflag")
    if flag is not None:
        factory["dewarp_flag"] = flag
    for prefix in ("drone-dji", "drone-skydio", "drone"):
        focal = number(xmp, f"{prefix}:calibratedfocallength", f"{prefix}:calibratedfocallengthx")
        x = number(xmp, f"{prefix}:calibratedopticalcenterx")
        y = number(xmp, f"{prefix}:calibratedopticalcentery")
        if focal is None or focal <= 0:
            continue
        factory["calibrated_f_px"] = focal
        if x is not None and y is not None:
            factory |= {"calibrated_cx_px": x, "calibrated_cy_px": y}
        break
    focal_mm = number(xmp, "camera:perspectivefocallength")
    if focal_mm is not None and focal_mm > 0 and xmp.get("camera:modeltype", "perspective") == "perspective":
        factory["pix4d_f_mm"] = focal_mm
        centre = numbers(xmp.get("camera:principalpoint"))
        if len(centre) == 2:
            factory |= {"pix4d_cx_mm": centre[0], "pix4d_cy_mm": centre[1]}
        lens = numbers(xmp.get("camera:perspectivedistortion"))
        if len(lens) == 5:
            factory |= {f"pix4d_{n}": v for n, v in zip(("k1", "k2", "k3", "p1", "p2"), lens, strict=True)}
    return {name: value for name, value in factory.items() if math.isfinite(value)}


def maker_focal_px(factory: Mapping[str, float], processing: Processing, width: int) -> float | None:
    """Focal length in px by the maker, brought to this image's width; None where there is none.

    DewarpData describes the uncorrected lens; corrected images have the designed focal length.
    """
    if processing is not Processing.LENS_CORRECTED and "fx_px" in factory:
        return factory["fx_px"]
    if "calibrated_f_px" in factory:
        centre = factory.get("calibrated_cx_px", 0.0)
        # The optical centre tells the image width that the number belongs to.
        ratio = width / (2 * centre) if centre > 0 else 1.0
        return factory["calibrated_f_px"] * (1.0 if abs(ratio - 1) < 0.1 else ratio)
    # Principal point and focal length in mm together give the pixel size.
    if "pix4d_f_mm" in factory and factory.get("pix4d_cx_mm", 0.0) > 0.1:
        return factory["pix4d_f_mm"] * width / (2 * factory["pix4d_cx_mm"])
    return None


def processing(xmp: Xmp, make: str, model: str, file_format: str, software: str) -> Processing:
    """Whether the camera (or an editor) took the lens distortion out of the pixels.

    DJI's DewarpFlag says it; DJI's built-in cameras without the flag correct their JPEGs
    unconditionally. Everything else is not known from the file.
    """
    if xmp.get("crs:lensprofileenable") == "1":
        return Processing.LENS_CORRECTED
    if any(editor in software.lower() for editor in _EDITORS) or "crs:rawfilename" in xmp:
        return Processing.UNKNOWN
    flag = number(xmp, "drone-dji:dewarpflag")
    if flag is not None:
        return Processing.LENS_CORRECTED if flag == 1 else Processing.RAW
    if make.lower() not in _DJI_LENS_MAKERS:
        return Processing.UNKNOWN
    if file_format == "TIFF":
        return Processing.RAW
    if file_format != "JPEG" or model.lower().startswith(_DJI_UNKNOWN):
        return Processing.UNKNOWN
    return Processing.LENS_CORRECTED


def position(
    xmp: Xmp,
    make: str,
    exif_coordinates: tuple[float, float] | None,
    exif_altitude_m: float | None,
    gps_altitude_ref: int | None,
    positioning_error_m: float | None,
) -> Position | None:
    """One position from XMP and EXIF; None where neither gives a believable one.

    XMP has more digits and carries RTK solutions, so it counts where both agree to 1 km.
    """
    point = next((p for p in (coordinates(xmp), exif_coordinates) if p is not None and _believable(p)), None)
    if point is None:
        return None
    if exif_coordinates is not None and _believable(exif_coordinates) and _far(point, exif_coordinates):
        point = exif_coordinates
    altitude = altitude_m(xmp)
    altitude = exif_altitude_m if altitude is None else altitude
    height = height_above_launch_m(xmp)
    horizontal, vertical = sigmas_m(xmp)
    if horizontal is None and positioning_error_m is not None:
        horizontal = positioning_error_m
    return Position(
        *point,
        altitude if altitude is not None and -500 < altitude < 20000 else None,
        height if height is not None and -2000 < height < 20000 else None,
        horizontal,
        vertical,
        altitude_datum(xmp, make, gps_altitude_ref),
    )


def _believable(point: tuple[float, float]) -> bool:
    latitude, longitude = point
    at_origin = abs(latitude) < 1e-4 and abs(longitude) < 1e-4
    return abs(latitude) <= 90 and abs(longitude) <= 180 and not at_origin


def _far(a: tuple[float, float], b: tuple[float, float]) -> bool:
    return math.hypot(a[0] - b[0], (a[1] - b[1]) * math.cos(math.radians(b[0]))) > 0.01

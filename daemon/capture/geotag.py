"""Positions and gimbal angles into XMP sidecars or into copies of JPEGs; never into the originals.

Tags: EXIF GPS; XMP ``exif:GPS*`` (XMP part 2, section 4), ``drone-dji:*`` for the angles, which is
what photogrammetry programs read whoever made the camera, and Pix4D's ``Camera:GPS?Accuracy``.
"""

from __future__ import annotations

import os
import re
import tempfile
from dataclasses import dataclass
from pathlib import Path

from calib.errors import InputError, OutputError
from calib.photos.photo import AltitudeDatum, GimbalAngles, Position
from daemon.capture.exif_gps import with_gps
from daemon.capture.jpeg_segments import EXIF_HEADER, XMP_HEADER, join, split

_TOOL = "fieldcal"
_SPACES = {
    "exif": "http://ns.adobe.com/exif/1.0/",
    "drone-dji": "http://www.dji.com/drone-dji/1.0/",
    "Camera": "http://pix4d.com/camera/1.0/",
}
_RDF_START = re.compile(rb"<rdf:RDF\b[^>]*[^/]>")


@dataclass(frozen=True)
class Geotag:
    """What is written about one photo: the camera's position and attitude, and the aircraft's."""

    position: Position
    gimbal: GimbalAngles | None = None
    aircraft: GimbalAngles | None = None


def write_sidecar(photo: Path, tag: Geotag, folder: Path | None = None) -> Path:
    """Write ``<name>.xmp`` beside the photo, or into ``folder``; its path.

    Raises:
        InputError: position or angles are not finite or impossible.
        OutputError: it cannot be written, or there is a sidecar that somebody else wrote.
    """
    target = (folder or photo.parent) / f"{photo.stem}.xmp"
    packet = _packet(_properties(tag))
    try:
        if target.exists() and f'x:xmptk="{_TOOL}"'.encode() not in target.read_bytes():
            raise OutputError(f"{target} is from another program; move it away or choose another folder.")
    except OSError as error:
        raise OutputError(f"{target} cannot be written: {error.strerror}.") from error
    _write_whole(target, packet)
    return target


def write_copy(photo: Path, target: Path, tag: Geotag) -> Path:
    """Copy a JPEG to ``target`` with the tags added; its image data and other metadata stay as they are.

    Raises:
        InputError: the photo is no whole JPEG or cannot be read, or position or angles are impossible.
        OutputError: the copy cannot be written, would replace the original, or has no room for the tags.
    """
    properties = _properties(tag)
    try:
        content = photo.read_bytes()
    except OSError as error:
        raise InputError(f"{photo} cannot be read: {error.strerror}.") from error
    try:
        same = target.exists() and target.samefile(photo)
    except OSError as error:
        raise OutputError(f"{target} cannot be written: {error.strerror}.") from error
    if same or target.resolve() == photo.resolve():
        raise OutputError(f"{target} is the original photo, which is never changed; choose another folder.")
    try:
        segments, rest = split(content)
        exif = next((s[len(EXIF_HEADER) :] for m, s in segments if m == 0xE1 and _is_exif(s)), b"")
        xmp = next((s[len(XMP_HEADER) :] for m, s in segments if m == 0xE1 and _is_xmp(s)), b"")
        new_exif = EXIF_HEADER + with_gps(exif, tag.position)
    except ValueError as error:
        raise InputError(f"{photo} cannot be tagged: {error}.") from error
    new_xmp = XMP_HEADER + _merged(xmp, properties)
    first_exif = next((s for m, s in segments if m == 0xE1 and _is_exif(s)), None)
    first_xmp = next((s for m, s in segments if m == 0xE1 and _is_xmp(s)), None)
    others = [(m, s) for m, s in segments if s is not first_exif and s is not first_xmp]
    # JFIF has to come first where it is.
    jfif = 1 if others and others[0][0] == 0xE0 else 0
    others[jfif:jfif] = [(0xE1, new_exif), (0xE1, new_xmp)]
    try:
        joined = join(others, rest)
    except ValueError as error:
        raise OutputError(f"{target} has no room for the tags: {error}; write sidecars instead.") from error
    _write_whole(target, joined)
    return target


def _is_exif(segment: bytes) -> bool:
    return segment.startswith(EXIF_HEADER)


def _is_xmp(segment: bytes) -> bool:
    return segment.startswith(XMP_HEADER)


def _properties(tag: Geotag) -> dict[str, str]:
    place = tag.position
    numbers = [place.latitude_deg, place.longitude_deg, place.altitude_m or 0.0]
    for angles in (tag.gimbal, tag.aircraft):
        numbers += [] if angles is None else [angles.yaw_deg, angles.pitch_deg, angles.roll_deg]
    if not all(abs(n) < 1e5 for n in numbers) or abs(numbers[0]) > 90 or abs(numbers[1]) > 360:
        raise InputError("A position or angle to be written into a photo is not a number on this globe.")
    longitude = _half_turn(place.longitude_deg)
    out = {
        "exif:GPSVersionID": "2.3.0.0",
        "exif:GPSLatitude": _minutes(place.latitude_deg, "NS"),
        "exif:GPSLongitude": _minutes(longitude, "EW"),
        "drone-dji:GpsLatitude": f"{place.latitude_deg:+.9f}",
        "drone-dji:GpsLongitude": f"{longitude:+.9f}",
    }
    if place.altitude_m is not None:
        out["exif:GPSAltitude"] = f"{round(abs(place.altitude_m) * 1000)}/1000"
        out["exif:GPSAltitudeRef"] = "0" if place.altitude_m >= 0 else "1"
        out["drone-dji:AbsoluteAltitude"] = f"{place.altitude_m:+.3f}"
    if place.altitude_datum is AltitudeDatum.ELLIPSOID:
        out["Camera:VertCS"] = "ellipsoidal"
    elif place.altitude_datum is AltitudeDatum.SEA_LEVEL:
        out["Camera:VertCS"] = "EPSG:5773"
    if place.height_above_launch_m is not None:
        out["drone-dji:RelativeAltitude"] = f"{place.height_above_launch_m:+.3f}"
    if place.sigma_horizontal_m is not None:
        out["Camera:GPSXYAccuracy"] = f"{place.sigma_horizontal_m:.4f}"
    if place.sigma_vertical_m is not None:
        out["Camera:GPSZAccuracy"] = f"{place.sigma_vertical_m:.4f}"
    for name, angles in (("Gimbal", tag.gimbal), ("Flight", tag.aircraft)):
        if angles is not None:
            out[f"drone-dji:{name}YawDegree"] = f"{_half_turn(angles.yaw_deg):+.3f}"
            out[f"drone-dji:{name}PitchDegree"] = f"{angles.pitch_deg:+.3f}"
            out[f"drone-dji:{name}RollDegree"] = f"{angles.roll_deg:+.3f}"
    return out


def _half_turn(angle_deg: float) -> float:
    return (angle_deg + 180.0) % 360.0 - 180.0


def _minutes(angle_deg: float, signs: str) -> str:
    """ "DD,MM.mmmmmmmmk", XMP's form of a GPS coordinate; the digits are 2 mm on the ground."""
    ticks = round(abs(angle_deg) * 60 * 1_000_000)
    whole, ticks = divmod(ticks, 60_000_000)
    return f"{whole},{ticks / 1_000_000:.6f}{signs[angle_deg < 0]}"


def _description(properties: dict[str, str]) -> bytes:
    spaces = "".join(f'\n   xmlns:{prefix}="{uri}"' for prefix, uri in _SPACES.items())
    body = "".join(f'\n   {name}="{value}"' for name, value in properties.items())
    return f'<rdf:Description rdf:about=""{spaces}{body}/>'.encode()


def _packet(properties: dict[str, str]) -> bytes:
    return (
        b'<?xpacket begin="\xef\xbb\xbf" id="W5M0MpCehiHzreSzNTczkc9d"?>\n'
        + f'<x:xmpmeta xmlns:x="adobe:ns:meta/" x:xmptk="{_TOOL}">\n'.encode()
        + b' <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n  '
        + _description(properties)
        + b'\n </rdf:RDF>\n</x:xmpmeta>\n<?xpacket end="w"?>\n'
    )


def _merged(packet: bytes, properties: dict[str, str]) -> bytes:
    """The photo's own packet with our properties in place of its own of the same names."""
    start = _RDF_START.search(packet)
    if start is None or b"</rdf:RDF>" not in packet:
        return _packet(properties)
    names = "|".join(re.escape(name) for name in properties).encode()
    after = packet[start.end() :]
    after = re.sub(rb"\s(?:" + names + rb")\s*=\s*(?:\"[^\"]*\"|'[^']*')", b"", after)
    after = re.sub(rb"<(" + names + rb")>[^<]*</\1>", b"", after)
    return packet[: start.end()] + b"\n  " + _description(properties) + after


def _write_whole(target: Path, content: bytes) -> None:
    """All of the file or nothing, and on the disk when this returns."""
    temporary: Path | None = None
    try:
        handle, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=".part", dir=target.parent)
        temporary = Path(name)
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o644)
        temporary.replace(target)
    except OSError as error:
        raise OutputError(f"{target} cannot be written: {error.strerror}.") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)

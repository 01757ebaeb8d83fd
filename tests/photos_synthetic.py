"""Small photo files with the metadata of various makers, written with Pillow."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

XMP_HEADER = b"http://ns.adobe.com/xap/1.0/\x00"


def packet(body: str, attributes: str = "") -> bytes:
    """An XMP packet around a Description's attributes and child elements."""
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"'
        ' xmlns:Camera="http://pix4d.com/camera/1.0/" xmlns:drone="http://www.autelrobotics.com/drone/1.0/"'
        ' xmlns:drone-parrot="http://www.parrot.com/drone-parrot/1.0/"'
        ' xmlns:drone-skydio="https://www.skydio.com/drone-skydio/1.0/"'
        ' xmlns:crs="http://ns.adobe.com/camera-raw-settings/1.0/"'
        f' xmlns:tiff="http://ns.adobe.com/tiff/1.0/" {attributes}>{body}'
        '</rdf:Description></rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
    ).encode()


def dms(value: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    """Decimal degrees -> EXIF rationals to 1e-4 seconds."""
    value = abs(value)
    whole, minutes = int(value), int(value % 1 * 60)
    seconds = (value - whole - minutes / 60) * 3600
    return IFDRational(whole), IFDRational(minutes), IFDRational(round(seconds * 10000), 10000)


def gps(latitude: float, longitude: float, altitude: float | None = None, **more: Any) -> dict[int, Any]:
    tags: dict[int, Any] = {
        1: "N" if latitude >= 0 else "S",
        2: dms(latitude),
        3: "E" if longitude >= 0 else "W",
        4: dms(longitude),
    }
    if altitude is not None:
        tags |= {5: b"\x01" if altitude < 0 else b"\x00", 6: IFDRational(round(abs(altitude) * 1000), 1000)}
    return tags | {int(k.removeprefix("t")): v for k, v in more.items()}


def write_photo(
    path: Path,
    *,
    size: tuple[int, int] = (400, 300),
    make: str = "",
    model: str = "",
    main: dict[int, Any] | None = None,
    photo: dict[int, Any] | None = None,
    position: dict[int, Any] | None = None,
    xmp: bytes = b"",
    seed: int = 0,
    **save: Any,
) -> Path:
    """Write a JPEG (or what the suffix says) with EXIF tags and an XMP packet."""
    exif = Image.Exif()
    if make:
        exif[0x010F] = make
    if model:
        exif[0x0110] = model
    for tag, value in (main or {}).items():
        exif[tag] = value
    for group, tags in ((0x8769, photo), (0x8825, position)):
        if tags:
            exif.get_ifd(group).update(tags)
            exif[group] = 0  # Pillow replaces it by the offset; TIFF files lose the directory without.
    # Coarse noise, enlarged: every seed another picture, quick to write at any size.
    noise = np.random.default_rng(seed).integers(0, 255, (12, 16), dtype=np.uint8)
    image = Image.fromarray(noise).resize(size, Image.Resampling.NEAREST)
    if xmp and path.suffix.lower() in (".jpg", ".jpeg"):
        save["xmp"] = xmp
    image.save(path, exif=exif, **save)
    return path


def claim_size(path: Path, width: int, height: int) -> Path:
    """Let a JPEG's frame header claim another size: the reader does not decode pixels."""
    data = bytearray(path.read_bytes())
    at = data.find(b"\xff\xc0")
    assert at > 0
    data[at + 5 : at + 9] = struct.pack(">HH", height, width)
    path.write_bytes(bytes(data))
    return path

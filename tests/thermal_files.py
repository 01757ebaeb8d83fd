"""Thermal photos as FLIR's and DJI's cameras lay them out (layouts: exiftool's FLIR and DJI tags)."""

from __future__ import annotations

import io
import struct

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

Counts = NDArray[np.uint16]
_SEGMENT = 65533


def jpeg(picture: NDArray[np.uint8], make: str, model: str = "T") -> bytes:
    """The coloured picture that the camera shows, with a maker's name in EXIF."""
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = make, model
    out = io.BytesIO()
    Image.fromarray(picture).save(out, "JPEG", quality=85, exif=exif)
    return out.getvalue()


def fff(counts: Counts, *, png: bool = False, field_of_view_deg: float = 45.0) -> bytes:
    """An FFF file, big-endian as in JPEGs: raw data (least byte first, or PNG in the wrong order), camera."""
    height, width = counts.shape
    body = counts.astype("<u2").tobytes()
    if png:
        body = cv2.imencode(".png", counts.byteswap())[1].tobytes()
    raw = struct.pack("<3H", 2, width, height).ljust(32, b"\0") + body
    info = bytearray(0x200)
    struct.pack_into("<H", info, 0, 2)
    struct.pack_into("<f", info, 0x1B4, field_of_view_deg)
    records = [(0x01, 3 if png else 2, raw), (0x20, 1, bytes(info))]
    directory, at = 0x40, 0x40 + 0x20 * len(records)
    head = b"FFF\0" + b"CAMCTRL".ljust(16, b"\0") + struct.pack(">3I", 101, directory, len(records))
    entries, data = b"", b""
    for kind, subtype, payload in records:
        entry = struct.pack(">2H4I", kind, subtype, 0x64, 1, at + len(data), len(payload))
        entries += entry.ljust(0x20, b"\0")
        data += payload
    return head.ljust(0x40, b"\0") + entries + data


def with_segments(photo: bytes, segments: list[tuple[int, bytes]]) -> bytes:
    """A JPEG with further segments (marker, payload) behind those that it begins with (JFIF, EXIF)."""
    at = 2
    while 0xE0 <= photo[at + 1] <= 0xEF:
        at += 2 + int.from_bytes(photo[at + 2 : at + 4], "big")
    extra = b"".join(bytes([0xFF, m]) + (len(p) + 2).to_bytes(2, "big") + p for m, p in segments)
    return photo[:at] + extra + photo[at:]


def flir(picture: NDArray[np.uint8], counts: Counts, **how: bool | float) -> bytes:
    """FLIR's radiometric JPEG: an FFF file in numbered APP1 segments."""
    blob = fff(counts, **how)  # type: ignore[arg-type]
    parts = [blob[i : i + _SEGMENT - 8] for i in range(0, len(blob), _SEGMENT - 8)]
    last = len(parts) - 1
    return with_segments(
        jpeg(picture, "FLIR"),
        [(0xE1, b"FLIR\0\x01" + bytes([i, last]) + part) for i, part in enumerate(parts)],
    )


def dji(picture: NDArray[np.uint8], data: bytes) -> bytes:
    """DJI's R-JPEG: raw data in APP3 segments."""
    parts = [data[i : i + 65532] for i in range(0, len(data), 65532)]
    return with_segments(jpeg(picture, "DJI", "ZH20T"), [(0xE3, part) for part in parts])

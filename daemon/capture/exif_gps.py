"""GPS tags into an EXIF block without moving anything that is in it.

The block is a TIFF file (EXIF 2.32, section 4.5). A new first directory and a new GPS directory are
appended and the header points to them; all else stays at its offset, so maker notes, whose inner
offsets nobody knows, and the thumbnail remain readable.
"""

from __future__ import annotations

import struct

from calib.photos.photo import Position

_GPS_POINTER = 0x8825
#: Of the receiver's own tags, time and date stay true.
_KEPT_GPS_TAGS = (7, 29)
_BYTE, _ASCII, _LONG, _RATIONAL = 1, 2, 4, 5


def with_gps(tiff: bytes, position: Position) -> bytes:
    """The TIFF block (empty: a new one) with this position as its only one.

    Raises:
        ValueError: the block is damaged.
    """
    if not tiff:
        tiff = b"II*\x00\x08\x00\x00\x00" + bytes(6)
    order = {b"II*\x00": "<", b"MM\x00*": ">"}.get(tiff[:4])
    if order is None:
        raise ValueError("its EXIF block is damaged")
    try:
        (first,) = struct.unpack_from(order + "I", tiff, 4)
        entries, following = _directory(tiff, order, first)
        old_gps: dict[int, bytes] = {}
        if _GPS_POINTER in entries:
            (at,) = struct.unpack(order + "I", entries[_GPS_POINTER][8:])
            old_gps = _directory(tiff, order, at)[0]
    except struct.error as error:
        raise ValueError("its EXIF block is damaged") from error
    out = bytearray(tiff)
    gps = {tag: entry for tag, entry in old_gps.items() if tag in _KEPT_GPS_TAGS}
    for tag, kind, count, value in _gps_values(position, order):
        if len(value) > 4:
            _align(out)
            at = len(out)
            out += value
            value = struct.pack(order + "I", at)
        gps[tag] = struct.pack(order + "HHI", tag, kind, count) + value.ljust(4, b"\x00")
    gps_at = _append(out, order, gps, 0)
    entries[_GPS_POINTER] = struct.pack(order + "HHII", _GPS_POINTER, _LONG, 1, gps_at)
    struct.pack_into(order + "I", out, 4, _append(out, order, entries, following))
    return bytes(out)


def _directory(tiff: bytes, order: str, at: int) -> tuple[dict[int, bytes], int]:
    """Entries (12 bytes each) by tag, and the offset of the next directory."""
    (count,) = struct.unpack_from(order + "H", tiff, at)
    entries = {}
    for k in range(count):
        entry = tiff[at + 2 + 12 * k : at + 14 + 12 * k]
        (tag,) = struct.unpack_from(order + "H", entry)
        if len(entry) < 12:
            raise struct.error
        entries[tag] = entry
    end = tiff[at + 2 + 12 * count : at + 6 + 12 * count]
    # Some writers leave the end mark out.
    return entries, struct.unpack(order + "I", end)[0] if len(end) == 4 else 0


def _append(out: bytearray, order: str, entries: dict[int, bytes], following: int) -> int:
    _align(out)
    at = len(out)
    out += struct.pack(order + "H", len(entries))
    out += b"".join(entries[tag] for tag in sorted(entries))
    out += struct.pack(order + "I", following)
    return at


def _align(out: bytearray) -> None:
    if len(out) % 2:
        out.append(0)


def _gps_values(position: Position, order: str) -> list[tuple[int, int, int, bytes]]:
    longitude = (position.longitude_deg + 180.0) % 360.0 - 180.0
    values = [
        (0, _BYTE, 4, b"\x02\x03\x00\x00"),
        (1, _ASCII, 2, b"S\x00" if position.latitude_deg < 0 else b"N\x00"),
        (2, _RATIONAL, 3, _dms(position.latitude_deg, order)),
        (3, _ASCII, 2, b"W\x00" if longitude < 0 else b"E\x00"),
        (4, _RATIONAL, 3, _dms(longitude, order)),
    ]
    if position.altitude_m is not None:
        height_mm = round(abs(position.altitude_m) * 1000)
        values.append((5, _BYTE, 1, b"\x01" if position.altitude_m < 0 else b"\x00"))
        values.append((6, _RATIONAL, 1, struct.pack(order + "II", height_mm, 1000)))
    if position.sigma_horizontal_m is not None:
        error_mm = min(round(position.sigma_horizontal_m * 1000), 2**32 - 1)
        values.append((31, _RATIONAL, 1, struct.pack(order + "II", error_mm, 1000)))
    return values


def _dms(angle_deg: float, order: str) -> bytes:
    """Degrees, minutes, seconds to 1e-5, which is 0.3 mm on the ground."""
    minutes, ticks = divmod(round(abs(angle_deg) * 3600 * 100_000), 6_000_000)
    return struct.pack(order + "6I", minutes // 60, 1, minutes % 60, 1, ticks, 100_000)

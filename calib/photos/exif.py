"""EXIF tags as plain, checked values. Garbage gives None, never an error (EXIF 2.32, CIPA DC-008)."""

from __future__ import annotations

import math
import struct
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any, BinaryIO

from PIL import Image

#: What Pillow's readers raise on garbage (they promise no single type).
GARBAGE = (
    SyntaxError,
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    ArithmeticError,
    struct.error,
    EOFError,
    OSError,
    MemoryError,
    RecursionError,
)
_PHOTO_IFD, _GPS_IFD = 0x8769, 0x8825


@dataclass(frozen=True)
class ExifTags:
    """The three directories that matter, by tag number, values as Pillow gives them."""

    main: Mapping[int, Any] = field(default_factory=dict)
    photo: Mapping[int, Any] = field(default_factory=dict)
    gps: Mapping[int, Any] = field(default_factory=dict)


def read_exif(stream: BinaryIO) -> ExifTags:
    """Read a TIFF stream's directories; those that cannot be read stay empty."""
    exif = Image.Exif()
    stream.seek(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow warns about corrupt tags, which it skips.
        try:
            exif.load_from_fp(stream)
        except GARBAGE:
            return ExifTags()
        main = {tag: value for tag in list(exif) if (value := _get(exif, tag)) is not None}
        return ExifTags(main, _directory(exif, _PHOTO_IFD), _directory(exif, _GPS_IFD))


def _get(exif: Image.Exif, tag: int) -> Any:
    try:
        return exif.get(tag)
    except GARBAGE:
        return None


def _directory(exif: Image.Exif, tag: int) -> dict[int, Any]:
    try:
        return dict(exif.get_ifd(tag))
    except GARBAGE:
        return {}


def text(value: Any) -> str:
    """A text tag without padding; "" where it is none."""
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    if not isinstance(value, str):
        return ""
    printable = "".join(c for c in value.partition("\x00")[0] if c.isprintable() and c != "\ufffd")
    return printable.strip()


def real(value: Any) -> float | None:
    """A number tag; None for 0/0, NaN, infinity and everything that is no number."""
    if isinstance(value, tuple | list):
        value = value[0] if value else None
    if value is None or isinstance(value, str | bytes):
        return None
    try:
        number = float(value)
    except (TypeError, ValueError, ArithmeticError):
        return None
    return number if math.isfinite(number) else None


def positive(value: Any) -> float | None:
    """A number tag above zero, otherwise None."""
    number = real(value)
    return number if number is not None and number > 0 else None


def whole(value: Any) -> int | None:
    """A small integer tag, which some makers write as a byte string."""
    if isinstance(value, bytes) and len(value) == 1:
        return value[0]
    number = real(value)
    return None if number is None else int(number)


def degrees(value: Any, reference: Any, negative: str) -> float | None:
    """Degrees, minutes, seconds and N/S/E/W -> decimal degrees; None where any part is none."""
    parts = [real(v) for v in value] if isinstance(value, tuple | list) else [real(value)]
    if not 1 <= len(parts) <= 3 or any(p is None or p < 0 for p in parts):
        return None
    magnitude = sum((p or 0.0) / (1.0, 60.0, 3600.0)[i] for i, p in enumerate(parts))
    return -magnitude if text(reference).upper().startswith(negative) else magnitude


def clock(tags: ExifTags) -> tuple[datetime, float] | None:
    """Exposure time on the camera's clock and its resolution in s; None where there is none."""
    for date_tag, fraction_tag, owner in (
        (0x9003, 0x9291, tags.photo),  # DateTimeOriginal, SubSecTimeOriginal
        (0x9004, 0x9292, tags.photo),  # DateTimeDigitized
        (0x0132, 0x9290, tags.main),  # DateTime
    ):
        moment = parse_time(text(owner.get(date_tag)))
        if moment is None:
            continue
        digits = text(tags.photo.get(fraction_tag))
        if digits.isascii() and digits.isdigit() and len(digits) <= 9:
            moment = moment.replace(microsecond=int(f"{digits:0<6}"[:6]))
            return moment, max(10.0 ** -len(digits), 1e-6)
        # Some cameras write the fraction into the date itself.
        return moment, 1.0 if moment.microsecond == 0 else 1e-3
    return None


def parse_time(value: str) -> datetime | None:
    """EXIF's or ISO 8601's date and time, zone left away; None for clocks never set."""
    value = value.strip().replace("T", " ").replace("-", ":", 2)
    # A zone or the digits after microseconds may follow.
    for candidate, pattern in ((value[:26], "%Y:%m:%d %H:%M:%S.%f"), (value[:19], "%Y:%m:%d %H:%M:%S")):
        try:
            moment = datetime.strptime(candidate, pattern)
        except ValueError:
            continue
        return moment if 1990 <= moment.year <= 2200 else None
    return None


def gps_clock(tags: ExifTags) -> datetime | None:
    """Time of the GPS fix, UTC without zone; None where the receiver gave none."""
    date = text(tags.gps.get(29)).replace("-", ":")
    stamp = tags.gps.get(7)
    if not isinstance(stamp, tuple | list) or len(stamp) != 3:
        return None
    hours, minutes, seconds = (real(v) for v in stamp)
    midnight = parse_time(f"{date} 00:00:00")
    if midnight is None or hours is None or minutes is None or seconds is None:
        return None
    if not (0 <= hours < 24 and 0 <= minutes < 60 and 0 <= seconds < 61):
        return None
    return midnight + timedelta(hours=hours, minutes=minutes, seconds=seconds)

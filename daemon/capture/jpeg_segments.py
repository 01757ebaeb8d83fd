"""A JPEG's header segments apart and together again (ITU-T T.81, annex B)."""

from __future__ import annotations

EXIF_HEADER = b"Exif\x00\x00"
XMP_HEADER = b"http://ns.adobe.com/xap/1.0/\x00"
_LONGEST = 65533

Segment = tuple[int, bytes]


def split(content: bytes) -> tuple[list[Segment], bytes]:
    """The application and comment segments at the start as (marker, payload), and all the rest.

    Raises:
        ValueError: no JPEG, or cut off within its header.
    """
    if content[:3] != b"\xff\xd8\xff":
        raise ValueError("it is no JPEG")
    segments: list[Segment] = []
    at = 2
    while True:
        start = at
        while content[at : at + 2] == b"\xff\xff":  # fill bytes
            at += 1
        if at + 4 > len(content) or content[at] != 0xFF:
            raise ValueError("its JPEG header is cut off or damaged")
        marker = content[at + 1]
        if not (0xE0 <= marker <= 0xEF or marker == 0xFE):
            return segments, content[start:]
        length = int.from_bytes(content[at + 2 : at + 4], "big")
        if length < 2 or at + 2 + length > len(content):
            raise ValueError("its JPEG header is cut off or damaged")
        segments.append((marker, content[at + 4 : at + 2 + length]))
        at += 2 + length


def join(segments: list[Segment], rest: bytes) -> bytes:
    """The inverse of :func:`split`.

    Raises:
        ValueError: a segment is longer than JPEG allows.
    """
    parts = [b"\xff\xd8"]
    for marker, payload in segments:
        if len(payload) > _LONGEST:
            raise ValueError(f"its metadata would need {len(payload)} of {_LONGEST} bytes")
        parts.append(bytes([0xFF, marker]) + (len(payload) + 2).to_bytes(2, "big") + payload)
    return b"".join([*parts, rest])

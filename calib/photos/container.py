"""Photo files as containers: which format, how large, where the metadata is, and is it whole.

Only the head and the last bytes of a JPEG are read, so 300 photos take about a second.
Structure of JPEG files: ITU-T T.81 annex B; APP1 payloads: EXIF 2.32 section 4.7.2, XMP part 3.
"""

from __future__ import annotations

import hashlib
import io
import os
import stat
import struct
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from PIL import Image

from calib.errors import PhotoError
from calib.photos.exif import GARBAGE, ExifTags, read_exif

_EXIF = b"Exif\x00"
_XMP = b"http://ns.adobe.com/xap/1.0/\x00"
_FLIR = b"FLIR\x00"
_EOI = b"\xff\xd9"
_TAIL = 65536
#: Frame headers (SOF) of T.81 table B.1; C4, C8 and CC are tables, not frames.
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_STANDALONE = frozenset({0x01, *range(0xD0, 0xD9)})
#: File names that raw and other unsupported photo formats have.
RAW_SUFFIXES = frozenset(
    {".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".srf", ".raf", ".rw2", ".orf", ".pef"}
    | {".gpr", ".3fr", ".fff", ".iiq", ".x3f"}
)
OTHER_SUFFIXES = frozenset({".heic", ".heif", ".hif", ".avif", ".jxl", ".jp2", ".webp", ".bmp"})
PHOTO_SUFFIXES = frozenset({".jpg", ".jpeg", ".jpe", ".jfif", ".mpo", ".tif", ".tiff", ".png"})
_HEIF_BRANDS = {b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1", b"avif", b"avis"}


@dataclass(frozen=True)
class Container:
    """One photo file taken apart; sizes in px as the pixels are stored.

    ``exif`` is empty where there is none or it cannot be read, and so is ``xmp``, the packet.
    ``fingerprint`` depends on the image data only. ``flir``: FLIR's records, joined from their segments,
    and ``app3``: all APP3 segments, where a JPEG has them. ``bits`` a channel.
    """

    path: Path
    format: str
    width: int
    height: int
    exif: ExifTags
    xmp: bytes
    fingerprint: str
    flir: bytes = b""
    app3: bytes = b""
    bits: int = 8


def open_container(path: Path) -> Container:
    """Take a JPEG, TIFF or PNG file apart.

    Raises:
        PhotoError: not a photo, not supported, truncated, empty or unreadable; one sentence.
    """
    try:
        mode = path.stat().st_mode
    except FileNotFoundError as error:
        raise PhotoError(f"{path} does not exist.") from error
    except (OSError, ValueError) as error:  # ValueError: a NUL byte in the name
        raise _unreadable(path, error) from error
    if stat.S_ISDIR(mode):
        raise PhotoError(f"{path} is a folder, not a photo.")
    if not stat.S_ISREG(mode):
        raise PhotoError(f"{path} is not a regular file.")
    try:
        with path.open("rb") as file:
            return _take_apart(path, file)
    except OSError as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> PhotoError:
    if isinstance(error, PermissionError):
        return PhotoError(f"{path} cannot be read: permission denied; change its permissions.")
    reason = getattr(error, "strerror", None) or str(error)
    return PhotoError(f"{path} cannot be read: {reason}; copy it again.")


def _take_apart(path: Path, file: BinaryIO) -> Container:
    head = file.read(32)
    suffix = path.suffix.lower()
    if not head:
        raise PhotoError(f"{path} is empty (0 bytes); copy it from the card again.")
    if not head.strip(b"\x00"):
        raise PhotoError(f"{path} holds only zeros at its start, the copy is damaged; copy it again.")
    if head[:3] == b"\xff\xd8\xff":
        return _jpeg(path, file)
    if _is_raw(head, suffix):
        raise PhotoError(f"{path} is a raw file, which is not supported; convert it to JPEG at full size.")
    if head[4:8] == b"ftyp" and (head[8:12] in _HEIF_BRANDS or suffix in OTHER_SUFFIXES):
        raise PhotoError(f"{path} is a HEIC photo, which is not supported; convert it to JPEG at full size.")
    if head[:8] == b"\x89PNG\r\n\x1a\n" or head[:4] in (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+"):
        return _by_pillow(path, file)
    raise PhotoError(f"{path} is not a photo{_what_instead(head)}; fieldcal reads JPEG, TIFF and PNG.")


def _is_raw(head: bytes, suffix: str) -> bool:
    magic = head[8:10] == b"CR" or head[:8] == b"FUJIFILM" or head[:3] in (b"IIU", b"IIR")
    return magic or head[4:11] == b"ftypcrx" or suffix in RAW_SUFFIXES


def _what_instead(head: bytes) -> str:
    if head[:2] == b"PK":
        return " but a ZIP archive"
    if head[4:8] == b"ftyp":
        return " but a video"
    if head[:4] == b"%PDF":
        return " but a PDF"
    if head[:4] == b"GIF8" or head[:2] == b"BM" or head[:4] == b"RIFF":
        return " in a supported format"
    try:
        text = head.decode("ascii")
    except UnicodeDecodeError:
        return ""
    return " but a text file" if all(c.isprintable() or c in "\r\n\t" for c in text) else ""


def _jpeg(path: Path, file: BinaryIO) -> Container:
    size = os.fstat(file.fileno()).st_size
    exif = xmp = b""
    flir: list[tuple[int, bytes]] = []
    app3: list[bytes] = []
    frame: tuple[int, int] | None = None
    file.seek(2)
    while True:
        marker = _next_marker(file)
        if marker is None or marker == 0xD9:
            raise _truncated(path)
        if marker in _STANDALONE:
            continue
        raw_length = file.read(2)
        length = int.from_bytes(raw_length, "big") - 2
        start = file.tell()
        if len(raw_length) < 2 or length < 0 or start + length > size:
            raise _truncated(path)
        if marker == 0xE1:
            payload = file.read(length)
            # Two Exif blocks (stitching tools leave the camera's as a second): the first counts.
            if payload.startswith(_EXIF) and not exif:
                exif = payload[6:]
            elif payload.startswith(_XMP):
                xmp += payload[len(_XMP) :]
            elif payload.startswith(_FLIR) and len(payload) > 8:
                # Number of the chunk; some programs write zero into all of them.
                flir.append((payload[6], payload[8:]))
        elif marker == 0xE3:
            app3.append(file.read(length))
        elif marker in _FRAMES:
            fields = file.read(min(length, 5))
            if len(fields) == 5:
                height, width = struct.unpack(">HH", fields[1:])
                frame = (width, height)
        elif marker == 0xDA:
            break
        file.seek(start + length)
    if frame is None or 0 in frame:
        raise PhotoError(f"{path} is damaged: the JPEG does not say its size; copy it again.")
    fingerprint = _scan_fingerprint(path, file, start, size)
    joined = b"".join(part for _, part in sorted(flir, key=lambda chunk: chunk[0]))
    tags = read_exif(io.BytesIO(exif))
    return Container(path, "JPEG", *frame, tags, xmp, fingerprint, joined, b"".join(app3))


def _next_marker(file: BinaryIO) -> int | None:
    """Next marker code; bytes between segments are skipped, as decoders do (None: end of file)."""
    skipped = 0
    while skipped < _TAIL:
        byte = file.read(1)
        if not byte:
            return None
        if byte == b"\xff":
            while byte == b"\xff":
                byte = file.read(1)
            if not byte:
                return None
            if byte != b"\x00":
                return byte[0]
        skipped += 1
    return None


def _truncated(path: Path) -> PhotoError:
    return PhotoError(f"{path} is truncated (the JPEG ends too early); copy it from the card again.")


def _scan_fingerprint(path: Path, file: BinaryIO, scan: int, size: int) -> str:
    """Check that the compressed image ends, and name its content.

    Within the scan every FF is followed by 00 or a restart marker, so FF D9 after its start is
    the real end. Usually the file ends with it; behind it there may be previews or thermal data.
    """
    tail_start = max(scan, size - _TAIL)
    file.seek(tail_start)
    tail = file.read(_TAIL)
    whole = tail.rstrip(b"\x00").endswith(_EOI)
    if not whole:
        file.seek(scan)
        whole = _EOI in file.read()
    if not whole:
        raise _truncated(path)
    file.seek(scan)
    digest = hashlib.blake2b(file.read(4096), digest_size=12)
    digest.update(tail[-4096:])
    return f"{size - scan:x}-{digest.hexdigest()}"


def _by_pillow(path: Path, file: BinaryIO) -> Container:
    file.seek(0)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            image = Image.open(file, formats=("TIFF", "PNG"))
            name, (width, height) = image.format or "", image.size
            packet = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
            exif = io.BytesIO(image.info.get("exif", b"").removeprefix(b"Exif\x00\x00"))
            ends = _strip_ends(getattr(image, "tag_v2", {}))
            bits = _bits(image)
    except Image.DecompressionBombError as error:
        raise PhotoError(f"{path} is larger than a photo can be; leave it out.") from error
    except GARBAGE as error:
        raise PhotoError(f"{path} is damaged: its header cannot be read; copy it again.") from error
    if name == "PNG":
        file.seek(24)  # Bit depth in the header, which Pillow does not tell of colour.
        bits = max(file.read(1), default=8)
    size = file.seek(0, io.SEEK_END)
    file.seek(max(0, size - 4096))
    tail = file.read()
    if not (b"IEND" in tail[-64:] if name == "PNG" else ends and max(ends) <= size):
        raise PhotoError(f"{path} is truncated (its pixels end too early); copy it from the card again.")
    tags = read_exif(file if name == "TIFF" else exif)
    if 0xC612 in tags.main:
        raise PhotoError(f"{path} is a raw file (DNG), which is not supported; convert it to JPEG.")
    fingerprint = f"{size:x}-{hashlib.blake2b(tail, digest_size=12).hexdigest()}"
    raw_packet = packet.encode() if isinstance(packet, str) else bytes(packet)
    return Container(path, name, width, height, tags, raw_packet, fingerprint, bits=bits)


def _bits(image: Image.Image) -> int:
    """Bits a channel: Pillow opens colour of 16 bits as if it had 8, which the TIFF's tag tells."""
    if image.mode == "F":
        return 32
    depth = getattr(image, "tag_v2", {}).get(258)
    return int(depth[0]) if depth else 8


def _strip_ends(tags: Mapping[int, Any]) -> list[int]:
    """Where the strips or tiles of a TIFF end, in bytes: the file must reach that far."""
    offsets, counts = tags.get(273) or tags.get(324) or (), tags.get(279) or tags.get(325) or ()
    return [int(o) + int(c) for o, c in zip(offsets, counts, strict=False)]

"""Raw counts of thermal cameras: FLIR's radiometric JPEG, DJI's R-JPEG, 16-bit TIFF and PNG.

The picture that a thermal camera shows is coloured, stretched anew in every photo and often overlaid with
edges of its other camera; the counts behind it are what the lens drew. FLIR keeps them in APP1 segments
that join to a file of records ("FFF"); DJI in APP3 segments, 16 bits a pixel, least byte first (layouts:
exiftool's FLIR and DJI tags). Counts are enough for the geometry: they are not made temperatures here.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.errors import PhotoError
from calib.photos.container import open_container
from calib.photos.photo import Photo, Radiometric

Counts = NDArray[np.uint16] | NDArray[np.float32]
#: Record types of an FFF file.
_RAW_DATA, _CAMERA_INFO = 0x01, 0x20
_FIELD_OF_VIEW = 0x1B4
_RAW_HEADER = 32
#: Dark and bright of a set: these shares of its counts, so that a few hot pixels do not decide.
_DARK_PERCENT, _BRIGHT_PERCENT = 0.5, 99.5
#: Photos of a set whose counts are looked at.
_LOOKED_AT = 20
#: Neighbouring pixels of a picture differ by less than this share of what any two differ by.
_SMOOTH_SHARE = 0.5


@dataclass(frozen=True)
class FlirRaw:
    """FLIR's raw image: size in px, as stored (``data``: 16 bits a pixel or PNG), and the field of view."""

    width: int
    height: int
    data: bytes
    big_endian: bool
    field_of_view_deg: float | None


def parse_fff(blob: bytes) -> FlirRaw | None:
    """The raw image among an FFF file's records; None where there is none or it is damaged."""
    if len(blob) < 0x40 or blob[:4] not in (b"FFF\0", b"AFF\0"):
        return None
    for order in ("<", ">"):
        version, directory, count = struct.unpack_from(f"{order}3I", blob, 0x14)
        if 100 <= version < 200:
            break
    else:
        return None
    records: dict[int, bytes] = {}
    for i in range(min(count, 256)):
        start = directory + 0x20 * i
        if start + 0x20 > len(blob):
            break
        kind = struct.unpack_from(f"{order}H", blob, start)[0]
        at, length = struct.unpack_from(f"{order}2I", blob, start + 0x0C)
        if at + length <= len(blob):
            records.setdefault(kind, blob[at : at + length])
    raw = records.get(_RAW_DATA, b"")
    if len(raw) <= _RAW_HEADER:
        return None
    # The first word of the record is 2 in its own byte order.
    own = "<" if struct.unpack_from("<H", raw)[0] < 0x100 else ">"
    width, height = struct.unpack_from(f"{own}2H", raw, 2)
    return FlirRaw(
        width, height, raw[_RAW_HEADER:], own == ">", _field_of_view(records.get(_CAMERA_INFO, b""))
    )


def _field_of_view(info: bytes) -> float | None:
    if len(info) < _FIELD_OF_VIEW + 4:
        return None
    own = "<" if struct.unpack_from("<H", info)[0] < 0x100 else ">"
    angle = float(struct.unpack_from(f"{own}f", info, _FIELD_OF_VIEW)[0])
    return angle if 1 < angle < 170 else None


def flir_counts(raw: FlirRaw) -> NDArray[np.uint16] | None:
    """Counts (height, width) of FLIR's raw image; None where it is damaged."""
    shape = (raw.height, raw.width)
    if raw.data[:8] == b"\x89PNG\r\n\x1a\n":
        image = cv2.imdecode(np.frombuffer(raw.data, np.uint8), cv2.IMREAD_UNCHANGED)
        if image is None or image.dtype != np.uint16 or image.shape != shape:
            return None
        counts = np.asarray(image, np.uint16)
        # Most cameras write PNG's bytes in the wrong order: the right one is the smoother.
        swapped = counts.byteswap()
        return min((counts, swapped), key=roughness)
    if len(raw.data) != 2 * raw.width * raw.height:
        return None
    return np.frombuffer(raw.data, ">u2" if raw.big_endian else "<u2").reshape(shape).astype(np.uint16)


def dji_counts(app3: bytes, width: int, height: int) -> NDArray[np.uint16] | None:
    """Counts (height, width) of DJI's APP3 data; None where they are of another size."""
    if len(app3) != 2 * width * height:
        return None
    return np.frombuffer(app3, "<u2").reshape(height, width).astype(np.uint16)


def roughness(counts: Counts) -> float:
    """Typical step between neighbours over the typical difference of any two pixels (1: noise)."""
    values = counts.astype(float)
    steps = np.abs(np.diff(values, axis=1))
    any_two = np.abs(values.ravel() - np.random.default_rng(0).permutation(values.ravel()))
    return float(np.mean(steps) / max(float(np.mean(any_two)), 1e-9))


def read_counts(photo: Photo) -> Counts:
    """Raw counts (height, width) of a radiometric photo.

    Raises:
        PhotoError: they cannot be read; one sentence.
    """
    container = open_container(photo.path)
    counts: Counts | None
    if container.flir:
        raw = parse_fff(container.flir)
        counts = None if raw is None else flir_counts(raw)
    elif container.app3:
        counts = dji_counts(container.app3, container.width, container.height)
    else:
        counts = _deep_pixels(photo.path)
    if counts is None or counts.shape != (photo.camera.height, photo.camera.width):
        raise PhotoError(f"{photo.path}: its raw counts cannot be read; copy the file from the card again.")
    return counts


def _deep_pixels(path: Path) -> Counts | None:
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.fromfile(path, np.uint8), flags)
    except cv2.error:
        return None
    if image is None or image.dtype == np.uint8:
        return None
    return np.asarray(image, np.uint16) if image.dtype == np.uint16 else np.asarray(image, np.float32)


def stretched(counts: Counts, levels: tuple[float, float]) -> NDArray[np.uint8]:
    """8-bit image: ``levels`` (dark, bright) become 0 and 255; what lies beyond is cut off."""
    dark, bright = levels
    scaled = (np.nan_to_num(counts.astype(np.float32), nan=dark) - dark) * (255 / max(bright - dark, 1e-6))
    return np.asarray(np.clip(scaled + 0.5, 0, 255), np.uint8)


def grey(photo: Photo) -> NDArray[np.uint8] | None:
    """Counts of a radiometric photo as an 8-bit image, stretched as its set is, or alone where it has none.

    None where the photo has no counts to use.

    Raises:
        PhotoError: they cannot be read; one sentence.
    """
    if photo.radiometric is None or photo.radiometric.unread:
        return None
    counts = read_counts(photo)
    return stretched(counts, photo.radiometric.levels or levels_of([counts]))


def levels_of(images: Sequence[Counts]) -> tuple[float, float]:
    """Dark and bright counts of several images together, robust against hot and dead pixels."""
    values = np.concatenate([image[::2, ::2].ravel() for image in images]).astype(float)
    values = values[np.isfinite(values)]
    if not len(values):
        return 0.0, 1.0
    dark, bright = np.percentile(values, [_DARK_PERCENT, _BRIGHT_PERCENT])
    return float(dark), float(max(bright, dark + 1e-6))


def with_levels(photos: Sequence[Photo]) -> list[Photo]:
    """The photos, those of each thermal camera with one common stretch of their counts.

    Where the counts are no picture (encrypted, damaged) the visible one is used and ``unread`` says so.
    """
    sets: dict[object, list[Photo]] = {}
    for photo in photos:
        if photo.radiometric is not None and not photo.radiometric.unread:
            sets.setdefault((photo.camera, photo.radiometric.kind), []).append(photo)
    known: dict[object, Radiometric] = {}
    for key, members in sets.items():
        kind = members[0].radiometric
        assert kind is not None
        images = []
        for photo in members[:: max(len(members) // _LOOKED_AT, 1)]:
            try:
                images.append(read_counts(photo))
            except PhotoError:
                continue
        if not images:
            known[key] = replace(kind, unread="their raw data cannot be read")
        elif kind.hidden and np.median([roughness(image) for image in images]) > _SMOOTH_SHARE:
            known[key] = replace(kind, unread="their raw data are no plain picture")
        else:
            known[key] = replace(kind, levels=levels_of(images))
    return [
        photo
        if photo.radiometric is None
        else replace(photo, radiometric=known.get((photo.camera, photo.radiometric.kind), photo.radiometric))
        for photo in photos
    ]


def counts_read(photos: Sequence[Photo]) -> list[str]:
    """What was read of thermal photos, counts or the picture, in one sentence a kind."""
    said = []
    for found in sorted({p.radiometric for p in photos if p.radiometric is not None}, key=str):
        count = sum(p.radiometric == found for p in photos)
        if found.unread:
            said.append(
                f"{count} photos are {found.kind}, but {found.unread}: the picture that the camera drew "
                "is used."
            )
        elif found.levels is not None:
            dark, bright = found.levels
            what = "raw counts" if found.hidden else "values"
            said.append(
                f"{count} photos are {found.kind}: their {what} are used, {dark:.5g} as black and "
                f"{bright:.5g} as white in all of them."
            )
    return said

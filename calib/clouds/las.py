"""LAS and LAZ through laspy, in pieces."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import laspy
import lazrs
import numpy as np
from laspy.errors import LaspyException
from pyproj import CRS
from pyproj.exceptions import CRSError

from calib.camera import FloatArray
from calib.clouds.kinds import CloudFile, Kind
from calib.errors import InputError
from calib.files import output_errors
from calib.similarity import Similarity


def describe(path: Path) -> CloudFile:
    with _errors(path), laspy.open(path) as reader:
        header = reader.header
        kind = Kind.LAZ if header.are_points_compressed else Kind.LAS
        count = int(header.point_count)
        if count == 0:
            raise InputError(f"{path} holds no points.")
        if kind is Kind.LAS:
            needed = header.offset_to_point_data + count * header.point_format.size
            there = path.stat().st_size
            if there < needed:
                whole = max(there - header.offset_to_point_data, 0) // header.point_format.size
                raise _cut_off(path, whole, count)
        return CloudFile(path, kind, _crs(header), count)


def chunks(cloud: CloudFile, size: int) -> Iterator[FloatArray]:
    with _errors(cloud.path), laspy.open(cloud.path) as reader:
        read = 0
        for record in reader.chunk_iterator(size):
            read += len(record)
            yield _xyz(record)
        if cloud.count is not None and read < cloud.count:
            raise _cut_off(cloud.path, read, cloud.count)


def rewrite(cloud: CloudFile, out: Path, moved: Similarity, size: int) -> None:
    """The cloud again with its points moved; everything else of the points stays as it is."""
    with _errors(cloud.path), laspy.open(cloud.path) as reader, laspy.open(cloud.path) as old:
        header = old.header
        x, y, z = zip(header.mins, header.maxs, strict=True)
        ends = np.array([[a, b, c] for a in x for b in y for c in z])
        # Integers about another offset: a large shift would not fit the old one.
        header.offsets = np.floor(moved.apply(ends).min(axis=0))
        compressed = cloud.kind is Kind.LAZ
        with output_errors(out), laspy.open(out, mode="w", header=header, do_compress=compressed) as writer:
            for record in reader.chunk_iterator(size):
                xyz = moved.apply(_xyz(record))
                record.offsets = header.offsets
                record.x, record.y, record.z = xyz.T
                writer.write_points(record)


def _xyz(record: Any) -> FloatArray:
    return np.column_stack([np.asarray(record.x), np.asarray(record.y), np.asarray(record.z)])


def _crs(header: Any) -> CRS | None:
    try:
        found = header.parse_crs()
    except CRSError:
        return None
    return None if found is None else CRS.from_user_input(found)


def _cut_off(path: Path, there: int, count: int) -> InputError:
    return InputError(f"{path} is cut off: {there} of {count} points are there; copy or export it again.")


@contextmanager
def _errors(path: Path) -> Iterator[None]:
    try:
        yield
    except (LaspyException, lazrs.LazrsError, ValueError, struct.error, EOFError) as error:
        text = " ".join(str(error).split())[:120]
        raise InputError(f"{path} is damaged or cut off ({text}); copy or export it again.") from error

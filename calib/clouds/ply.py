"""PLY: header, and the vertices in pieces; binary (both byte orders) or text.

The vertices must come first and have no lists, as all programs write clouds and meshes. What follows them
(a mesh's faces) is copied as it is. No library: the common one is GPL, and this is a header and an array.
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from calib.camera import FloatArray
from calib.clouds.kinds import CloudFile, Kind, coarse_float32
from calib.errors import InputError
from calib.files import output_errors
from calib.similarity import Similarity

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_LONGEST_HEADER = 100_000
_AXES, _NORMALS = ("x", "y", "z"), ("nx", "ny", "nz")


@dataclass(frozen=True)
class _Header:
    """``start``: the byte after the header; ``dtype``: of one vertex; ``order``: "<", ">" or "" for text."""

    start: int
    count: int
    dtype: np.dtype[Any]
    order: str


def describe(path: Path) -> CloudFile:
    header = _header(path)
    if header.count == 0:
        raise InputError(f"{path} holds no points.")
    if header.order:
        there = (path.stat().st_size - header.start) // header.dtype.itemsize
        if there < header.count:
            raise _cut_off(path, there, header.count)
    note = None
    if header.dtype["x"].itemsize <= 4:
        first = next(chunks(CloudFile(path, Kind.PLY, None, header.count), 1))[0]
        note = coarse_float32(first) if np.isfinite(first).all() else None
    return CloudFile(path, Kind.PLY, None, header.count, () if note is None else (note,))


def chunks(cloud: CloudFile, size: int) -> Iterator[FloatArray]:
    header = _header(cloud.path)
    with cloud.path.open("rb") as file:
        file.seek(header.start)
        for vertices in _vertices(cloud.path, file, header, size):
            yield _stacked(vertices, _AXES)


def rewrite(cloud: CloudFile, out: Path, moved: Similarity, size: int) -> None:
    """The file again with its vertices moved and their normals turned."""
    header = _header(cloud.path)
    names = header.dtype.names or ()
    with cloud.path.open("rb") as source, output_errors(out), out.open("wb") as file:
        file.write(source.read(header.start))
        for vertices in _vertices(cloud.path, source, header, size):
            new = vertices.copy()
            for axis, values in zip(_AXES, moved.apply(_stacked(vertices, _AXES)).T, strict=True):
                new[axis] = values
            if set(_NORMALS) <= set(names):
                turned = _stacked(vertices, _NORMALS) @ moved.rotation.T
                for axis, values in zip(_NORMALS, turned.T, strict=True):
                    new[axis] = values
            if header.order:
                file.write(new.tobytes())
            else:
                rows = map(" ".join, zip(*(_texts(new[name]) for name in names), strict=True))
                file.write(("\n".join(rows) + "\n").encode("ascii"))
        shutil.copyfileobj(source, file)


def _texts(values: NDArray[Any]) -> list[str]:
    if values.dtype.kind != "f":
        return [str(value) for value in values.tolist()]
    digits = 9 if values.dtype.itemsize <= 4 else 15
    return [f"{value:.{digits}g}" for value in values.tolist()]


def _stacked(vertices: NDArray[Any], names: tuple[str, ...]) -> FloatArray:
    return np.column_stack([vertices[name].astype(float) for name in names])


def _vertices(path: Path, file: BinaryIO, header: _Header, size: int) -> Iterator[NDArray[Any]]:
    for done in range(0, header.count, size):
        n = min(size, header.count - done)
        if header.order:
            data = file.read(n * header.dtype.itemsize)
            if len(data) < n * header.dtype.itemsize:
                raise _cut_off(path, done + len(data) // header.dtype.itemsize, header.count)
            yield np.frombuffer(data, header.dtype)
            continue
        lines = [line for line in (file.readline() for _ in range(n)) if line.strip()]
        if len(lines) < n:
            raise _cut_off(path, done + len(lines), header.count)
        try:
            yield np.loadtxt(io.BytesIO(b"".join(lines)), dtype=header.dtype, ndmin=1)
        except ValueError as error:
            raise InputError(f"{path} has a vertex that is no row of numbers; export it again.") from error


def _header(path: Path) -> _Header:
    with path.open("rb") as file:
        text = file.read(_LONGEST_HEADER)
    end = text.find(b"end_header")
    stop = text.find(b"\n", end)
    if end < 0 or stop < 0:
        raise InputError(f"{path} is cut off within its header; copy or export it again.")
    order: str | None = None
    count: int | None = None
    fields: list[tuple[str, str]] = []
    for line in text[:end].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            order = _ORDERS.get(words[1] if len(words) > 1 else "")
        elif words[:1] == ["element"]:
            if count is not None:
                break  # What comes after the vertices is not read.
            if words[1:2] != ["vertex"] or len(words) < 3 or not words[2].isdigit():
                raise InputError(f"{path} does not begin with vertices; save it as a plain PLY cloud.")
            count = int(words[2])
        elif words[:1] == ["property"] and count is not None:
            if len(words) != 3 or words[1] not in _TYPES:
                raise InputError(
                    f"{path} has vertices with lists or unknown types; save it as a plain cloud."
                )
            fields.append((words[2], (order or "") + _TYPES[words[1]]))
    names = [name for name, _ in fields]
    if order is None or count is None or not set(_AXES) <= set(names) or len(set(names)) < len(names):
        raise InputError(f"{path} is no PLY file with vertices x, y, z.")
    return _Header(stop + 1, count, np.dtype(fields), order)


def _cut_off(path: Path, there: int, count: int) -> InputError:
    return InputError(f"{path} is cut off: {there} of {count} points are there; copy or export it again.")

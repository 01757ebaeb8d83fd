"""Points as text: x y z first in every line, or named by a header; comma, semicolon, tab or blanks between.

Lines that start with # or // are passed over, and a first line with a number of points.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.camera import FloatArray
from calib.clouds.kinds import CloudFile, Kind
from calib.control_files import AXIS_NAMES
from calib.errors import InputError
from calib.files import is_number, output_errors
from calib.similarity import Similarity

_COMMENTS = ("#", "//")
#: Bytes of a piece for each point that is asked for.
_BYTES_A_POINT = 40
_BLANKS = bytes.maketrans(b",;\t\r", b"    ")


@dataclass(frozen=True)
class _Layout:
    """``skip``: lines before the first point; ``columns``: those of x, y, z; ``delimiter`` None: blanks."""

    skip: int
    columns: tuple[int, int, int]
    delimiter: str | None


def describe(path: Path) -> CloudFile:
    _layout(path)
    return CloudFile(path, Kind.XYZ)


def chunks(cloud: CloudFile, size: int) -> Iterator[FloatArray]:
    layout = _layout(cloud.path)
    for number, block in _blocks(cloud.path, layout, size):
        yield _parsed(cloud.path, layout, number, block)


def rewrite(cloud: CloudFile, out: Path, moved: Similarity, size: int) -> None:
    """The file again with x, y, z moved; header, comments and other columns stay as they are."""
    layout = _layout(cloud.path)
    between = layout.delimiter or " "
    with output_errors(out), out.open("wb") as file:
        with cloud.path.open("rb") as source:
            for _ in range(layout.skip):
                file.write(source.readline())
        for number, block in _blocks(cloud.path, layout, size):
            found = iter(moved.apply(_parsed(cloud.path, layout, number, block)).tolist())
            lines = []
            for line in block.decode("utf-8", "replace").splitlines():
                text = line.strip()
                if text and not text.startswith(_COMMENTS):
                    cells = line.split(layout.delimiter)
                    for column, value in zip(layout.columns, next(found), strict=True):
                        cells[column] = f"{value:.4f}"
                    line = between.join(cells)
                lines.append(line)
            file.write(("\n".join(lines) + "\n").encode("utf-8"))


def _layout(path: Path) -> _Layout:
    with path.open("rb") as file:
        for number in range(1000):
            raw = file.readline(10_000)
            if not raw:
                break
            line = raw.decode("utf-8-sig" if number == 0 else "utf-8", "replace").strip()
            if not line or line.startswith(_COMMENTS):
                named = _named(path, line.lstrip("#/ "), number)
                if named is not None:
                    return named
                continue
            cells = [cell for cell in re.split(r"[,;\t ]+", line) if cell]
            if all(is_number(cell) for cell in cells[:3]):
                if len(cells) < 3:
                    if len(cells) == 1 and cells[0].isdigit():
                        continue  # The number of points, as PTS files have it.
                    raise InputError(f"{path}, line {number + 1}: x, y and z are expected in every line.")
                return _Layout(number, (0, 1, 2), _delimiter(line))
            named = _named(path, line, number)
            if named is None:
                break
            return named
        else:
            raise InputError(f"{path} holds no points in its first 1000 lines.")
    raise InputError(
        f"{path} is not a point cloud that fieldcal reads (LAS, LAZ, PLY, GeoTIFF, or text with x y z)."
    )


def _named(path: Path, line: str, number: int) -> _Layout | None:
    """The layout that a header names, None where the line is no header."""
    delimiter = _delimiter(line)
    cells = [cell.strip().strip('"').lower() for cell in line.split(delimiter)]
    found = [next((cells.index(name) for name in names if name in cells), None) for names in AXIS_NAMES]
    x, y, z = found
    if x is None or y is None or z is None:
        return None
    with path.open("rb") as file:
        after = [file.readline(10_000).decode("utf-8", "replace").strip() for _ in range(number + 100)]
    first = next((row for row in after[number + 1 :] if row and not row.startswith(_COMMENTS)), "")
    return _Layout(number + 1, (x, y, z), _delimiter(first))


def _delimiter(line: str) -> str | None:
    return next((mark for mark in (";", ",", "\t") if mark in line), None)


def _blocks(path: Path, layout: _Layout, size: int) -> Iterator[tuple[int, bytes]]:
    """Whole lines after the header, many at a time, with the number of the first."""
    with path.open("rb") as file:
        for _ in range(layout.skip):
            file.readline()
        number = layout.skip + 1
        while block := file.read(size * _BYTES_A_POINT):
            block += file.readline()
            yield number, block
            number += block.count(b"\n")


def _parsed(path: Path, layout: _Layout, number: int, block: bytes) -> FloatArray:
    plain = _plain_numbers(block, layout)
    if plain is not None:
        return plain
    try:
        return np.loadtxt(
            io.BytesIO(block), comments=_COMMENTS, delimiter=layout.delimiter, usecols=layout.columns, ndmin=2
        )
    except (ValueError, IndexError) as error:
        row = re.search(r"row (\d+)", str(error))
        where = f", about line {number + int(row[1])}" if row else ""
        raise InputError(f"{path}{where}: x, y and z are expected as numbers in every line.") from error


def _plain_numbers(block: bytes, layout: _Layout) -> FloatArray | None:
    """The points where the block is numbers and nothing else, ten times as fast; None where it is not."""
    first = block[: block.find(b"\n")].split(None if layout.delimiter is None else layout.delimiter.encode())
    width, rows = len(first), block.count(b"\n") + (not block.endswith(b"\n"))
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # What numpy says of text between the numbers.
        try:
            numbers = np.fromstring(block.translate(_BLANKS), sep=" ")
        except (DeprecationWarning, ValueError):
            return None
    if numbers.size != rows * width:
        return None
    return np.asarray(numbers.reshape(rows, width)[:, layout.columns])

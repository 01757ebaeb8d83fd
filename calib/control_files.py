"""Control and check points, and the marks of them in photos: files read strictly, in one sentence each.

Points: CSV, or Pix4D's without a header. Marks: the same, OpenDroneMap's ``gcp_list.txt``, Metashape's
exported markers (XML); the last two bring the points' coordinates along. Pixels count from the corner
of the first pixel, as everywhere.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath

from defusedxml.common import DefusedXmlException  # type: ignore[import-untyped]
from defusedxml.ElementTree import ParseError, fromstring  # type: ignore[import-untyped]

from calib.errors import FormatError
from calib.files import is_number

_LARGEST_BYTES = 50_000_000
_NAMES = ("name", "label", "point", "id", "target", "marker")
#: Names of the columns x, y and z in tables of points.
AXIS_NAMES = (
    ("x", "east", "easting", "e", "x_m", "longitude", "lon"),
    ("y", "north", "northing", "n", "y_m", "latitude", "lat"),
    ("z", "height", "up", "h", "z_m", "elevation", "altitude"),
)
_SIGMAS = (("sigma_x_m", "sx", "sigma_xy_m"), ("sigma_y_m", "sy", "sigma_xy_m"), ("sigma_z_m", "sz"))
_PHOTOS = ("photo", "image", "file", "filename", "image_name")
#: Columns of Pix4D's files, which name none.
_PIX4D_POINTS = ("name", "x", "y", "z", "sigma_xy_m", "sigma_z_m")
_PIX4D_MARKS = ("photo", "point", "u_px", "v_px", "precision", "zoom")
_OTHER_PROGRAMS = (
    " Image measurements of VMS and Australis have no published layout and are not read; save them as CSV "
    "with the columns photo,point,u_px,v_px, in pixels from the picture's upper left corner."
)
_U, _V = ("u", "u_px", "px", "column", "x_px", "im_x"), ("v", "v_px", "py", "row", "y_px", "im_y")


@dataclass(frozen=True)
class ControlPoint:
    """A surveyed point in a right-handed frame, metres. ``sigmas_m`` (x, y, z): None where not stated."""

    name: str
    xyz_m: tuple[float, float, float]
    sigmas_m: tuple[float, float, float] | None = None
    check: bool = False


@dataclass(frozen=True)
class Mark:
    """Where a point was marked in a photo, px; ``photo`` is the file's name without folders."""

    photo: str
    point: str
    u_px: float
    v_px: float


@dataclass(frozen=True)
class Marks:
    """All marks of a file, and the points that it brings along (empty: none)."""

    marks: tuple[Mark, ...]
    points: tuple[ControlPoint, ...]
    source: str


def read_points(path: Path, degrees: bool = False) -> tuple[ControlPoint, ...]:
    """Points from a CSV with a header: name, x, y, z, and where known sigma_x_m, sigma_y_m, sigma_z_m
    (or sigma_m) and role (control or check); or as Pix4D writes them, without a header. ``degrees``: x and y
    may be longitude and latitude.

    Raises:
        FormatError: the file cannot be read or used; one sentence.
    """
    rows, columns = _table(path, _PIX4D_POINTS)
    name = _column(path, columns, _NAMES, "name")
    axes = [_column(path, columns, wanted, wanted[0]) for wanted in AXIS_NAMES]
    points: list[ControlPoint] = []
    seen: set[str] = set()
    for number, row in rows:
        label = row[name].strip()
        if not label:
            raise FormatError(f"{path}, line {number}: the point has no name.")
        if label in seen:
            raise FormatError(f"{path}, line {number}: there are two points named {label}.")
        seen.add(label)
        x, y, z = (_number(path, number, row[axis]) for axis in axes)
        points.append(
            ControlPoint(
                label, (x, y, z), _sigmas(path, number, row, columns), _is_check(path, number, row, columns)
            )
        )
    if not points:
        raise FormatError(f"{path} holds no points.")
    if not degrees:
        _check_metres(path, points)
    return tuple(points)


def read_marks(path: Path) -> Marks:
    """Marks from any of the known files, told by their content.

    Raises:
        FormatError: the file cannot be read or used; one sentence.
    """
    text = read_table_text(path)
    if text.lstrip().startswith("<"):
        return _metashape(path, text)
    first = next((line for line in text.splitlines() if line.strip()), "")
    lowered = first.lower()
    if lowered.startswith(("epsg:", "+proj", "wgs84")):
        return _odm(path, text)
    rows, columns = _table(path, _PIX4D_MARKS, _OTHER_PROGRAMS)
    photo = _column(path, columns, _PHOTOS, "photo")
    point = _column(path, columns, _NAMES, "point")
    u, v = _column(path, columns, _U, "u_px"), _column(path, columns, _V, "v_px")
    marks = [
        Mark(base_name(row[photo]), row[point].strip(), _number(path, n, row[u]), _number(path, n, row[v]))
        for n, row in rows
    ]
    return Marks(_unique(path, marks), (), f"{path.name} (CSV)")


def _metashape(path: Path, text: str) -> Marks:
    """Markers as Metashape exports them (File, Export, Export Markers)."""
    try:
        root = fromstring(text, forbid_dtd=True)
    except DefusedXmlException as error:
        raise FormatError(f"{path} contains a document type or entities and is not read.") from error
    except ParseError as error:
        raise FormatError(f"{path} is not valid XML: {error}.") from error
    chunk = root if root.tag == "chunk" else root.find("chunk")
    if chunk is None or chunk.find("markers") is None:
        raise FormatError(f"{path} is not a file of markers as Metashape exports them.")
    cameras = {
        node.get("id"): base_name(node.get("label") or "") for node in chunk.iterfind("cameras/camera")
    }
    labels: dict[str | None, str] = {}
    points: list[ControlPoint] = []
    for node in chunk.iterfind("markers/marker"):
        labels[node.get("id")] = (node.get("label") or "").strip()
        place = node.find("reference")
        if place is not None and all(place.get(axis) for axis in "xyz"):
            x, y, z = (_number(path, None, place.get(axis) or "") for axis in "xyz")
            check = (place.get("enabled") or "true").lower() in ("false", "0")
            points.append(ControlPoint(labels[node.get("id")], (x, y, z), None, check))
    marks = []
    for node in chunk.iterfind("frames/frame/markers/marker"):
        name = labels.get(node.get("marker_id"))
        for spot in node.iterfind("location"):
            photo = cameras.get(spot.get("camera_id"))
            if name is None or photo is None:
                raise FormatError(
                    f"{path}: a mark belongs to a camera or marker that the file does not hold."
                )
            if (spot.get("pinned") or "true").lower() in ("false", "0"):
                continue  # Predicted by the program, not marked by anybody.
            u, v = _number(path, None, spot.get("x") or ""), _number(path, None, spot.get("y") or "")
            marks.append(Mark(photo, name, u, v))
    if points:
        _check_metres(path, points)
    return Marks(_unique(path, marks), tuple(points), f"{path.name} (Metashape)")


def _odm(path: Path, text: str) -> Marks:
    """x y z column row photo [name], with the coordinate system in the first line."""
    marks: list[Mark] = []
    places: dict[str, tuple[float, float, float]] = {}
    lines = [(n, line.split("#")[0].split()) for n, line in enumerate(text.splitlines(), 1)]
    body = [(n, fields) for n, fields in lines if fields][1:]
    for number, fields in body:
        if len(fields) < 6:
            raise FormatError(f"{path}, line {number}: x, y, z, column, row and photo are expected.")
        x, y, z, u, v = (_number(path, number, field) for field in fields[:5])
        name = fields[6] if len(fields) > 6 else f"{x:.3f} {y:.3f} {z:.3f}"
        known = places.setdefault(name, (x, y, z))
        if known != (x, y, z):
            raise FormatError(f"{path}, line {number}: point {name} has two different positions.")
        marks.append(Mark(base_name(fields[5]), name, u, v))
    points = [ControlPoint(name, place) for name, place in places.items()]
    if not points:
        raise FormatError(f"{path} holds no marks.")
    _check_metres(path, points)
    return Marks(_unique(path, marks), tuple(points), f"{path.name} (OpenDroneMap)")


def _check_metres(path: Path, points: list[ControlPoint]) -> None:
    xs, ys = [p.xyz_m[0] for p in points], [p.xyz_m[1] for p in points]
    degrees = all(abs(x) <= 180 for x in xs) and all(abs(y) <= 180 for y in ys)
    tiny = max(max(xs) - min(xs), max(ys) - min(ys)) < 0.05
    if degrees and tiny and len(points) > 2:
        raise FormatError(
            f"The coordinates in {path} look like degrees; give them in metres (UTM or a local frame)."
        )


def _unique(path: Path, marks: list[Mark]) -> tuple[Mark, ...]:
    seen: set[tuple[str, str]] = set()
    for mark in marks:
        key = (mark.photo.lower(), mark.point)
        if key in seen:
            raise FormatError(f"{path}: point {mark.point} is marked twice in {mark.photo}.")
        seen.add(key)
    if not marks:
        raise FormatError(f"{path} holds no marks.")
    return tuple(marks)


def read_table_text(path: Path) -> str:
    """The text of a file of points or marks.

    Raises:
        FormatError: it cannot be read, is no text or far too large; one sentence.
    """
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise FormatError(f"{path} is too large to be a list of points or marks.")
        return path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise FormatError(f"{path} is not a text file.") from error


def _table(
    path: Path, unnamed: tuple[str, ...], hint: str = ""
) -> tuple[list[tuple[int, list[str]]], dict[str, int]]:
    """Rows with their line numbers, and the columns by their lower-case names.

    ``unnamed``: what the columns are where the first line names none, as Pix4D writes them. ``hint`` goes on
    where the file is no table at all.
    """
    text = read_table_text(path)
    first = text.split("\n", 1)[0]
    delimiter = max(",;\t", key=first.count)
    if first.count(delimiter) == 0:
        raise FormatError(f"{path} is not a CSV table: its first line must name the columns.{hint}")
    rows = list(csv.reader(io.StringIO(text), delimiter=delimiter))
    named = not any(map(is_number, rows[0][1:]))
    header = rows[0] if named else unnamed[: len(rows[0])]
    columns = {cell.strip().lstrip("#").strip().lower(): i for i, cell in enumerate(header)}
    body = []
    for number, row in enumerate(rows[1:] if named else rows, 2 if named else 1):
        if not any(cell.strip() for cell in row) or row[0].lstrip().startswith("#"):
            continue
        if len(row) < len(rows[0]):
            raise FormatError(
                f"{path}, line {number}: {len(rows[0])} columns are expected, {len(row)} found."
            )
        body.append((number, row))
    return body, columns


def _column(path: Path, columns: dict[str, int], wanted: tuple[str, ...], said: str) -> int:
    for name in wanted:
        if name in columns:
            return columns[name]
    raise FormatError(f"{path} has no column {said}; its columns are {', '.join(columns) or 'none'}.")


def _number(path: Path, line: int | None, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        where = f"{path}" + (f", line {line}" if line is not None else "")
        raise FormatError(f"{where}: {text.strip() or 'an empty cell'} is not a number.")
    return value


def _sigmas(
    path: Path, number: int, row: list[str], columns: dict[str, int]
) -> tuple[float, float, float] | None:
    values = []
    for names in _SIGMAS:
        index = next((columns[n] for n in (*names, "sigma_m") if n in columns), None)
        if index is None or not row[index].strip():
            return None
        value = _number(path, number, row[index])
        if value < 0:
            raise FormatError(f"{path}, line {number}: a standard deviation cannot be negative.")
        values.append(value)
    return values[0], values[1], values[2]


def _is_check(path: Path, number: int, row: list[str], columns: dict[str, int]) -> bool:
    if "role" not in columns:
        return False
    role = row[columns["role"]].strip().lower()
    if role not in ("", "control", "check"):
        raise FormatError(f"{path}, line {number}: the role is control or check, not {role}.")
    return role == "check"


def base_name(name: str) -> str:
    """A file's name without its folders, whichever system wrote them."""
    return PureWindowsPath(PurePosixPath(name.strip()).name).name

"""Polygons out of files: KML, KMZ, GeoJSON, WKT; the GIS formats are in ``area_gis``.

Every reader returns geometries in WGS84 degrees (x longitude) and refuses with one sentence.
Files come from anywhere: XML without entities, zip members that stay inside, sizes bounded.
"""

from __future__ import annotations

import json
import re
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree.ElementTree import Element, ParseError

import shapely
from defusedxml import DefusedXmlException  # type: ignore[import-untyped]
from defusedxml.ElementTree import fromstring  # type: ignore[import-untyped]
from shapely import Polygon
from shapely.geometry import shape
from shapely.geometry.base import BaseGeometry

from calib.errors import InputError
from mission.area_gis import projected_to_degrees, read_geopackage, read_shapefile

MOST_BYTES = 50_000_000


def read_wkt(text: str, source: str) -> list[BaseGeometry]:
    """WKT or EWKT (``SRID=4326;POLYGON(...)``), longitude first.

    Raises:
        InputError: not WKT, unknown SRID.
    """
    found = re.fullmatch(r"\s*(?:SRID=(\d+)\s*;)?(.*)", text, re.IGNORECASE | re.DOTALL)
    assert found is not None
    try:
        geometry = shapely.from_wkt(found[2].strip())
    except shapely.errors.ShapelyError as error:
        reason = str(error).partition(":")[2].strip() or str(error)
        raise InputError(f"The WKT of {source} cannot be read: {reason}.") from error
    if found[1] is None:
        return [geometry]
    return projected_to_degrees([geometry], f"EPSG:{found[1]}", source)


def _read_wkt_file(path: Path) -> list[BaseGeometry]:
    return read_wkt(_text(path), str(path))


def _read_kml(path: Path) -> list[BaseGeometry]:
    return kml_polygons(_bytes(path), str(path))


def _read_kmz(path: Path) -> list[BaseGeometry]:
    """The ``doc.kml`` of a KMZ, or its first .kml."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            for member in members:
                name = PurePosixPath(member.filename.replace("\\", "/"))
                if name.is_absolute() or ".." in name.parts or ":" in member.filename:
                    raise InputError(
                        f"{path} is refused: its member {member.filename} points out of its folder."
                    )
            kml = [m for m in members if m.filename.lower().endswith(".kml")]
            if not kml:
                raise InputError(f"{path} is no KMZ: there is no .kml file in it.")
            chosen = next((m for m in kml if m.filename.lower() == "doc.kml"), kml[0])
            with archive.open(chosen) as member_file:
                data = member_file.read(MOST_BYTES + 1)
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError) as error:
        raise InputError(f"{path} is no KMZ: it cannot be opened as a zip file.") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from error
    if len(data) > MOST_BYTES:
        raise InputError(
            f"{path} is refused: {chosen.filename} in it is larger than {MOST_BYTES // 10**6} MB."
        )
    return kml_polygons(data, str(path))


def kml_polygons(data: bytes, source: str) -> list[BaseGeometry]:
    """All polygons of a KML document.

    Raises:
        InputError: not XML, entities, no polygon, corners that are no numbers.
    """
    try:
        root = fromstring(data, forbid_dtd=True)
    except DefusedXmlException as error:
        raise InputError(f"{source} is refused: it declares XML entities, which no map needs.") from error
    except (ParseError, ValueError, LookupError) as error:
        raise InputError(f"{source} is no KML: {error}.") from error
    polygons: list[BaseGeometry] = [
        Polygon(outer[0], _rings(element, "innerBoundaryIs", source))
        for element in _named(root, "Polygon")
        if (outer := _rings(element, "outerBoundaryIs", source))
    ]
    if not polygons:
        lines = any(True for _ in _named(root, "LineString"))
        what = "only lines; draw the area as a polygon" if lines else "no polygon"
        raise InputError(f"{source} holds {what}.")
    return polygons


def _named(root: Element, name: str) -> Iterator[Element]:
    return (element for element in root.iter() if str(element.tag).rpartition("}")[2] == name)


def _rings(polygon: Element, boundary: str, source: str) -> list[list[tuple[float, float]]]:
    rings = []
    for element in _named(polygon, boundary):
        for coordinates in _named(element, "coordinates"):
            try:
                corners = [
                    (float(c[0]), float(c[1]))
                    for c in (
                        word.split(",") for word in re.sub(r"\s*,\s*", ",", coordinates.text or "").split()
                    )
                ]
            except (ValueError, IndexError) as error:
                raise InputError(f"A polygon in {source} has corners that are no numbers.") from error
            if corners:
                if len(corners) < 3:
                    raise InputError(f"A polygon in {source} has {len(corners)} corners; it needs three.")
                rings.append(corners)
    return rings


def _read_geojson(path: Path) -> list[BaseGeometry]:
    """Any GeoJSON object; the ``crs`` of older files is honoured."""
    try:
        data = json.loads(_text(path))
        if not isinstance(data, dict):
            raise ValueError("no object")
        geometries = [shape(g) for g in _geometries(data)]
        crs = data.get("crs")
        name = crs.get("properties", {}).get("name") if isinstance(crs, dict) else None
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError) as error:
        raise InputError(f"{path} is no GeoJSON that can be read ({type(error).__name__}).") from error
    except shapely.errors.ShapelyError as error:
        raise InputError(f"{path} holds a geometry that cannot be read: {error}.") from error
    return projected_to_degrees(geometries, str(name), str(path)) if name else geometries


def _geometries(data: dict[str, Any]) -> Iterator[dict[str, Any]]:
    kind = data.get("type")
    if kind == "FeatureCollection":
        for feature in data["features"]:
            yield from _geometries(feature)
    elif kind == "Feature":
        if data.get("geometry") is not None:
            yield from _geometries(data["geometry"])
    elif kind == "GeometryCollection":
        for geometry in data["geometries"]:
            yield from _geometries(geometry)
    elif kind in ("Polygon", "MultiPolygon"):
        yield data


def _bytes(path: Path) -> bytes:
    try:
        if path.stat().st_size > MOST_BYTES:
            raise InputError(
                f"{path} is larger than {MOST_BYTES // 10**6} MB; that is no outline of an area."
            )
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error


def _text(path: Path) -> str:
    try:
        return _bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not a text file in UTF-8.") from error


#: Reader by suffix.
FILE_READERS: dict[str, Callable[[Path], list[BaseGeometry]]] = {
    ".kml": _read_kml,
    ".kmz": _read_kmz,
    ".geojson": _read_geojson,
    ".json": _read_geojson,
    ".gpkg": read_geopackage,
    ".shp": read_shapefile,
    ".wkt": _read_wkt_file,
}

"""Polygons out of GeoPackages and shapefiles, and out of any projection into WGS84 degrees."""

from __future__ import annotations

import contextlib
import sqlite3
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapefile
import shapely
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from shapely.geometry import shape
from shapely.geometry.base import BaseGeometry

from calib.camera import FloatArray
from calib.errors import InputError

#: Geometries read at most: an area is one polygon.
MOST_GEOMETRIES = 1000
#: Bytes of the envelope in a GeoPackage blob by its code.
_ENVELOPE_BYTES = {0: 0, 1: 32, 2: 48, 3: 48, 4: 64}


def projected_to_degrees(
    geometries: Sequence[BaseGeometry], crs: str | int | CRS, source: str
) -> list[BaseGeometry]:
    """Geometries in the projection ``crs`` (WKT, EPSG code, URN) -> WGS84, longitude first.

    Raises:
        InputError: a projection that is not known or not tied to the Earth.
    """
    try:
        known = CRS.from_user_input(crs)
        if known.is_engineering:
            raise ProjError("a local grid")
        transformer = Transformer.from_crs(known, "EPSG:4326", always_xy=True)
    except ProjError as error:
        raise InputError(
            f"The projection of {source} is not known to fieldcal; save it again as WGS84 longitude "
            "and latitude."
        ) from error

    def move(xy: FloatArray) -> FloatArray:
        return np.stack(transformer.transform(xy[:, 0], xy[:, 1]), axis=-1)

    moved = [shapely.transform(shapely.force_2d(g), move) for g in geometries]
    if not all(np.isfinite(shapely.get_coordinates(g)).all() for g in moved):
        raise InputError(f"{source} has corners where its projection is not defined.")
    return moved


def read_shapefile(path: Path) -> list[BaseGeometry]:
    """Polygons of a shapefile; its .prj must be there.

    Raises:
        InputError: damaged, no .prj, unknown projection.
    """
    prj = next((p for p in (path.with_suffix(s) for s in (".prj", ".PRJ")) if p.is_file()), None)
    if prj is None:
        raise InputError(f"The projection of {path} is not known: there is no {path.stem}.prj beside it.")
    try:
        # pyshp wants a seekable .shp and looks for the others by name.
        with shapefile.Reader(str(path)) as reader:
            kinds = (shapefile.POLYGON, shapefile.POLYGONZ, shapefile.POLYGONM)
            shapes = reader.shapes() if reader.shapeType in kinds else []
            geometries = [shape(s.__geo_interface__) for s in shapes[:MOST_GEOMETRIES] if s.points]
        wkt = prj.read_text(encoding="utf-8", errors="replace")
    except (shapefile.ShapefileException, struct.error, ValueError, IndexError, KeyError, EOFError) as error:
        raise InputError(f"{path} is no shapefile that can be read ({type(error).__name__}).") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from error
    return projected_to_degrees(geometries, wkt, str(path))


def read_geopackage(path: Path) -> list[BaseGeometry]:
    """Polygons of all feature layers of a GeoPackage.

    Raises:
        InputError: no GeoPackage, unknown projection.
    """
    found: list[BaseGeometry] = []
    try:
        uri = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
        with contextlib.closing(sqlite3.connect(uri, uri=True)) as base:
            layers = base.execute(
                "SELECT g.table_name, g.column_name, s.organization, s.organization_coordsys_id, "
                "s.definition "
                "FROM gpkg_geometry_columns g JOIN gpkg_spatial_ref_sys s ON s.srs_id = g.srs_id"
            ).fetchall()
            for table, column, organization, code, definition in layers:
                rows = base.execute(
                    f"SELECT {_quoted(column)} FROM {_quoted(table)} WHERE {_quoted(column)} IS NOT NULL "
                    f"LIMIT {MOST_GEOMETRIES}"
                )
                geometries = [g for (blob,) in rows if "Polygon" in (g := _from_blob(blob)).geom_type]
                if geometries:
                    found += projected_to_degrees(geometries, _crs(organization, code, definition), str(path))
    except (sqlite3.Error, ValueError, TypeError, struct.error, shapely.errors.ShapelyError) as error:
        raise InputError(f"{path} is no GeoPackage that can be read: {error}.") from error
    return found


def _crs(organization: Any, code: Any, definition: Any) -> str:
    if str(organization).upper() == "EPSG" and int(code) > 0:
        return f"EPSG:{code}"
    return str(definition)


def _quoted(name: object) -> str:
    return '"' + str(name).replace('"', '""') + '"'


def _from_blob(blob: bytes) -> BaseGeometry:
    """A GeoPackage geometry: a header of 8 bytes, an envelope, then WKB."""
    if not isinstance(blob, bytes) or blob[:2] != b"GP" or len(blob) < 8:
        raise ValueError("a geometry does not begin with GP")
    start = 8 + _ENVELOPE_BYTES.get((blob[3] >> 1) & 7, 0)
    geometry: BaseGeometry = shapely.from_wkb(blob[start:])
    return geometry

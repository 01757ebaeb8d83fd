"""Areas and terrain from files: every format, every hemisphere, every mistake in one sentence."""

from __future__ import annotations

import json
import math
import sqlite3
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import rasterio
import shapefile
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS, Transformer
from rasterio.transform import from_bounds, from_origin

from calib.errors import InputError
from calib.frames import LocalFrame
from mission.area import load_area
from mission.site_file import read_site_file
from mission.terrain import DemTerrain, load_terrain, profile_m

CORNERS = [(9.0, 48.0), (9.002, 48.0), (9.002, 48.001), (9.0, 48.001)]
HOLE = [(9.0005, 48.0003), (9.001, 48.0003), (9.001, 48.0006)]
SIZE_M = (149.2, 111.2)  # 0.002 x 0.001 degrees there


def _kml(corners: list[tuple[float, float]], hole: list[tuple[float, float]] | None = None) -> str:
    def ring(points: list[tuple[float, float]]) -> str:
        text = " ".join(f"{x},{y},0" for x, y in [*points, points[0]])
        return f"<LinearRing><coordinates>\n{text}\n</coordinates></LinearRing>"

    inner = "" if hole is None else f"<innerBoundaryIs>{ring(hole)}</innerBoundaryIs>"
    return (
        '<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark><Polygon>'
        f"<outerBoundaryIs>{ring(corners)}</outerBoundaryIs>{inner}</Polygon></Placemark></Document></kml>"
    )


def _write(folder: Path, kind: str) -> Path:
    path = folder / f"area{kind}"
    utm = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    projected = [utm.transform(x, y) for x, y in CORNERS]
    polygon = shapely.Polygon(projected)
    if kind == ".kml":
        path.write_text(_kml(CORNERS, HOLE))
    elif kind == ".kmz":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("files/photo.jpg", b"")
            archive.writestr("doc.kml", _kml(CORNERS, HOLE))
    elif kind == ".geojson":
        geometry = {"type": "Polygon", "coordinates": [[*CORNERS, CORNERS[0]]]}
        feature = {"type": "Feature", "properties": {}, "geometry": geometry}
        path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    elif kind == ".shp":
        with shapefile.Writer(str(path)) as writer:
            writer.field("name", "C")
            writer.poly([[list(p) for p in projected]])
            writer.record("field")
        path.with_suffix(".prj").write_text(CRS.from_epsg(32632).to_wkt("WKT1_ESRI"))
    elif kind == ".gpkg":
        _geopackage(path, polygon)
    else:
        path.write_text(shapely.Polygon(CORNERS).wkt)
    return path


def _geopackage(path: Path, polygon: shapely.Polygon) -> None:
    blob = b"GP" + bytes([0, 1]) + struct.pack("<i", 32632) + shapely.to_wkb(polygon)
    with sqlite3.connect(path) as base:
        base.executescript(
            "CREATE TABLE gpkg_spatial_ref_sys (srs_name, srs_id, organization, organization_coordsys_id,"
            " definition); CREATE TABLE gpkg_geometry_columns (table_name, column_name, geometry_type_name,"
            " srs_id, z, m); CREATE TABLE field (fid INTEGER PRIMARY KEY, geom BLOB);"
        )
        base.execute("INSERT INTO gpkg_spatial_ref_sys VALUES ('UTM', 32632, 'EPSG', 32632, '')")
        base.execute("INSERT INTO gpkg_geometry_columns VALUES ('field', 'geom', 'POLYGON', 32632, 0, 0)")
        base.execute("INSERT INTO field (geom) VALUES (?)", (blob,))
    base.close()


@pytest.mark.parametrize("kind", [".kml", ".kmz", ".geojson", ".shp", ".gpkg", ".wkt"])
def test_every_format_gives_the_same_area(tmp_path: Path, kind: str) -> None:
    area = load_area(str(_write(tmp_path, kind)))
    latitude, longitude = area.middle
    assert latitude == pytest.approx(48.0005, abs=1e-4)
    assert longitude == pytest.approx(9.001, abs=1e-4)
    west, south, east, north = area.local(LocalFrame(latitude, longitude)).bounds
    assert east - west == pytest.approx(SIZE_M[0], abs=0.2)
    assert north - south == pytest.approx(SIZE_M[1], abs=0.2)
    assert len(area.polygon.interiors) == (1 if kind in (".kml", ".kmz") else 0)


@settings(deadline=None, max_examples=60)
@given(
    latitude=st.floats(-88.5, 88.5), longitude=st.floats(-180, 180), radius=st.floats(5, 2500)
)  # fmt: skip
def test_circles_anywhere_on_earth(latitude: float, longitude: float, radius: float) -> None:
    """Date line, high latitudes, the south: a circle of the asked size around the asked place."""
    area = load_area(f"{latitude!r},{longitude!r},{radius!r}")
    local = area.local(LocalFrame(latitude, longitude))
    edge = np.hypot(*np.asarray(local.exterior.coords).T)
    assert edge.min() > radius * (1 - 1e-3)
    assert edge.max() < radius * 1.01 / math.cos(math.pi / 64)
    assert local.area > math.pi * radius**2 * (1 - 1e-4)


def test_an_area_split_at_the_date_line_is_one() -> None:
    west = "((179.999 -17, 180 -17, 180 -16.999, 179.999 -16.999, 179.999 -17))"
    east = "((-180 -17, -179.999 -17, -179.999 -16.999, -180 -16.999, -180 -17))"
    area = load_area(f"MULTIPOLYGON({west},{east})")
    local = area.local(LocalFrame(*area.middle))
    assert local.area == pytest.approx(213 * 110.65, rel=0.01)
    assert abs(area.middle[1]) == pytest.approx(180, abs=1e-6)


def _bad_files(folder: Path) -> dict[str, tuple[str, str]]:
    """Name -> (what is given, words that the sentence must have)."""
    files: dict[str, tuple[str | bytes, str]] = {
        "empty.kml": ("<kml/>", "no polygon"),
        "nothing.kml": ("", "is no KML"),
        "lines.kml": ("<kml><LineString><coordinates>1,2 3,4</coordinates></LineString></kml>", "only lines"),
        "words.kml": (_kml(CORNERS).replace("48.001", "north"), "no numbers"),
        "entity.kml": ('<!DOCTYPE k [<!ENTITY a "b">]><kml>&a;</kml>', "XML entities"),
        "bowtie.kml": (_kml([(9, 48), (9.01, 48.01), (9.01, 48), (9, 48.01)]), "crosses itself at 48.005"),
        "swapped.kml": (_kml([(48.0, 139.0), (48.1, 139.0), (48.1, 139.1)]), "swapped"),
        "huge.kml": (_kml([(9, 48), (12, 48), (12, 50)]), "km across"),
        "pole.kml": (_kml([(0, 89.5), (90, 89.6), (180, 89.5)]), "pole"),
        "point.kml": (_kml([(9, 48), (9, 48), (9, 48)]), "proper polygon"),
        "no.kmz": ("not a zip", "is no KMZ"),
        "text.geojson": ("{", "is no GeoJSON"),
        "list.geojson": ("[]", "is no GeoJSON"),
        "points.geojson": ('{"type": "Point", "coordinates": [1, 2]}', "no polygon"),
        "crs.geojson": (
            '{"type":"Polygon","coordinates":[[[0,0],[9,0],[9,9],[0,0]]],'
            '"crs":{"properties":{"name":"EPSG:999999"}}}',
            "projection",
        ),
        "latin.geojson": (b"\xff\xfe{}", "UTF-8"),
        "bad.gpkg": ("nonsense", "is no GeoPackage"),
        "text.wkt": ("POLYGON((0 0, 1", "WKT"),
        "two.wkt": (
            "MULTIPOLYGON(((0 0,.001 0,0 .001,0 0)),((1 1,1.001 1,1 1.001,1 1)))",
            "2 separate polygons",
        ),
        "area.dwg": ("", "a known kind"),
    }
    for name, (content, _) in files.items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with zipfile.ZipFile(folder / "climb.kmz", "w") as archive:
        archive.writestr("../../doc.kml", _kml(CORNERS))
    with zipfile.ZipFile(folder / "none.kmz", "w") as archive:
        archive.writestr("photo.jpg", "")
    lost = _write(folder, ".shp")
    lost.with_suffix(".prj").unlink()
    found = {str(folder / name): (str(folder / name), words) for name, (_, words) in files.items()}
    found |= {
        name: (str(folder / name), words)
        for name, words in (
            ("climb.kmz", "out of its folder"),
            ("none.kmz", "no .kml"),
            ("area.shp", "there is no area.prj"),
            ("missing.kml", "no file"),
        )
    }
    found |= {text: (text, words) for text, words in (
        ("91,0,50", "latitude of 91"), ("48,9,-5", "radius"), ("48,9,1e9", "radius"), ("here", "neither"),
        ("POLYGON EMPTY", "no polygon"),
    )}  # fmt: skip
    return found


def _located(given_text: str) -> shapely.Polygon:
    area = load_area(given_text)
    return area.local(LocalFrame(*area.middle))


def test_bad_areas_are_refused_in_one_sentence(tmp_path: Path) -> None:
    for given_text, words in _bad_files(tmp_path).values():
        with pytest.raises(InputError) as caught:
            _located(given_text)
        sentence = str(caught.value)
        assert words in sentence, sentence
        assert "\n" not in sentence


def test_an_unknown_projection_is_said(tmp_path: Path) -> None:
    path = _write(tmp_path, ".shp")
    for text in ("nonsense", 'LOCAL_CS["building site",UNIT["metre",1]]'):
        path.with_suffix(".prj").write_text(text)
        with pytest.raises(InputError, match=r"projection of .* is not known"):
            load_area(str(path))


# --- Terrain ---------------------------------------------------------------------------------------


def _slope(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.asarray(200 + 0.1 * (x - 500_000) - 0.05 * (y - 5_300_000))


def _dem(path: Path, hole: bool = False, **profile: object) -> Path:
    size, step = 400, 5.0
    transform = from_origin(499_000, 5_301_000, step, step)
    x = 499_000 + (np.arange(size) + 0.5) * step
    y = 5_301_000 - (np.arange(size) + 0.5) * step
    values = _slope(*np.meshgrid(x, y)).astype(np.float32)
    if hole:
        values[150:160, 200:210] = -9999
    options = {"driver": "GTiff", "dtype": "float32", "count": 1, "width": size, "height": size}
    options |= {"crs": "EPSG:32632", "transform": transform, "nodata": -9999} | profile
    with rasterio.open(path, "w", **options) as file:
        file.write(values, 1)
    return path


def _frame(x: float = 500_100, y: float = 5_300_100) -> LocalFrame:
    longitude, latitude = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True).transform(x, y)
    return LocalFrame(latitude, longitude)


def test_heights_are_those_of_the_model(tmp_path: Path) -> None:
    frame = _frame()
    terrain = load_terrain(_dem(tmp_path / "dem.tif"), frame, (-300, -300, 300, 300))
    east, north = np.array([0.0, 100, -200, 250]), np.array([0.0, 50, 130, -250])
    expected = 0.1 * east - 0.05 * north  # UTM's grid north is within 0.002 degrees of true north here
    assert terrain.height_m(east, north) == pytest.approx(expected, abs=0.1)
    assert terrain.resolution_m == pytest.approx(5.0, rel=0.01)
    assert terrain.altitudes_m.size < 200 * 200, "only the window is read"
    along, ground = profile_m(terrain, np.array([0.0, 0]), np.array([100.0, 0]), 1.0)
    assert len(along) == 101
    assert ground[-1] == pytest.approx(10, abs=0.1)


def test_missing_cover_is_said(tmp_path: Path) -> None:
    frame = _frame(500_025, 5_300_225)
    with pytest.raises(InputError, match="does not cover"):
        load_terrain(_dem(tmp_path / "dem.tif"), LocalFrame(10.0, 10.0), (-100, -100, 100, 100))
    with pytest.raises(InputError, match="no height at the launch point"):
        load_terrain(_dem(tmp_path / "hole.tif", hole=True), frame, (-300, -300, 300, 300))
    terrain = load_terrain(tmp_path / "dem.tif", frame, (-300, -300, 300, 300))
    with pytest.raises(InputError, match=r"has no height at .* 5000 m from the launch"):
        terrain.height_m(np.array([5000.0]), np.array([0.0]))
    with pytest.raises(InputError, match="projection"):
        load_terrain(_dem(tmp_path / "bare.tif", crs=None), frame, (-300, -300, 300, 300))
    (tmp_path / "text.tif").write_text("no raster")
    for name in ("text.tif", "missing.tif"):
        with pytest.raises(InputError, match="terrain model"):
            load_terrain(tmp_path / name, frame, (-300, -300, 300, 300))


def test_srtm_tiles_are_read(tmp_path: Path) -> None:
    rows = np.linspace(1000, 0, 1201)[:, None] + np.zeros(1201)
    (tmp_path / "N48E009.hgt").write_bytes(rows.astype(">i2").tobytes())
    frame = LocalFrame(48.5, 9.5)
    terrain = load_terrain(tmp_path / "N48E009.hgt", frame, (-500, -500, 500, 500))
    assert isinstance(terrain, DemTerrain)
    assert float(terrain.height_m(np.array([0.0]), np.array([400.0]))[0]) == pytest.approx(3.6, abs=0.6)


def test_a_terrain_model_of_ten_gigabytes_is_read_by_window(tmp_path: Path) -> None:
    path = tmp_path / "huge.tif"
    size = 52_000
    with rasterio.open(
        path, "w", driver="GTiff", dtype="float32", count=1, width=size, height=size, crs="EPSG:32632",
        transform=from_bounds(460_000, 5_260_000, 512_000, 5_312_000, size, size), tiled=True,
        SPARSE_OK=True, BIGTIFF="YES",
    ) as file:  # fmt: skip
        block = np.full((2048, 2048), 321.0, dtype=np.float32)
        file.write(block, 1, window=rasterio.windows.Window(39_000, 11_000, 2048, 2048))
        assert 4 * file.width * file.height > 10e9
    terrain = load_terrain(path, _frame(), (-200, -200, 200, 200))
    assert terrain.launch_altitude_m == pytest.approx(321.0)
    assert terrain.altitudes_m.shape[0] < 500


# --- Site files ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("height = 60", "no key height in"),
        ("height_m = -3", "key height_m in"),
        ("height_m = 60\ngsd_cm = 2", "Both height_m and gsd_cm"),
        ("launch = [1]", "key launch.2 is missing"),
        ("launch = [100, 0]", "key launch.1 in"),
        ("side_overlap = 120", "key side_overlap in"),
        ("[vehicle]\nspeed = 3", "no key vehicle.speed in"),
        ("[[fence]]\nkeep = 'near'\noutline = '1,2,3'", "key fence.1.keep in"),
        ("[[structure]]\noutline = '1,2,3'", "key structure.1.height_m is missing"),
        ("height_m =", "is no TOML"),
    ],
)
def test_a_mistake_in_a_site_file_names_key_and_file(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "site.toml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_site_file(path)
    assert words in str(caught.value)
    assert "site.toml" in str(caught.value)
    assert "\n" not in str(caught.value)

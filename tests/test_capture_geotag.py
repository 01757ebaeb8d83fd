"""Geotags in copies and sidecars: read back by ourselves and by exiftool; originals untouched."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from calib.errors import InputError, OutputError
from calib.photos import makers
from calib.photos.photo import AltitudeDatum, GimbalAngles, Position
from calib.photos.read import read_photo
from calib.photos.xmp import parse_packet
from daemon.capture.exif_gps import with_gps
from daemon.capture.geotag import Geotag, write_copy, write_sidecar
from sim.photo_writer import PhotoTags, write_photo

TAG = Geotag(
    Position(-33.8567844, 151.2152967, 61.234, 60.5, 0.8, 1.9, AltitudeDatum.ELLIPSOID),
    GimbalAngles(-170.25, -65.5, 0.75),
    GimbalAngles(12.5, 3.0, -2.0),
)


def photo_file(path: Path, *, dji_xmp: bool) -> Path:
    level = GimbalAngles(5.0, -90.0, 0.0)
    tags = PhotoTags(
        datetime(2026, 5, 1, 10, 0, 3), 10.0, 20.0, 5.0, 4.0, level, level, make="SONY", dji_xmp=dji_xmp
    )
    noise = np.random.default_rng(1).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    write_photo(path, noise, tags)
    return path


def exiftool(path: Path) -> dict[str, object]:
    if shutil.which("exiftool") is None:
        pytest.skip("exiftool")
    done = subprocess.run(["exiftool", "-j", "-n", "-G1", str(path)], capture_output=True, check=True)
    (values,) = json.loads(done.stdout)
    assert isinstance(values, dict)
    assert not [name for name in values if name in ("ExifTool:Warning", "ExifTool:Error")], values
    return values


@pytest.mark.parametrize("dji_xmp", [True, False])
def test_copy_carries_the_tags_and_the_original_stays(tmp_path: Path, dji_xmp: bool) -> None:
    photo = photo_file(tmp_path / "a.jpg", dji_xmp=dji_xmp)
    before = photo.read_bytes()
    (tmp_path / "tagged").mkdir()
    copy = write_copy(photo, tmp_path / "tagged" / "a.jpg", TAG)
    assert photo.read_bytes() == before
    old, new = read_photo(photo), read_photo(copy)
    assert new.position is not None
    assert new.position.latitude_deg == pytest.approx(TAG.position.latitude_deg, abs=1e-8)
    assert new.position.longitude_deg == pytest.approx(TAG.position.longitude_deg, abs=1e-8)
    assert new.position.altitude_m == pytest.approx(61.234, abs=1e-3)
    assert new.position.height_above_launch_m == pytest.approx(60.5)
    assert new.position.sigma_horizontal_m == pytest.approx(0.8)
    assert new.position.sigma_vertical_m == pytest.approx(1.9)
    assert new.position.altitude_datum is AltitudeDatum.ELLIPSOID
    assert new.gimbal == TAG.gimbal
    assert new.aircraft == TAG.aircraft
    assert (new.time, new.camera, new.fingerprint) == (old.time, old.camera, old.fingerprint)
    with Image.open(photo) as one, Image.open(copy) as two:
        assert np.array_equal(np.asarray(one), np.asarray(two))


@pytest.mark.parametrize("dji_xmp", [True, False])
def test_exiftool_agrees(tmp_path: Path, dji_xmp: bool) -> None:
    photo = photo_file(tmp_path / "a.jpg", dji_xmp=dji_xmp)
    for values in (
        exiftool(write_copy(photo, tmp_path / "b.jpg", TAG)),
        exiftool(write_sidecar(photo, TAG)),
    ):
        assert float(str(values["XMP-drone-dji:GimbalPitchDegree"])) == pytest.approx(-65.5)
        assert float(str(values["XMP-exif:GPSLatitude"])) == pytest.approx(-33.8567844, abs=1e-7)
        assert float(str(values["XMP-exif:GPSAltitude"])) == pytest.approx(61.234)
    values = exiftool(tmp_path / "b.jpg")
    assert float(str(values["Composite:GPSLongitude"])) == pytest.approx(151.2152967, abs=1e-7)
    assert values["GPS:GPSHPositioningError"] == pytest.approx(0.8)
    assert values["ExifIFD:ISO"] == 100


def test_sidecar_reads_back(tmp_path: Path) -> None:
    photo = photo_file(tmp_path / "a.jpg", dji_xmp=False)
    before = photo.read_bytes()
    xmp = parse_packet(write_sidecar(photo, TAG).read_bytes())
    assert makers.gimbal_angles(xmp, "SONY", "x") == TAG.gimbal
    assert makers.coordinates(xmp) == pytest.approx((-33.8567844, 151.2152967), abs=1e-8)
    assert photo.read_bytes() == before
    write_sidecar(photo, TAG)  # ours may be replaced


def test_originals_and_foreign_sidecars_are_never_replaced(tmp_path: Path) -> None:
    photo = photo_file(tmp_path / "a.jpg", dji_xmp=False)
    before = photo.read_bytes()
    (tmp_path / "link.jpg").symlink_to(photo)
    (tmp_path / "hard.jpg").hardlink_to(photo)
    for target in (photo, tmp_path / "link.jpg", tmp_path / "hard.jpg"):
        with pytest.raises(OutputError, match="original"):
            write_copy(photo, target, TAG)
    (tmp_path / "a.xmp").write_text("<x:xmpmeta/>")
    with pytest.raises(OutputError, match="another program"):
        write_sidecar(photo, TAG)
    with pytest.raises(OutputError, match="cannot be written"):
        write_copy(photo, tmp_path / "missing" / "a.jpg", TAG)
    assert photo.read_bytes() == before
    assert not list(tmp_path.glob(".*"))


def test_impossible_values_and_damaged_files_are_refused(tmp_path: Path) -> None:
    photo = photo_file(tmp_path / "a.jpg", dji_xmp=False)
    for latitude in (math.nan, 91.0):
        with pytest.raises(InputError):
            write_copy(photo, tmp_path / "b.jpg", Geotag(Position(latitude, 0.0, 1.0)))
    for k in (0, 2, 5, 40):
        (tmp_path / "cut.jpg").write_bytes(photo.read_bytes()[:k])
        with pytest.raises(InputError, match="cannot be tagged"):
            write_copy(tmp_path / "cut.jpg", tmp_path / "b.jpg", TAG)
    assert not (tmp_path / "b.jpg").exists()


@given(st.binary(max_size=80), st.sampled_from([b"II*\x00", b"MM\x00*", b""]))
def test_damaged_exif_is_a_value_error_at_worst(body: bytes, head: bytes) -> None:
    try:
        tagged = with_gps(head + body, TAG.position)
    except ValueError:
        return
    assert tagged[8 : len(head + body)] == (head + body)[8:]

"""Raw counts of thermal photos: FLIR, DJI and 16-bit TIFF; told what was read; damaged and odd files."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
import thermal_files as files
from numpy.typing import NDArray
from PIL import Image

from calib.align.features import extract, photo_gray
from calib.errors import PhotoError
from calib.photos import read_photo, read_photos
from calib.photos.photo import Photo
from calib.photos.radiometric import counts_read, read_counts
from calib.targets import find_targets, tag_detector

WIDTH, HEIGHT = 320, 256


def scene(seed: int, dark: float = 7000.0) -> files.Counts:
    """Counts of a cool scene: 14 bits, of which few are used, some dead and hot pixels."""
    rng = np.random.default_rng(seed)
    small = rng.normal(size=(HEIGHT // 8, WIDTH // 8)).astype(np.float32)
    smooth = cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    counts = dark + 120 * smooth + 3 * rng.normal(size=smooth.shape)
    counts[5, 7], counts[100, 200] = 0, 16383
    return counts.astype(np.uint16)


def picture(counts: files.Counts) -> NDArray[np.uint8]:
    """As the camera shows it: stretched for itself, inverted, with a cross drawn in."""
    own = cv2.normalize(counts.astype(np.float32), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    shown = cv2.applyColorMap(255 - own, cv2.COLORMAP_INFERNO)
    cv2.drawMarker(shown, (WIDTH // 2, HEIGHT // 2), (255, 255, 255), cv2.MARKER_CROSS, 60, 3)
    return np.asarray(shown, np.uint8)


def written(path: Path, data: bytes) -> Photo:
    path.write_bytes(data)
    return read_photo(path)


@pytest.mark.parametrize("png", [False, True])
def test_flir_counts_are_read(tmp_path: Path, png: bool) -> None:
    counts = scene(1)
    photo = written(tmp_path / "a.jpg", files.flir(picture(counts), counts, png=png, field_of_view_deg=45.0))
    assert photo.radiometric is not None
    assert photo.radiometric.kind == "FLIR radiometric JPEG"
    assert np.array_equal(read_counts(photo), counts)
    # Nothing else states the focal length.
    assert photo.focal_px == pytest.approx(WIDTH / 2 / np.tan(np.radians(22.5)))


@pytest.mark.skipif(shutil.which("exiftool") is None, reason="exiftool is not installed")
@pytest.mark.parametrize("png", [False, True])
def test_exiftool_reads_the_same(tmp_path: Path, png: bool) -> None:
    counts = scene(2)
    path = tmp_path / "a.jpg"
    path.write_bytes(files.flir(picture(counts), counts, png=png))
    told = subprocess.run(
        ["exiftool", "-s3", "-RawThermalImageWidth", "-RawThermalImageType", "-FieldOfView", str(path)],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split("\n")
    assert told[:3] == [str(WIDTH), "PNG" if png else "TIFF", "45.0 deg"]
    raw = subprocess.run(["exiftool", "-b", "-RawThermalImage", str(path)], capture_output=True, check=True)
    image = cv2.imdecode(np.frombuffer(raw.stdout, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert np.array_equal(image.byteswap() if png else image, read_counts(read_photo(path)))
    other = tmp_path / "b.jpg"
    other.write_bytes(files.dji(picture(counts), counts.tobytes()))
    raw = subprocess.run(["exiftool", "-b", "-ThermalData", str(other)], capture_output=True, check=True)
    assert raw.stdout == read_counts(read_photo(other)).astype("<u2").tobytes()


def test_a_set_is_stretched_alike_and_told(tmp_path: Path) -> None:
    for i in range(4):
        counts = scene(i, 7000 + 100 * i)
        (tmp_path / f"{i}.jpg").write_bytes(files.dji(picture(counts), counts.tobytes()))
    photos, bad = read_photos(sorted(tmp_path.iterdir()))
    assert not bad
    levels = {p.radiometric.levels for p in photos if p.radiometric is not None}
    assert len(levels) == 1
    (both,) = levels
    assert both is not None
    dark, bright = both
    # Neither the dead nor the hot pixels decide.
    assert 6500 < dark < 6900
    assert 7400 < bright < 7800
    grays = [photo_gray(photo, None)[0] for photo in photos]
    means = [float(g.mean()) for g in grays]
    assert np.all(np.diff(means) > 5)
    assert all(g.dtype == np.uint8 and 30 < g.std() < 80 for g in grays)
    assert photo_gray(photos[0], 160)[0].shape == (128, 160)
    (said,) = counts_read(photos)
    assert "4 photos are DJI R-JPEG: their raw counts are used" in said


def test_the_visible_picture_where_counts_are_none(tmp_path: Path) -> None:
    """Encrypted data, another size of the raw image: said, and the picture taken."""
    counts = scene(3)
    noise = np.random.default_rng(0).bytes(2 * counts.size)
    small = counts[::2, ::2].copy()
    for name, data, why in (
        ("noise", files.dji(picture(counts), noise), "no plain picture"),
        ("short", files.dji(picture(counts), counts.tobytes()[:-40]), "another size"),
        ("small", files.flir(picture(counts), small), r"another size (160 x 128 px)"),
    ):
        (tmp_path / f"{name}.jpg").write_bytes(data)
        (photo,), _ = read_photos([tmp_path / f"{name}.jpg"])
        (said,) = counts_read([photo])
        assert why in said
        assert "the picture that the camera drew is used" in said
        gray, _ = photo_gray(photo, None)
        seen = cv2.imread(str(photo.path), cv2.IMREAD_GRAYSCALE)
        assert seen is not None
        assert np.array_equal(gray, seen)


def test_tiff_of_16_bits(tmp_path: Path) -> None:
    counts = scene(4)
    cv2.imwrite(str(tmp_path / "a.tif"), counts)
    cv2.imwrite(str(tmp_path / "b.tif"), (counts / np.float32(100) - np.float32(60)).astype(np.float32))
    cv2.imwrite(str(tmp_path / "c.png"), counts)
    photos, bad = read_photos(sorted(tmp_path.iterdir()))
    assert not bad
    grays = [photo_gray(photo, None)[0] for photo in photos]
    # Counts, degrees, counts: the same picture; eight bits of sixteen alone would be all but black.
    for gray in grays:
        assert np.abs(gray.astype(int) - grays[0]).max() <= 1
        assert gray.std() > 30
    assert len(extract(grays[0], 1.0)) > 300
    Image.fromarray((counts >> 6).astype(np.uint8)).save(tmp_path / "d.tif")
    assert read_photo(tmp_path / "d.tif").radiometric is None


def test_a_tag_that_only_the_heat_shows_is_found(tmp_path: Path) -> None:
    """What looks at pixels looks at the counts."""
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    counts = np.full((HEIGHT, WIDTH), 7300, np.uint16)
    tag = cv2.aruco.generateImageMarker(tags, 7, 96)
    counts[80:176, 100:196] = 7200 + (tag > 0) * 100
    path = tmp_path / "a.jpg"
    path.write_bytes(files.flir(np.full((HEIGHT, WIDTH, 3), 90, np.uint8), counts))
    photos, _ = read_photos([path])
    (mark,) = find_targets(photos, tag_detector("4X4_50"))
    assert (mark.photo, mark.point) == ("a.jpg", "7")
    assert (mark.u_px, mark.v_px) == pytest.approx((148, 128), abs=0.5)


def test_damaged_files(tmp_path: Path) -> None:
    counts = scene(5)
    whole = files.fff(counts)
    for cut in (10, 0x40, 0x50, 0x90, 2000, len(whole) - 900):
        parts = [(0xE1, b"FLIR\0\x01\x00\x00" + whole[:cut][:60000])]
        data = files.with_segments(files.jpeg(picture(counts), "FLIR"), parts)
        photo = written(tmp_path / "a.jpg", data)
        assert photo.radiometric is None
        assert photo_gray(photo, None)[0].shape == (HEIGHT, WIDTH)
    good = written(tmp_path / "b.jpg", files.flir(picture(counts), counts))
    (tmp_path / "b.jpg").write_bytes(files.jpeg(picture(counts), "FLIR"))
    with pytest.raises(PhotoError, match="raw counts cannot be read"):
        read_counts(good)

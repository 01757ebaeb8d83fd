"""Files that are no photos, broken photos, broken metadata, odd folders."""

from __future__ import annotations

import os
import re
import struct
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from photos_synthetic import XMP_HEADER, gps, packet, write_photo
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from calib.errors import InputError, PhotoError
from calib.photos import collect, read_photo, read_photos
from calib.photos.xmp import parse_packet


def refusal(path: Path) -> str:
    with pytest.raises(PhotoError) as caught:
        read_photo(path)
    message = str(caught.value)
    assert str(path) in message
    assert message.endswith(".")
    assert "\n" not in message
    return message


def with_segment(path: Path, marker: int, payload: bytes) -> Path:
    """Put a segment right behind the start of a JPEG."""
    data = path.read_bytes()
    segment = bytes([0xFF, marker]) + struct.pack(">H", len(payload) + 2) + payload
    path.write_bytes(data[:2] + segment + data[2:])
    return path


def not_photos(folder: Path) -> dict[str, tuple[Path, str]]:
    """Name -> file and a word that its refusal must hold."""
    files: dict[str, tuple[bytes, str]] = {
        "notes.JPG": (b"These are my notes about the flight.\n" * 3, "text file"),
        "empty.jpg": (b"", "0 bytes"),
        "zeros.jpg": (bytes(10000), "zeros"),
        "video.jpg": (b"\x00\x00\x00\x18ftypisom" + bytes(100), "video"),
        "phone.heic": (b"\x00\x00\x00\x18ftypheic" + bytes(100), "convert it to JPEG"),
        "renamed.jpg": (b"\x00\x00\x00\x18ftypheic" + bytes(100), "convert it to JPEG"),
        "raw.dng": (b"II*\x00\x08\x00\x00\x00" + bytes(100), "convert it to JPEG"),
        "raw.CR2": (b"II*\x00\x10\x00\x00\x00CR\x02\x00" + bytes(100), "convert it to JPEG"),
        "raw.raf": (b"FUJIFILMCCD-RAW 0201" + bytes(100), "convert it to JPEG"),
        "garbage.jpg": (bytes(range(128, 250)) * 5, "not a photo"),
        "start_only.jpg": (b"\xff\xd8\xff", "truncated"),
        "gif.jpg": (b"GIF89a" + bytes(30), "not a photo"),
        "garbage.tif": (b"II*\x00\xff\xff\xff\x7f" + bytes(100), "damaged"),
        "garbage.png": (b"\x89PNG\r\n\x1a\n" + bytes(100), "damaged"),
    }
    for name, (data, _) in files.items():
        (folder / name).write_bytes(data)
    return {name: (folder / name, word) for name, (_, word) in files.items()}


def test_files_that_are_no_photos_get_one_sentence_each(tmp_path):
    for path, word in not_photos(tmp_path).values():
        assert word in refusal(path)
    with zipfile.ZipFile(tmp_path / "zip.jpg", "w") as archive:
        archive.writestr("a.txt", "hello")
    assert "ZIP" in refusal(tmp_path / "zip.jpg")
    (tmp_path / "folder.jpg").mkdir()
    assert "is a folder" in refusal(tmp_path / "folder.jpg")
    assert "does not exist" in refusal(tmp_path / "nowhere.jpg")
    os.mkfifo(tmp_path / "pipe.jpg")
    assert "not a regular file" in refusal(tmp_path / "pipe.jpg")


def test_a_raw_tiff_by_another_name(tmp_path):
    path = tmp_path / "developed.tif"
    Image.new("L", (64, 48)).save(path, tiffinfo={0xC612: b"\x01\x04\x00\x00"})
    assert "DNG" in refusal(path)


@pytest.mark.parametrize("kept", [0.02, 0.3, 0.6, 0.9, 0.999])
@pytest.mark.parametrize("filled", [False, True])
def test_truncated_jpeg(tmp_path, kept, filled):
    path = write_photo(tmp_path / "a.jpg", size=(1600, 1200), xmp=packet("", 'drone-dji:GimbalYawDegree="1"'))
    data = path.read_bytes()
    cut = data[: int(kept * len(data))]
    # A copy that broke off is shorter, or has its full length and zeros.
    path.write_bytes(cut + bytes(len(data) - len(cut)) if filled else cut)
    assert "truncated" in refusal(path)


@pytest.mark.parametrize(
    ("suffix", "save"), [(".png", {}), (".tif", {}), (".tif", {"compression": "tiff_lzw"})]
)
def test_tiff_and_png_whole_and_truncated(tmp_path, suffix, save):
    position = None if save else gps(46.5, 6.25, 400)  # Pillow writes no GPS tags through libtiff
    path = write_photo(tmp_path / f"a{suffix}", make="Sony", model="ILCE-6000", position=position, **save)
    photo = read_photo(path)
    assert (photo.camera.width, photo.camera.height) == (400, 300)
    assert (photo.camera.make, photo.camera.model) == ("Sony", "ILCE-6000")
    assert (photo.position is None) == bool(save)
    if photo.position is not None:
        assert photo.position.latitude_deg == pytest.approx(46.5, abs=1e-7)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    assert re.search("truncated|damaged", refusal(path))


@pytest.mark.parametrize(
    "trailer", [b"\x00" * 5000, b"thermal data " * 9000, b"\xff\xd8\xff\xe0preview cut off"]
)
def test_data_behind_the_image_does_no_harm(tmp_path, trailer):
    path = write_photo(tmp_path / "a.jpg", make="DJI", model="ZH20T")
    path.write_bytes(path.read_bytes() + trailer)
    assert read_photo(path).camera.model == "ZH20T"


def test_other_jpegs_that_decoders_accept(tmp_path):
    progressive = write_photo(tmp_path / "p.jpg", size=(640, 480), progressive=True)
    assert read_photo(progressive).camera.width == 640
    grey = tmp_path / "g.jpg"
    Image.new("L", (320, 200), 128).convert("CMYK").save(grey)
    assert read_photo(grey).camera.height == 200
    filled = write_photo(tmp_path / "f.jpg")
    data = filled.read_bytes()
    filled.write_bytes(data[:2] + b"\xff\xff\xff" + data[2:])  # fill bytes before a marker, T.81 B.1.1.2
    assert read_photo(filled).camera.width == 400


@pytest.mark.parametrize(
    "position",
    [
        gps(0.0, 0.0, 0.0),
        gps(91.0, 10.0),
        gps(10.0, 181.0),
        {1: "N", 2: (IFDRational(0, 0),) * 3, 3: "E", 4: (IFDRational(0, 0),) * 3},
        {1: "N", 2: (IFDRational(46),), 3: "E"},
        gps(46.0, 6.0, t9="V"),
        {1: "N", 2: (IFDRational(46), IFDRational(0, 0), IFDRational(1)), 3: "E", 4: (IFDRational(6),) * 3},
    ],
)
def test_positions_not_to_be_believed(tmp_path, position):
    photo = read_photo(write_photo(tmp_path / "a.jpg", make="Canon", position=position))
    assert photo.position is None
    assert photo.camera.make == "Canon"


def test_altitude_that_is_no_number(tmp_path):
    tags = gps(46.0, 6.0) | {5: b"\x00", 6: IFDRational(0, 0)}
    position = read_photo(write_photo(tmp_path / "a.jpg", position=tags)).position
    assert position is not None
    assert position.altitude_m is None


@pytest.mark.parametrize(
    "packet_bytes",
    [
        b"not xml at all",
        b"",
        packet("", 'drone-dji:GimbalYawDegree="nan" drone-dji:GimbalPitchDegree="inf"'),
        packet("", 'drone-dji:GimbalYawDegree="1e999" drone-dji:GimbalPitchDegree="-90"'),
        packet("<drone-dji:GimbalYawDegree>x</drone-dji:GimbalYawDegree>"),
        b'<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><x:xmpmeta>&b;</x:xmpmeta>',
        b'<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><x:xmpmeta>&a;</x:xmpmeta>',
        b"<a>" * 5000,
        b"\xff\xfe\x00\xd8" * 100,
        b'<?xml version="1.0" encoding="no-such-code"?><a/>',
    ],
)
def test_broken_xmp_leaves_the_photo_usable(tmp_path, packet_bytes):
    path = with_segment(
        write_photo(tmp_path / "a.jpg", make="DJI", model="FC330"), 0xE1, XMP_HEADER + packet_bytes
    )
    photo = read_photo(path)
    assert photo.camera.model == "FC330"
    assert photo.gimbal is None


@pytest.mark.parametrize(
    "damage",
    [
        lambda p: p[: p.index(b"</rdf:RDF>")],  # cut off
        lambda p: p.replace(
            b' xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"', b""
        ),  # undeclared prefix
        lambda p: p.replace(b"DJI Meta", b"DJI & Meta"),  # bare ampersand before the values
        lambda p: p + b"\x00" * 50,
        lambda p: p.replace(b"<?xpacket begin", b"\x00<?xpacket begin"),
    ],
)
def test_what_can_be_read_of_a_broken_packet_counts(tmp_path, damage):
    whole = packet(
        "<tiff:Copyright>x</tiff:Copyright>",
        'tiff:Note="DJI Meta" drone-dji:GimbalYawDegree="+45.0" drone-dji:GimbalPitchDegree="-89.9"',
    )
    path = with_segment(write_photo(tmp_path / "a.jpg"), 0xE1, XMP_HEADER + damage(whole))
    gimbal = read_photo(path).gimbal
    assert gimbal is not None
    assert (gimbal.yaw_deg, gimbal.pitch_deg) == (45.0, -89.9)


@given(st.binary(max_size=400))
def test_any_bytes_as_xmp(data):
    assert all(isinstance(v, str) for v in parse_packet(data).values())
    parse_packet(b'<x:xmpmeta xmlns:x="a"><rdf:RDF>' + data)


@pytest.fixture(scope="module")
def rich_photo(tmp_path_factory) -> bytes:
    path = write_photo(
        tmp_path_factory.mktemp("rich") / "a.jpg",
        make="DJI",
        model="FC330",
        photo={0x9003: "2020:01:01 10:00:00", 0x920A: IFDRational(361, 100), 0xA405: 20},
        position=gps(46, 6, 400),
        xmp=packet("", 'drone-dji:GimbalYawDegree="+45.0" drone-dji:GimbalPitchDegree="-89.9"'),
    )
    return path.read_bytes()


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.integers(12, 1000), st.integers(0, 255)), min_size=1, max_size=20))
def test_flipped_bytes_in_the_metadata(tmp_path, rich_photo, changes):
    data = bytearray(rich_photo)
    for at, value in changes:
        data[at] = value
    path = tmp_path / "flipped.jpg"
    path.write_bytes(bytes(data))
    photo, message = None, ""
    try:
        photo = read_photo(path)
    except PhotoError as error:
        message = str(error)
    if photo is None:
        assert str(path) in message
    else:
        assert (photo.camera.width, photo.camera.height) == (400, 300)
        assert photo.focal_px is None or np.isfinite(photo.focal_px)
        assert photo.position is None or abs(photo.position.latitude_deg) <= 90


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=300))
def test_any_bytes_as_exif(tmp_path, data):
    for header in (b"", b"II*\x00\x08\x00\x00\x00", b"MM\x00*\x00\x00\x00\x08"):
        path = tmp_path / "a.jpg"
        with_segment(write_photo(path, size=(32, 32)), 0xE1, b"Exif\x00\x00" + header + data)
        assert read_photo(path).camera.width == 32


def test_huge_metadata_is_passed_over_quickly(tmp_path):
    path = write_photo(tmp_path / "a.jpg", make="DJI", model="ZH20T")
    data = path.read_bytes()
    thermal = (b"\xff\xe3" + struct.pack(">H", 65002) + bytes(65000)) * 200  # 13 MB, as radiometric JPEGs
    path.write_bytes(data[:2] + thermal + data[2:])
    with_segment(path, 0xE1, b"Exif\x00\x00II*\x00\x08\x00\x00\x00\xff\xff" + bytes(65000))
    start = time.perf_counter()
    assert read_photo(path).camera.width == 400
    assert time.perf_counter() - start < 1


def test_unreadable_file_and_folder(tmp_path):
    if os.geteuid() == 0:
        pytest.skip("root may read everything")
    path = write_photo(tmp_path / "a.jpg")
    path.chmod(0)
    assert "permission denied" in refusal(path)
    folder = tmp_path / "closed"
    folder.mkdir(mode=0)
    with pytest.raises(InputError, match="permission denied"):
        collect([folder])
    folder.chmod(0o700)


def test_read_many_lists_what_it_leaves_out(tmp_path):
    bad = not_photos(tmp_path)
    good = [write_photo(tmp_path / f"grün {i} 写真.jpg", seed=i) for i in range(3)]
    done: list[int] = []
    photos, left_out = read_photos([*good[:2], *(path for path, _ in bad.values()), good[2]], done.append)
    assert [p.path for p in photos] == good
    assert [item.path for item in left_out] == [path for path, _ in bad.values()]
    assert done == list(range(1, len(bad) + 4))


def test_collect_card(tmp_path):
    card = tmp_path / "DCIM"
    names = [
        "100MEDIA/DJI_0002.JPG",
        "100MEDIA/DJI_0010.JPG",
        "100MEDIA/DJI_0010.DNG",
        "100MEDIA/DJI_0011.DNG",
        "100MEDIA/._DJI_0002.JPG",
        "100MEDIA/DJI_0003.MP4",
        "100MEDIA/.hidden/a.jpg",
        "101MEDIA/DJI_0001.tif",
        "MISC/THM/100/DJI_0002.jpg",
        "Thumbnails/DJI_0002.jpg",
        "a.jpg/inner.png",
    ]
    for name in names:
        path = card / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")
    (card / "again").symlink_to(card)
    (card / "self.jpg").symlink_to(card / "self.jpg")
    (card / "100MEDIA" / "twin.jpg").symlink_to(card / "100MEDIA" / "DJI_0002.JPG")
    found = collect([card, card / "100MEDIA" / "DJI_0002.JPG"])
    assert [str(p.relative_to(card)) for p in found] == [
        "100MEDIA/DJI_0002.JPG",
        "100MEDIA/DJI_0010.JPG",
        "100MEDIA/DJI_0011.DNG",
        "101MEDIA/DJI_0001.tif",
        "a.jpg/inner.png",
        "self.jpg",
    ]
    assert "cannot be read" in refusal(card / "self.jpg")


def test_collect_takes_named_files_whatever_they_are(tmp_path):
    path = tmp_path / "photo.backup"
    path.write_bytes(b"x")
    assert collect([path, path]) == [path]


def test_collect_refusals(tmp_path):
    with pytest.raises(InputError, match="name a folder"):
        collect([])
    with pytest.raises(InputError, match=r"no file or folder .*nowhere"):
        collect([tmp_path / "nowhere"])
    with pytest.raises(InputError, match=r"no photos in .* it is empty"):
        collect([tmp_path])
    (tmp_path / "a.mp4").write_bytes(b"x")
    (tmp_path / "b.mp4").write_bytes(b"x")
    with pytest.raises(InputError, match=r"no photos in .*only 2 \.mp4"):
        collect([tmp_path])

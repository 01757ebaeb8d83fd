"""Files that are not what they claim: one sentence each, never a traceback, never a guess."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from calibrations import P3P
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.camera import BrownCamera
from calib.errors import FormatError
from calib.formats import FORMATS, MAX_BYTES, detect_format, read_calibration

WEAK = BrownCamera(4000, 3000, 2900.0, 2010.25, 1490.5, -0.01, 0.006, p1=1e-5, p2=-2e-5)
TEXTS = {name: FORMATS[name].write(WEAK, None) for name in FORMATS}


@pytest.mark.parametrize("name", list(FORMATS))
@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_a_damaged_file_is_refused_or_still_a_camera(name: str, data: st.DataObject) -> None:
    text = TEXTS[name]
    start = data.draw(st.integers(0, len(text)))
    length = data.draw(st.integers(0, 40))
    patch = data.draw(
        st.one_of(
            st.text(max_size=20),
            st.sampled_from(
                ["nan", "inf", "1e999", "-0", "<", "</f>", "{", "[", "]", '"', "\n", "9" * 400, "e"]
            ),
        )
    )
    damaged = text[:start] + patch + text[start + length :]
    refused = None
    try:
        camera = detect_format(damaged).read(damaged, None)
    except FormatError as error:
        refused = str(error)
    if refused is None:
        assert np.isfinite(camera.vector).all()
        assert min(camera.f_px, camera.fy_px) > 0
    else:
        assert refused.endswith(".")


@pytest.mark.parametrize("name", list(FORMATS))
def test_a_file_cut_in_half_is_refused(name: str) -> None:
    half = TEXTS[name][: len(TEXTS[name]) * 2 // 5]
    with pytest.raises(FormatError):
        detect_format(half).read(half, None)


BOMB = """<?xml version="1.0"?>
<!DOCTYPE lolz [<!ENTITY lol "lol"><!ENTITY lol1 "&lol;&lol;&lol;&lol;"><!ENTITY lol2 "&lol1;&lol1;&lol1;">]>
"""
EXTERNAL = '<?xml version="1.0"?>\n<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]>\n'


@pytest.mark.parametrize("name", ["metashape", "opencv-xml", "micmac"])
@pytest.mark.parametrize("prolog", [BOMB, EXTERNAL, '<!DOCTYPE r SYSTEM "http://127.0.0.1:9/x.dtd">'])
def test_xml_with_entities_or_a_document_type_is_not_read(name: str, prolog: str, tmp_path: Path) -> None:
    body = TEXTS[name].split("?>", 1)[1].lstrip()
    path = tmp_path / "camera.xml"
    path.write_text(prolog + body)
    with pytest.raises(FormatError, match="entity definitions"):
        read_calibration(path)


def test_files_that_are_no_calibration(tmp_path: Path) -> None:
    for content in (
        "",
        "\n\n",
        "hello",
        "{}",
        "[1, 2]",
        "<html></html>",
        '{"schema": "fieldcal.check/1"}',
        "1 2 3",
    ):
        path = tmp_path / "file.txt"
        path.write_text(content)
        with pytest.raises(FormatError, match=r"file\.txt: The file is no camera calibration"):
            read_calibration(path)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ('{"schema": "fieldcal.camera/2"}', "this version reads fieldcal.camera/1"),
        ('{"schema": "fieldcal.camera/1", "width": 4000}', "lacks height, f_px, cx_px, cy_px"),
        ('{"schema": "fieldcal.camera/1"', "not valid JSON"),
        ('{"schema": "fieldcal.camera/1", "a": ' + "[" * 100_000, "nested too deeply|not valid JSON"),
        (TEXTS["json"].replace("2900.0", "true"), "f_px is 'True', not a number"),
        (TEXTS["json"].replace("2900.0", '"2900"'), "f_px is '2900', not a number"),
        (TEXTS["json"].replace("2900.0", "1" + "0" * 400), "f_px is too large"),
        (TEXTS["json"].replace("2900.0", "NaN"), "f_px is 'nan', not a number"),
        (TEXTS["json"].replace("4000", "0"), "cannot be"),
        (TEXTS["json"].replace("2900.0", "1e-3"), "no camera has"),
    ],
)
def test_our_own_json_is_read_strictly(text: str, why: str) -> None:
    with pytest.raises(FormatError, match=why):
        detect_format(text).read(text, None)


def test_not_a_file_not_text_and_too_large(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no such file"):
        read_calibration(tmp_path / "missing.xml")
    with pytest.raises(FormatError, match="no such file"):
        read_calibration(tmp_path)
    fifo = tmp_path / "pipe.xml"
    os.mkfifo(fifo)
    with pytest.raises(FormatError, match="no such file"):
        read_calibration(fifo)
    photo = tmp_path / "photo.xml"
    photo.write_bytes(b"\xff\xd8\xff\xe0\0\x10JFIF")
    with pytest.raises(FormatError, match="not a text file"):
        read_calibration(photo)
    large = tmp_path / "film.xml"
    with large.open("wb") as stream:
        stream.truncate(3 * 2**30)  # sparse: three gigabytes that take no disk
    with pytest.raises(FormatError, match=f"larger than {MAX_BYTES // 2**20} MB"):
        read_calibration(large)


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads every file")
def test_a_file_that_may_not_be_read(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(TEXTS["json"])
    path.chmod(0)
    with pytest.raises(FormatError, match="cannot be read"):
        read_calibration(path)


def test_byte_order_mark_and_old_encodings(tmp_path: Path) -> None:
    marked = tmp_path / "marked.xml"
    marked.write_bytes(b"\xef\xbb\xbf" + TEXTS["metashape"].encode())
    assert read_calibration(marked)[0] == "metashape"
    old = tmp_path / "old.txt"
    old.write_bytes(TEXTS["vms"].replace("for VMS", "f\xfcr VMS").encode("latin-1"))
    assert read_calibration(old)[0] == "vms"


def test_a_format_may_be_named(tmp_path: Path) -> None:
    path = tmp_path / "camera.txt"
    path.write_text(FORMATS["colmap"].write(P3P, None))
    assert read_calibration(path, format_name="colmap") == read_calibration(path)
    with pytest.raises(FormatError, match=r"camera\.txt: .*not well-formed XML"):
        read_calibration(path, format_name="metashape")

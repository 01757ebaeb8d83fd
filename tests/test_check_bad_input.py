"""What `fieldcal check` says to input that it cannot use, to full disks and to interruptions.

One sentence and exit code 2, or the photo listed as left out; the photos untouched, nothing left behind.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from check_process import (
    Ran,
    Survey,
    check,
    command,
    ended,
    environment,
    left_out,
    report_of,
    running,
    untouched,
    without_superpowers,
)
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from benchmarks.processes import session, wait_for, worker
from calib.photos.photo import Position

pytest_plugins = ("check_fixtures",)

XXE = '<?xml version="1.0"?><!DOCTYPE c [<!ENTITY x SYSTEM "file:///etc/passwd">]><calibration>&x;</calibration>'


def refused(home: Path, folder: Path, *arguments: str | Path, **options: object) -> str:
    """The sentence of a check that must end with 2, change no photo and leave nothing behind."""
    with untouched(folder, home):
        ran = check(home, *arguments, **options)
    assert ran.code == 2, ran
    assert ran.out == ""
    return ran.sentence


# -- nothing usable ------------------------------------------------------------------------------


def _empty(card: Path) -> list[str | Path]:
    for path in card.iterdir():
        path.unlink()
    return [card]


def _no_such_folder(card: Path) -> list[str | Path]:
    return [card / "DCIM"]


def _one_photo(card: Path) -> list[str | Path]:
    return [min(card.iterdir())]


def _only_text(card: Path) -> list[str | Path]:
    for path in card.iterdir():
        path.write_text("no photo at all\n")
    return [card]


def _only_raw_and_heic(card: Path) -> list[str | Path]:
    for number, path in enumerate(sorted(card.iterdir())):
        path.unlink()
        if number % 2:
            path.with_suffix(".DNG").write_bytes(b"II*\0" + bytes(200))
        else:
            path.with_suffix(".HEIC").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(200))
    return [card]


def _all_truncated(card: Path) -> list[str | Path]:
    for path in card.iterdir():
        path.write_bytes(path.read_bytes()[:9000])
    return [card]


def _identical(card: Path) -> list[str | Path]:
    first, *others = sorted(card.iterdir())
    for path in others:
        path.write_bytes(first.read_bytes())
    return [card]


def _one_spot(card: Path) -> list[str | Path]:
    for number, path in enumerate(sorted(card.iterdir())):
        _retagged(path, Position(50.83, -0.142, 134.0 + 0.1 * number))
    return [card]


def _link_loop(card: Path) -> list[str | Path]:
    _empty(card)
    (card / "inner").symlink_to(card)
    (card / "a.JPG").symlink_to(card / "b.JPG")
    (card / "b.JPG").symlink_to(card / "a.JPG")
    return [card]


@pytest.mark.parametrize(
    ("prepare", "words"),
    [
        (_empty, r"There are no photos in .*card, it is empty"),
        (_no_such_folder, r"There is no file or folder .*DCIM; check the path"),
        (_one_photo, r"Only one photo is usable; a check needs at least three"),
        (_only_text, r"No photo is usable.*4 left out, for example .*\.JPG: not a photo but a text file"),
        (_only_raw_and_heic, r"No photo is usable.*(raw file|HEIC photo), which is not supported"),
        (_all_truncated, r"No photo is usable.*truncated"),
        (_identical, r"Only one photo is usable.*a copy of"),
        (_one_spot, r"All 4 photos were taken from one spot"),
        (_link_loop, r"No photo is usable.*2 left out.*links"),
    ],
)
def test_nothing_usable_is_one_sentence(
    home: Path, card: Path, prepare: Callable[[Path], list[str | Path]], words: str
) -> None:
    arguments = prepare(card)
    assert re.search(words, refused(home, card, *arguments))


def _retagged(path: Path, position: Position) -> None:
    """The same pixels with a position of our own and no other metadata."""
    exif = Image.Exif()
    place = exif.get_ifd(0x8825)
    place.update({1: "N", 2: (IFDRational(50), IFDRational(49), IFDRational(480_000 + 0, 10_000))})
    place.update({3: "W", 4: (IFDRational(0), IFDRational(8), IFDRational(312_000, 10_000))})
    place.update({5: b"\0", 6: IFDRational(round(10 * (position.altitude_m or 0)), 10)})
    with Image.open(path) as image:
        image.load()
    image.save(path, quality=95, exif=exif)


def test_unreadable_permissions(home: Path, card: Path) -> None:
    for path in card.iterdir():
        path.chmod(0)
    sentence = refused_to_the_powerless(home, card)
    assert re.search(r"No photo is usable.*permission denied; change its permissions", sentence)
    card.chmod(0)
    try:
        assert re.search(r"folder .*card cannot be read: permission denied", refused_to_the_powerless(home))
    finally:
        card.chmod(0o700)


def refused_to_the_powerless(home: Path, *folders: Path) -> str:
    before = sorted(home.iterdir())
    ran = check(home, home.parent / "card", preexec_fn=without_superpowers)
    assert ran.code == 2
    assert ran.out == ""
    assert sorted(home.iterdir()) == before
    for folder in folders:
        assert all(path.stat().st_mode & 0o777 == 0 for path in folder.iterdir())
    return ran.sentence


def test_a_name_with_newlines_and_controls_stays_one_line(home: Path, card: Path) -> None:
    sentence = refused(home, card, card / "no\nsuch \x1b[31mfile.JPG")
    assert "There is no file or folder" in sentence
    assert "\x1b" not in sentence


def _pictures_of_nothing(card: Path, size: tuple[int, int], noisy: bool) -> None:
    rng = np.random.default_rng(1)
    for number, path in enumerate(sorted(card.iterdir())):
        shape = (size[1], size[0], 3)
        pixels = (
            rng.integers(0, 255, shape, dtype=np.uint8) if noisy else np.full(shape, 90 + number, np.uint8)
        )
        Image.fromarray(pixels).save(path, quality=95)


@pytest.mark.parametrize(
    ("size", "noisy"), [((400, 300), False), ((400, 300), True), ((10, 10), True), ((1, 1), False)]
)
def test_pictures_of_nothing(home: Path, card: Path, size: tuple[int, int], noisy: bool) -> None:
    _pictures_of_nothing(card, size, noisy)
    sentence = refused(home, card, card)
    assert re.search(r"overlap|recognisably|could not be joined", sentence), sentence


def test_the_pixels_of_every_photo_are_damaged(home: Path, card: Path) -> None:
    """Whole files whose compressed data is rubbish: found out only when they are decoded."""
    for path in card.iterdir():
        data = bytearray(path.read_bytes())
        start = data.find(b"\xff\xda")
        middle = slice(start + 14, len(data) - 2)
        data[middle] = b"\x00" * (middle.stop - middle.start)
        path.write_bytes(bytes(data))
    assert refused(home, card, card)


def test_a_size_that_no_photo_has(home: Path, card: Path) -> None:
    """Headers that claim 65,500 x 65,500 px must not take the machine's memory."""
    for path in card.iterdir():
        data = bytearray(path.read_bytes())
        frame = data.find(b"\xff\xc0")
        data[frame + 5 : frame + 9] = b"\xff\xdc\xff\xdc"
        path.write_bytes(bytes(data))
    assert re.search(r"readable|decoded|larger", refused(home, card, card))


# -- places and options --------------------------------------------------------------------------


def _out_is_a_file(home: Path) -> list[str]:
    (home / "taken").write_text("mine")
    return ["--out", "taken"]


def _out_below_a_file(home: Path) -> list[str]:
    (home / "taken").write_text("mine")
    return ["--out", "taken/deeper"]


def _out_is_read_only(home: Path) -> list[str]:
    (home / "locked").mkdir(mode=0o500)
    return ["--out", "locked/out"]


def _json_in_no_folder(_: Path) -> list[str]:
    return ["--json", "no/such/report.json"]


def _json_is_a_folder(home: Path) -> list[str]:
    (home / "folder").mkdir()
    return ["--json", "folder"]


def _json_read_only(home: Path) -> list[str]:
    (home / "locked").mkdir(mode=0o500)
    return ["--json", "locked/report.json"]


def _unknown_reference(_: Path) -> list[str]:
    return ["--reference", "dji-phantom-3-profesional"]


def _broken_reference(home: Path) -> list[str]:
    (home / "broken.json").write_text('{"schema": "fieldcal.reference/1", "name": 3}')
    return ["--reference", "broken.json"]


def _reference_of_rubbish(home: Path) -> list[str]:
    (home / "rubbish.xml").write_bytes(bytes(range(256)))
    return ["--reference", "rubbish.xml"]


def _reference_with_a_dtd(home: Path) -> list[str]:
    (home / "dtd.xml").write_text(XXE)
    return ["--reference", "dtd.xml"]


def _reference_is_a_folder(home: Path) -> list[str]:
    (home / "folder").mkdir()
    return ["--reference", "folder"]


def _climbing_name(_: Path) -> list[str]:
    return ["--save-reference", "../x"]


def _empty_name(_: Path) -> list[str]:
    return ["--save-reference", ""]


def _bundled_name(_: Path) -> list[str]:
    return ["--save-reference", "dji-inspire-1"]


def _unknown_option(_: Path) -> list[str]:
    return ["--refrence", "x"]


@pytest.mark.parametrize(
    ("prepare", "words"),
    [
        (_out_is_a_file, r"Cannot write taken: there is a file of that name"),
        (_out_below_a_file, r"Cannot write taken/deeper: part of the path is a file"),
        (_out_is_read_only, r"Cannot write locked/out: you may not write there"),
        (_json_in_no_folder, r"Cannot write no/such/report.json: there is no such folder"),
        (_json_is_a_folder, r"Cannot write folder: there is a folder of that name"),
        (_json_read_only, r"Cannot write locked/report.json: you may not write there"),
        (_unknown_reference, r"no reference .*profesional. Did you mean dji-phantom-3-professional"),
        (_broken_reference, r"broken.json is not a valid reference"),
        (_reference_of_rubbish, r"rubbish.xml"),
        (_reference_with_a_dtd, r"dtd.xml.*(DTD|DOCTYPE|entit|document type)"),
        (_reference_is_a_folder, r"folder is a folder"),
        (_climbing_name, r"cannot be named '../x': use small letters"),
        (_empty_name, r"cannot be named ''"),
        (_bundled_name, r"dji-inspire-1 is a reference that comes with fieldcal"),
        (_unknown_option, r"--refrence"),
    ],
)
def test_hopeless_options_are_refused_before_the_work(
    home: Path, card: Path, prepare: Callable[[Path], list[str]], words: str
) -> None:
    arguments = prepare(home)
    started = time.monotonic()
    sentence = refused(home, card, card, *arguments, preexec_fn=without_superpowers)
    assert re.search(words, sentence), sentence
    assert "root:" not in sentence  # nothing of the file that the DTD names
    assert time.monotonic() - started < 20


def test_no_paths_at_all(home: Path, card: Path) -> None:
    assert "PATH" in refused(home, card)


def test_the_store_cannot_be_written(home: Path, card: Path) -> None:
    (home / "store").write_text("a file where the store should be")
    assert "store" in refused(home, card, card, "--save-reference", "mine")


# -- checks that go on ---------------------------------------------------------------------------


def test_bad_photos_among_good_ones_are_listed_and_the_check_goes_on(
    home: Path, card: Path, small: Survey
) -> None:
    """All at once: unreadable files, another camera, odd names; a narrow terminal without colour."""
    good = sorted(card.iterdir())
    whole = good[0].read_bytes()
    other = small.nadir[5].read_bytes()
    (card / "truncated.JPG").write_bytes(other[: len(other) // 2])
    (card / "letter.JPG").write_text("Dear drone,\n")
    (card / "empty.jpeg").write_bytes(b"")
    (card / "phone.HEIC").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(99))
    (card / "raw.dng").write_bytes(b"II*\0" + bytes(99))
    (card / "loop.JPG").symlink_to(card / "loop.JPG")
    (card / "copy of 1.JPG").write_bytes(whole)
    Image.fromarray(np.full((90, 120, 3), 99, np.uint8)).save(card / "thumbnail.jpg")
    grey = Image.fromarray(np.full((300, 400, 3), 120, np.uint8))
    with Image.open(good[0]) as tagged:
        grey.save(card / "grey.JPG", exif=tagged.getexif().tobytes(), xmp=tagged.info["xmp"])
    # Names that want to be something else.
    good[1] = good[1].rename(card / "<script>alert(1)<\n>é 写真 [bold]\x1b[31m.JPG")
    good[2] = good[2].rename(os.fsdecode(os.fsencode(card) + b"/\xff\xfe.JPG"))
    # EXIF garbage and coordinates of 0/0 in photos that are good otherwise.
    data = bytearray(good[3].read_bytes())
    at = data.find(b"Exif\0\0")
    data[at + 6 : at + 60] = os.urandom(54)
    good[3].write_bytes(bytes(data))
    with untouched(card):
        ran = check(home, card, env={"COLUMNS": "40", "NO_COLOR": "1"})
    assert ran.code in (3, 4), ran
    assert ran.err == ""
    assert max(len(line) for line in ran.out.splitlines()) <= 40
    assert "\x1b" not in ran.out
    report = report_of(home)
    reasons = left_out(report)
    for name, words in {
        "truncated.JPG": "truncated",
        "letter.JPG": "text file",
        "empty.jpeg": "empty",
        "phone.HEIC": "HEIC",
        "raw.dng": "raw file",
        "loop.JPG": "links",
        "thumbnail.jpg": "another camera",
    }.items():
        assert words in reasons[name], (name, reasons)
    assert sum("a copy of" in reason for reason in reasons.values()) == 1
    alignment = report["alignment"]
    assert alignment["aligned"] >= 3
    assert alignment["photos"] == len(list(card.iterdir())) == alignment["aligned"] + len(reasons)
    page = (home / "fieldcal-out" / "report.html").read_text(encoding="utf-8")
    assert "<script>alert" not in page
    assert "truncated" in page


def test_0_0_coordinates_are_no_coordinates(home: Path, card: Path) -> None:
    for path in card.iterdir():
        exif = Image.Exif()
        zero = (IFDRational(0), IFDRational(0), IFDRational(0))
        exif.get_ifd(0x8825).update({1: "N", 2: zero, 3: "E", 4: zero, 5: b"\0", 6: IFDRational(0)})
        with Image.open(path) as image:
            image.load()
        image.save(path, quality=97, exif=exif)
    ran = check(home, card)
    assert ran.code in (3, 4)
    assert "No photo has a position in its metadata." in ran.out
    assert report_of(home)["georeference"]["crs"] is None


def test_two_cameras_and_two_flights_on_one_card(home: Path, card: Path, small: Survey) -> None:
    with Image.open(small.nadir[5]) as image:
        image.load()
    image.resize((320, 240)).save(card / "smaller.JPG", exif=image.getexif().tobytes())
    later = small.nadir[6].read_bytes()
    assert b"2026:05:12" in later
    (card / "DJI_0999.JPG").write_bytes(later.replace(b"2026:05:12", b"2026:05:13"))
    ran = check(home, card, "--quiet")
    assert ran.code in (3, 4)
    assert len(ran.out.splitlines()) == 1
    assert ran.err == ""
    reasons = left_out(report_of(home))
    assert "another image size (320 x 240 instead of 400 x 300)" in reasons["smaller.JPG"]
    assert re.search(r"another flight \(1 photo, .*hours later\)", reasons["DJI_0999.JPG"])
    assert report_of(home)["alignment"]["aligned"] == 4


# -- disks, pipes and closed streams ---------------------------------------------------------------


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Path:
    place = tmp_path / "tiny"
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=200k", "none", str(place)], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("mounting a small disk is not allowed here")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def test_disk_full_while_writing_the_report(home: Path, card: Path, tiny_disk: Path) -> None:
    sentence = refused(home, card, card, "--out", tiny_disk / "out")
    assert re.search(r"Cannot write .*out: the disk is full; free some space", sentence)
    assert list(tiny_disk.iterdir()) == []


def test_stdout_is_full_or_closed_or_has_no_reader(home: Path, card: Path) -> None:
    full = os.open("/dev/full", os.O_WRONLY)
    ran = check(home, card, "--json", "-", stdout=full)
    os.close(full)
    assert ran.code == 2
    assert ran.err.splitlines()[-1] == "fieldcal: The output cannot be written: no space left on device."
    report = report_of(home)  # The files were written all the same.
    assert report["alignment"]["aligned"] == 4


def test_reader_has_enough_and_stdin_is_closed(home: Path, card: Path) -> None:
    line = " ".join(f"'{word}'" for word in command(card, "--json", "-", "--quiet"))
    done = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {line} <&- | head -c 1"],
        cwd=home,
        env=environment(home),
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.stdout == "{"
    assert done.stderr == ""
    # A small report fits into the pipe before its reader leaves; then the verdict is the answer.
    assert done.returncode in (141, 3, 4)


# -- interruptions -------------------------------------------------------------------------------


def _loading(leader: int) -> bool:
    """Inside the numerical libraries' loading."""
    return "_multiarray_umath" in Path(f"/proc/{leader}/maps").read_text()


def _aligning(leader: int) -> bool:
    """The child is past its own loading and at work (it has opened the pipe's worth of libraries)."""
    pid = worker(leader)
    return pid is not None and "cv2" in Path(f"/proc/{pid}/maps").read_text()


@pytest.mark.parametrize("moment", [_loading, worker, _aligning])
def test_ctrl_c_is_one_line_and_leaves_nothing(
    home: Path, card: Path, moment: Callable[[int], object]
) -> None:
    with untouched(card, home), running(home, card) as process:
        wait_for(lambda: moment(process.pid))
        if moment is _aligning:
            time.sleep(1)
        os.killpg(process.pid, signal.SIGINT)
        ran = ended(process, 30)
        assert ran == Ran(130, "", "fieldcal: Interrupted.\n")
        wait_for(lambda: not session(process.pid), 5)


def test_terminating_leaves_nothing(home: Path, card: Path) -> None:
    with untouched(card, home), running(home, card) as process:
        wait_for(lambda: _aligning(process.pid))
        process.terminate()
        ran = ended(process, 30)
        assert ran == Ran(143, "", "")
        wait_for(lambda: not session(process.pid), 5)


def test_a_killed_command_leaves_no_orphan_at_work(home: Path, card: Path) -> None:
    with untouched(card), running(home, card) as process:
        wait_for(lambda: _aligning(process.pid))
        process.kill()
        wait_for(lambda: not session(process.pid), 30)
        _, err = process.communicate()
        assert b"Traceback" not in err


def test_a_killed_child_is_tried_again(home: Path, card: Path) -> None:
    with untouched(card), running(home, card) as process:
        wait_for(lambda: _aligning(process.pid))
        first = worker(process.pid)
        assert first is not None
        os.kill(first, signal.SIGKILL)
        wait_for(lambda: worker(process.pid) not in (None, first))
        ran = ended(process)
    assert ran.code in (3, 4)
    assert ran.err == ""
    assert report_of(home)["alignment"]["aligned"] == 4


def test_a_child_killed_twice_is_given_up_with_a_sentence(home: Path, card: Path) -> None:
    with untouched(card, home), running(home, card) as process:
        killed = [None]
        for _ in range(2):
            killed.append(wait_for(lambda: (pid := worker(process.pid)) not in killed and pid))
            os.kill(killed[-1], signal.SIGKILL)
        ran = ended(process)
        assert ran.code == 2
        assert "The alignment process died 2 times" in ran.sentence

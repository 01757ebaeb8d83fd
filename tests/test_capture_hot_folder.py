"""A folder that fills while it is watched: only whole photos, each once, whatever the order."""

from __future__ import annotations

import hashlib
import os
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from calib.photos.collect import collect
from calib.photos.photo import CameraIdentity, Photo
from daemon.capture.adapters import file_number, shots, triggers
from daemon.capture.hot_folder import HotFolder
from daemon.link.events import Angles, PhotoSource
from daemon.link.triggers import Trigger as LinkTrigger


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture(scope="module")
def jpeg(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("jpeg") / "a.jpg"
    noise = np.random.default_rng(0).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path, quality=90)
    return path.read_bytes()


class Watched:
    """A hot folder with its clock: :meth:`look` is one poll, a second later."""

    def __init__(self, folder: Path) -> None:
        self.clock = Clock()
        self.hot = HotFolder(folder, settle_s=1.0, clock=self.clock)
        self.names: list[str] = []

    def look(self) -> list[str]:
        self.clock.now += 1.0
        self.last = self.hot.poll()
        new = [a.photo.path.name for a in self.last.arrived]
        self.names += new
        return new


def test_only_what_has_stopped_changing_and_is_whole(tmp_path: Path, jpeg: bytes) -> None:
    watched, file = Watched(tmp_path), tmp_path / "A.JPG"
    for end in (100, 1000, 1000, 1000, len(jpeg) - 1):
        file.write_bytes(jpeg[:end])
        assert watched.look() == []
    assert watched.look() == []  # It has stopped, one byte short.
    assert watched.last.waiting == (file,)
    file.write_bytes(jpeg)
    assert watched.look() == []
    assert watched.look() == ["A.JPG"]
    assert watched.last.arrived[0].sha256 == hashlib.sha256(jpeg).hexdigest()
    assert watched.last.arrived[0].size_bytes == len(jpeg)
    assert watched.last.waiting == ()
    for _ in range(3):
        assert watched.look() == []
    assert watched.last.whole == 1


def test_a_file_of_full_size_that_fills_later(tmp_path: Path, jpeg: bytes) -> None:
    """As some copying programs do: the size is claimed first, and the time is set back at the end."""
    watched, file = Watched(tmp_path), tmp_path / "A.JPG"
    file.write_bytes(jpeg[:500].ljust(len(jpeg), b"\0"))
    os.utime(file, (1e9, 1e9))
    assert [watched.look() for _ in range(4)] == [[]] * 4
    with file.open("r+b") as open_file:
        open_file.write(jpeg)
    os.utime(file, (1e9, 1e9))
    assert watched.look() == ["A.JPG"]


def test_any_order_subfolders_and_what_is_not_a_photo(tmp_path: Path, jpeg: bytes) -> None:
    watched = Watched(tmp_path)
    for name in ("DCIM/101MEDIA/DJI_0002.JPG", "DCIM/100MEDIA/DJI_0999.JPG", "DCIM/100MEDIA/DJI_0001.JPG"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(jpeg)
        watched.look()
    (tmp_path / "MISC").mkdir()
    (tmp_path / "MISC" / "thumb.JPG").write_bytes(jpeg)
    (tmp_path / ".A.JPG.part").write_bytes(jpeg)
    (tmp_path / "log.txt").write_bytes(jpeg)
    (tmp_path / "broken.jpg").write_bytes(b"")
    (tmp_path / "nowhere.jpg").symlink_to(tmp_path / "gone")
    for _ in range(3):
        watched.look()
    assert sorted(watched.names) == ["DJI_0001.JPG", "DJI_0002.JPG", "DJI_0999.JPG"]
    assert sorted(file.name for file in watched.last.waiting) == ["broken.jpg", "nowhere.jpg"]
    assert {p.name for p in collect([tmp_path])} == {*watched.names, "broken.jpg", "nowhere.jpg"}


def test_a_card_pulled_in_the_middle_comes_back(tmp_path: Path, jpeg: bytes) -> None:
    card, away = tmp_path / "card", tmp_path / "away"
    (card / "DCIM").mkdir(parents=True)
    (card / "DCIM" / "1.JPG").write_bytes(jpeg)
    watched = Watched(card)
    watched.look()
    assert watched.look() == ["1.JPG"]
    card.rename(away)
    assert watched.look() == []
    assert "put the card back" in watched.last.fault
    assert watched.last.whole == 1
    (away / "DCIM" / "2.JPG").write_bytes(jpeg)
    away.rename(card)
    watched.look()
    assert watched.last.fault == ""
    assert watched.look() == ["2.JPG"]  # And not the first one again.


def test_a_file_replaced_by_another_is_another_photo(tmp_path: Path, jpeg: bytes) -> None:
    watched, file = Watched(tmp_path), tmp_path / "A.JPG"
    file.write_bytes(jpeg)
    watched.look()
    assert watched.look() == ["A.JPG"]
    file.write_bytes(jpeg[:-2] + b"\0\xff\xd9")
    watched.look()
    assert watched.look() == ["A.JPG"]


def test_nothing_in_the_folder_is_touched(tmp_path: Path, jpeg: bytes) -> None:
    (tmp_path / "A.JPG").write_bytes(jpeg)
    (tmp_path / "A.JPG").chmod(0o444)
    tmp_path.chmod(0o555)
    try:
        before = [(p.name, p.stat().st_mtime_ns) for p in tmp_path.iterdir()]
        watched = Watched(tmp_path)
        watched.look()
        assert watched.look() == ["A.JPG"]
        assert [(p.name, p.stat().st_mtime_ns) for p in tmp_path.iterdir()] == before
    finally:
        tmp_path.chmod(0o755)


def test_a_folder_that_was_never_there(tmp_path: Path) -> None:
    watched = Watched(tmp_path / "none")
    assert watched.look() == []
    assert "is away" in watched.last.fault
    (tmp_path / "none").mkdir()
    assert watched.look() == []
    assert watched.last.fault == ""


def test_photos_and_triggers_as_pairing_takes_them() -> None:
    camera = CameraIdentity("DJI", "FC330", None, 4000, 3000)
    moment = datetime(2026, 5, 31, 10, 0, 0, 250_000)
    first = Photo(Path("/card/DCIM/100MEDIA/DJI_0999.JPG"), camera, time=moment, time_resolution_s=0.01)
    second = Photo(Path("/card/DCIM/101MEDIA/DJI_0001.JPG"), camera, time=moment)
    timeless = Photo(Path("/card/DCIM/101MEDIA/DJI_0002.JPG"), camera)
    one, two = shots([first, second, timeless])
    assert one.time_s % 60 == pytest.approx(0.25)
    assert one.resolution_s == 0.01
    assert one.order < two.order
    assert file_number(Photo(Path("/x/photo.jpg"), camera)) == 0
    feedback = LinkTrigger(
        3, 1, 99.0, ((PhotoSource.FEEDBACK, 7),), 0, None, 1.7e9,
        latitude_deg=47.0, longitude_deg=8.0, altitude_msl_m=500.0,
        vehicle_angles=Angles(1.0, 2.0, 3.0), completed=0,
    )  # fmt: skip
    captured = LinkTrigger(4, 0, 101.0, ((PhotoSource.CAPTURED, -1),), 0, 55.0, 1.7e9 + 2)
    silent = LinkTrigger(5, 0, 103.0, (), 0, 57.0, None)
    got = triggers([feedback, captured, silent])
    assert [(t.key, t.time_s, t.image_index) for t in got] == [(3, 1.7e9, 7), (4, 1.7e9 + 2, None)]
    assert got[0].completed_captures is None
    assert got[0].position == (47.0, 8.0, 500.0)
    assert got[1].position is None
    assert got[0].attitude_deg == (1.0, 2.0, 3.0)
    assert [(t.key, t.time_s) for t in triggers([silent, captured])] == [(5, 57.0), (4, 55.0)]

"""Photos brought by the program itself: the camera's files over MAVLink and HTTP, and gphoto2."""

from __future__ import annotations

import asyncio
import random
import shutil
import socket
import stat
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

pytest.importorskip("pymavlink", reason="pip install fieldcal[flight]")
pytest.importorskip("mavsdk", reason="pip install fieldcal[flight]")

from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.asyncio.plugins.ftp_server import FtpServerAsync

from benchmarks.processes import wait_for
from calib.photos.collect import photos_below
from daemon.again import unended
from daemon.capture.fetch import Fetcher, local_name
from daemon.capture.hot_folder import HotFolder
from daemon.capture.tether import ARGUMENTS, Tether, gphoto2_program
from daemon.capture.trigger_book import Offer, TriggerBook
from daemon.capture.web import read_web
from daemon.cli import run
from daemon.flight import STARTED
from daemon.link import wire
from daemon.link.address import parse
from daemon.link.events import PhotoReport, PhotoSource
from daemon.link.ftp import PIECE_BYTES, ReadPiece, address_of, read_file
from daemon.link.live import Link
from daemon.link.message import from_pymavlink
from daemon.remote import CutError, RefusedError
from daemon.session.library import begin
from daemon.session.rows import ClockName, Event, Stamp
from daemon.session.store import Session
from sim.faults.ends import free_port
from sim.tether.file_server import FileServer
from sim.tether.offering import Offering


def jpeg(path: Path, seed: int, side: int = 64) -> Path:
    noise = np.random.default_rng(seed).integers(0, 255, (side, side, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path, "JPEG")
    return path


# -- MAVLink's file transfer ---------------------------------------------------------------------------


def carried(piece: ReadPiece, server: FileServer, seed: int, bad: float = 0.1) -> None:
    """Exchange and server over a line that loses, doubles and reorders, in simulated time."""
    rng, now_s, end_s = random.Random(seed), 100.0 * seed, 100.0 * seed + 90.0
    line = piece.start(now_s)
    while not piece.over:
        now_s += 0.01
        assert now_s < end_s
        rng.shuffle(line)
        coming, line = line[:16], line[16:]
        for request in coming:
            for _ in range(rng.choices((0, 1, 2), (bad, 1 - 2 * bad, bad))[0]):
                reply = server.answer(bytes(request.payload)).ljust(wire.FILE_PAYLOAD_BYTES, b"\0")
                back = wire.file_transfer(wire.SYSTEM_ID, wire.COMPONENT_ID, reply)
                packed = wire.Packer(1, 100).pack(back)
                (frame,) = wire.Splitter().feed(packed)
                assert frame.message is not None
                if rng.random() >= bad:
                    line += piece.receive(frame.message, now_s)
        line += piece.tick(now_s)


@pytest.mark.parametrize(
    ("size", "start"), [(0, 0), (1, 0), (239, 0), (240, 0), (60_000, 0), (60_000, 31_111), (9, 9)]
)
def test_a_file_arrives_whole_over_a_bad_line(tmp_path: Path, size: int, start: int) -> None:
    content = random.Random(size).randbytes(size)
    (tmp_path / "a.jpg").write_bytes(content)
    server, came, ended = FileServer(tmp_path), b"", False
    for seed in range(50):
        piece = ReadPiece(1, 100, "/a.jpg", start + len(came))
        carried(piece, server, seed)
        assert (piece.refused, piece.size_bytes) == (None, size)
        came, ended = came + piece.data, piece.ended
        if ended:
            break
    assert ended
    assert came == content[start:]


def test_pieces_refusals_and_sessions_of_before(tmp_path: Path) -> None:
    content = random.Random(1).randbytes(PIECE_BYTES + 5000)
    (tmp_path / "a.jpg").write_bytes(content)
    server = FileServer(tmp_path)
    first = ReadPiece(1, 100, "/a.jpg", 0)
    carried(first, server, 0, bad=0.0)
    assert not first.ended
    assert PIECE_BYTES <= len(first.data) < len(content)
    abandoned = ReadPiece(1, 100, "/a.jpg", 0)  # killed after it opened: nobody closes its session
    server.answer(bytes(abandoned.start(1.0)[0].payload))
    rest = ReadPiece(1, 100, "/a.jpg", len(first.data))
    carried(rest, server, 1)
    assert rest.ended
    assert bytes(first.data + rest.data) == content
    for seed, (path, start, why) in enumerate(
        (
            ("/b.jpg", 0, "no such file"),
            ("/../secret", 0, "no such file"),
            ("/a.jpg", 10**6, "shorter"),
        ),
        2,
    ):
        (tmp_path.parent / "secret").touch()
        refused = ReadPiece(1, 100, path, start)
        carried(refused, server, seed)
        assert why in (refused.refused or "")
        assert not refused.data
    silent = ReadPiece(1, 100, "/a.jpg", 0)
    silent.start(0.0)
    while not silent.over:
        silent.tick(silent._heard_s + 5.0)
    assert (silent.refused, silent.ended, silent.data) == (None, False, b"")


@pytest.mark.parametrize(
    ("url", "found"),
    [
        ("mftp:///DCIM/1.jpg", (100, "/DCIM/1.jpg")),
        ("mftp://[;comp=101]DCIM/1.jpg", (101, "/DCIM/1.jpg")),
        ("MFTP://DCIM/1.jpg", (100, "/DCIM/1.jpg")),
        ("mftp://[;comp=999]/1.jpg", None),
        ("mftp://", None),
        ("http://camera/1.jpg", None),
    ],
)
def test_addresses(url: str, found: tuple[int, str] | None) -> None:
    assert address_of(url, 100) == found


@given(st.text(max_size=200), st.integers(1, 10**6))
def test_no_address_names_a_file_elsewhere(url: str, number: int) -> None:
    for prefix in ("mftp://", "http://camera/", ""):
        name = local_name(Offer(number, prefix + url, 100))
        assert Path("/x", name).resolve() == Path("/x") / name
        assert name.startswith(f"{number:05d}-")
        assert name.isascii()
        assert name.isprintable()
        assert len(name) < 80


def test_the_name_of_a_photo_stays() -> None:
    for url in (
        "mftp://[;comp=100]/DCIM/100MEDIA/DSC00012.JPG",
        "http://10.0.0.2/get/DSC00012.JPG?size=full",
    ):
        assert local_name(Offer(7, url, 100)) == "00007-DSC00012.JPG"
    assert local_name(Offer(7, "http://10.0.0.2/photo?id=3", 100)) == "00007-photo.JPG"
    assert local_name(Offer(7, "mftp:///../../.ssh/.config", 100)) == "00007-config.JPG"


def test_mavsdk_s_server_gives_its_files(tmp_path: Path) -> None:
    """The other implementation of the protocol that is at hand, as an autopilot's."""
    content = random.Random(3).randbytes(300_000)
    (tmp_path / "a.jpg").write_bytes(content)
    port = free_port()

    async def serve() -> bytes:
        async with Mavsdk(Configuration.create_with_component_type(ComponentType.AUTOPILOT)) as mavsdk:
            await mavsdk.add_any_connection(f"udpout://127.0.0.1:{port}")
            server = FtpServerAsync(await mavsdk.server_component())
            await server.set_root_dir(str(tmp_path))
            return await asyncio.to_thread(fetch)

    def fetch() -> bytes:
        with Link(parse(f"udp://127.0.0.1:{port}")) as link:
            link.wait_for_vehicle(30)
            with pytest.raises(RefusedError, match="no such file"):
                list(read_file(link, 1, "/b.jpg", 0, lambda: True))
            return b"".join(read_file(link, 1, "/a.jpg", 100, lambda: True))

    assert asyncio.run(serve()) == content[100:]


def test_a_log_holds_of_a_file_only_that_it_came() -> None:
    message = wire.file_transfer(wire.SYSTEM_ID, wire.COMPONENT_ID, bytes(range(1, 252)))
    packer = wire.Packer(1, 100)
    for _ in range(3):
        raw = packer.pack(message)
    (frame,) = wire.Splitter().feed(raw)
    (logged,) = wire.Splitter().feed(wire.without_content(frame))
    assert (logged.sequence, logged.system_id, logged.component_id) == (frame.sequence, 1, 100) == (2, 1, 100)
    assert logged.message is not None
    assert logged.message.octets("payload").rstrip(b"\0") == bytes(range(1, 13))
    assert len(logged.raw) < 32 < len(frame.raw)
    assert from_pymavlink(message).octets("payload")[12] == 13


# -- HTTP ----------------------------------------------------------------------------------------------


@contextmanager
def answering(reply: Callable[[str], bytes]) -> Iterator[str]:
    """A web server of one's own making: request head -> all bytes of the answer, then the line is cut."""
    listener = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        while True:
            try:
                line, _ = listener.accept()
            except OSError:
                return
            with line:
                line.sendall(reply(line.recv(65536).decode()))

    threading.Thread(target=serve, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
    finally:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()


def test_web_refusals_and_cuts() -> None:
    def reply(head: str) -> bytes:
        path = head.split()[1]
        return {
            "/cut": b"HTTP/1.1 200 OK\r\nContent-Length: 100\r\n\r\nabc",
            "/large": b"HTTP/1.1 200 OK\r\nContent-Length: 9999999999\r\n\r\n",
            "/part": b"HTTP/1.1 206 Partial\r\nContent-Range: bytes 9-10/11\r\n\r\nab",
            "/away": b"HTTP/1.1 302 Found\r\nLocation: http://192.0.2.1/\r\n\r\n",
            "/rubbish": b"\x00\x01\x02",
            "/whole": b"HTTP/1.1 200 OK\r\n\r\nabcdef",
        }[path]

    with answering(reply) as at:
        for path, error, why in (
            ("/cut", CutError, "cut"),
            ("/large", RefusedError, "MB"),
            ("/part", RefusedError, "another part"),
            ("/away", RefusedError, "302"),
            ("/rubbish", CutError, "does not answer"),
        ):
            with pytest.raises(error, match=why):
                list(read_web(at + path, 3))
        # Who knows no parts sends all: what was there is told to be dropped.
        assert list(read_web(at + "/whole", 3)) == [None, b"abcdef"]
    for url, why in (
        ("http://93.184.216.34/a.jpg", "not on the local net"),
        ("http://127.0.0.1:99999/", "address"),
        ("http:///a.jpg", "no host"),
        ("http://127.0.0.1:1/\r\nX: y", "address cannot be used|does not answer"),
    ):
        with pytest.raises((RefusedError, CutError), match=why):
            list(read_web(url, 0))


def test_the_simulated_camera_s_web_server(tmp_path: Path) -> None:
    content = jpeg(tmp_path / "a.jpg", 1).read_bytes()
    with Offering(tmp_path, "http") as offering:
        assert b"".join(filter(None, read_web(offering.url("a.jpg"), 0))) == content
        assert b"".join(filter(None, read_web(offering.url("a.jpg"), 500))) == content[500:]
        assert list(read_web(offering.url("a.jpg"), len(content))) == []
        with pytest.raises(CutError, match="changed"):
            list(read_web(offering.url("a.jpg"), len(content) + 1))
        with pytest.raises(RefusedError, match="404"):
            list(read_web(offering.url("b.jpg"), 0))


class Camera:
    """A book that is told of photos, and a fetcher that brings them."""

    def __init__(self, home: Path, session: Session) -> None:
        self.folder = home / "photos"
        self.folder.mkdir(exist_ok=True)
        self.book = TriggerBook(session)
        self.link = Link(parse(f"udp://127.0.0.1:{free_port()}"))
        self.said: list[str] = []
        self.now = 0.0
        self.fetcher = Fetcher(self.book, self.folder, self.link, lambda: self.now)

    def tell(self, number: int, url: str) -> None:
        report = PhotoReport(
            source=PhotoSource.CAMERA, component_id=100, camera=0, index=number, vehicle_boot_s=None,
            utc_s=1.7e9 + 10 * number, confirmed=True, url=url,
        )  # fmt: skip
        self.book.hear(report, 1.7e9 + 10 * number, self.link.state.time_base)

    def until(self, true: Callable[[], bool]) -> None:
        def look() -> bool:
            self.now += 0.5
            self.fetcher.poll()
            self.said += [text for _, text in self.fetcher.news()]
            return true()

        wait_for(look, 60)

    def names(self) -> list[str]:
        return [path.name for path in photos_below(self.folder)[0]]


def test_only_whole_photos_appear_and_refusals_are_told(tmp_path: Path) -> None:
    whole = jpeg(tmp_path / "a.jpg", 1).read_bytes()
    asked: list[str] = []

    def reply(head: str) -> bytes:
        path, start = head.split()[1], int(head.partition("bytes=")[2].partition("-")[0])
        asked.append(f"{path} {start}")
        if path == "/missing.jpg":
            return b"HTTP/1.1 404 Not Found\r\n\r\n"
        content = b"no photo at all" if path == "/text.jpg" else whole
        head_ = f"HTTP/1.1 206 P\r\nContent-Range: bytes {start}-{len(content) - 1}/{len(content)}\r\n\r\n"
        # Every answer ends after 1,000 bytes.
        return head_.encode() + content[start : start + 1000]

    with answering(reply) as at, Session.create(tmp_path / "record") as session:
        camera = Camera(tmp_path, session)
        with camera.link, camera.fetcher:
            for number, name in enumerate(("missing", "a", "text", "../../b"), 1):
                camera.tell(number, f"{at}/{name}.jpg")
            camera.tell(5, "gopher://camera/x.jpg")
            camera.until(
                lambda: len(camera.names()) == 2 and sum("from the camera" in s for s in camera.said) == 3
            )
            assert camera.names() == ["00002-a.jpg", "00004-b.jpg"]
            assert all((camera.folder / name).read_bytes() == whole for name in camera.names())
            assert camera.fetcher.anchors() == {"00002-a.jpg": 2, "00004-b.jpg": 4}
            assert camera.fetcher.missing == 3
            assert f"/a.jpg {1000}" in asked
            assert asked.count("/missing.jpg 0") == 3
            said = " ".join(camera.said)
            for words in ("Photo 1 cannot", "404", "Photo 3 cannot", "no whole photo", "Photo 5", "gopher"):
                assert words in said
        # Killed in the middle and begun again: the book knows what was told, the folder what is there.
        (camera.folder / "00002-a.jpg").unlink()
        (camera.folder / ".00002-a.jpg.part").write_bytes(whole[:1500])
        asked.clear()
        again = Camera(tmp_path, session)
        with again.link, again.fetcher:
            assert again.fetcher.anchors() == {"00004-b.jpg": 4}
            again.until(lambda: "00002-a.jpg" in again.names())
        assert (again.folder / "00002-a.jpg").read_bytes() == whole
        assert "/a.jpg 1500" in asked
        assert "/a.jpg 0" not in asked
        assert not any(request.startswith("/../b") for request in asked)


# -- gphoto2 -------------------------------------------------------------------------------------------

#: As gphoto2 2.5 does (gphoto2/main.c, actions.c): a temporary name first, then the one that was asked for.
GPHOTO2 = """#!{python}
import os, shutil, sys, tempfile, time
camera = "{camera}"
words = sys.argv[1:]
open(camera + "/asked", "a").write(" ".join(words) + "\\n")
assert "--capture-tethered" in words
name = next(w.partition("=")[2] for w in words if w.startswith("--filename="))
if not os.path.exists(camera + "/free"):
    print("ERROR: An error occurred in the io-library", file=sys.stderr)
    print("*** Error (-53: 'Could not claim the USB device') ***       \\n", file=sys.stderr)
    print("For debugging messages, please use the --debug option.")
    sys.exit(1)
print("Waiting for events from camera. Press Ctrl-C to abort.")
done = set()
while not os.path.exists(camera + "/unplugged"):
    for shot in sorted(set(os.listdir(camera + "/dcim")) - done):
        done.add(shot)
        stem, _, suffix = shot.rpartition(".")
        out = time.strftime(name.replace("%f", stem).replace("%C", suffix), time.localtime(1.78e9))
        if "--skip-existing" in words and os.path.exists(out):
            print("Skip existing file " + out, flush=True)
            continue
        with tempfile.NamedTemporaryFile(prefix="tmpfile", dir=".", delete=False) as part:
            content = open(camera + "/dcim/" + shot, "rb").read()
            for start in range(0, len(content), 1000):
                part.write(content[start:start + 1000])
                part.flush()
                time.sleep(0.001)
        print("Saving file as " + out, flush=True)
        os.rename(part.name, out)
        if "--keep" not in words:
            os.unlink(camera + "/dcim/" + shot)
    print("UNKNOWN PTP Property d1d3 changed", flush=True)
    time.sleep(0.01)
print("*** Error (-52: 'Could not find the requested device on the USB port') ***       \\n", file=sys.stderr)
sys.exit(1)
"""


@pytest.fixture
def usb_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    camera, programs = tmp_path / "camera", tmp_path / "bin"
    (camera / "dcim").mkdir(parents=True)
    programs.mkdir()
    program = programs / "gphoto2"
    program.write_text(GPHOTO2.format(python=sys.executable, camera=camera))
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", str(programs), prepend=":")
    return camera


def test_photos_of_a_camera_on_usb(tmp_path: Path, usb_camera: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "tmpfileAbCdEf").write_bytes(b"killed in the middle")
    now, said = [0.0], list[str]()
    with Tether(folder, gphoto2_program(), lambda: now[0]) as tether:
        hot = HotFolder(folder, clock=lambda: now[0])
        arrived = list[str]()

        def look() -> None:
            now[0] += 1.0
            tether.poll()
            said.extend(text for _, text in tether.news())
            arrived.extend(one.photo.path.name for one in hot.poll().arrived)

        def until(true: Callable[[], bool]) -> None:
            wait_for(lambda: (look(), true())[1], 30)

        until(lambda: bool(said))
        assert "could not claim the USB device (another program holds it" in said[0]
        assert tether.degraded
        (usb_camera / "free").touch()
        for number in range(3):
            jpeg(usb_camera / "dcim" / f"IMG_{number:04d}.JPG", number)
        until(lambda: len(arrived) == 3)
        until(lambda: not tether.degraded)
        assert said[-1] == "The camera is there again."
        (usb_camera / "unplugged").touch()
        until(lambda: bool(tether.degraded))
        assert "could not find the requested device" in said[-1]
        (usb_camera / "unplugged").unlink()
        jpeg(usb_camera / "dcim" / "IMG_0003.JPG", 3)
        until(lambda: len(arrived) == 4)
    names = sorted(path.name for path in folder.iterdir())
    assert [name.rpartition("-")[2] for name in names] == [f"IMG_{n:04d}.JPG" for n in range(4)]
    for name in names:
        assert (folder / name).read_bytes() == (usb_camera / "dcim" / name.rpartition("-")[2]).read_bytes()
    assert set((usb_camera / "asked").read_text().splitlines()) == {" ".join(ARGUMENTS)}
    asked = len((usb_camera / "asked").read_text())
    time.sleep(0.1)
    assert len((usb_camera / "asked").read_text()) == asked  # it ended with us


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["--photos", "gphoto2"], "sudo apt install gphoto2"),
        (["--photos", "mavlink"], "add --link"),
        (["--photos", "mavlink", "--link", "flight.tlog"], "add --link"),
        (["--photos", "mavlink", "--again"], "add --link"),
        (["--photos", "mavlink", "--again", "--resume"], "--again goes with --photos"),
        (["--photos", "/nowhere/gphoto2"], "no folder /nowhere/gphoto2"),
    ],
)
def test_refusals(
    words: list[str],
    why: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("FIELDCAL_SESSIONS", str(tmp_path / "sessions"))
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    assert shutil.which("gphoto2") is None
    assert run(["run", *words, "--no-live"]) == 2
    told = capsys.readouterr().err
    assert why in told
    assert told.count("\n") == 1
    assert not (tmp_path / "sessions").exists()


def test_the_service_goes_on_with_the_flight_of_its_own_source(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FIELDCAL_SESSIONS", str(tmp_path / "sessions"))
    names = {}
    for source in ("folder", "mavlink", "gphoto2"):
        with begin(source) as session:
            folder = tmp_path if source == "folder" else session.folder / "photos"
            data = {"folder": str(folder), "source": source}
            session.add_event(Event(STARTED, Stamp(1.7e9, ClockName.UTC), data))
            names[source] = session.folder.name
    assert unended(None, "mavlink") == names["mavlink"]
    assert unended(None, "gphoto2") == names["gphoto2"]
    assert unended(tmp_path) == names["folder"]
    assert unended(tmp_path / "other") is None

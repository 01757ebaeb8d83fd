"""Marking by hand: snapping, prediction, the file, the page in a real browser, and what its door refuses."""

from __future__ import annotations

import http.client
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from browser import CHROMIUM, Browser
from marked_photos import CAMERA, FOCAL_35_MM, Site, build
from PIL import Image

from calib.camera import BrownCamera, FloatArray
from calib.control_files import ControlPoint, Mark, read_marks, read_points
from calib.control_output import ControlReport
from calib.errors import FormatError, InputError, PhotoError
from calib.marking.book import MarkBook, check_names, read_book
from calib.marking.pictures import Picture, cut_out, decode, levels
from calib.marking.predict import predict
from calib.marking.snap import snap
from daemon import cli

LENS = BrownCamera.ideal(CAMERA.width, CAMERA.height, FOCAL_35_MM / 36 * CAMERA.width)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    return build(tmp_path_factory.mktemp("site") / "photos")


# --- Snapping ------------------------------------------------------------------------------------


def _drawn(shape: Callable[[FloatArray, FloatArray], FloatArray], seed: int, noise: float = 2.0) -> Picture:
    """A square of 80 px, each pixel the mean of 6 x 6 samples, with noise."""
    v, u = (np.mgrid[:480, :480] + 0.5) / 6
    image = shape(u, v).reshape(80, 6, 80, 6).mean(axis=(1, 3))
    image += np.random.default_rng(seed).normal(0, noise, image.shape)
    return np.repeat(np.clip(image, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


TRUE_U, TRUE_V = 40.3, 38.8


def _disc(u: FloatArray, v: FloatArray) -> FloatArray:
    return np.where(np.hypot((u - TRUE_U) / 1.5, v - TRUE_V) < 4, 30.0, 150 + u / 2)


def _checker(u: FloatArray, v: FloatArray) -> FloatArray:
    along = (u - TRUE_U) * np.cos(0.3) + (v - TRUE_V) * np.sin(0.3)
    across = (v - TRUE_V) * np.cos(0.3) - (u - TRUE_U) * np.sin(0.3)
    return np.where((along > 0) == (across > 0), 40.0, 200.0)


@pytest.mark.parametrize(("shape", "onto"), [(_disc, "target"), (_checker, "corner")])
def test_marks_snap_to_what_was_meant(shape: Callable[..., FloatArray], onto: str) -> None:
    for seed, (u, v) in enumerate([(40, 39), (45, 36), (36, 42), (40.3, 45.5)]):
        found = snap(_drawn(shape, seed), u, v, 12)
        assert found is not None
        assert found.onto == onto
        assert np.hypot(found.u_px - TRUE_U, found.v_px - TRUE_V) < 0.08


def test_marks_stay_where_there_is_nothing() -> None:
    edge = _drawn(lambda u, v: np.where(u + 0.3 * v > 50, 40.0, 200.0), 0)
    assert snap(edge, 38, 40, 12) is None
    assert snap(_drawn(lambda u, _: 120 + 0 * u, 0, 25), 40, 40, 12) is None
    # Further than the reach, and at the picture's corners.
    assert snap(_drawn(_disc, 0), 60, 60, 8) is None
    for corner in ((0, 0), (80, 80), (0, 80), (80, 0)):
        assert snap(_drawn(_disc, 0), *corner, 12) is None


# --- Prediction ----------------------------------------------------------------------------------


def _points(site: Site) -> dict[str, ControlPoint]:
    return {
        name: ControlPoint(name, (float(x), float(y), float(z)))
        for name, (x, y, z) in zip(site.names, site.xyz_m, strict=True)
    }


@pytest.mark.parametrize("known", [range(4), range(5), (0, 2, 5, 7), range(9)], ids=str)
def test_the_rest_is_predicted(site: Site, known: range | tuple[int, ...]) -> None:
    """Five in a plane among them, by which OpenCV's RANSAC alone misses by a thousand pixels."""
    for photo in range(4):
        marked = {site.names[i]: tuple(map(float, site.pixels[photo, i])) for i in known}
        found = predict(_points(site), marked, LENS)  # type: ignore[arg-type]
        assert found is not None
        assert found.doubtful == ()
        misses = [
            np.hypot(*(np.array(found.pixels[name]) - site.pixels[photo, i]))
            for i, name in enumerate(site.names)
        ]
        assert 0.01 < max(misses) < 8  # The lens's distortion is not known.


def test_swapped_marks_do_not_fit(site: Site) -> None:
    marked = {name: (float(u), float(v)) for name, (u, v) in zip(site.names, site.pixels[1], strict=True)}
    marked["T02"], marked["T07"] = marked["T07"], marked["T02"]
    found = predict(_points(site), marked, LENS)
    assert found is not None
    assert found.doubtful == ("T02", "T07")
    three = dict(list(marked.items())[:3])
    assert predict(_points(site), three, LENS) is None
    line = {name: ControlPoint(name, (float(i), 2.0 * i, 0.0)) for i, name in enumerate(site.names)}
    assert predict(line, marked, LENS) is None


# --- Files ---------------------------------------------------------------------------------------


def test_the_file_is_gone_on_with(tmp_path: Path) -> None:
    path = tmp_path / "marks.csv"
    assert read_book(path).marks == {}
    marks = (Mark("a, b.JPG", "T1", 1.25, 2.5), Mark("c.JPG", "T 2", 3.0, 0.125), Mark("c.JPG", "T1", 0, 0))
    book = MarkBook.of(marks)
    path.write_text(book.csv_text(), encoding="utf-8")
    assert read_marks(path).marks == marks
    again = read_book(path)
    assert tuple(again.marks.values()) == marks
    assert again.get("A, B.jpg", "T1") == marks[0]
    moved = again.with_mark(Mark("c.JPG", "T1", 9, 9)).without("a, b.jpg", "T1").without("x", "y")
    assert tuple(moved.marks.values()) == (marks[1], Mark("c.JPG", "T1", 9, 9))
    path.write_text(MarkBook().csv_text(), encoding="utf-8")
    assert read_book(path).marks == {}
    for other in ("EPSG:32630\n1 2 3 4 5 a.JPG\n", "a.JPG,T1,1,2,0.5\n", "photo,point,u_px,v_px,by\n", ""):
        path.write_text(other, encoding="utf-8")
        with pytest.raises(FormatError, match="written over"):
            read_book(path)


def test_names_that_would_be_lost_are_refused() -> None:
    check_names(["a.JPG", "b c.JPG"], ["T1"])
    for photos in (["a.JPG", "A.jpg"], ["#a.JPG"], ["a\\b.JPG"], ["a\n.JPG"], [" a.JPG"]):
        with pytest.raises(InputError, match=r"photo"):
            check_names(photos, [])


def test_pictures_are_as_stored(tmp_path: Path, site: Site) -> None:
    turned = decode(site.folder / site.photos[4])
    assert turned.shape == (CAMERA.height, CAMERA.width, 3)
    u, v = site.pixels[4, 0].astype(int)
    assert turned[v, u].max() < 60
    wide = np.zeros((301, 1603, 3), np.uint8)
    wide[:, 800:] = 200
    assert [level.shape[:2] for level in levels(wide)] == [(301, 1603), (151, 802), (76, 401)]
    file = tmp_path / "deep.tif"
    Image.fromarray(np.linspace(7000, 7400, 80 * 60).reshape(60, 80).astype(np.uint16)).save(file)
    deep = decode(file)
    assert deep.shape == (60, 80, 3)
    assert (deep[0, 0, 0], deep[-1, -1, 0]) == (0, 255)
    assert decode(file, 40).shape == (30, 40, 3)
    assert decode(site.folder / site.photos[4], 160).shape == (120, 160, 3)
    assert len(cut_out(wide, 0, 0, 40)) > 300
    assert len(cut_out(wide, 9999, 9999, 40)) > 300
    file.write_bytes(file.read_bytes()[:300])
    with pytest.raises(PhotoError, match="cannot be decoded"):
        decode(file)


# --- The page ------------------------------------------------------------------------------------


@contextmanager
def _running(site: Site, folder: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The command as a user runs it, and the address that it prints."""
    site.write_points(folder / "points.csv")
    words = ["calibrate", "mark", str(site.folder), "--points", "points.csv", "--marks", "marks.csv"]
    with subprocess.Popen(
        [sys.executable, "-m", "daemon.cli", *words],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1", "COLUMNS": "80"},
    ) as process:
        assert process.stdout is not None
        try:
            address = next((line.strip() for line in process.stdout if "http://" in line), "")
            assert address.startswith("http://127.0.0.1:")
            yield process, address
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)


def _ask(address: str, path: str, method: str = "GET", body: str | None = None, **headers: str) -> int:
    """The status of a request to the page's host, for exactly this path."""
    connection = http.client.HTTPConnection(urlsplit(address).netloc, timeout=20)
    try:
        connection.putrequest(method, path, skip_host="Host" in headers)
        for name, value in headers.items():
            connection.putheader(name, value)
        if body is not None:
            connection.putheader("Content-Length", str(len(body)))
        connection.endheaders(None if body is None else body.encode())
        return connection.getresponse().status
    finally:
        connection.close()


def test_only_the_page_is_answered(site: Site, tmp_path: Path) -> None:
    with _running(site, tmp_path) as (process, address):
        home = urlsplit(address).path
        assert _ask(address, home) == 200
        assert _ask(address, f"{home}state") == 200
        assert _ask(address, f"{home}photo/4/tile/0/1/0") == 200
        for path in (
            "/",
            "/state",
            "/favicon.ico",
            f"{home[:-2]}/state",
            f"/{'A' * 32}/state",
            "//",
            "state",
        ):
            assert _ask(address, path) == 403, path
        for host in ("evil.example", "127.0.0.1", "localhost", f"evil.example:{urlsplit(address).port}", ""):
            assert _ask(address, f"{home}state", Host=host) == 403, host
        assert _ask(address, f"{home}state", Host=f"localhost:{urlsplit(address).port}") == 200
        tries = ("../points.csv", "..%2fpoints.csv", "photo/../../etc/passwd", "/etc/passwd", "points.csv")
        for path in (*tries, "photo/5/thumb", "photo/-1/thumb", "photo/0/tile/9/0/0", "photo/0/tile/0/9/9"):
            assert _ask(address, home + path) == 404, path
        put = json.dumps({"photo": 0, "point": "T01", "at": [10, 10]})
        assert _ask(address, f"{home}mark", "POST", put, Origin="http://evil.example") == 403
        assert _ask(address, "/mark", "POST", put) == 403
        assert _ask(address, f"{home}mark", "POST", "x" * 70_000) == 413
        for size in ("-5", "9" * 5000, "", "1e3"):
            assert _ask(address, f"{home}mark", "POST", **{"Content-Length": size}) == 403
        assert _ask(address, f"{home}state", "GET", put) == 403
        for method in ("PUT", "DELETE", "OPTIONS", "HEAD", "CONNECT"):
            assert _ask(address, f"{home}mark", method) == 501
        for wrong in (
            '{"photo": 9, "point": "T01", "at": null}',
            '{"photo": 0, "point": "T99", "at": null}',
            "[",
        ):
            assert _ask(address, f"{home}mark", "POST", wrong) == 422
        for at in ([-1, 5], [5, 481], ["nan", 5]):
            assert _ask(address, f"{home}mark", "POST", json.dumps({**json.loads(put), "at": at})) == 422
        assert not (tmp_path / "marks.csv").exists()
        assert _ask(address, f"{home}mark", "POST", put) == 200
        assert read_marks(tmp_path / "marks.csv").marks == (Mark("IMG_1.JPG", "T01", 10, 10),)
        # What another program wrote meanwhile is not written over.
        (tmp_path / "marks.csv").write_text("theirs", encoding="utf-8")
        assert _ask(address, f"{home}save", "POST", "") == 422
        assert (tmp_path / "marks.csv").read_text(encoding="utf-8") == "theirs"
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0


class Page:
    """The marking page under test."""

    def __init__(self, browser: Browser, address: str) -> None:
        self.browser = browser
        browser.open(address, 1100, 700)
        self.until("said", "Click the point")

    def text(self, name: str) -> str:
        return str(self.browser.evaluate(f"document.getElementById('{name}').textContent"))

    def until(self, name: str, start: str) -> None:
        self.browser.until(f"document.getElementById('{name}').textContent.startsWith({json.dumps(start)})")

    def click(self, pixel: FloatArray, turned: bool = False) -> None:
        self.browser.press("0")  # The page may have moved it, to bring the point into view.
        box = "document.getElementById('view').getBoundingClientRect()"
        left, top, width, height = self.browser.evaluate(f"(r => [r.left, r.top, r.width, r.height])({box})")
        size = np.array([CAMERA.width, CAMERA.height])
        x, y = pixel - size / 2
        if turned:
            x, y, size = -y, x, size[::-1]
        scale = 0.98 * float(np.min([width, height] / size))
        self.browser.click(left + width / 2 + scale * x, top + height / 2 + scale * y)


def _place(file: Path) -> tuple[float, float]:
    """Where the first point is marked in the first photo, by the file."""
    mark = read_book(file).get("IMG_1.JPG", "T01")
    assert mark is not None
    return mark.u_px, mark.v_px


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_marked_in_a_browser_and_calibrated(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ten points in five photos, an undo, saved, loaded again, gone on with and used."""
    file = tmp_path / "marks.csv"
    random = np.random.default_rng(1)
    with _running(site, tmp_path) as (process, address), Browser(tmp_path / "profile") as browser:
        page = Page(browser, address)
        for photo, name in enumerate(site.photos):
            page.until("photo", name)
            for i, point in enumerate(site.names):
                if photo == 1 and i == 6:  # By the keyboard alone, where it is predicted.
                    browser.press("Enter")
                else:
                    page.click(site.pixels[photo, i] + random.uniform(-2, 2, 2), turned=photo == 4)
                page.until("said", f"{point} marked on the target")
                browser.press("n")
            browser.press("PageDown")
        page.until("photo", site.photos[0])
        before = file.read_bytes()
        # A click astray without snapping, a nudge, and both undone.
        browser.press("t")
        page.click(np.array([320.0, 240.0]))
        page.until("said", "T01 marked.")
        astray = _place(file)
        assert astray == pytest.approx((320, 240), abs=1)
        for key, modifiers in (("ArrowRight", 0), ("ArrowRight", 0), ("ArrowDown", 0), ("ArrowLeft", 8)):
            browser.press(key, modifiers)
        shown = f"Mark: {astray[0] - 0.8:.2f}, {astray[1] + 0.1:.2f} px"
        page.until("where", shown)
        assert _place(file) == pytest.approx((astray[0] - 0.8, astray[1] + 0.1), abs=0.002)
        browser.press("u")
        page.until("said", "Undone")
        assert _place(file) == astray
        browser.evaluate("document.getElementById('undo').click()")
        browser.until(f"!document.getElementById('where').textContent.startsWith('Mark: {astray[0]:.0f}')")
        browser.press("s", modifiers=2)
        page.until("said", "Saved in marks.csv")
        assert sorted(file.read_bytes().splitlines()) == sorted(before.splitlines())
        page = Page(browser, address)
        assert "50 marks in all" in page.text("counts")
        assert browser.evaluate("document.querySelectorAll('#points .marked').length") == 10
        assert browser.evaluate("document.querySelectorAll('#others img').length") == 4
        browser.press("Delete")
        page.until("said", "T01 removed")
        browser.press("u")
        page.until("said", "Undone")
        assert browser.errors == []
        own = {"http", "data"}
        assert {urlsplit(url).scheme for url in browser.requests} <= own
        assert all(url.startswith((address, "data:")) for url in browser.requests)
        browser.evaluate("document.getElementById('finish').click()")
        assert process.wait(20) == 0
        assert process.stdout is not None
        said = process.stdout.read()
    assert "50 marks of 10 points in 5 photos in marks.csv." in said
    marks = {(mark.photo, mark.point): (mark.u_px, mark.v_px) for mark in read_marks(file).marks}
    true = {(p, t): site.pixels[i, j] for i, p in enumerate(site.photos) for j, t in enumerate(site.names)}
    misses = [np.hypot(*(np.array(marks[key]) - pixel)) for key, pixel in true.items()]
    assert np.max(misses) < 0.15
    monkeypatch.setenv("FIELDCAL_STORE", str(tmp_path / "store"))
    monkeypatch.chdir(tmp_path)
    next_line = next(line for line in said.splitlines() if line.startswith("Next: fieldcal "))
    assert cli.run([*next_line.split()[2:], "--json", "-", "--mark-sigma-px", "0.05"]) in (0, 3)
    report = ControlReport.model_validate_json(capsys.readouterr().out)
    assert report.control.marks == 50
    assert report.blunders == []
    assert report.control.rms_px is not None
    assert 0.005 < report.control.rms_px < 0.1
    assert abs(report.parameters["f_px"] - CAMERA.f_px) < 4 * report.sigma["f_px"] < 10


def test_refusals_of_the_command(site: Site, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = site.write_points(tmp_path / "points.csv")
    words = ["calibrate", "mark", str(site.folder), "--points", str(points), "--marks"]
    (tmp_path / "other.csv").write_text("name,x\nA,1\n", encoding="utf-8")
    for marks, said in (
        (tmp_path / "other.csv", "written over"),
        (tmp_path / "no" / "m.csv", "no such folder"),
    ):
        assert cli.run([*words, str(marks)]) == 2
        assert said in capsys.readouterr().err
    assert len(read_points(points)) == 10

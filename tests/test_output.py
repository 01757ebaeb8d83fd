import errno
import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import result_factory
from disks import mounted

import calib.output
from calib.errors import OutputError
from calib.files import check_writable, write_text_atomic
from calib.findings import Verdict
from calib.output import write_outputs
from calib.result import CheckResult


@pytest.fixture(scope="module")
def result() -> CheckResult:
    return result_factory.build(points=200)


def _files(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_writes_report_json_and_exports(result: CheckResult, tmp_path: Path) -> None:
    out = tmp_path / "new" / "out"
    exports = write_outputs(result, out)
    data = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert data["exports"] == exports
    assert (out / "report.html").read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    for target in exports.values():
        assert (out / target).exists()
        assert f'href="./{target}"' in (out / "report.html").read_text(encoding="utf-8")
    assert not [path for path in out.iterdir() if path.name.startswith(".")]


def test_a_second_check_replaces_the_first(result: CheckResult, tmp_path: Path) -> None:
    write_outputs(result, tmp_path)
    (tmp_path / "exports" / "mine.txt").write_text("keep")
    write_outputs(result_factory.build(Verdict.TRUST, gps=False, points=200), tmp_path)
    files = _files(tmp_path)
    assert json.loads((tmp_path / "report.json").read_text())["verdict"] == "TRUST"
    assert "exports/geo.txt" not in files
    assert "exports/colmap/images.txt" in files
    assert (tmp_path / "exports" / "mine.txt").read_text() == "keep"


def test_a_failure_leaves_the_earlier_files_alone(
    result: CheckResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_outputs(result, tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    def full(_: CheckResult) -> str:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(calib.output, "render_report", full)
    with pytest.raises(OutputError, match=r"disk is full"):
        write_outputs(result_factory.build(Verdict.TRUST, points=200), tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    assert not list(tmp_path.glob(".fieldcal-*"))


def test_an_interrupt_leaves_nothing_behind(
    result: CheckResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(_: CheckResult) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr(calib.output, "report_json", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_outputs(result, tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    """A real file system of two megabytes."""
    with mounted(tmp_path, 2) as disk:
        yield disk


def test_a_full_disk_is_one_sentence(result: CheckResult, tiny_disk: Path) -> None:
    with pytest.raises(OutputError, match=rf"^Cannot write {tiny_disk}/out: the disk is full; .*\.$"):
        write_outputs(result, tiny_disk / "out")
    assert _files(tiny_disk) == set()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this machine")
def test_a_full_device_is_one_sentence() -> None:
    with pytest.raises(OutputError, match=r"^Cannot write /dev/full: the disk is full; .*\.$"):
        write_text_atomic(Path("/dev/full"), "text")


def test_a_file_in_the_way(result: CheckResult, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match="there is a file of that name"):
        write_outputs(result, tmp_path / "file")
    with pytest.raises(OutputError, match="part of the path is a file"):
        write_outputs(result, tmp_path / "file" / "out")
    (tmp_path / "exports").write_text("x")
    with pytest.raises(OutputError, match=r"Cannot write .*/exports: there is a file of that name"):
        write_outputs(result, tmp_path)
    assert (tmp_path / "file").read_text() == "x"
    assert _files(tmp_path) == {"file", "exports"}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_folder_that_may_not_be_written(tmp_path: Path) -> None:
    locked = tmp_path / "locked"
    locked.mkdir()
    for folder in (tmp_path, *tmp_path.parents):
        if folder.stat().st_uid == os.geteuid() and folder != Path("/"):
            folder.chmod(folder.stat().st_mode | 0o055)
        if folder.parent == Path("/tmp"):
            break
    locked.chmod(0o555)
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        # An unprivileged child: root may write anywhere.
        if os.geteuid() == 0:
            os.setuid(65534)
        try:
            check_writable(locked)
            message = "no error"
        except OutputError as error:
            message = str(error)
        os.write(write, message.encode())
        os._exit(0)
    os.close(write)
    message = os.read(read, 4096).decode()
    os.close(read)
    os.waitpid(child, 0)
    assert message == f"Cannot write {locked}: you may not write there; choose another place."


def test_atomic_text(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_text_atomic(path, "first")
    path.chmod(0o640)
    write_text_atomic(path, "zweite ✓")
    assert path.read_text(encoding="utf-8") == "zweite ✓"
    assert _files(tmp_path) == {"a.json"}
    with pytest.raises(OutputError, match="there is a folder of that name"):
        write_text_atomic(tmp_path, "x")
    with pytest.raises(OutputError, match=r"Cannot write .*no/such/a\.json: .*\.$"):
        write_text_atomic(tmp_path / "no" / "such" / "a.json", "x")
    assert _files(tmp_path) == {"a.json"}


def test_new_files_have_ordinary_permissions(tmp_path: Path) -> None:
    (tmp_path / "ordinary").write_text("x")
    write_text_atomic(tmp_path / "ours", "x")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "ordinary").stat().st_mode

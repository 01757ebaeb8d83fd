"""Files that are there whole or not at all, and errors of writing in one sentence."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from calib.errors import OutputError

_REASONS = {
    errno.ENOSPC: "the disk is full; free some space or choose another place",
    errno.EDQUOT: "your disk quota is used up; free some space or choose another place",
    errno.EACCES: "you may not write there; choose another place",
    errno.EPERM: "you may not write there; choose another place",
    errno.EROFS: "the disk is read-only; choose another place",
    errno.ENOENT: "there is no such folder; make it first or choose another place",
    errno.ENOTDIR: "part of the path is a file, not a folder; choose another place",
    errno.EEXIST: "there is a file of that name; choose another place",
    errno.EISDIR: "there is a folder of that name; choose another name",
    errno.ELOOP: "the path is a link that leads back to itself; choose another place",
    errno.ENAMETOOLONG: "the name is too long; choose a shorter one",
}


@contextmanager
def output_errors(target: Path) -> Iterator[None]:
    """Turns an ``OSError`` while writing to ``target`` into an ``OutputError`` with one sentence."""
    try:
        yield
    except OSError as error:
        reason = _REASONS.get(error.errno or 0, (error.strerror or str(error)).lower())
        raise OutputError(f"Cannot write {target}: {reason}.") from error


def write_text_atomic(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8, as :func:`write_bytes_atomic` does.

    Raises:
        OutputError: not writable, no such folder, disk full.
    """
    write_bytes_atomic(path, text.encode("utf-8"))


def write_bytes_atomic(path: Path, data: bytes) -> None:
    """Write ``data`` to a sibling and rename it to ``path``; an old file stays until then.

    Pipes and devices, which cannot be renamed over, are written to directly.

    Raises:
        OutputError: not writable, no such folder, disk full.
    """
    with output_errors(path):
        if path.exists() and not path.is_file() and not path.is_dir():
            path.write_bytes(data)
            return
        with staged(path) as fresh, fresh.open("wb") as file:
            file.write(data)


@contextmanager
def staged(path: Path) -> Iterator[Path]:
    """A sibling of ``path`` to write to, renamed to ``path`` at the end; gone if anything fails.

    Raises:
        OutputError: not writable, no such folder, disk full.
    """
    with output_errors(path):
        descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=path.suffix, dir=path.parent)
        os.close(descriptor)
    fresh = Path(name)
    try:
        yield fresh
        with output_errors(path):
            with fresh.open("rb") as file:
                settle(file.fileno())
            _open_to_all(fresh)
            fresh.replace(path)
    except BaseException:
        fresh.unlink(missing_ok=True)
        raise


def check_writable(out_dir: Path) -> None:
    """Make ``out_dir`` and try it out, so that a hopeless one is refused before the work, not after.

    Raises:
        OutputError: not a folder, not writable.
    """
    with output_errors(out_dir):
        out_dir.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(prefix=".fieldcal-", dir=out_dir):
            pass


@contextmanager
def output_folder(out_dir: Path) -> Iterator[None]:
    """Hold ``out_dir`` ready (:func:`check_writable`) for the work inside.

    If that fails or is interrupted, folders that were made here and are still empty go again.

    Raises:
        OutputError: not a folder, not writable.
    """
    with output_errors(out_dir):
        made = [folder for folder in (out_dir, *out_dir.parents) if not folder.exists()]
    try:
        check_writable(out_dir)
        yield
    except BaseException:
        for folder in made:
            with suppress(OSError):
                folder.rmdir()
        raise


def check_file_writable(path: Path) -> None:
    """Refuse a file that :func:`write_text_atomic` could not write, before the work, not after.

    Raises:
        OutputError: no such folder, not writable, a folder.
    """
    with output_errors(path):
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        if path.exists() and not path.is_file():
            if not os.access(path, os.W_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
            return
        with tempfile.NamedTemporaryFile(prefix=".fieldcal-", dir=path.parent):
            pass


def settle(descriptor: int) -> None:
    """Have the bytes on the disk before the rename, which would otherwise promise too much."""
    os.fsync(descriptor)


def _open_to_all(path: Path) -> None:
    """Give a temporary file (made 0600) the permissions of an ordinary new file."""
    mask = os.umask(0)
    os.umask(mask)
    path.chmod(0o666 & ~mask)


def is_number(text: str) -> bool:
    """Whether a cell of a table is a number (NaN is one)."""
    try:
        float(text)
    except ValueError:
        return False
    return True

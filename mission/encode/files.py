"""Bytes of a mission file in and out."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from calib.errors import FormatError, InputError

#: No mission file is larger; a larger one is something else, or meant to harm.
LARGEST_BYTES = 64 * 1024 * 1024


def write_bytes_atomic(path: Path, data: bytes) -> None:
    """Write to a sibling and rename it to ``path``; an old file stays until then.

    Raises:
        OutputError: not writable, no such folder, disk full.
    """
    # Only here: that module brings the whole report with it.
    from calib.output import output_errors

    with output_errors(path):
        if path.exists() and not path.is_file() and not path.is_dir():
            path.write_bytes(data)
            return
        descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            mask = os.umask(0)
            os.umask(mask)
            Path(name).chmod(0o666 & ~mask)
            Path(name).replace(path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise


def read_bytes(path: Path) -> bytes:
    """All of a file.

    Raises:
        InputError: missing, not readable, larger than any mission.
    """
    try:
        with path.open("rb") as file:
            data = file.read(LARGEST_BYTES + 1)
    except OSError as error:
        raise InputError(f"Cannot read {path}: {(error.strerror or str(error)).lower()}.") from error
    if len(data) > LARGEST_BYTES:
        raise InputError(f"{path} has more than {LARGEST_BYTES >> 20} MB, which no mission file has.")
    return data


def text_of(data: bytes, what: str) -> str:
    """UTF-8 text (with or without a byte order mark), or FormatError."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FormatError(f"{what} is not text (UTF-8): it is no mission, or a damaged one.") from error

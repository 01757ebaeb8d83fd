"""Bytes of a mission file that somebody else may have written."""

from __future__ import annotations

from pathlib import Path

from calib.errors import FormatError, InputError

#: No mission file is larger; a larger one is something else, or meant to harm.
LARGEST_BYTES = 64 * 1024 * 1024


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

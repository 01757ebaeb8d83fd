"""Paths as the user gives them -> photo files, in the order a person would list them."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from calib.errors import InputError
from calib.photos.container import OTHER_SUFFIXES, PHOTO_SUFFIXES, RAW_SUFFIXES

#: Folders on cards that hold previews and logs, system folders, and our own output.
_SKIPPED_FOLDERS = frozenset(
    {
        "misc",
        "thm",
        "thumbnails",
        "thumbs",
        "fieldcal-out",
        "$recycle.bin",
        "lost+found",
        "@eadir",
        "__macosx",
    }
    | {"system volume information"}
)
_CONVERTIBLE = RAW_SUFFIXES | OTHER_SUFFIXES


def collect(paths: Sequence[Path]) -> list[Path]:
    """Photo files among ``paths`` (files and folders, recursively), each once, in natural order.

    A file that is named is always taken, whatever it is called: reading it says what it is. In
    folders, hidden files, thumbnails and DJI's MISC are passed over, and so are raw and HEIC files
    that have a JPEG beside them.

    Raises:
        InputError: a path does not exist, a folder cannot be read or holds no photo; one sentence.
    """
    if not paths:
        raise InputError("No photos were given; name a folder or photo files.")
    found: dict[str, Path] = {}
    for path in paths:
        for file in _photos_of(Path(path)):
            found.setdefault(os.path.realpath(file), file)
    return list(found.values())


def _photos_of(path: Path) -> list[Path]:
    if not path.is_dir():
        if os.path.lexists(path):
            return [path]
        raise InputError(
            f"There is no file or folder {path}; check the path, or whether the card is mounted."
        )
    photos, others = photos_below(path)
    if not photos:
        seen = ", ".join(f"{count} {suffix}" for suffix, count in others.most_common(4))
        raise InputError(f"There are no photos in {path}{f' (only {seen})' if seen else ', it is empty'}.")
    return photos


def photos_below(folder: Path) -> tuple[list[Path], Counter[str]]:
    """Photo files of a folder as :func:`collect` takes them, perhaps none, and the suffixes of other files.

    Raises:
        InputError: the folder, or one below it, cannot be read; one sentence.
    """
    others: Counter[str] = Counter()
    photos: list[Path] = []
    convertible: list[Path] = []
    for file in _walk(folder):
        suffix = file.suffix.lower()
        if suffix in PHOTO_SUFFIXES:
            photos.append(file)
        elif suffix in _CONVERTIBLE:
            convertible.append(file)
        else:
            others[suffix or "no extension"] += 1
    developed = {file.with_suffix("") for file in photos}
    photos += [file for file in convertible if file.with_suffix("") not in developed]
    return sorted(photos, key=_natural), others


def _walk(top: Path) -> Iterator[Path]:
    """Files below a folder; links to folders are followed, each folder is visited once."""
    visited: set[tuple[int, int]] = set()
    pending = [top]
    while pending:
        folder = pending.pop()
        try:
            status = folder.stat()
            if (status.st_dev, status.st_ino) in visited:
                continue
            visited.add((status.st_dev, status.st_ino))
            with os.scandir(folder) as entries:
                children = list(entries)
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            raise InputError(f"The folder {folder} cannot be read: {reason}.") from error
        for entry in children:
            if entry.name.startswith("."):
                continue
            if _is_folder(entry):
                if entry.name.lower() not in _SKIPPED_FOLDERS:
                    pending.append(Path(entry.path))
            else:
                yield Path(entry.path)


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:
        return False  # A link that points to itself: reading it as a photo will say so.


def _natural(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Sort key under which DJI_2 comes before DJI_10."""
    parts = re.split(r"(\d+)", str(path).lower())
    return tuple((1, int(p), p) if p.isascii() and p.isdigit() else (0, 0, p) for p in parts if p)

"""Photos from a folder that somebody else fills: a card, a tethering program, an FTP server.

Looked at again and again (:meth:`HotFolder.poll`), files are only ever read. A photo is taken when
it has stopped changing *and* is whole: copying programs pause, and some claim a file's full size first.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from calib.errors import InputError, PhotoError
from calib.photos.collect import photos_below
from calib.photos.photo import Photo
from calib.photos.read import read_photo

#: Size, time of change in ns, and inode: any of them new is another file.
_Mark = tuple[int, int, int]
_BLOCK = 1 << 20
#: Files by their absolute paths: size, time of change in ns.
Marks = Mapping[Path, tuple[int, int]]


@dataclass(frozen=True)
class Arrival:
    """A whole photo, and what names its content for good."""

    photo: Photo
    sha256: str
    size_bytes: int


@dataclass(frozen=True)
class Poll:
    """What one look found: photos new or changed since, whole files in the folder, files that are not
    whole yet, and why the folder cannot be read now ("": it can)."""

    arrived: tuple[Arrival, ...]
    whole: int
    waiting: tuple[Path, ...]
    fault: str = ""


@dataclass
class _Seen:
    mark: _Mark
    since_s: float
    tried_s: float
    whole: bool = False


class HotFolder:
    """A folder and what has come in it.

    Args:
        settle_s: a file that has not changed for so long may be finished.
        passed_over: files that are none of this flight's while they are as they were (:func:`marks`).
        clock: seconds on a clock that never steps.
    """

    def __init__(
        self,
        folder: Path,
        settle_s: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
        passed_over: Marks = MappingProxyType({}),
    ) -> None:
        self.folder = folder
        self._passed_over = passed_over
        self._settle_s = settle_s
        self._clock = clock
        self._seen: dict[Path, _Seen] = {}
        self._whole = 0

    def poll(self) -> Poll:
        """Look once. A folder that is away (a card pulled) is a fault that may pass; nothing is forgotten."""
        try:
            files = self.files()
        except InputError as error:
            return Poll((), self._whole, (), self._absence(error))
        now = self._clock()
        arrived, waiting = [], []
        for file in files:
            arrival = self._look(file, now)
            if arrival is not None:
                arrived.append(arrival)
            elif not self._seen[file].whole:
                waiting.append(file)
        self._whole = sum(self._seen[file].whole for file in files)
        return Poll(tuple(arrived), self._whole, tuple(waiting))

    def files(self) -> list[Path]:
        """The photo files in the folder that are not passed over, whole or not.

        Raises:
            InputError: the folder cannot be read.
        """
        files = photos_below(self.folder)[0]
        if not self._passed_over:
            return files
        return [file for file in files if self._passed_over.get(file.absolute()) != _mark(file)[:2]]

    def _absence(self, error: InputError) -> str:
        if not self.folder.exists():
            return f"The folder {self.folder} is away; put the card back, or check the connection."
        return str(error)

    def _look(self, file: Path, now_s: float) -> Arrival | None:
        mark = _mark(file)
        seen = self._seen.get(file)
        if seen is None or seen.mark != mark:
            self._seen[file] = _Seen(mark, now_s, now_s)
            return None
        # What is not whole is tried again: some copies fill a file without changing size or time.
        if seen.whole or now_s - seen.since_s < self._settle_s or now_s - seen.tried_s < self._settle_s:
            return None
        seen.tried_s = now_s
        try:
            photo = read_photo(file)
            digest = _sha256(file)
        except (PhotoError, OSError):
            return None
        if _mark(file) != mark:  # It changed while it was read.
            return None
        seen.whole = True
        return Arrival(photo, digest, mark[0])


def marks(folder: Path) -> Marks:
    """The photo files of a folder as they are now.

    Raises:
        InputError: the folder cannot be read.
    """
    return {file.absolute(): _mark(file)[:2] for file in photos_below(folder)[0]}


def _mark(file: Path) -> _Mark:
    try:
        status = file.stat()
    except OSError:  # Gone, or a link that leads nowhere.
        return (-1, 0, 0)
    return (status.st_size, status.st_mtime_ns, status.st_ino)


def _sha256(file: Path) -> str:
    digest = hashlib.sha256()
    with file.open("rb") as content:
        while block := content.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()

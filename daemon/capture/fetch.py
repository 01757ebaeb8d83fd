"""Photos that the vehicle's camera offers (``file_url`` of CAMERA_IMAGE_CAPTURED), fetched as it tells.

Into a folder that is watched like any other: a photo appears there whole, under the number of its trigger
and its own last name. What came of one before a cut or a kill stays beside it and is gone on from.
"""

from __future__ import annotations

import os
import queue
import re
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from calib.errors import PhotoError
from calib.photos.container import OTHER_SUFFIXES, PHOTO_SUFFIXES, RAW_SUFFIXES
from calib.photos.read import read_photo
from daemon.capture.bringer import Bringer
from daemon.capture.trigger_book import Offer, TriggerBook
from daemon.capture.web import SCHEMES, read_web
from daemon.link.ftp import address_of, read_file
from daemon.link.live import Link
from daemon.remote import CutError, RefusedError

#: Photos handed to the thread ahead of time; the others wait in the record.
_AHEAD = 2
#: A refusal is taken for the last word after so many.
_TRIES = 3
_WAIT_S, _MOST_WAIT_S = 1.0, 20.0
#: Nothing came for so long although something is offered: worth a word.
_STUCK_S = 10.0
_NAME = re.compile(r"[^A-Za-z0-9._-]+")
_NUMBER = re.compile(r"(\d{5,})-")
_SUFFIXES = PHOTO_SUFFIXES | OTHER_SUFFIXES | RAW_SUFFIXES


def local_name(offer: Offer) -> str:
    """Of the file on this computer: nothing in an address leads out of the folder or hides the file."""
    last = re.split(r"[/\\]", offer.url.partition("?")[0].rstrip("/"))[-1]
    name = _NAME.sub("_", last).lstrip("._-")[-60:] or "photo"
    if Path(name).suffix.lower() not in _SUFFIXES:
        name += ".JPG"
    return f"{offer.number:05d}-{name}"


@dataclass
class _Try:
    due_s: float = 0.0
    wait_s: float = _WAIT_S
    refusals: int = 0


@dataclass(frozen=True)
class _End:
    """How one try ended; ``error`` None: the photo is there. ``came``: bytes of it did."""

    offer: Offer
    error: RefusedError | CutError | OSError | None
    came: bool = False


class Fetcher(Bringer):
    """One thread that fetches, one photo after the other in the order of their numbers.

    Args:
        link: the vehicle's; used for ``mftp://``, closed by the caller after this.
        clock: seconds on a clock that never steps.
    """

    def __init__(
        self, book: TriggerBook, folder: Path, link: Link, clock: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__(clock())
        self._book, self._folder, self._link, self._clock = book, folder, link, clock
        self._there = _numbers_in(folder)
        self._anchors = {name: number for number, name in self._there.items()}
        self._tries: dict[int, _Try] = {}
        self._given_up: set[int] = set()
        self._in_hand: set[int] = set()
        self._work: queue.Queue[Offer] = queue.Queue(_AHEAD)
        self._ends: queue.SimpleQueue[_End] = queue.SimpleQueue()
        self._bytes = self._bytes_seen = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fetch", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """What is not there stays where it is. Again does no harm."""
        self._stop.set()
        self._thread.join(2)

    # -- for the flight's thread -------------------------------------------------------------------

    @property
    def missing(self) -> int:
        return sum(number not in self._there for number in self._book.offers)

    def anchors(self) -> dict[str, int]:
        found, self._anchors = self._anchors, {}
        return found

    def poll(self) -> None:
        """Hand out what is due, take in what has ended."""
        now = self._clock()
        if self._bytes != self._bytes_seen:
            self._bytes_seen, self.moved_s = self._bytes, now
        while not self._ends.empty():
            self._ended(self._ends.get(), now)
        for number, offer in self._book.offers.items():
            if number in self._there or number in self._given_up or number in self._in_hand:
                continue
            if self._tries.setdefault(number, _Try()).due_s > now:
                continue
            if self._work.full():
                break
            self._in_hand.add(number)
            self._work.put_nowait(offer)
        if self._fault is None and self._in_hand and now - self.moved_s > _STUCK_S:
            self._fault = "No photo comes from the camera although it offers some."

    def _ended(self, end: _End, now_s: float) -> None:
        number, error = end.offer.number, end.error
        self._in_hand.discard(number)
        tried = self._tries.setdefault(number, _Try())
        if error is None:
            self._there[number] = name = local_name(end.offer)
            self._anchors[name] = number
            self._fault, self.moved_s = None, now_s
            return
        tried.wait_s = _WAIT_S if end.came else min(2 * tried.wait_s, _MOST_WAIT_S)
        tried.due_s = now_s + tried.wait_s
        if isinstance(error, RefusedError):
            tried.refusals += 1
            if tried.refusals >= _TRIES:
                self._given_up.add(number)
                self._news.append(("warning", f"Photo {number} cannot be fetched from the camera: {error}."))
            return
        reason = f"{self._folder} cannot be written: {error}" if isinstance(error, OSError) else str(error)
        self._failed(f"Photos cannot be fetched now: {reason}.")

    # -- the thread --------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                offer = self._work.get(timeout=0.1)
            except queue.Empty:
                continue
            before, error = self._bytes, None
            try:
                self._fetch(offer)
            except (RefusedError, CutError, OSError) as caught:
                error = caught
            if not self._stop.is_set():
                self._ends.put(_End(offer, error, self._bytes > before))

    def _fetch(self, offer: Offer) -> None:
        part = self._folder / f".{local_name(offer)}.part"
        try:
            with part.open("ab") as file:
                for block in self._blocks(offer, file.tell()):
                    if self._stop.is_set():
                        return
                    if block is None:
                        file.truncate(0)
                        continue
                    file.write(block)
                    self._bytes += len(block)
                file.flush()
                os.fsync(file.fileno())
            try:
                read_photo(part)
            except PhotoError as error:
                raise RefusedError("what came is no whole photo") from error
        except RefusedError:
            part.unlink(missing_ok=True)  # The next try begins anew.
            raise
        part.replace(self._folder / local_name(offer))

    def _blocks(self, offer: Offer, start_byte: int) -> Iterator[bytes | None]:
        at = address_of(offer.url, offer.component_id)
        if at is not None:
            return read_file(self._link, *at, start_byte, lambda: not self._stop.is_set())
        if offer.url.partition(":")[0].lower() in SCHEMES:
            return read_web(offer.url, start_byte)
        raise RefusedError(f"an address like {offer.url[:40]!r} is not one of mftp, http or https")


def _numbers_in(folder: Path) -> dict[int, str]:
    """Number of the vehicle's photo -> name of its file, for those in the folder."""
    found = {}
    for path in folder.iterdir():
        number = _NUMBER.match(path.name)
        if number is not None:
            found[int(number[1])] = path.name
    return found

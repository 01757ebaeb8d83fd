"""The desk behind the marking page: photos in pieces, marks kept and written, positions predicted."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from calib.camera import BrownCamera
from calib.control_files import ControlPoint, Mark
from calib.errors import InputError, OutputError, PhotoError
from calib.files import output_errors, write_bytes_atomic
from calib.marking.book import MarkBook, check_names, read_book
from calib.marking.pictures import TILE_PX, Picture, cut_out, decode, jpeg, levels, tile
from calib.marking.predict import Prediction, predict
from calib.marking.snap import snap
from calib.photos.photo import Photo
from daemon.web import Reply

#: Photos are kept decoded up to so many bytes together; the one being marked in any case.
_KEPT_BYTES = 500_000_000
_THUMBNAIL_PX = 160
_CUT_OUT_HALF_PX = 40
#: Quarter turns clockwise that show a photo upright, by EXIF orientation; mirrored ones are shown as stored.
_TURNS = {3: 2, 6: 1, 8: 3}
_FILES = {
    "": ("mark.html", "text/html; charset=utf-8"),
    "mark.js": ("mark.js", "text/javascript; charset=utf-8"),
    "mark.css": ("mark.css", "text/css; charset=utf-8"),
}


class MarkRequest(BaseModel):
    """A mark put at ``at`` (px), or taken away (None); snapped within ``snap_px`` where that is given."""

    model_config = ConfigDict(extra="forbid")

    photo: int
    point: str
    at: tuple[FiniteFloat, FiniteFloat] | None
    snap_px: FiniteFloat | None = Field(default=None, gt=0, le=200)


class Shelf:
    """Photos decoded once, with their reduced levels; the longest unused make room."""

    def __init__(self, photos: Sequence[Photo]) -> None:
        self._photos = photos
        self._kept: OrderedDict[int, tuple[Picture, ...]] = OrderedDict()
        self._lock = threading.Lock()
        #: One a photo, so that one that is looked at does not wait for the next.
        self._decoding = [threading.Lock() for _ in photos]

    def levels(self, number: int) -> tuple[Picture, ...]:
        """
        Raises:
            PhotoError: it cannot be decoded, or to another size than its metadata say.
        """
        with self._decoding[number]:
            with self._lock:
                found = self._kept.get(number)
            found = found or self._decoded(number)
            with self._lock:
                self._kept[number] = found
                self._kept.move_to_end(number)
                while len(self._kept) > 1 and sum(map(_bytes, self._kept.values())) > _KEPT_BYTES:
                    self._kept.popitem(last=False)
        return found

    def _decoded(self, number: int) -> tuple[Picture, ...]:
        photo = self._photos[number]
        picture = decode(photo.path)
        if picture.shape[:2] != (photo.camera.height, photo.camera.width):
            raise PhotoError(f"{photo.path}: its pixels are not those that its metadata tell of.")
        return levels(picture)


def _bytes(pictures: tuple[Picture, ...]) -> int:
    return sum(picture.nbytes for picture in pictures)


class Desk:
    """Photos, points and marks of one sitting. Every change is written to ``path`` at once.

    Raises:
        InputError: names that do not fit, or ``path`` holds something else.
    """

    def __init__(
        self,
        photos: Sequence[Photo],
        points: Mapping[str, ControlPoint],
        path: Path,
        focal_px: float | None,
    ) -> None:
        self.photos, self.points, self.path = photos, points, path
        self.finished = threading.Event()
        self._book = read_book(path)
        #: What the file held when it was last read or written; None: there was none.
        self._written = path.read_bytes() if path.exists() else None
        # Points of an earlier sitting that are no longer in the list stay; they can be marked on.
        marked = (mark.point for mark in self._book.marks.values())
        self.names = tuple(dict.fromkeys((*points, *marked)))
        check_names((photo.path.name for photo in photos), self.names)
        self._focal_px = focal_px
        self._shelf = Shelf(photos)
        self._lock = threading.Lock()

    @property
    def book(self) -> MarkBook:
        return self._book

    def answer(self, parts: tuple[str, ...], body: bytes | None) -> Reply | None:
        """What the page asks for; see :mod:`daemon.web`."""
        match body, parts:
            case None, (("" | "mark.js" | "mark.css") as name,):
                file, kind = _FILES[name]
                return Reply(resources.files("calib").joinpath("data", file).read_bytes(), kind)
            case None, ("state",):
                return Reply.of_json(self._state())
            case None, ("photo", number, *rest) if (photo := self._number(number)) is not None:
                return self._picture(photo, rest)
            case bytes(), ("mark",):
                return Reply.of_json(self._change(body))
            case bytes(), ("save",):
                with self._lock:
                    self._save()
                return Reply.of_json({})
            case bytes(), ("finish",):
                with self._lock:
                    self._save()
                return replace(Reply.of_json({}), afterwards=self.finished.set)
        return None

    def _number(self, text: str) -> int | None:
        number = _whole(text)
        return number if number is not None and number < len(self.photos) else None

    def _state(self) -> dict[str, object]:
        numbers = {photo.path.name.lower(): i for i, photo in enumerate(self.photos)}
        return {
            "file": self.path.name,
            "tile_px": TILE_PX,
            "focal": self._focal_px is not None or any(photo.focal_px for photo in self.photos),
            "photos": [
                {
                    "name": photo.path.name,
                    "width": photo.camera.width,
                    "height": photo.camera.height,
                    "turn": _TURNS.get(photo.orientation, 0),
                }
                for photo in self.photos
            ],
            "points": [
                {
                    "name": name,
                    "known": name in self.points,
                    "check": name in self.points and self.points[name].check,
                }
                for name in self.names
            ],
            "marks": [
                [numbers[mark.photo.lower()], mark.point, mark.u_px, mark.v_px]
                for mark in self._book.marks.values()
                if mark.photo.lower() in numbers
            ],
        }

    def _picture(self, photo: int, rest: list[str]) -> Reply | None:
        match rest:
            case ["thumb"]:
                small = decode(self.photos[photo].path, _THUMBNAIL_PX)
                return Reply(jpeg(small), "image/jpeg", lasting=True)
            case ["tile", *where] if (at := _wholes(where, 3)) is not None:
                found = self._shelf.levels(photo)
                made = tile(found[at[0]], at[1], at[2]) if at[0] < len(found) else None
                return None if made is None else Reply(made, "image/jpeg", lasting=True)
            case ["cut", *where] if (at := _wholes(where, 2)) is not None:
                picture = self._shelf.levels(photo)[0]
                made = cut_out(picture, at[0], at[1], _CUT_OUT_HALF_PX)
                return Reply(made, "image/jpeg", lasting=True)
            case ["predicted"]:
                return Reply.of_json(self._predicted(photo))
        return None

    def _change(self, body: bytes) -> dict[str, object]:
        try:
            asked = MarkRequest.model_validate_json(body)
        except ValidationError as error:
            raise InputError(
                f"The page asked for something unknown ({error.error_count()} errors)."
            ) from error
        if not 0 <= asked.photo < len(self.photos) or asked.point not in self.names:
            raise InputError("The page asked for a photo or point that is not here; load it again.")
        photo = self.photos[asked.photo]
        mark, onto = None, None
        if asked.at is not None:
            u, v = asked.at
            if not (0 <= u <= photo.camera.width and 0 <= v <= photo.camera.height):
                raise InputError("That is outside of the photo.")
            if asked.snap_px is not None:
                snapped = snap(self._shelf.levels(asked.photo)[0], u, v, asked.snap_px)
                if snapped is not None:
                    u, v, onto = snapped.u_px, snapped.v_px, snapped.onto
            mark = Mark(photo.path.name, asked.point, u, v)
        with self._lock:
            before = self._book.get(photo.path.name, asked.point)
            if mark is None:
                self._book = self._book.without(photo.path.name, asked.point)
            else:
                self._book = self._book.with_mark(mark)
            failure = None
            try:
                self._save()
            except OutputError as error:
                failure = str(error)
        return {
            "before": None if before is None else [before.u_px, before.v_px],
            "at": None if mark is None else [mark.u_px, mark.v_px],
            "onto": onto,
            "not_saved": failure,
            "predicted": self._predicted(asked.photo),
        }

    def _save(self) -> None:
        data = self._book.csv_text().encode("utf-8")
        with output_errors(self.path):
            there = self.path.read_bytes() if self.path.exists() else None
        if there is not None and there != self._written:
            raise OutputError(
                f"Not saved: {self.path} was changed by another program; move it away, then press Save."
            )
        if there is None and not self._book.marks:
            return
        if there != data:
            write_bytes_atomic(self.path, data)
        self._written = data

    def _predicted(self, number: int) -> dict[str, object]:
        photo = self.photos[number]
        focal_px = self._focal_px or photo.focal_px
        found: Prediction | None = None
        if focal_px is not None:
            own = photo.path.name.lower()
            marked = {m.point: (m.u_px, m.v_px) for m in self._book.marks.values() if m.photo.lower() == own}
            camera = BrownCamera.ideal(photo.camera.width, photo.camera.height, focal_px)
            found = predict(self.points, marked, camera)
        if found is None:
            return {"pixels": {}, "doubtful": []}
        return {"pixels": found.pixels, "doubtful": found.doubtful}


def _whole(text: str) -> int | None:
    return int(text) if text.isascii() and text.isdigit() and len(text) < 7 else None


def _wholes(texts: Sequence[str], count: int) -> tuple[int, ...] | None:
    numbers = tuple(number for number in map(_whole, texts) if number is not None)
    return numbers if len(numbers) == len(texts) == count else None

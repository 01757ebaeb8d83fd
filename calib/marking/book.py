"""Marks made by hand, and the CSV that keeps them for ``calibrate control``."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from calib.control_files import Mark, base_name, read_marks, read_table_text
from calib.errors import FormatError, InputError

HEADER = ("photo", "point", "u_px", "v_px")
#: A thousandth of a pixel is far below what anybody can mark.
_DECIMALS = 3


@dataclass(frozen=True)
class MarkBook:
    """Marks by photo (name in lower case) and point, in the order in which they were made."""

    marks: Mapping[tuple[str, str], Mark] = field(default_factory=dict)

    @classmethod
    def of(cls, marks: Iterable[Mark]) -> MarkBook:
        return cls({_key(mark.photo, mark.point): mark for mark in marks})

    def get(self, photo: str, point: str) -> Mark | None:
        return self.marks.get(_key(photo, point))

    def with_mark(self, mark: Mark) -> MarkBook:
        """With a mark put or moved."""
        return MarkBook({**self.marks, _key(mark.photo, mark.point): mark})

    def without(self, photo: str, point: str) -> MarkBook:
        """With a mark taken away, where there is one."""
        gone = _key(photo, point)
        return MarkBook({key: mark for key, mark in self.marks.items() if key != gone})

    def csv_text(self) -> str:
        """As a table with the columns of ``HEADER``, pixels from the corner of the first one."""
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        table.writerow(HEADER)
        for mark in self.marks.values():
            table.writerow(
                (mark.photo, mark.point, f"{mark.u_px:.{_DECIMALS}f}", f"{mark.v_px:.{_DECIMALS}f}")
            )
        return text.getvalue()


def read_book(path: Path) -> MarkBook:
    """The marks of an earlier sitting; none where there is no file yet.

    Raises:
        FormatError: it cannot be read, or holds more than marks, which saving would lose.
    """
    if not path.exists():
        return MarkBook()
    first, *rest = read_table_text(path).splitlines() or [""]
    if tuple(cell.strip().lower() for cell in first.split(",")) != HEADER:
        raise FormatError(
            f"{path} is not a file of marks with the columns {','.join(HEADER)}, and would be written over: "
            "name another one with --marks."
        )
    return MarkBook.of(read_marks(path).marks) if any(line.strip() for line in rest) else MarkBook()


def check_names(photos: Iterable[str], points: Iterable[str]) -> None:
    """Refuse names that the file of marks could not tell apart or give back.

    Raises:
        InputError: with the name.
    """
    seen: set[str] = set()
    for name in photos:
        if name.lower() in seen:
            raise InputError(
                f"Two photos are named {name}: marks go by the name; mark them one folder at a time."
            )
        seen.add(name.lower())
        if base_name(name) != name or name.startswith("#") or not name.isprintable():
            raise InputError(f"The photo's name {name!r} does not fit a file of marks: rename it.")
    for name in points:
        if not name.isprintable():
            raise InputError(f"The point's name {name!r} does not fit a file of marks: rename it.")


def _key(photo: str, point: str) -> tuple[str, str]:
    return photo.lower(), point

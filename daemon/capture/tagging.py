"""Positions and angles of a recorded flight's sure pairs, written beside the photos or into copies."""

from __future__ import annotations

import os
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from calib.errors import PhotoError
from calib.files import output_errors
from calib.photos.read import read_photo
from daemon.capture.geotag import write_copy, write_sidecar
from daemon.capture.trigger_book import places_of
from daemon.session.reader import SessionReader

_JPEG = frozenset({".jpg", ".jpeg", ".jpe"})


class Kind(StrEnum):
    SIDECARS = "sidecars"
    COPIES = "copies"


@dataclass(frozen=True)
class Tagged:
    """Photos by what became of them. ``own``: they carry a position themselves and were left alone;
    ``away``: they cannot be read any more; ``unsure``: no sure pair, or no position for it."""

    written: int = 0
    own: int = 0
    away: int = 0
    unsure: int = 0

    def sentence(self, folder: Path) -> str:
        parts = [f"{self.written} photos got their position, in {folder}"]
        for count, text in (
            (self.own, "have their own and were left alone"),
            (self.unsure, "have none: no trigger is surely theirs"),
            (self.away, "cannot be read any more"),
        ):
            parts += [f"{count} {text}"] if count else []
        return f"{'; '.join(parts)}."


def tag_photos(session: SessionReader, folder: Path, kind: Kind) -> Tagged:
    """Write the tags of all photos into ``folder``, in the subfolders that the photos are in.

    Photos that are no JPEG get a sidecar in any case.

    Raises:
        InputError: a photo cannot be tagged. OutputError: not writable, disk full.
        What :class:`SessionReader` raises.
    """
    pairing, places = session.pairing(), places_of(session)
    rows = {row.seq: session.folder.absolute() / row.value.path for row in session.photos()}
    numbers = {} if pairing is None else {p.photo: p.data["photo"] for p in pairing.value.pairs if p.sure}
    top = Path(os.path.commonpath([path.parent for path in rows.values()])) if rows else folder
    written = own = away = unsure = 0
    for seq, path in sorted(rows.items()):
        tag = places.get(numbers.get(seq, 0))
        if tag is None:
            unsure += 1
            continue
        try:
            has_own = read_photo(path).position is not None
        except PhotoError:
            away += 1
            continue
        if has_own:
            own += 1
            continue
        target = folder / path.relative_to(top)
        with output_errors(target.parent):
            target.parent.mkdir(parents=True, exist_ok=True)
        if kind is Kind.COPIES and path.suffix.lower() in _JPEG:
            write_copy(path, target, tag)
        else:
            write_sidecar(path, tag, target.parent)
        written += 1
    return Tagged(written, own, away, unsure)

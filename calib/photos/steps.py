"""What the sorting steps share: order of the photos, and splitting them by a reason."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime

from calib.photos.photo import LeftOut, Photo

#: What each step returns: photos kept, photos left out with reasons, remarks for the user.
Step = tuple[list[Photo], list[LeftOut], list[str]]


def in_order(photo: Photo) -> tuple[bool, datetime, str]:
    """Sort key: by time, then by name; photos without a time last."""
    return photo.time is None, photo.time or datetime.min, str(photo.path)


def split(photos: Sequence[Photo], keep: Callable[[Photo], str | None]) -> tuple[list[Photo], list[LeftOut]]:
    """Photos for which ``keep`` gives no reason, and the others with theirs."""
    used, out = [], []
    for photo in photos:
        reason = keep(photo)
        if reason is None:
            used.append(photo)
        else:
            out.append(LeftOut(photo.path, reason))
    return used, out

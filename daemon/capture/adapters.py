"""What cards and links give, as pairing takes it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from datetime import UTC

from calib.photos.photo import Photo
from daemon.capture.records import Shot, Trigger
from daemon.link.events import PhotoSource
from daemon.link.triggers import Trigger as LinkTrigger

#: DCF: folders 100 to 999 hold files 0001 to 9999 each (JEITA CP-3461, section 3.2).
_FILES_A_FOLDER = 10_000
_FOLDER = re.compile(r"^(\d{3})\w{5}$")
_LAST_NUMBER = re.compile(r"(\d+)\D*$")
#: The trigger's time is that of the autopilot's own loop.
_SIGMA_S = 0.02


def shots(photos: Iterable[Photo]) -> list[Shot]:
    """Photos as pairing takes them; those without a time, which nothing can be said about, are left out.

    Times are seconds since 1970 as if the camera's clock were UTC; the order is the number in the
    file's name, counted on over a card's folders.
    """
    return [
        Shot(
            str(photo.path),
            photo.time.replace(tzinfo=UTC).timestamp(),
            photo.time_resolution_s,
            file_number(photo),
        )
        for photo in photos
        if photo.time is not None
    ]


def file_number(photo: Photo) -> int:
    """The number that the camera gave to a file (0: its name has none)."""
    found = _LAST_NUMBER.search(photo.path.stem)
    if found is None:
        return 0
    folder = _FOLDER.match(photo.path.parent.name)
    return int(found[1]) + (int(folder[1]) * _FILES_A_FOLDER if folder else 0)


def triggers(photos: Sequence[LinkTrigger]) -> list[Trigger]:
    """Photos as the vehicle told of them, on one clock: UTC or time since boot, whichever more have.

    The key is the photo's number. Those without a time on that clock are left out.
    """
    utc = sum(photo.utc_s is not None for photo in photos)
    boot = sum(photo.vehicle_boot_s is not None for photo in photos)
    found = []
    for photo in photos:
        time_s = photo.utc_s if utc >= boot else photo.vehicle_boot_s
        if time_s is None:
            continue
        position = (photo.latitude_deg, photo.longitude_deg, photo.altitude_msl_m)
        angles = photo.vehicle_angles
        found.append(
            Trigger(
                photo.number,
                time_s,
                _SIGMA_S,
                image_index(photo),
                # 0 is what autopilots without a feedback pin send.
                photo.completed or None,
                None if None in position else position,  # type: ignore[arg-type]
                None if angles is None else (angles.roll_deg, angles.pitch_deg, angles.yaw_deg),
            )
        )
    return found


def image_index(photo: LinkTrigger) -> int | None:
    return next((n for source in PhotoSource if (n := photo.index(source)) is not None and n >= 0), None)

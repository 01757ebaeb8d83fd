"""Which photos belong to the survey, and in words why the others do not.

Pure functions on :class:`Photo`; the rules err on the side of keeping. Oblique photos, other
heights, an orbit after the grid, a second battery and photos without metadata stay.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib import frames
from calib.errors import InputError
from calib.photos.cameras import other_cameras
from calib.photos.collect import collect
from calib.photos.flights import other_flights
from calib.photos.photo import LeftOut, Photo
from calib.photos.radiometric import counts_read
from calib.photos.steps import Step, in_order, split

__all__ = ["Sorted", "collect", "require_block", "sort_photos"]

#: Above this angle off nadir (gimbal pitch of about -15) the picture is mostly horizon and sky.
HORIZON_TILT_DEG = 75.5
#: More than this share of such photos is intent: a wall, a building.
INTENT_SHARE = 0.25
#: Lower than this above launch while the survey is flown well above: take-off and landing.
GROUND_HEIGHT_M = 5.0
#: Positions within this radius are one spot, as far as a receiver without corrections can tell.
SPOT_RADIUS_M = 1.5
#: Photos in a row that a hovering drone took of the same view.
HOVER_RUN = 5


@dataclass(frozen=True)
class Sorted:
    """The photos of one camera and one flight, in order of time; what was left out; remarks."""

    used: tuple[Photo, ...]
    left_out: tuple[LeftOut, ...]
    notes: tuple[str, ...]


def sort_photos(photos: Sequence[Photo], left_out: Iterable[LeftOut] = ()) -> Sorted:
    """Separate one survey from whatever else the photos hold; nothing is left out without a reason.

    ``left_out`` are files already given up (unreadable ones), passed on in front.
    """
    out = list(left_out)
    notes: list[str] = []
    used = sorted(photos, key=in_order)
    for step in (_duplicates, other_cameras, other_flights, _near_ground, _horizon, _hovering):
        used, dropped, remarks = step(used)
        out += dropped
        notes += remarks
    return Sorted(tuple(used), tuple(out), tuple(notes + _missing_metadata(used) + counts_read(used)))


def require_block(result: Sorted) -> None:
    """Check that the photos can be joined to a block at all.

    Raises:
        InputError: fewer than three photos remain, or all were taken from one spot; one sentence.
    """
    used = result.used
    if len(used) < 3:
        count = ["No photo is", "Only one photo is", "Only two photos are"][len(used)]
        because = ""
        if result.left_out:
            usual = Counter(item.reason for item in result.left_out).most_common(1)[0][0]
            example = next(item.path for item in result.left_out if item.reason == usual)
            because = f" ({len(result.left_out)} left out, for example {example}: {usual})"
        raise InputError(f"{count} usable; a check needs at least three overlapping photos{because}.")
    local = frames.local_positions([p.position for p in used])
    if local is None or np.isnan(local[1]).any():
        return
    offsets = np.abs(local[1] - np.median(local[1], axis=0))
    if np.hypot(offsets[:, 0], offsets[:, 1]).max() < SPOT_RADIUS_M and offsets[:, 2].max() < SPOT_RADIUS_M:
        raise InputError(
            f"All {len(used)} photos were taken from one spot according to their positions, so nothing can "
            "be measured; fly a survey, or if the drone did move, remove the wrong positions from copies "
            "of the photos."
        )


def _duplicates(photos: list[Photo]) -> Step:
    """Same image data, or same file name, time and place (a copy that was saved anew)."""
    seen: dict[object, Path] = {}

    def keep(photo: Photo) -> str | None:
        keys: list[object] = [photo.fingerprint] if photo.fingerprint else []
        if photo.time is not None and photo.position is not None:
            keys.append((photo.path.name.lower(), photo.time, photo.position, photo.camera))
        first = next((seen[key] for key in keys if key in seen), None)
        for key in keys:
            seen.setdefault(key, photo.path)
        return None if first is None else f"a copy of {first.name}"

    used, out = split(photos, keep)
    return used, out, []


def _near_ground(photos: list[Photo]) -> Step:
    """Take-off and landing: a few photos close above launch while the survey is flown far above."""
    heights = {id(p): p.position.height_above_launch_m for p in photos if p.position is not None}
    known = [h for h in heights.values() if h is not None]
    usual = float(np.median(known)) if known else 0.0
    limit = min(GROUND_HEIGHT_M, 0.15 * usual)
    low = [h for h in known if h < limit]
    if usual < 8 or not low or len(low) > INTENT_SHARE * len(known):
        return photos, [], []

    def keep(photo: Photo) -> str | None:
        height = heights.get(id(photo))
        if height is None or height >= limit:
            return None
        return f"take-off or landing ({height:.1f} m above launch, the survey at {usual:.0f} m)"

    used, out = split(photos, keep)
    return used, out, []


def _horizon(photos: list[Photo]) -> Step:
    """Photos towards the horizon, unless the survey is of walls."""
    tilts = {id(p): frames.tilt_deg(p.gimbal) for p in photos if p.gimbal is not None}
    level = [t for t in tilts.values() if t > HORIZON_TILT_DEG]
    if not level:
        return photos, [], []
    if len(level) > INTENT_SHARE * len(tilts):
        note = f"{len(level)} photos look at the horizon; they were kept, as in a survey of walls."
        return photos, [], [note]

    def keep(photo: Photo) -> str | None:
        tilt = tilts.get(id(photo), 0.0)
        if tilt <= HORIZON_TILT_DEG:
            return None
        return f"looks at the horizon (gimbal pitch {tilt - 90:+.0f} degrees)"

    used, out = split(photos, keep)
    return used, out, []


def _hovering(photos: list[Photo]) -> Step:
    """Runs of the same view from the same spot: the first says all that the others do.

    Only where gimbal angles are known: cameras without them often repeat a stale position.
    """
    local = frames.local_positions([p.position for p in photos])
    if local is None:
        return photos, [], []
    runs: list[list[int]] = []
    for index, photo in enumerate(photos):
        if runs and _same_view(photos[runs[-1][0]], photo, local[1][runs[-1][0]], local[1][index]):
            runs[-1].append(index)
        else:
            runs.append([index])
    repeats = {
        id(photos[index]): photos[run[0]].path.name
        for run in runs
        if len(run) >= HOVER_RUN and len(run) < len(photos)
        for index in run[1:]
    }

    def keep(photo: Photo) -> str | None:
        first = repeats.get(id(photo))
        return None if first is None else f"taken from the same spot in the same direction as {first}"

    used, out = split(photos, keep)
    return used, out, []


def _same_view(a: Photo, b: Photo, at_a: frames.FloatArray, at_b: frames.FloatArray) -> bool:
    if a.gimbal is None or b.gimbal is None or not np.linalg.norm(at_a - at_b) < 0.5:
        return False
    between = frames.rotation_cam_from_world(a.gimbal) @ frames.rotation_cam_from_world(b.gimbal).T
    return bool(np.degrees(np.arccos(np.clip((np.trace(between) - 1) / 2, -1, 1))) < 3)


def _missing_metadata(photos: Sequence[Photo]) -> list[str]:
    """Remarks on what the files do not say; the check goes on without."""
    notes = []
    for what, count in (
        ("position", sum(p.position is None for p in photos)),
        ("camera angles", sum(p.gimbal is None for p in photos)),
        ("time", sum(p.time is None for p in photos)),
    ):
        if count and count == len(photos):
            notes.append(f"No photo has {'a ' if what != 'camera angles' else ''}{what} in its metadata.")
        elif count:
            notes.append(f"{count} of {len(photos)} photos have no {what} in their metadata; they are kept.")
    return notes

"""Photos of other flights on the same card: kept apart by place and by pauses of hours."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from datetime import timedelta

import numpy as np
from scipy.spatial import cKDTree

from calib import frames
from calib.photos.photo import Photo
from calib.photos.steps import Step, split

#: Photos over one site with a longer pause are another flight; recharging takes an hour or two.
FLIGHT_GAP = timedelta(hours=3)
#: Sites further apart than this (and ten times the usual spacing) cannot be one block.
SITE_GAP_M = 500.0
#: Faster than any survey drone: such a jump is a wrong position.
JUMP_M_S = 100.0
#: More such photos than this share are rather a second drone of the same make.
JUMP_SHARE = 0.1


def other_flights(photos: list[Photo]) -> Step:
    """Keep the largest flight: photos of one site without a pause of hours."""
    site = _sites(photos)
    flight: dict[int, int] = {}
    last: dict[int, tuple[Photo, int]] = {}
    count = 0
    for photo, number in zip(photos, site, strict=True):
        if number is None or photo.time is None:
            continue
        before = last.get(number)
        if before is None or (before[0].time is not None and photo.time - before[0].time > FLIGHT_GAP):
            count += 1
            last[number] = (photo, count)
        else:
            last[number] = (photo, before[1])
        flight[id(photo)] = last[number][1]
    for photo, number in zip(photos, site, strict=True):
        # Without a time a photo counts to its site's largest flight.
        if number is not None and photo.time is None:
            same = [
                flight[id(p)] for p, n in zip(photos, site, strict=True) if n == number and id(p) in flight
            ]
            if same:
                flight[id(photo)] = Counter(same).most_common(1)[0][0]
            else:
                flight[id(photo)] = -1 - number
    _place_unlocated(photos, flight)
    _join(photos, flight)
    sizes = Counter(flight[id(p)] for p in photos if id(p) in flight)
    if len(sizes) < 2:
        return photos, [], []
    best = sizes.most_common(1)[0][0]
    mine = [p for p in photos if flight.get(id(p), best) == best]
    others = [p for p in photos if flight.get(id(p), best) != best]
    jumped = _jumped(others, mine) if len(others) <= JUMP_SHARE * len(mine) else set()
    if jumped:
        healed = [replace(p, position=None) if id(p) in jumped else p for p in photos]
        used, out, notes = other_flights(healed)
        names = ", ".join(p.path.name for p in photos if id(p) in jumped)
        return used, out, [f"Positions far from where the drone can have been are not used: {names}.", *notes]

    apart = {flight[id(p)]: p for p in reversed(others)}
    words = {number: _apart_words(first, mine) for number, first in apart.items()}

    def keep(photo: Photo) -> str | None:
        number = flight.get(id(photo), best)
        if number == best:
            return None
        size = sizes[number]
        return f"another flight ({size} photo{'s' if size > 1 else ''}, {words[number]})"

    used, out = split(photos, keep)
    note = (
        f"{len(sizes)} flights were found; the largest was checked ({len(mine)} photos, "
        f"{mine[0].path.name} to {mine[-1].path.name}). To check another, give its photos alone."
    )
    return used, out, [note]


def _join(photos: Sequence[Photo], flight: dict[int, int]) -> None:
    """Make one flight of those that hold photos known to belong together."""
    parts = {flight[id(p)] for p in photos if p.joined and id(p) in flight}
    for photo, number in list(flight.items()):
        if number in parts:
            flight[photo] = min(parts)


def _jumped(others: Sequence[Photo], mine: Sequence[Photo]) -> set[int]:
    """Photos of supposed other sites that no drone can have reached between those of this one."""
    jumped = set()
    for photo in others:
        times = [(abs(p.time - photo.time), p) for p in mine if p.time is not None and photo.time is not None]
        if photo.position is None or not times:
            continue
        gap, neighbour = min(times, key=lambda pair: pair[0])
        local = frames.local_positions([photo.position, neighbour.position])
        if local is not None and np.linalg.norm(local[1][0] - local[1][1]) > JUMP_M_S * max(
            gap.total_seconds(), 2
        ):
            jumped.add(id(photo))
    return jumped


def _sites(photos: Sequence[Photo]) -> list[int | None]:
    """Number of the site of each photo (None: no position), linked by neighbours within reach."""
    local = frames.local_positions([p.position for p in photos])
    if local is None:
        return [0 if p.position is not None else None for p in photos]
    points = local[1][:, :2]
    known = np.flatnonzero(np.isfinite(points).all(axis=1))
    points = points[known]
    nearest = np.asarray(cKDTree(points).query(points, k=2)[0])[:, 1]
    spacing = float(np.median(nearest[np.isfinite(nearest)])) if len(known) > 1 else 0.0
    reach = max(SITE_GAP_M, 10 * spacing)
    # Link cells of a quarter of the reach instead of photos: thousands of photos are a few cells.
    cells, member = np.unique(np.floor(points / (reach / 4)), axis=0, return_inverse=True)
    distance = np.hypot(*(cells[:, None] - cells[None, :]).transpose(2, 0, 1))
    label = np.full(len(cells), -1)
    for seed in range(len(cells)):
        if label[seed] >= 0:
            continue
        front = [seed]
        label[seed] = seed
        while front:
            near = np.flatnonzero((distance[front.pop()] <= 4.5) & (label < 0))
            label[near] = seed
            front += near.tolist()
    site: list[int | None] = [None] * len(photos)
    for index, number in zip(known, label[member.ravel()], strict=True):
        site[index] = int(number)
    return site


def _place_unlocated(photos: Sequence[Photo], flight: dict[int, int]) -> None:
    """Photos without a position belong to the flight nearest in time, if it is within the gap.

    Without any positions at all, pauses alone separate flights. Photos with neither position nor
    time stay without a flight, which keeps them.
    """
    located = [(p.time, flight[id(p)]) for p in photos if id(p) in flight and p.time is not None]
    number = -len(photos) - 1
    previous: Photo | None = None
    for photo in photos:
        if id(photo) in flight or photo.time is None:
            continue
        gap, nearest = min(((abs(t - photo.time), f) for t, f in located), default=(FLIGHT_GAP * 2, 0))
        if gap <= FLIGHT_GAP:
            flight[id(photo)] = nearest
            continue
        if previous is None or previous.time is None or photo.time - previous.time > FLIGHT_GAP:
            number -= 1
        previous = photo
        flight[id(photo)] = number


def _apart_words(photo: Photo, mine: Sequence[Photo]) -> str:
    """How far a photo is from the survey, in space or else in time."""
    local = frames.local_positions([photo.position, *(p.position for p in mine)])
    if local is not None and np.isfinite(local[1][0, 0]):
        offsets = local[1][1:, :2] - local[1][0, :2]
        distance = float(np.nanmin(np.hypot(offsets[:, 0], offsets[:, 1]), initial=np.inf))
        if SITE_GAP_M <= distance < np.inf:
            return f"{distance / 1000:.1f} km away"
    times = [p.time for p in mine if p.time is not None]
    if photo.time is None or not times:
        return "elsewhere"
    later = photo.time > max(times)
    hours = (photo.time - max(times) if later else min(times) - photo.time) / timedelta(hours=1)
    span = f"{hours:.1f} hours" if hours < 48 else f"{hours / 24:.0f} days"
    return f"{span} {'later' if later else 'earlier'}"

"""Photos of other cameras, bodies, image sizes and focal lengths: kept apart."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence

from calib.photos.photo import Photo
from calib.photos.steps import Step, in_order, split

#: Relative difference of focal lengths (zoom) up to which photos may share one calibration.
FOCAL_TOLERANCE = 0.005


def _camera_words(photo: Photo) -> str:
    camera = photo.camera
    return f"{camera.name or 'unknown camera'}, {camera.width} x {camera.height}"


def camera_groups(photos: Sequence[Photo]) -> list[list[Photo]]:
    """Photos that may be adjusted together: one body, image size and focal length each."""
    groups: dict[object, list[Photo]] = defaultdict(list)
    for photo in photos:
        camera = photo.camera
        groups[camera.make, camera.model, camera.width, camera.height, camera.processing, camera.band].append(
            photo
        )
    return [part for group in groups.values() for part in _by_body(group)]


def other_cameras(photos: list[Photo]) -> Step:
    """Keep the largest group that may be adjusted together."""
    parts = camera_groups(photos)
    if len(parts) < 2:
        return photos, [], []
    best = max(parts, key=len)
    mine = best[0].camera
    body = next((p.camera.serial for p in best if p.camera.serial is not None), None)
    kept = {id(photo) for photo in best}

    def keep(photo: Photo) -> str | None:
        if id(photo) in kept:
            return None
        other = photo.camera
        if (other.make, other.model) != (mine.make, mine.model):
            return f"taken by another camera ({_camera_words(photo)})"
        if (other.width, other.height) != (mine.width, mine.height):
            return (
                f"another image size ({other.width} x {other.height} instead of {mine.width} x {mine.height})"
            )
        if other.processing != mine.processing:
            return f"processed otherwise in the camera ({other.processing} instead of {mine.processing})"
        if other.band != mine.band:
            return f"taken by another camera of the same body ({other.band or 'unnamed'})"
        if other.serial is not None and body is not None and other.serial != body:
            return f"taken by another body of this camera (serial number {other.serial})"
        return f"taken at another focal length ({_focal_words(photo, best)})"

    used, out = split(photos, keep)
    note = (
        f"Photos of {len(parts)} cameras or settings were found; the largest group was checked "
        f"({len(best)} photos, {_camera_words(best[0])}). To check another, give its photos alone."
    )
    return used, out, [note]


def _focal_words(photo: Photo, others: list[Photo]) -> str:
    mine = next((p.camera.focal_mm for p in others if p.camera.focal_mm is not None), None)
    this = photo.camera.focal_mm
    if this is not None and mine is not None and abs(this / mine - 1) > FOCAL_TOLERANCE:
        return f"{this:.4g} mm instead of {mine:.4g} mm"
    mine, this = next((p.focal_px for p in others if p.focal_px is not None), None), photo.focal_px
    return "zoomed" if this is None or mine is None else f"{this:.0f} px instead of {mine:.0f} px"


def _by_body(photos: list[Photo]) -> list[list[Photo]]:
    """Split by serial number and focal length; photos that lack one go with the largest group."""
    parts = _grouped(photos, lambda p: p.camera.serial)
    for value in (lambda p: p.camera.focal_mm, lambda p: p.focal_px):
        parts = [piece for part in parts for piece in _grouped(part, _steps(part, value))]
    return parts


def _grouped(photos: list[Photo], key: Callable[[Photo], object]) -> list[list[Photo]]:
    groups: dict[object, list[Photo]] = defaultdict(list)
    for photo in photos:
        groups[key(photo)].append(photo)
    unknown = groups.pop(None, [])
    if not groups:
        return [unknown]
    parts = sorted(groups.values(), key=len, reverse=True)
    parts[0] = sorted(parts[0] + unknown, key=in_order)
    return parts


def _steps(photos: list[Photo], value: Callable[[Photo], float | None]) -> Callable[[Photo], int | None]:
    """Number the levels of a value: neighbours closer than the tolerance are one level."""
    values = sorted({v for p in photos if (v := value(p)) is not None})
    level, levels = 0, {}
    for before, this in zip([None, *values], values, strict=False):
        if before is not None and this / before - 1 > FOCAL_TOLERANCE:
            level += 1
        levels[this] = level
    return lambda photo: None if (v := value(photo)) is None else levels[v]

"""Photos of several cameras over the same control, thermal and RGB: each calibrated for itself.

Where two of them are mounted together, the one that sees more places photos of the other ([SEN]: thermal
and RGB cameras over one building).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.camera import BROWN_NAMES
from calib.control import (
    LEAST_PLACED_MARKS,
    MARK_SIGMA_PX,
    POINT_SIGMA_M,
    ControlCalibration,
    calibrate_control,
    free_parameters,
    prepare,
    with_checks,
)
from calib.control_adjust import Pose, adjust, in_camera, residuals_px
from calib.control_files import ControlPoint, Mark
from calib.errors import AlignmentError, InputError
from calib.mount import Mount, Mounted, Poses, same_moment, solve_mount
from calib.photos.cameras import camera_groups
from calib.photos.photo import Photo
from calib.photos.radiometric import counts_read


@dataclass(frozen=True)
class Given:
    """What all cameras of a campaign share.

    ``focal_px``: to start from, for photos that state none, or, where there is one camera, for all.
    ``remarks``: what is to be said of the points in every report.
    """

    points: tuple[ControlPoint, ...]
    marks: tuple[Mark, ...]
    focal_px: float | None = None
    mark_sigma_px: float = MARK_SIGMA_PX
    point_sigma_m: float = POINT_SIGMA_M
    check_every: int = 0
    focal_for_all: bool = True
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class Campaign:
    """Calibrations, that with most marks first; ``failed``: photos of a camera and why it has none."""

    calibrations: tuple[ControlCalibration, ...]
    failed: tuple[tuple[Photo, str], ...]


def calibrate_cameras(photos: Sequence[Photo], given: Given) -> Campaign:
    """Every camera that has marks, by itself; those mounted on the first help each other to poses.

    Raises:
        InputError, AlignmentError: no camera can be calibrated; one sentence.
    """
    groups = _marked(photos, given.marks)
    if len(groups) == 1:
        return Campaign((_calibrated(groups[0], given),), ())
    marked = {mark.point for mark in given.marks}
    named = sorted((p for p in given.points if p.name in marked), key=lambda p: p.name)
    # The same check points for all.
    points = tuple(with_checks(named, given.check_every))
    given = replace(given, points=points, check_every=0, focal_for_all=False)
    unsaid = [group[0].camera.name or "unknown camera" for group in groups if _stated(group) is None]
    if given.focal_px is not None and len(unsaid) > 1:
        raise InputError(
            f"The photos of {' and '.join(unsaid)} do not state their focal lengths, and one --focal-px "
            "cannot be right for all: calibrate one camera at a time."
        )
    made: list[tuple[ControlCalibration, list[Photo]]] = []
    failed: list[tuple[Photo, str]] = []
    errors: list[Exception] = []
    for group in groups:
        try:
            made.append((_calibrated(group, _own(given, group)), group))
        except (InputError, AlignmentError) as error:
            failed.append((group[0], str(error)))
            errors.append(error)
    if not made:
        raise errors[0]
    made.sort(key=lambda one: -int(one[0].used.sum()))
    given_names = {photo.path.name.lower() for photo in photos}
    lost = sum(mark.photo.lower() not in given_names for mark in given.marks)
    first = made[0][0]
    if lost:
        first = replace(first, notes=(*first.notes, f"{lost} marks are in photos that were not given."))
    others = [_beside(one, group, first, _own(given, group)) for one, group in made[1:]]
    return Campaign((first, *others), tuple(failed))


def _marked(photos: Sequence[Photo], marks: Sequence[Mark]) -> list[list[Photo]]:
    """The photos of each camera of which some are marked; all photos where none is.

    Raises:
        InputError: two photos of one name, of which the marks do not say which is meant.
    """
    names = {mark.photo.lower() for mark in marks}
    counts = Counter(photo.path.name.lower() for photo in photos)
    twice = next((p.path.name for p in photos if counts[p.path.name.lower()] > 1), None)
    if twice is not None and twice.lower() in names:
        raise InputError(
            f"There are {counts[twice.lower()]} photos named {twice}, and marks tell photos by their names: "
            "rename those of one camera, in its marks too."
        )
    groups = [g for g in camera_groups(photos) if any(p.path.name.lower() in names for p in g)]
    return groups or [list(photos)]


def _own(given: Given, group: Sequence[Photo]) -> Given:
    names = {photo.path.name.lower() for photo in group}
    return replace(given, marks=tuple(m for m in given.marks if m.photo.lower() in names))


def _calibrated(
    group: Sequence[Photo],
    given: Given,
    placed: dict[str, Pose] | None = None,
) -> ControlCalibration:
    """One camera. ``placed``: poses of photos (lower-case name) in the points' frame."""
    marks, kept, points, notes = prepare(
        group,
        given.points,
        given.marks,
        given.mark_sigma_px,
        given.point_sigma_m,
        given.check_every,
        tuple(placed or ()),
    )
    camera = kept[0].camera
    stated = _stated(kept)
    focal_px = given.focal_px or stated if given.focal_for_all else stated or given.focal_px
    if focal_px is None:
        raise InputError(
            f"The photos of {camera.name or 'this camera'} do not state their focal length; give it with "
            "--focal-px."
        )
    if not 0.1 < focal_px / camera.width < 100:
        raise InputError(f"{focal_px:g} px is no focal length of photos {camera.width} px wide.")
    origin = np.asarray(points[0].xyz_m) - marks.points_m[0]
    starts = {
        i: (pose[0], pose[1] - origin)
        for i, photo in enumerate(kept)
        if (pose := (placed or {}).get(photo.path.name.lower())) is not None
    }
    said = (*given.remarks, *notes, *counts_read(kept))
    return calibrate_control(marks, kept, points, focal_px, said, starts)


def _stated(photos: Sequence[Photo]) -> float | None:
    return next((photo.focal_px for photo in photos if photo.focal_px), None)


def _beside(
    made: ControlCalibration, group: Sequence[Photo], first: ControlCalibration, given: Given
) -> ControlCalibration:
    """The calibration with what the first camera's poses add to it: photos placed, points expected."""
    mount = _mount(made, first)
    if mount is None:
        note = (
            f"Not mounted together with {first.photos[0].camera.name or 'the other camera'}, as far as "
            "photos of the same moment tell."
        )
        return replace(made, notes=(*made.notes, note))
    through = _placed_through(group, first, mount)
    marks = Counter(mark.photo.lower() for mark in given.marks)
    mine = {photo.path.name.lower() for photo in made.photos}
    helped = {
        name: pose for name, pose in through.items() if name not in mine and marks[name] >= LEAST_PLACED_MARKS
    }
    if helped:
        try:
            better = _calibrated(group, given, helped)
        except (InputError, AlignmentError):
            # Marks that contradict the pose: the calibration without them stands.
            helped = {}
        else:
            made = better
            mount = _mount(made, first) or mount
    mine = {photo.path.name.lower() for photo in made.photos}
    names = {photo.path.name.lower(): photo.path.name for photo in group}
    expected = [
        mark
        for name, pose in through.items()
        if name not in mine
        for mark in _expected(names[name], pose, made, given.points)
    ]
    mounted = Mounted(
        mount,
        first.photos[0].camera.name,
        _miss_px(made, first, mount),
        tuple(names[name] for name in helped if name in mine),
        tuple(expected),
    )
    return replace(made, mounted=mounted)


def _mount(made: ControlCalibration, first: ControlCalibration) -> Mount | None:
    pairs = same_moment([p.time for p in first.photos], [p.time for p in made.photos])
    if not pairs:
        return None
    a, b = (list(side) for side in zip(*pairs, strict=True))
    depth = in_camera(made.marks, made.fit.block)[:, 2]
    return solve_mount(_loose(first).of(a), _loose(made).of(b), float(np.median(depth)))


def _loose(made: ControlCalibration) -> Poses:
    """The poses, with their covariance under a free principal point: one that is held turns all photos."""
    free = {*free_parameters(made), "cx", "cy"}
    used = made.used & made.marks.control[made.marks.point]
    try:
        fit = adjust(made.marks, made.fit.block, tuple(name for name in BROWN_NAMES if name in free), used)
    except AlignmentError:  # Too few marks for two parameters more.
        return made.poses
    return replace(made.poses, covariance=fit.pose_covariance)


def _placed_through(group: Sequence[Photo], first: ControlCalibration, mount: Mount) -> dict[str, Pose]:
    """Poses, by lower-case name, of the photos taken at the moment of one of the first camera's."""
    pairs = same_moment([p.time for p in first.photos], [p.time for p in group])
    poses = mount.place(first.poses.of([i for i, _ in pairs]))
    return {
        group[j].path.name.lower(): (poses.rotations_cam_from_world[n], poses.centres_m[n])
        for n, (_, j) in enumerate(pairs)
    }


def _expected(photo: str, pose: Pose, made: ControlCalibration, points: Sequence[ControlPoint]) -> list[Mark]:
    """Where the points should be in a photo; whether something hides them is not known."""
    local = (np.array([point.xyz_m for point in points]) - pose[1]) @ pose[0].T
    camera = made.camera
    found = []
    for point, (x, y, z) in zip(points, local.tolist(), strict=True):
        # Rays far outside are left out before the radial polynomial can fold them back in.
        if z <= 0 or max(abs(x) / camera.width, abs(y) / camera.height) * camera.f_px > 0.55 * z:
            continue
        u, v = camera.project(np.array([x / z, y / z])).tolist()
        if 0 <= u <= camera.width and 0 <= v <= camera.height:
            found.append(Mark(photo, point.name, round(u, 2), round(v, 2)))
    return found


def _miss_px(made: ControlCalibration, first: ControlCalibration, mount: Mount) -> float:
    """Rms per coordinate of the marks where the first camera's poses put them."""
    through = _placed_through(made.photos, first, mount)
    block = made.fit.block
    rotations, centres = block.rotations.copy(), block.centres_m.copy()
    there = np.zeros(len(made.photos), bool)
    for i, photo in enumerate(made.photos):
        if photo.path.name.lower() in through:
            rotations[i], centre = through[photo.path.name.lower()]
            centres[i] = centre - made.origin_m
            there[i] = True
    miss = residuals_px(made.marks, replace(block, rotations=rotations, centres_m=centres))
    miss = miss[there[made.marks.photo] & made.used]
    return float(np.sqrt(np.mean(miss**2)))

"""Calibration on control points ([SEN]): parameters released in steps, blunders found and named."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from calib.camera import BROWN_NAMES, BrownCamera, FloatArray
from calib.control_adjust import (
    Fit,
    MarkSet,
    Pose,
    adjust,
    intersected,
    resected,
    residuals_px,
)
from calib.control_checks import (
    AGREE_SHARE,
    RADIAL,
    require_agreement,
    require_handedness,
    require_lens,
    require_shape,
    shape_notes,
)
from calib.control_files import ControlPoint, Mark
from calib.control_spread import Spread, model_spread
from calib.errors import AlignmentError, InputError
from calib.mount import Mounted, Poses
from calib.photos.photo import Photo
from calib.solution import BoolArray

#: Release of the parameters ([SEN] 2.3); a step stays where chance explains its gain with less than P.
STEPS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("poses", ()),
    ("f and K1-K3", RADIAL),
    ("principal point", ("cx", "cy")),
    ("decentring P1 P2", ("p1", "p2")),
    ("affinity b1 b2", ("b1", "b2")),
)
SIGNIFICANT_P = 0.01
#: [SEN] discussion: natural features are marked to half a pixel.
MARK_SIGMA_PX = 0.5
POINT_SIGMA_M = 0.005
LEAST_PHOTOS, LEAST_MARKS = 3, 5
#: Marks that all lie within this share of the photo from its corner are in other units.
_CORNER = 0.05
#: In photos whose pose is known otherwise.
LEAST_PLACED_MARKS = 4
#: Probability that any of the good marks of a set is called a blunder (standardised residuals, Baarda 1968).
BLUNDER_P = 0.01
#: A point is at fault, not its marks, where more than this share of them is off.
POINT_SHARE = 0.6


@dataclass(frozen=True)
class Step:
    """One release: ``chance`` that the gain in fit is chance's (None for the poses), ``kept`` or not."""

    name: str
    parameters: tuple[str, ...]
    sigma0: float
    control_rms_px: float
    check_rms_px: float
    chance: float | None
    kept: bool


@dataclass(frozen=True)
class ControlCalibration:
    """The outcome of ``fieldcal calibrate control`` for one camera.

    ``used`` (n,): marks that took part or, on check points, were not found to be blunders.
    ``errors_m`` (t, 3): points from their marks minus as surveyed, NaN where fewer than two marks.
    ``blunders``: one sentence each. ``spread``: what other models of the lens would change.
    """

    photos: tuple[Photo, ...]
    points: tuple[ControlPoint, ...]
    marks: MarkSet
    fit: Fit
    steps: tuple[Step, ...]
    used: BoolArray
    errors_m: FloatArray
    blunders: tuple[str, ...]
    notes: tuple[str, ...]
    spread: Spread
    mounted: Mounted | None = None

    @property
    def covariance(self) -> FloatArray:
        """(11, 11) over ``BROWN_NAMES``: the formal one and what the choice of the model leaves open.

        Parameters that were left out have variances too: they may be there.
        """
        return np.asarray(self.fit.covariance + self.spread.covariance)

    @property
    def sigma_f_percent(self) -> float:
        """Standard deviation of f in percent."""
        return 100 * float(np.sqrt(self.covariance[0, 0])) / self.camera.f_px

    @property
    def origin_m(self) -> FloatArray:
        """Where coordinates of ``marks`` and ``fit`` count from (3,), in the points' own frame."""
        return np.asarray(self.points[0].xyz_m - self.marks.points_m[0])

    @property
    def poses(self) -> Poses:
        """Of the photos, in the points' own frame."""
        block = self.fit.block
        return Poses(block.rotations, block.centres_m + self.origin_m, self.fit.pose_covariance)

    @property
    def camera(self) -> BrownCamera:
        return self.fit.block.camera

    def rms_px(self, check: bool) -> float:
        """Rms per coordinate of the marks on control or on check points, as surveyed."""
        return _rms(self.fit, self.marks, self.used, check)

    def rmse_m(self, check: bool) -> FloatArray:
        """Root mean square errors (3,) of the points from their marks, x y z; NaN where there are none."""
        mine = self.errors_m[self.marks.control != check]
        mine = mine[np.isfinite(mine).all(axis=1)]
        return np.asarray(np.sqrt(np.mean(mine**2, axis=0)) if len(mine) else np.full(3, np.nan))


def prepare(
    photos: Sequence[Photo],
    points: Sequence[ControlPoint],
    marks: Sequence[Mark],
    mark_sigma_px: float = MARK_SIGMA_PX,
    point_sigma_m: float = POINT_SIGMA_M,
    check_every: int = 0,
    placed: Collection[str] = (),
) -> tuple[MarkSet, tuple[Photo, ...], tuple[ControlPoint, ...], tuple[str, ...]]:
    """Marks of known points in given photos, photos and points that they use, and remarks.

    Coordinates are taken from the points' mean. ``check_every``: every so many points in the order of
    their names is a check point, where no point is one by itself (0: none). ``placed``: photos (by name)
    whose poses are known otherwise, which need fewer marks.

    Raises:
        InputError: nothing fits together, or there is too little of it; one sentence.
    """
    by_name = {photo.path.name.lower(): photo for photo in photos}
    known = {point.name: point for point in points}
    here = [mark for mark in marks if mark.photo.lower() in by_name]
    if not here:
        raise InputError(
            f"None of the {len({m.photo for m in marks})} photos in the marks is among those given (the "
            f"first is {marks[0].photo}): is it the file of another photo set?"
        )
    usable = [mark for mark in here if mark.point in known]
    if not usable:
        raise InputError(
            f"None of the marked points has coordinates (the first is {here[0].point}); check the names."
        )
    notes = []
    if len(here) < len(marks):
        notes.append(f"{len(marks) - len(here)} marks are in photos that were not given.")
    unknown = sorted({mark.point for mark in here} - set(known))
    if unknown:
        notes.append(
            f"No coordinates are known of {', '.join(unknown[:5])}{' ...' if len(unknown) > 5 else ''}."
        )
    names = sorted({mark.point for mark in usable})
    chosen = with_checks([known[name] for name in names], check_every)
    roles = {point.name: point.check for point in chosen}
    files = sorted({mark.photo.lower() for mark in usable})
    counts = {f: sum(m.photo.lower() == f and not roles[m.point] for m in usable) for f in files}
    known_poses = {name.lower() for name in placed}
    least = {f: LEAST_PLACED_MARKS if f in known_poses else LEAST_MARKS for f in files}
    thin = [by_name[f].path.name for f in files if counts[f] < least[f]]
    if thin:
        notes.append(f"Fewer than {LEAST_MARKS} control points are marked in {', '.join(thin)}: left out.")
    files = [f for f in files if counts[f] >= least[f]]
    if len(files) < LEAST_PHOTOS:
        raise InputError(
            f"{len(files)} photos have {LEAST_MARKS} marks on control points or more; {LEAST_PHOTOS} are "
            "needed."
        )
    usable = [m for m in usable if m.photo.lower() in set(files)]
    cameras = {(by_name[f].camera.name, by_name[f].camera.width, by_name[f].camera.height) for f in files}
    if len(cameras) > 1:
        raise InputError("The marked photos are of different cameras or sizes; give those of one camera.")
    xyz = np.array([point.xyz_m for point in chosen])
    control = np.array([not point.check for point in chosen])
    require_shape(xyz[control])
    camera = by_name[files[0]].camera
    if max(max(abs(m.u_px), abs(m.v_px)) for m in usable) < _CORNER * max(camera.width, camera.height):
        raise InputError(
            f"All marks lie in one corner of the photos ({camera.width} x {camera.height} px): are they in "
            "mm from the middle of the sensor? column = width / 2 + x / pixel size, row = height / 2 - y / "
            "pixel size."
        )
    # A mark at the very edge may lie a little outside.
    room = 0.01 * max(camera.width, camera.height)
    outside = [
        m
        for m in usable
        if not (-room <= m.u_px <= camera.width + room and -room <= m.v_px <= camera.height + room)
    ]
    if outside:
        raise InputError(
            f"Point {outside[0].point} is marked outside of {outside[0].photo} ({camera.width} x "
            f"{camera.height} px): are the marks from photos of another size?"
        )
    sigmas = [p.sigmas_m if p.sigmas_m is not None else (point_sigma_m,) * 3 for p in chosen]
    position = {point.name: i for i, point in enumerate(chosen)}
    return (
        MarkSet(
            photo=np.array([files.index(m.photo.lower()) for m in usable]),
            point=np.array([position[m.point] for m in usable]),
            pixels=np.array([[m.u_px, m.v_px] for m in usable]),
            sigma_px=mark_sigma_px,
            points_m=xyz - xyz.mean(axis=0),
            sigmas_m=np.array(sigmas, float),
            control=control,
        ),
        tuple(by_name[f] for f in files),
        tuple(chosen),
        tuple(notes),
    )


def with_checks(points: Sequence[ControlPoint], every: int) -> list[ControlPoint]:
    """Every so many of the points made a check point, where none is one by itself (0: none)."""
    if not every or any(point.check for point in points):
        return list(points)
    return [replace(point, check=i % every == every - 1) for i, point in enumerate(points)]


def calibrate_control(
    marks: MarkSet,
    photos: tuple[Photo, ...],
    points: tuple[ControlPoint, ...],
    focal_px: float,
    notes: tuple[str, ...] = (),
    starts: Mapping[int, Pose] | None = None,
) -> ControlCalibration:
    """Resection, release in steps, blunders out and named.

    ``starts``: poses known otherwise, by the photos' indices.

    Raises:
        AlignmentError: a photo cannot be placed, or there are too few marks.
    """
    size = photos[0].camera
    start = BrownCamera.ideal(size.width, size.height, focal_px)
    try:
        block, used = resected(marks, start, starts=starts)
    except AlignmentError as error:
        name = photos[int(str(error))].path.name
        raise AlignmentError(
            f"{name} cannot be placed by its marks: four or more of them must agree. Check their names, "
            "order and units of the coordinates (x east, y north, z up) and the focal length (--focal-px)."
        ) from error
    on_control = marks.control[marks.point]
    share = float(np.mean(used[on_control]))
    if share < AGREE_SHARE:
        # Said at once: the hunt for blunders takes minutes where hundreds of marks are wrong.
        require_handedness(marks, start, share)
    # Blunders are sought under the radial model: before, the corners miss for want of it.
    fit = adjust(marks, block, RADIAL, used)
    fit, used = _without_blunders(marks, fit, used, on_control, RADIAL)
    require_agreement(marks, start, used, on_control)
    steps: list[Step] = []
    free: tuple[str, ...] = ()
    fit = adjust(marks, replace(fit.block, camera=start), (), used)
    steps.append(_step("poses", (), fit, marks, used, None, True))
    for name, parameters in STEPS[1:]:
        trial = adjust(marks, fit.block, (*free, *parameters), used)
        gain = (fit.chi2 - trial.chi2) / max(trial.sigma0**2, 1e-12)
        chance = float(chdtrc(len(parameters), max(gain, 0.0)))
        kept = chance < SIGNIFICANT_P or "f" in parameters
        steps.append(_step(name, parameters, trial, marks, used, chance, kept))
        if kept:
            fit, free = trial, (*free, *parameters)
    require_lens(marks, fit, start)
    fit, used = _without_blunders(marks, fit, used, on_control, free)
    good = used | (~on_control & _small(marks, fit, used))
    blunders = name_blunders(marks, fit, good, photos, points)
    errors = intersected(marks, fit.block, good) - marks.points_m
    every = tuple(name for _, names in STEPS for name in names)
    spread = model_spread(marks, fit, free, every, used & on_control)
    if spread.beyond_brown:
        notes = (*notes, _beyond_brown(spread))
    notes = (*notes, *shape_notes(marks, fit.block))
    return ControlCalibration(photos, points, marks, fit, tuple(steps), good, errors, blunders, notes, spread)


def _beyond_brown(spread: Spread) -> str:
    return (
        f"The lens departs from Brown's model by some {spread.field_rms_px:.2f} px (rms at the marks, smooth "
        "over the picture); the sigmas allow for what that does to the parameters."
    )


def _step(
    name: str,
    parameters: tuple[str, ...],
    fit: Fit,
    marks: MarkSet,
    used: BoolArray,
    chance: float | None,
    kept: bool,
) -> Step:
    good = used | (~marks.control[marks.point] & _small(marks, fit, used))
    rms = [_rms(fit, marks, good, check) for check in (False, True)]
    return Step(name, parameters, fit.sigma0, rms[0], rms[1], chance, kept)


def _rms(fit: Fit, marks: MarkSet, used: BoolArray, check: bool) -> float:
    """Of marks against the points as surveyed."""
    surveyed = residuals_px(marks, replace(fit.block, points_m=marks.points_m))
    mine = surveyed[used & (marks.control[marks.point] != check)]
    return float(np.sqrt(np.mean(mine**2))) if len(mine) else float("nan")


def _spread(fit: Fit, used: BoolArray) -> float:
    """Robust noise per coordinate, px, from the median of the standardised lengths (Rayleigh)."""
    return max(float(np.median(fit.standardised()[used])) / 1.1774, 0.02)


def _small(marks: MarkSet, fit: Fit, used: BoolArray) -> BoolArray:
    """Marks (n,) that miss the surveyed points by no more than chance and the points' own errors explain."""
    surveyed = np.linalg.norm(residuals_px(marks, replace(fit.block, points_m=marks.points_m)), axis=1)
    typical = float(np.median(surveyed[used])) if used.any() else marks.sigma_px
    return np.asarray(surveyed < 6 * max(typical, marks.sigma_px))


def _without_blunders(
    marks: MarkSet, fit: Fit, used: BoolArray, candidates: BoolArray, free: tuple[str, ...]
) -> tuple[Fit, BoolArray]:
    """Marks that came out good join, the worst one goes, and again, until all are within chance."""
    # The largest of n lengths of two coordinates (Rayleigh) exceeds this once in a hundred sets.
    limit = float(np.sqrt(2 * np.log(max(int(candidates.sum()), 2) / BLUNDER_P)))
    for _ in range(len(marks)):
        standard = fit.standardised() / _spread(fit, used)
        joined = used | (candidates & (standard < limit))
        if (joined != used).any():
            used = joined
            fit = adjust(marks, fit.block, free, used)
            standard = fit.standardised() / _spread(fit, used)
        standard = np.where(used, standard, 0.0)
        worst = int(standard.argmax())
        if standard[worst] < limit:
            break
        used = used.copy()
        used[worst] = False
        candidates = candidates.copy()
        candidates[worst] = False
        fit = adjust(marks, fit.block, free, used)
    return fit, used


def name_blunders(
    marks: MarkSet,
    fit: Fit,
    good: BoolArray,
    photos: tuple[Photo, ...],
    points: tuple[ControlPoint, ...],
) -> tuple[str, ...]:
    """What is wrong with the marks that are not ``good``: swapped names, points off, single slips."""
    wrong = np.flatnonzero(~good)
    said: list[str] = []
    told: set[int] = set()
    limit = 8 * max(_spread(fit, good), marks.sigma_px)
    for a in wrong:
        for b in wrong:
            if b <= a or marks.photo[a] != marks.photo[b] or told & {int(a), int(b)}:
                continue
            swapped = replace(marks, point=marks.point.copy())
            swapped.point[[a, b]] = marks.point[[b, a]]
            miss = np.linalg.norm(residuals_px(swapped, fit.block)[[a, b]], axis=1)
            if miss.max() < limit:
                told |= {int(a), int(b)}
                one, two = points[marks.point[a]].name, points[marks.point[b]].name
                said.append(f"{one} and {two} are swapped in {photos[marks.photo[a]].path.name}.")
    for point in np.unique(marks.point[wrong]):
        mine = np.flatnonzero(marks.point == point)
        off = [int(i) for i in mine if not good[i] and int(i) not in told]
        if len(off) >= 3 and len(off) > POINT_SHARE * len(mine):
            found = intersected(marks, fit.block, np.isin(np.arange(len(marks)), mine))[point]
            apart = float(np.linalg.norm(found - marks.points_m[point]))
            told |= set(off)
            said.append(
                f"{points[point].name}: {len(off)} of its {len(mine)} marks disagree with its coordinates, "
                f"which seem to be off by {apart:.3g} m."
            )
    for i in wrong:
        if int(i) not in told:
            miss = float(np.linalg.norm(fit.residuals_px[i]))
            said.append(
                f"{points[marks.point[i]].name} in {photos[marks.photo[i]].path.name} is {miss:.1f} px off."
            )
    return tuple(said)


def coverage_hint(calibration: ControlCalibration) -> str | None:
    """What the operator should mark more of, where edges of the sensor are empty; None where none is."""
    marks, camera = calibration.marks, calibration.camera
    at = marks.pixels[calibration.used] / [camera.width, camera.height]
    empty = [
        side
        for side, inside in (
            ("left", at[:, 0] < 0.125),
            ("right", at[:, 0] > 0.875),
            ("upper", at[:, 1] < 0.125),
            ("lower", at[:, 1] > 0.875),
        )
        if int(inside.sum()) < 5
    ]
    if not empty:
        return None
    return (
        f"The {' and '.join(empty)} edge{'s' if len(empty) > 1 else ''} of the sensor "
        f"hold{'' if len(empty) > 1 else 's'} hardly any marks: "
        "the distortion there is a guess. Take photos nearer, or with the object towards that edge."
    )


def free_parameters(calibration: ControlCalibration) -> tuple[str, ...]:
    """Names of the lens parameters that were kept."""
    return tuple(n for i, n in enumerate(BROWN_NAMES) if calibration.fit.covariance[i, i] > 0)

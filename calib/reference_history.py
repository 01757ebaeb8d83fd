"""The calibrations of one camera body over time: drift, pairs before and after, averages, age."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import date as Date
from itertools import pairwise

import numpy as np
from scipy.special import chdtrc

from calib.brownfit import fit_brown
from calib.camera import BROWN_NAMES, BrownCamera, FloatArray
from calib.equifinal import Deviation, Radial, image_radius_px, profile_deviation
from calib.errors import FormatError, InputError
from calib.evidence import reference_radial_covariance, reference_sigma_f_px
from calib.limits import FOCAL_LIMIT_PERCENT, Z95, percent
from calib.reference import Reference
from calib.reference_file import read_reference_file
from calib.references import history, is_bundled, load_reference, stored_references

#: Lenses of small cameras move over a year by about as much as the check allows ([SEN] introduction asks
#: for calibrations before and after every survey); older references are still used, and that is said.
AGED_DAYS = 365
#: Calibrations of one body at most so many days apart are a pair before and after a survey.
PAIR_DAYS = 3
#: Two calibrations differ where chance alone explains it with less than this probability.
DIFFERENT_P = 0.01
#: Calibrations to be averaged must not differ more than this: one of them is wrong, and no mean cures it.
INCONSISTENT_P = 1e-3
_COMPARED = [BROWN_NAMES.index(name) for name in ("f", "k1", "k2", "k3")]


@dataclass(frozen=True)
class Entry:
    """One calibration in a history; ``label`` tells older ones of a name apart."""

    label: str
    reference: Reference
    day: Date | None


@dataclass(frozen=True)
class Change:
    """From one calibration to a later one of the same body.

    ``f_percent`` with ``sigma_percent`` (both calibrations' together); ``deviation``: of the radial
    profiles over half the longer side; ``chance``: probability that chance alone makes f and K1-K3
    differ as much. ``days`` is None where a date is missing.
    """

    before: str
    after: str
    days: int | None
    f_percent: float
    sigma_percent: float
    deviation: Deviation
    chance: float

    @property
    def different(self) -> bool:
        return self.chance < DIFFERENT_P

    @property
    def pair(self) -> bool:
        """Whether the two frame a survey."""
        return self.days is not None and 0 <= self.days <= PAIR_DAYS


@dataclass(frozen=True)
class Trend:
    """Weighted regression of f: percent per ``unit`` with its standard deviation, from ``count`` values."""

    unit: str
    slope_percent: float
    sigma_percent: float
    count: int

    @property
    def significant(self) -> bool:
        return abs(self.slope_percent) > Z95 * self.sigma_percent


def _brown_covariance(reference: Reference) -> FloatArray:
    """(11, 11) over ``BROWN_NAMES`` of the comparable Brown parameters."""
    if reference.fitted_covariance is not None:
        return reference.fitted_covariance
    n = len(BROWN_NAMES)
    if reference.covariance is not None and reference.fitted_brown is None:
        return np.asarray(reference.covariance[:n, :n])
    return np.diag([reference.sigma.get(name, 0.0) ** 2 for name in BROWN_NAMES])


def _day(reference: Reference) -> Date | None:
    try:
        return None if reference.date is None else Date.fromisoformat(reference.date[:10])
    except ValueError:
        return None


def same_body(a: Reference, b: Reference) -> bool:
    """Whether two calibrations are of one body with the same image size, zoom and processing."""
    return (
        a.serial is not None
        and a.serial == b.serial
        and a.model.lower() == b.model.lower()
        and (a.width, a.height, a.processing) == (b.width, b.height, b.processing)
        and (a.focal_mm is None or b.focal_mm is None or abs(a.focal_mm / b.focal_mm - 1) < 0.01)
    )


def body_history(name: str) -> tuple[tuple[Entry, ...], tuple[str, ...]]:
    """All calibrations of the body that ``name`` belongs to, oldest first, and what could not be read.

    Those saved under the name before, and those of the same body under other names.

    Raises:
        InputError: no such reference.
    """
    chosen = load_reference(name)
    if is_bundled(name):
        return (Entry(name, chosen, _day(chosen)),), ()
    found: list[tuple[str, Reference]] = []
    faults: list[str] = []
    stored, unread = stored_references()
    faults += unread
    names = [name, *(r.name for r in stored if r.name != name and same_body(r, chosen))]
    for one in names:
        for path in history(one):
            try:
                older = read_reference_file(path)
            except FormatError as error:
                faults.append(str(error))
                continue
            found.append((f"{one} ({int(path.stem)})" if path.stem.isdigit() else path.stem, older))
        current = chosen if one == name else next(r for r in stored if r.name == one)
        found.append((one, current))
    usable = [Entry(label, r, _day(r)) for label, r in found if r.comparable_brown is not None]
    # Undated ones stay where their names put them, before the dated ones.
    usable.sort(key=lambda entry: entry.day or Date.min)
    return tuple(usable), tuple(faults)


def entry_of(name: str) -> Entry:
    """One calibration by name or file.

    Raises:
        InputError: there is none of that name.
    """
    reference = load_reference(name)
    return Entry(reference.name, reference, _day(reference))


def change(before: Entry, after: Entry) -> Change:
    """What moved from one calibration to another.

    Raises:
        InputError: of one of them only lines are known, or the image sizes differ.
    """
    a, b = before.reference, after.reference
    one, two = a.comparable_brown, b.comparable_brown
    if one is None or two is None:
        raise InputError(f"Of {before.label if one is None else after.label} too little is known to compare.")
    if (one.width, one.height) != (two.width, two.height):
        raise InputError(f"{before.label} and {after.label} are for images of different sizes.")
    together = _brown_covariance(a) + _brown_covariance(b)
    move = (two.vector - one.vector)[_COMPARED]
    radial = reference_radial_covariance(a) + reference_radial_covariance(b)
    sigma = math.hypot(reference_sigma_f_px(a), reference_sigma_f_px(b))
    days = None if before.day is None or after.day is None else (after.day - before.day).days
    return Change(
        before=before.label,
        after=after.label,
        days=days,
        f_percent=100 * (two.f_px - one.f_px) / one.f_px,
        sigma_percent=100 * sigma / one.f_px,
        deviation=profile_deviation(Radial.of(two), Radial.of(one), image_radius_px(one), radial),
        chance=_chance(move, together[np.ix_(_COMPARED, _COMPARED)]),
    )


def _chance(move: FloatArray, covariance: FloatArray) -> float:
    """Probability of a move as large as this one (c,) under its covariance (c, c)."""
    used = np.diag(covariance) > 0
    if not used.any():
        return 1.0 if not move.any() else 0.0
    scale = np.sqrt(np.diag(covariance)[used])
    matrix = covariance[np.ix_(used, used)] / np.outer(scale, scale)
    scaled = move[used] / scale
    square = float(scaled @ np.linalg.pinv(matrix, rcond=1e-10, hermitian=True) @ scaled)
    return float(chdtrc(int(used.sum()), max(square, 0.0)))


def changes(entries: Sequence[Entry]) -> tuple[Change, ...]:
    """From each calibration to the next."""
    return tuple(change(a, b) for a, b in pairwise(entries))


def trends(entries: Sequence[Entry]) -> tuple[Trend, ...]:
    """f against time and against temperature, where three calibrations or more tell it."""
    found = []
    dated = [(e.day.toordinal() / 365.25, e.reference) for e in entries if e.day is not None]
    warm = [
        (e.reference.temperature_c, e.reference) for e in entries if e.reference.temperature_c is not None
    ]
    for unit, rows in (("year", dated), ("degree Celsius", warm)):
        trend = _regression(unit, [(x, r) for x, r in rows if reference_sigma_f_px(r) > 0])
        if trend is not None:
            found.append(trend)
    return tuple(found)


def _regression(unit: str, rows: Sequence[tuple[float, Reference]]) -> Trend | None:
    if len(rows) < 3:
        return None
    x = np.array([value for value, _ in rows])
    f = np.array([r.f_px or math.nan for _, r in rows])
    weight = 1 / np.array([reference_sigma_f_px(r) for _, r in rows]) ** 2
    middle = float(weight @ x / weight.sum())
    spread = float(weight @ (x - middle) ** 2)
    if np.ptp(x) < 1e-3 or not spread > 0:
        return None
    mean = float(weight @ f / weight.sum())
    slope = float(weight @ ((x - middle) * (f - mean))) / spread
    rest = float(weight @ (f - mean - slope * (x - middle)) ** 2) / (len(x) - 2)
    # Where calibrations scatter more than they claim, the scatter counts (Birge 1932).
    sigma = math.sqrt(max(rest, 1.0) / spread)
    return Trend(unit, 100 * slope / mean, 100 * sigma / mean, len(x))


def condition(reference: Reference, taken: Date | None) -> tuple[str, ...]:
    """What a check should say about a reference of the store that aged or whose body moves.

    Args:
        taken: day of the photos that it is held against.
    """
    said = []
    made = _day(reference)
    if made is not None and taken is not None:
        days = abs((taken - made).days)
        if days > AGED_DAYS:
            side = "older" if taken > made else "newer"
            said.append(
                f"The reference is {days / 365.25:.1f} years {side} than the photos: calibrate again."
            )
    if reference.serial is None or is_bundled(reference.name):
        return tuple(said)
    try:
        entries, _ = body_history(reference.name)
        steps = changes(entries)
    except InputError:
        return tuple(said)
    moved = [step for step in steps if step.different and abs(step.f_percent) > FOCAL_LIMIT_PERCENT / 2]
    if moved:
        last = moved[-1]
        said.append(
            f"This body's focal length moved by {last.f_percent:+.3f} % between its calibrations "
            f"{last.before} and {last.after}: calibrate before and after every survey."
        )
    return tuple(said)


def average(entries: Sequence[Entry], name: str) -> Reference:
    """The mean of consistent calibrations of one body, weighted by what is known of f, with covariance.

    Where they scatter more than they claim, the covariance grows by the scatter (Birge 1932).

    Raises:
        InputError: fewer than two, different bodies, or calibrations that contradict each other.
    """
    if len(entries) < 2:
        raise InputError("An average needs at least two calibrations.")
    first = entries[0].reference
    lenses, sigmas = [], []
    for entry in entries:
        reference = entry.reference
        lens, sigma = reference.lens, reference_sigma_f_px(reference)
        if lens is None or not sigma > 0:
            raise InputError(f"{entry.label} cannot be averaged: its precision is not known.")
        if not _compatible(first, reference):
            raise InputError(
                f"{entry.label} and {entries[0].label} are not of one camera body, image size and "
                "processing, so they are not averaged."
            )
        lenses.append(lens)
        sigmas.append(sigma)
    worst = min(
        (change(a, b) for i, a in enumerate(entries) for b in entries[i + 1 :]), key=lambda c: c.chance
    )
    if worst.chance < INCONSISTENT_P:
        raise InputError(
            f"{worst.before} and {worst.after} contradict each other: the focal length differs by "
            f"{worst.f_percent:+.3f} % ({abs(worst.f_percent) / worst.sigma_percent:.1f} sigma) and the "
            f"profile by {worst.deviation.raw_px:.2f} px. Leave the wrong one away."
        )
    weight = 1 / np.square(sigmas)
    weight = weight / weight.sum()
    vector = np.einsum("i,ij->j", weight, np.array([lens.vector for lens in lenses]))
    covariance = np.einsum(
        "i,ijk->jk", weight**2, np.array([entry.reference.lens_covariance for entry in entries])
    )
    f = np.array([entry.reference.f_px or math.nan for entry in entries])
    scatter = float(np.sum(((f - weight @ f) / sigmas) ** 2)) / (len(f) - 1)
    covariance = covariance * max(scatter, 1.0)
    lens = lenses[0].with_vector(vector)
    fitted, jacobian = fit_brown(lens, keep_k4=lens.brown.k4 != 0)
    fitted_covariance = jacobian @ covariance @ jacobian.T
    days = [entry.day for entry in entries if entry.day is not None]
    warm = [e.reference.temperature_c for e in entries if e.reference.temperature_c is not None]
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return replace(
        first,
        name=name,
        brown=lens.brown,
        field_px=lens.field_px,
        sigma={key: float(s) for key, s in zip(BROWN_NAMES, deviations, strict=False) if s > 0},
        covariance=covariance,
        fitted_brown=fitted,
        fitted_covariance=fitted_covariance,
        date=max(days).isoformat() if days else None,
        temperature_c=float(np.mean(warm)) if warm and len(warm) == len(entries) else None,
        line=None,
        source=f"average of {len(entries)} calibrations by fieldcal cameras average",
        provenance="; ".join(
            f"{entry.label} ({entry.day.isoformat() if entry.day else 'no date'}, f "
            f"{entry.reference.f_px:.3f} px, weight {w:.2f})"
            for entry, w in zip(entries, weight, strict=True)
        )
        + (f"; covariance x {scatter:.2f} for their scatter" if scatter > 1 else ""),
    )


def _compatible(a: Reference, b: Reference) -> bool:
    if a.serial is not None and b.serial is not None:
        return same_body(a, b)
    same = (a.width, a.height, a.processing, a.model) == (b.width, b.height, b.processing, b.model)
    return same and a.serial == b.serial


def describe(step: Change) -> str:
    """One change in a sentence."""
    ratio = abs(step.f_percent) / step.sigma_percent if step.sigma_percent > 0 else math.inf
    size = f"f {step.f_percent:+.4f} % ({ratio:.1f} sigma), profile {step.deviation.raw_px:.2f} px"
    what = "the lens moved" if step.different else "no more than chance explains"
    if step.pair:
        what += "; a pair before and after: the survey between them is " + (
            "in doubt" if step.different else "framed"
        )
    return f"{step.before} to {step.after}: {size}: {what}."


def describe_trend(trend: Trend) -> str:
    sign = "significant" if trend.significant else "not significant"
    return (
        f"f changes by {trend.slope_percent:+.4f} ± {trend.sigma_percent:.4f} % per {trend.unit} "
        f"({trend.count} calibrations, {sign})."
    )


def verified_camera(reference: Reference) -> BrownCamera:
    """The camera of a verified calibration for other programs, most of which cannot hold b1 and b2.

    Raises:
        InputError: the calibration is not one that deserves to be called verified; why.
    """
    brown, sigma = reference.comparable_brown, reference_sigma_f_px(reference)
    if brown is None or reference.width == 0:
        raise InputError(f"Too little is known of {reference.name} to write it for other programs.")
    limit = FOCAL_LIMIT_PERCENT / 2
    if reference.fitted_covariance is None and reference.covariance is None:
        raise InputError(
            f"{reference.name} comes without a covariance, so nothing verifies it; make a calibration with "
            "`fieldcal calibrate`."
        )
    if 100 * sigma / brown.f_px > limit:
        raise InputError(
            f"The focal length of {reference.name} is known to {percent(100 * sigma / brown.f_px)} only; "
            f"{limit:g} % is needed."
        )
    lens = reference.lens
    spread = np.sqrt(np.maximum(np.diag(_brown_covariance(reference)), 0.0))
    index = [BROWN_NAMES.index("b1"), BROWN_NAMES.index("b2")]
    if lens is None or (np.abs(brown.vector[index]) > 3 * spread[index]).any():
        return brown
    return fit_brown(lens, keep_k4=brown.k4 != 0, affinity=False)[0]

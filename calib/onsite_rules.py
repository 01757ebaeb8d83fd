"""Rules of calibrating on site: what a wall or an orbit must show before its calibration is accepted."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from shapely.geometry import MultiPoint, Polygon

from calib.align.flatness import TERMS, Flatness
from calib.camera import FloatArray
from calib.evidence import Evidence
from calib.findings import Finding, State
from calib.limits import CD, SEN, Z95, decide, percent
from calib.rules_network import alignment, convergent_share, coverage, cross_validation, model_sensitivity
from calib.rules_reference import opposite_signs, predicted_dome
from calib.solution import Network, Solution

#: [C&D] discussion: second-order terms of the wall's surface are negligible below this share of the distance.
FLATNESS_LIMIT_PERCENT = 0.1
#: A reference must be known four times better than what it is to judge: 1.96 sigma within 0.1 %.
REFERENCE_SIGMA_PERCENT = 0.05
#: What that is at the edge of [C&D]'s pictures of 4000 px; a thermal camera's pixel is coarser.
REFERENCE_SIGMA_EDGE_PX = 1.0
#: [C&D] methods: 20-30 photos, axes at about 45 degrees to the wall, overlap above 80 %.
PHOTOS_WANTED, PHOTOS_LEAST = 20, 8
SIDE_DEG, STEEP_SIDE_DEG = 20.0, 60.0
SIDE_SHARE_PERCENT = 20.0
OVERLAP_WANTED_PERCENT, OVERLAP_LEAST_PERCENT = 80.0, 60.0
#: With fewer photos head-on the focal length is known six times worse (benchmarks, onsite).
HEAD_ON_SHARE = 0.15
#: Less than this of the tie points on the wall, and it is no picture of a wall.
WALL_SHARE_PERCENT = 40.0
#: Tie points a photo should have.
TEXTURE_POINTS = 100
#: Photos of an orbit should stand in at least so many of the eight directions around the middle.
DIRECTIONS = 8
DIRECTIONS_LEAST = 5

_Z_POWER = 1.645
_BENDS = (
    ("wall-bend-along", "bends along its length"),
    ("wall-twist", "is twisted"),
    ("wall-bend-up", "bends over its height"),
)


@dataclass(frozen=True)
class CalibrationEvidence:
    """What the rules look at: the check's evidence (without a reference) and the block itself."""

    evidence: Evidence
    solution: Solution
    network: Network
    flatness: Flatness | None


def wall_findings(given: CalibrationEvidence) -> tuple[Finding, ...]:
    """All rules of a wall, in the order in which they are told."""
    flatness, e = given.flatness, given.evidence
    if flatness is None:
        raise ValueError("a wall's rules need its flatness")
    return (
        wall_share(flatness),
        alignment(replace(e, geotag_fault=None)),
        wall_angles(flatness),
        *(bend(flatness, index) for index in range(len(TERMS))),
        focal_sigma(e),
        cross_validation(e),
        model_sensitivity(e),
        coverage(e),
        photo_count(given.solution),
        wall_overlap(given.solution, flatness),
        texture(given.solution),
        opposite_signs(e),
    )


def orbit_findings(given: CalibrationEvidence) -> tuple[Finding, ...]:
    """All rules of a convergent flight without a wall."""
    e = given.evidence
    return (
        # Geotags that err do not matter to the lens once they are refused.
        alignment(replace(e, geotag_fault=None)),
        convergent_share(e),
        focal_sigma(e),
        predicted_dome(e),
        cross_validation(e),
        model_sensitivity(e),
        coverage(e),
        photo_count(given.solution),
        directions(given.solution),
        texture(given.solution),
        opposite_signs(e),
    )


def bend(flatness: Flatness, index: int) -> Finding:
    """One second-order term of the wall, with its significance and the power of the test."""
    rule, what = _BENDS[index]
    value, sigma = float(flatness.terms_percent[index]), float(flatness.sigmas_percent[index])
    limit = FLATNESS_LIMIT_PERCENT
    state = decide(value, sigma, limit)
    times = abs(value) / sigma if sigma > 0 else math.inf
    seen = (Z95 + _Z_POWER) * sigma
    significance = "significant" if times > Z95 else "not significant"
    text = f"The wall {what} by {percent(abs(value))} of the distance ({times:.1f} sigma, {significance})"
    if state is State.PASS:
        ending = f": negligible. A bend of {percent(seen)} would have shown with 95 % certainty."
        if rule == "wall-twist":
            ending = f": negligible. A twist of {percent(seen)} would have shown with 95 % certainty."
    elif state is State.FLAG:
        ending = f"; {limit:g} % is allowed. Either the wall is not flat or the calibration is wrong."
    else:
        ending = f", known to {percent(Z95 * sigma)} only: {limit:g} % cannot be told."
    return Finding(rule, state, value, sigma, "%", limit, f"{CD}, methods and discussion", text + ending)


def wall_share(flatness: Flatness) -> Finding:
    value = 100 * flatness.wall_share
    text = f"{value:.0f} % of the tie points lie on one flat wall"
    if value >= WALL_SHARE_PERCENT:
        state, ending = State.PASS, "; the others were left out of the surface."
    else:
        state = State.FLAG
        ending = (
            ": this is no wall, or there is much else in the pictures. Let the wall fill the picture, or "
            "use `fieldcal calibrate orbit`, which needs no wall."
        )
    return Finding("wall-share", state, value, None, "%", WALL_SHARE_PERCENT, "fieldcal", text + ending)


def side_angles_deg(flatness: Flatness) -> FloatArray:
    """Angle of every photo's axis to the wall's normal, sideways (k,): positive looks to the right."""
    axes = flatness.axes
    return np.asarray(np.degrees(np.arctan2(axes[:, 0], -axes[:, 2])))


def wall_angles(flatness: Flatness) -> Finding:
    """Whether enough photos look from the left and from the right."""
    sideways = side_angles_deg(flatness)
    # Photos taken with the camera turned upright count by the larger of the two angles as well.
    upward = np.degrees(np.arctan2(flatness.axes[:, 1], -flatness.axes[:, 2]))
    k = len(sideways)
    right, left = int(np.sum(sideways >= SIDE_DEG)), int(np.sum(sideways <= -SIDE_DEG))
    up, down = int(np.sum(upward >= SIDE_DEG)), int(np.sum(upward <= -SIDE_DEG))
    pairs = max(min(left, right), min(up, down))
    value = 100 * pairs / k
    steep = int(np.sum(np.maximum(np.abs(sideways), np.abs(upward)) > STEEP_SIDE_DEG))
    head_on = int(np.sum((np.abs(sideways) < SIDE_DEG) & (np.abs(upward) < SIDE_DEG)))
    text = f"Photos of the wall: {right} from the left, {left} from the right, {head_on} head-on"

    def finding(state: State, ending: str) -> Finding:
        return Finding(
            "wall-angles", state, value, None, "%", SIDE_SHARE_PERCENT, f"{CD}, methods", text + ending
        )

    if value < SIDE_SHARE_PERCENT:
        want = max(math.ceil(k * SIDE_SHARE_PERCENT / 100), 4)
        if left < want and right < want:
            missing = f"{want - right} more from the left and {want - left} more from the right"
        elif left < right:
            missing = f"{want - left} more from the right"
        else:
            missing = f"{want - right} more from the left"
        return finding(State.FLAG, f". Take {missing}, turned about 45 degrees to the wall.")
    if steep > k / 4:
        return finding(
            State.PASS,
            f". {steep} of them are turned more than {STEEP_SIDE_DEG:g} degrees; about 45 are better.",
        )
    if head_on < HEAD_ON_SHARE * k:
        return finding(
            State.PASS, ". Head-on photos between them make the focal length several times better known."
        )
    return finding(State.PASS, ".")


def footprints(solution: Solution, flatness: Flatness) -> list[Polygon]:
    """What each photo sees of the wall, in the wall's plane (lengths in distances)."""
    spots = np.full((len(solution.points_m), 2), np.nan)
    spots[flatness.on_wall] = flatness.points[:, :2]
    seen = []
    for photo in range(len(solution.photos)):
        mine = spots[solution.observations.point[solution.observations.photo == photo]]
        mine = mine[np.isfinite(mine).all(axis=1)]
        hull = MultiPoint(mine).convex_hull if len(mine) >= 3 else Polygon()
        seen.append(hull if isinstance(hull, Polygon) else Polygon())
    return seen


def wall_overlap(solution: Solution, flatness: Flatness) -> Finding:
    """Overlap of neighbours along the wall among photos from the same side."""
    sides = np.sign(side_angles_deg(flatness)) * (np.abs(side_angles_deg(flatness)) >= SIDE_DEG)
    prints = footprints(solution, flatness)
    worst: tuple[float, str] | None = None
    shares = []
    for side in (-1.0, 0.0, 1.0):
        row = [i for i in np.flatnonzero(sides == side) if not prints[i].is_empty]
        row.sort(key=lambda i: prints[i].centroid.x)
        for a, b in pairwise(row):
            smaller = min(prints[a].area, prints[b].area)
            share = 100 * prints[a].intersection(prints[b]).area / max(smaller, 1e-12)
            shares.append(share)
            if worst is None or share < worst[0]:
                names = f"{solution.photos[a].path.name} and {solution.photos[b].path.name}"
                worst = share, names

    def finding(state: State, value: float | None, message: str) -> Finding:
        source = f"{CD}, methods"
        return Finding("wall-overlap", state, value, None, "%", OVERLAP_WANTED_PERCENT, source, message)

    if worst is None:
        return finding(State.UNKNOWN, None, "The overlap along the wall could not be measured.")
    usual = float(np.median(shares))
    text = f"Neighbours on one side share {usual:.0f} % of their picture"
    if worst[0] < OVERLAP_LEAST_PERCENT:
        return finding(
            State.FLAG,
            worst[0],
            f"{text}, but {worst[1]} only {worst[0]:.0f} %. Take photos in between: a step of a fifth of "
            "the picture's width.",
        )
    if usual < OVERLAP_WANTED_PERCENT:
        return finding(
            State.UNKNOWN, usual, f"{text}; {OVERLAP_WANTED_PERCENT:g} % are better (shorter steps)."
        )
    return finding(State.PASS, usual, f"{text}.")


def reference_limit_percent(width_px: int) -> float:
    """How well f must be known for a reference on control points, in percent, one sigma.

    0.05 % of [C&D]'s pictures is a pixel at their edge; cameras of fewer pixels need no more than that of
    their own.
    """
    return max(REFERENCE_SIGMA_PERCENT, 100 * REFERENCE_SIGMA_EDGE_PX / (width_px / 2))


def focal_sigma(e: Evidence) -> Finding:
    sigma, limit = 100 * e.sigma_f_px / e.f_px, REFERENCE_SIGMA_PERCENT
    known = f"The focal length is known to {percent(sigma)} (1 sigma)"
    source = f"{CD}, 0.1 % rule at 95 %"
    if math.isfinite(sigma) and sigma <= limit:
        text = f"{known}: enough for a reference."
        return Finding("focal-sigma", State.PASS, sigma, None, "%", limit, source, text)
    text = f"{known}; a reference needs {limit:g} %."
    return Finding("focal-sigma", State.FLAG, sigma, None, "%", limit, source, text)


def photo_count(solution: Solution) -> Finding:
    count = len(solution.photos)
    text = f"{count} photos take part"

    def finding(state: State, ending: str) -> Finding:
        source = f"{CD}, discussion"
        return Finding("photo-count", state, count, None, "photos", PHOTOS_WANTED, source, text + ending)

    if count >= PHOTOS_WANTED:
        return finding(State.PASS, ".")
    more = PHOTOS_WANTED - count
    if count >= PHOTOS_LEAST:
        return finding(State.UNKNOWN, f"; 20 to 30 are usual: take {more} more if anything else is in doubt.")
    return finding(State.FLAG, f"; take {more} more.")


def texture(solution: Solution) -> Finding:
    """Photos with too few tie points, by name."""
    counts = np.bincount(solution.observations.photo, minlength=len(solution.photos))
    usual = float(np.median(counts))
    poor = [solution.photos[i].path.name for i in np.flatnonzero(counts < TEXTURE_POINTS)]
    text = f"The photos have {usual:.0f} tie points each (median)"

    def finding(state: State, ending: str) -> Finding:
        return Finding("texture", state, usual, None, "points", TEXTURE_POINTS, "fieldcal", text + ending)

    if not poor:
        return finding(State.PASS, ".")
    names = ", ".join(poor[:3]) + (f" and {len(poor) - 3} more" if len(poor) > 3 else "")
    state = State.FLAG if len(poor) > len(counts) / 4 else State.UNKNOWN
    return finding(
        state,
        f"; {names} {'has' if len(poor) == 1 else 'have'} fewer than {TEXTURE_POINTS}: smooth or dark "
        "surfaces, blur, or too little overlap.",
    )


def directions(solution: Solution) -> Finding:
    """From how many of eight directions around the middle the ground is seen at an angle."""
    axis = solution.rotations_cam_from_world[:, 2, :]
    tilt = np.degrees(np.arccos(np.clip(-axis[:, 2], -1, 1)))
    azimuth = np.arctan2(-axis[:, 0], -axis[:, 1])[tilt >= SIDE_DEG]
    sectors = np.unique(np.floor((azimuth + np.pi) / (2 * np.pi) * DIRECTIONS).astype(int) % DIRECTIONS)
    count = len(sectors)
    text = f"Oblique photos look from {count} of {DIRECTIONS} directions"
    state = State.PASS if count >= DIRECTIONS_LEAST else State.UNKNOWN
    ending = "." if state is State.PASS else "; from all around is better (a full circle)."
    return Finding(
        "directions", state, float(count), None, "", DIRECTIONS_LEAST, f"{SEN}, methods", text + ending
    )

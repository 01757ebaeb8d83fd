"""Thresholds of the field check, and how a value with its sigma is held against one.

A measured value v with standard deviation s against a threshold t is answered at 95 %,
two-sided: pass if |v| + 1.96 s <= t, flag if |v| - 1.96 s > t, otherwise unknown. So "differs"
and "cannot tell" stay two answers, and a larger s never turns a pass into a flag.
"""

from __future__ import annotations

import math

from calib.evidence import Evidence
from calib.findings import State

Z95 = 1.96
#: [C&D] discussion: f within 0.1 % of the reference, dome within 0.1 % of the flying height.
FOCAL_LIMIT_PERCENT = 0.1
DOME_LIMIT_PERCENT = 0.1
#: [C&D] discussion: at least 10 % of the photos 20-45 degrees off nadir.
CONVERGENT_LIMIT_PERCENT = 10.0
#: Fewer never do, however well f seems to be known: one blurred photo may be among them.
LEAST_CONVERGENT = 3
#: Photos closer to the vertical look "straight down".
NADIR_DEG = 10.0
#: Sigma of f at which 0.1 % can just be decided, and the stricter one that a network must reach
#: to be trusted on its own word, without a reference.
FOCAL_SIGMA_PERCENT = FOCAL_LIMIT_PERCENT / Z95
FOCAL_SIGMA_ALONE_PERCENT = 0.03
#: Half of the tie points against the other, in sigmas of their difference; 3 and not 1.96 because the largest
#: of many differences is looked at.
SPLIT_LIMIT = 3.0
#: Least share of covered sensor cells in the middle, along the edges and in the corners.
COVERAGE_LIMIT_PERCENT = 50.0
ALIGNED_LIMIT_PERCENT = 80.0
SECOND_COMPONENT_PERCENT = 10.0
RMS_LIMIT_PX = 3.0

CD = "Carbonneau & Dietrich 2017"
SEN = "Senn et al. 2020"


def decide(value: float, sigma: float, threshold: float) -> State:
    """Pass, flag or unknown at 95 %; unknown where value or sigma are not finite."""
    if not (math.isfinite(value) and math.isfinite(sigma)):
        return State.UNKNOWN
    if abs(value) + Z95 * sigma <= threshold:
        return State.PASS
    if abs(value) - Z95 * sigma > threshold:
        return State.FLAG
    return State.UNKNOWN


def severity(value: float, threshold: float) -> str:
    """How far a flagged value lies beyond its threshold, as a word."""
    ratio = abs(value) / threshold
    if ratio < 1.5:
        return "just over"
    return "clearly over" if ratio < 5 else "far over"


def f_decides(f_px: float, sigma_f_px: float) -> bool:
    """Whether a reference's f is known well enough to hold a survey to 0.1 %."""
    return 100 * sigma_f_px / f_px <= FOCAL_SIGMA_PERCENT


def reference_decides(e: Evidence) -> bool:
    """Whether there is a reference whose own f is known well enough to hold a survey to 0.1 %."""
    return e.f_ref_px is not None and f_decides(e.f_ref_px, e.sigma_f_ref_px)


def no_reference(e: Evidence) -> str:
    """Why there is nothing to compare with, as the end of a sentence."""
    note = e.reference_note or "There is no reference calibration for this camera."
    return note[:1].lower() + note[1:]


def missing_geometry(e: Evidence) -> str:
    """What the flight lacks for the focal length, as the start of a sentence."""
    share = e.convergent_share
    if share is None:
        return "The photos see the ground from too few directions"
    if 100 * share >= CONVERGENT_LIMIT_PERCENT:
        return "The convergent photos are too few or too poorly connected"
    if share > 0:
        start = "Nearly all photos look down"
    elif e.largest_tilt_deg is not None and e.largest_tilt_deg > NADIR_DEG:
        start = f"No photo looks more than {e.largest_tilt_deg:.0f} degrees off the vertical, all"
    else:
        start = "All photos look straight down"
    heights = len(e.heights_agl_m)
    if heights == 0:
        return start.removesuffix(", all")
    return f"{start} from {'one height' if heights == 1 else f'{heights} heights'}"


def percent(value: float) -> str:
    """A percentage with two significant digits and no more than needed: 12 %, 0.13 %, 0.004 %."""
    if not math.isfinite(value):
        return "an unknown amount"
    if value >= 9.95:
        return f"{value:.0f} %"
    digits = 1 - math.floor(math.log10(value)) if value > 0 else 1
    return f"{value:.{min(digits, 4)}f} %"

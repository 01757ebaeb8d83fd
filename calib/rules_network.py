"""Rules about the photos and the adjustment themselves: Evidence -> Finding."""

from __future__ import annotations

import math

from calib.evidence import CONVERGENT_DEG, STEEP_DEG, Evidence
from calib.findings import Finding, State
from calib.limits import (
    ALIGNED_LIMIT_PERCENT,
    CD,
    CONVERGENT_LIMIT_PERCENT,
    COVERAGE_LIMIT_PERCENT,
    FOCAL_LIMIT_PERCENT,
    FOCAL_SIGMA_ALONE_PERCENT,
    FOCAL_SIGMA_PERCENT,
    LEAST_CONVERGENT,
    RMS_LIMIT_PX,
    SECOND_COMPONENT_PERCENT,
    SEN,
    SPLIT_LIMIT,
    decide,
    missing_geometry,
    percent,
    reference_decides,
    severity,
)


def convergent_share(e: Evidence) -> Finding:
    def finding(state: State, message: str, value: float | None) -> Finding:
        return Finding(
            "convergent-share",
            state,
            value,
            None,
            "%",
            CONVERGENT_LIMIT_PERCENT,
            f"{CD}, discussion",
            message,
        )

    share = e.convergent_share
    if share is None or e.convergent is None or e.steep is None or e.nadir is None:
        return finding(State.UNKNOWN, "It is not known how far the photos look off the vertical.", None)
    oblique, photos = e.convergent + e.steep, e.nadir + e.convergent + e.steep
    value = 100 * share
    if oblique == 0:
        text = f"None of the {photos} photos looks {CONVERGENT_DEG:g} degrees or more off the vertical"
    else:
        text = f"{oblique} of {photos} photos ({value:.0f} %) look {CONVERGENT_DEG:g} degrees or more off"
        text += " the vertical"
        if e.steep:
            text += f", {'all' if e.steep == oblique else e.steep} of them beyond {STEEP_DEG:g} degrees"
    if value >= CONVERGENT_LIMIT_PERCENT:
        return finding(State.PASS, f"{text}: at least {CONVERGENT_LIMIT_PERCENT:g} % are asked for.", value)
    sigma = 100 * e.sigma_f_px / e.f_px
    if oblique >= LEAST_CONVERGENT and sigma <= _focal_sigma_limit(e):
        return finding(
            State.PASS,
            f"{text}: fewer than the {CONVERGENT_LIMIT_PERCENT:g} % asked for, but with them the focal "
            f"length is known to {percent(sigma)}.",
            value,
        )
    return finding(State.FLAG, f"{text}; at least {CONVERGENT_LIMIT_PERCENT:g} % are needed.", value)


def _focal_sigma_limit(e: Evidence) -> float:
    """Percent; stricter where no good reference takes part."""
    return FOCAL_SIGMA_PERCENT if reference_decides(e) else FOCAL_SIGMA_ALONE_PERCENT


def focal_sigma(e: Evidence) -> Finding:
    sigma = 100 * e.sigma_f_px / e.f_px
    limit = _focal_sigma_limit(e)

    def finding(state: State, message: str) -> Finding:
        # sigma 0: the sigma of a sigma is not estimated.
        return Finding("focal-sigma", state, sigma, None, "%", limit, f"{CD}, 0.1 % rule at 95 %", message)

    if not math.isfinite(sigma):
        return finding(State.FLAG, f"The focal length cannot be determined: {missing_geometry(e)}.")
    known = f"known to {percent(sigma)} (1 sigma)"
    if sigma <= limit:
        return finding(State.PASS, f"The focal length is {known}: enough to hold it to 0.1 %.")
    if sigma > FOCAL_LIMIT_PERCENT:
        return finding(
            State.FLAG,
            f"{missing_geometry(e)}, so the focal length cannot be determined: it is {known}, "
            f"and {percent(limit)} is needed.",
        )
    return finding(
        State.UNKNOWN, f"The focal length is {known}; {percent(limit)} is needed to hold it to 0.1 %."
    )


def cross_validation(e: Evidence) -> Finding:
    source = "two halves of the tie points, as mrcal does"

    def finding(state: State, message: str, value: float | None) -> Finding:
        return Finding("cross-validation", state, value, 1.0, "sigma", SPLIT_LIMIT, source, message)

    ratios = [] if e.split_profile_ratio is None else [e.split_profile_ratio]
    if e.split_f_px is not None and e.split_sigma_f_px:
        ratios.append(abs(e.split_f_px) / e.split_sigma_f_px)
    if not ratios:
        return Finding(
            "cross-validation",
            State.UNKNOWN,
            None,
            None,
            "sigma",
            SPLIT_LIMIT,
            source,
            "The two halves of the tie points could not be calibrated separately.",
        )
    worst = max(ratios)
    text = f"Calibrated from each half of the tie points, f and profile differ by {worst:.1f} sigma"
    if e.split_f_px is not None:
        text += f" ({percent(100 * abs(e.split_f_px) / e.f_px)} of the focal length)"
    if worst <= SPLIT_LIMIT:
        return finding(State.PASS, f"{text}: as much as chance explains.", worst)
    return finding(State.FLAG, f"{text}: more than chance explains.", worst)


def model_sensitivity(e: Evidence) -> Finding:
    source = "nested lens models"
    limit = FOCAL_LIMIT_PERCENT
    if e.spread_f_px is None:
        return Finding(
            "model-sensitivity",
            State.UNKNOWN,
            None,
            None,
            "%",
            limit,
            source,
            "The calibration was not tried with other lens models.",
        )
    spread, sigma = 100 * abs(e.spread_f_px) / e.f_px, 100 * e.sigma_f_formal_px / e.f_px
    models = str(len(e.models) or "several")
    text = f"Between {models} defensible lens models the focal length moves by {percent(spread)}"
    if spread > limit and spread > sigma:
        state, ending = (
            State.FLAG,
            f": {severity(spread, limit)} {limit:g} %, so the model decides, not the photos.",
        )
    elif spread > limit:
        state, ending = (
            State.UNKNOWN,
            f", no more than its formal sigma of {percent(sigma)}, which is too large itself.",
        )
    elif _decision(e, e.sigma_f_formal_px) is not _decision(e, e.sigma_f_px):
        state, ending = State.UNKNOWN, ": enough to leave the comparison with the reference open."
    else:
        state, ending = State.PASS, ": too little to change the answer."
    return Finding("model-sensitivity", state, spread, sigma, "%", limit, source, text + ending)


def _decision(e: Evidence, sigma_f_px: float) -> State | None:
    """What focal-drift would say with another sigma of this flight's f (None: no reference)."""
    if e.f_ref_px is None:
        return None
    sigma = 100 * math.hypot(sigma_f_px, e.sigma_f_ref_px) / e.f_ref_px
    return decide(100 * (e.f_px - e.f_ref_px) / e.f_ref_px, sigma, FOCAL_LIMIT_PERCENT)


def coverage(e: Evidence) -> Finding:
    def finding(state: State, message: str, value: float | None) -> Finding:
        return Finding("coverage", state, value, None, "%", COVERAGE_LIMIT_PERCENT, f"{SEN}, fig. 4", message)

    if e.coverage is None:
        return finding(State.UNKNOWN, "It is not known which parts of the sensor hold tie points.", None)
    shares = {"middle": e.coverage.centre, "edges": e.coverage.edges, "corners": e.coverage.corners}
    worst = min(shares.values())
    thin = [part for part, share in shares.items() if 100 * share < COVERAGE_LIMIT_PERCENT]
    if thin:
        text = f"Tie points are thin in the {' and '.join(thin)} of the image"
        return finding(State.FLAG, f"{text} (only {100 * worst:.0f} % covered there).", 100 * worst)
    least = "edges and corners included" if worst > 0.995 else f"at least {100 * worst:.0f} % of every part"
    return finding(State.PASS, f"Tie points cover the whole image, {least}.", 100 * worst)


def alignment(e: Evidence) -> Finding:
    def finding(state: State, message: str) -> Finding:
        share = 100 * e.aligned / e.used if e.used else None
        return Finding("alignment", state, share, None, "%", ALIGNED_LIMIT_PERCENT, "fieldcal", message)

    if not e.used:
        return finding(State.UNKNOWN, "It is not known how many photos were aligned.")
    text = f"{e.aligned} of {e.used} photos were aligned"
    if e.rms_px is not None:
        text += f" with {e.rms_px:.2f} px residual"
    faults = []
    if 100 * e.aligned / e.used < ALIGNED_LIMIT_PERCENT:
        faults.append("too few")
    second = sorted(e.components, reverse=True)[1] if len(e.components) > 1 else 0
    if 100 * second / e.used >= SECOND_COMPONENT_PERCENT:
        faults.append(f"{second} photos form a block of their own")
    if e.rms_px is not None and e.rms_px > RMS_LIMIT_PX:
        faults.append(f"the residual is over {RMS_LIMIT_PX:g} px")
    if not e.converged:
        faults.append("the adjustment did not settle")
    geotags = "" if e.geotag_fault is None else f"{e.geotag_fault.strip().rstrip('.')}."
    if geotags and "more photos" not in geotags.lower():
        geotags += " More photos do not cure this."
    if faults:
        return finding(State.FLAG, f"{text}, but {', and '.join(faults)}. {geotags}".rstrip())
    if geotags:
        return finding(State.FLAG, f"{geotags} Without them {text}.")
    return finding(State.PASS, f"{text} in one block (that alone proves nothing about the calibration).")

"""Rules that hold the survey against a reference: Evidence -> Finding."""

from __future__ import annotations

import math

from calib.evidence import Evidence
from calib.findings import Finding, State
from calib.limits import (
    CD,
    DOME_LIMIT_PERCENT,
    FOCAL_LIMIT_PERCENT,
    Z95,
    decide,
    no_reference,
    percent,
    reference_decides,
    severity,
)


def focal_drift(e: Evidence) -> Finding:
    def finding(
        state: State, message: str, value: float | None = None, sigma: float | None = None
    ) -> Finding:
        return Finding(
            "focal-drift", state, value, sigma, "%", FOCAL_LIMIT_PERCENT, f"{CD}, discussion", message
        )

    if e.f_ref_px is None:
        return finding(State.UNKNOWN, f"The focal length was not compared: {no_reference(e)}")
    drift = 100 * (e.f_px - e.f_ref_px) / e.f_ref_px
    sigma = 100 * math.hypot(e.sigma_f_px, e.sigma_f_ref_px) / e.f_ref_px
    state = decide(drift, sigma, FOCAL_LIMIT_PERCENT)
    way = "longer" if drift > 0 else "shorter"
    text = (
        f"The focal length is {percent(abs(drift))} {way} than the reference's ({e.f_px:.1f} against "
        f"{e.f_ref_px:.1f} px)"
    )
    limit = f"the limit of {FOCAL_LIMIT_PERCENT:g} %"
    if state is State.FLAG:
        return finding(state, f"{text}: {severity(drift, FOCAL_LIMIT_PERCENT)} {limit}.", drift, sigma)
    if state is State.PASS:
        return finding(state, f"{text}: within {limit}.", drift, sigma)
    why = (
        "the reference is not known well enough for this body"
        if e.sigma_f_ref_px > e.sigma_f_px
        else "this flight does not fix it well enough"
    )
    return finding(
        state, f"{text}, known to {percent(Z95 * sigma)} only: {why} to hold it to {limit}.", drift, sigma
    )


def equifinal_deviation(e: Evidence) -> Finding:
    source = f"{CD}, fig. 5 and discussion"

    def finding(
        state: State, message: str, value: float | None = None, sigma: float | None = None
    ) -> Finding:
        return Finding("equifinal-deviation", state, value, sigma, "px", e.tolerance_px, source, message)

    if e.deviation is None:
        return finding(State.UNKNOWN, f"The lens distortion was not compared: {no_reference(e)}")
    d = e.deviation
    state = decide(d.raw_px, d.sigma_raw_px, e.tolerance_px)
    text = (
        f"The lens distortion differs from the reference's by up to {_px(d.raw_px)} "
        f"({_px(d.linear_removed_px)} apart from a plain scale)"
    )
    limit = f"the tolerance of {e.tolerance_px:.2g} px"
    ending = {
        State.PASS: f": within {limit}.",
        State.FLAG: f": {severity(d.raw_px, e.tolerance_px)} {limit}.",
        State.UNKNOWN: f", uncertain by {_px(Z95 * d.sigma_raw_px)}: too close to {limit} to tell.",
    }[state]
    return finding(state, text + ending, d.raw_px, d.sigma_raw_px)


def equifinal_line(e: Evidence) -> Finding:
    source = e.line.source if e.line is not None else f"{CD}, eq. 5-8"
    band = e.line.band_k2_px if e.line is not None else None

    def finding(
        state: State, message: str, value: float | None = None, sigma: float | None = None
    ) -> Finding:
        return Finding("equifinal-line", state, value, sigma, "px^-4", band, source, message)

    if e.f_ref_px is None:
        return finding(
            State.UNKNOWN, f"There is no equifinal line to compare K1 and K2 with: {no_reference(e)}"
        )
    if not e.radial.opposite_signs:
        return finding(
            State.UNKNOWN, "The equifinal line does not apply, because K1 and K2 have the same sign."
        )
    if e.line is None or e.offset is None or band is None:
        return finding(
            State.UNKNOWN,
            "No equifinal line could be drawn: the reference's distortion is unknown, or K3 too far off.",
        )
    o = e.offset
    across = decide(o.k2_px, o.sigma_k2_px, band)
    # Inside the domain at 95 %, outside at 95 %, or neither.
    if o.inside_k1_px - Z95 * o.sigma_k1_px >= 0:
        along = State.PASS
    else:
        along = State.FLAG if o.inside_k1_px + Z95 * o.sigma_k1_px < 0 else State.UNKNOWN
    where = f"K2 lies {abs(o.k2_px) / band:.1f} band widths from the equifinal line"
    if State.FLAG in (across, along):
        why = "outside the band" if across is State.FLAG else "and K1 outside the range where the line holds"
        return finding(
            State.FLAG, f"{where}, {why}: distortion and reference disagree.", o.k2_px, o.sigma_k2_px
        )
    if across is State.PASS and along is State.PASS:
        return finding(
            State.PASS,
            f"{where}, and K1 inside its range: equivalent to the reference.",
            o.k2_px,
            o.sigma_k2_px,
        )
    unsure = "K2" if across is State.UNKNOWN else "K1"
    return finding(
        State.UNKNOWN, f"{where}; {unsure} is not known well enough to tell.", o.k2_px, o.sigma_k2_px
    )


def opposite_signs(e: Evidence) -> Finding:
    r = e.radial
    product = r.k1_px * r.k2_px
    slope = (r.k2_px, r.k1_px)
    variance = sum(slope[i] * slope[j] * float(e.radial_covariance[i, j]) for i in range(2) for j in range(2))
    sigma = math.sqrt(max(variance, 0.0))
    if product + Z95 * sigma < 0:
        state, text = State.PASS, "K1 and K2 have opposite signs, so the equifinal method applies."
    elif product < 0:
        state = State.UNKNOWN
        text = (
            "K1 and K2 seem to have opposite signs, but not beyond doubt; the equifinal method may not apply."
        )
    else:
        state = State.UNKNOWN
        text = "K1 and K2 have the same sign, so the equifinal method does not apply to this lens."
    return Finding("opposite-signs", state, product, sigma, "px^-6", 0.0, f"{CD}, discussion", text)


def predicted_dome(e: Evidence) -> Finding:
    def finding(state: State, message: str, sigma: float | None) -> Finding:
        return Finding(
            "predicted-dome",
            state,
            e.dome_percent,
            sigma,
            "% H",
            DOME_LIMIT_PERCENT,
            f"{CD}, conclusion",
            message,
        )

    sigma = e.sigma_dome_percent
    if sigma is None or not math.isfinite(sigma):
        return finding(State.UNKNOWN, "A dome or dish in the heights could not be predicted.", sigma)
    if e.dome_percent is not None and reference_decides(e):
        state = decide(e.dome_percent, sigma, DOME_LIMIT_PERCENT)
        limit = f"the limit of {DOME_LIMIT_PERCENT:g} %"
        shape = "dome" if e.dome_percent > 0 else "dish"
        text = (
            f"The calibration bends the model into a {shape} of {percent(abs(e.dome_percent))} of the height"
        )
        if e.dome_m is not None:
            text += f" ({abs(e.dome_m):.2g} m)"
        ending = {
            State.PASS: f": within {limit}.",
            State.FLAG: f": {severity(e.dome_percent, DOME_LIMIT_PERCENT)} {limit}.",
            State.UNKNOWN: f", known to {percent(Z95 * sigma)} only: too uncertain to tell.",
        }[state]
        return finding(state, text + ending, sigma)
    # A reference that does not decide takes no part, nor does its sigma.
    left_open = sigma if e.dome_left_open_percent is None else e.dome_left_open_percent
    room = percent(Z95 * left_open)
    if Z95 * left_open <= DOME_LIMIT_PERCENT:
        return finding(
            State.PASS,
            f"The photos leave room for a dome or dish of no more than {room} of the height (95 %).",
            left_open,
        )
    return finding(
        State.UNKNOWN,
        f"The photos leave room for a dome or dish of {room} of the height; none can be excluded.",
        left_open,
    )


def _px(value: float) -> str:
    return f"{value:.1f} px" if value >= 0.95 else f"{value:.2f} px"

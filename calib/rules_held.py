"""Rules for a survey whose lens is held at a reference: what the photos can still verify."""

from __future__ import annotations

import numpy as np

from calib.evidence import Evidence
from calib.findings import Finding, State
from calib.limits import CD, DOME_LIMIT_PERCENT, Z95, decide, percent

#: A chance below this is none. Mean radial residuals of fewer px do no harm.
LEAST_P = 1e-3
RING_LIMIT_PX = 0.25


def reference_fit(e: Evidence) -> Finding:
    """Whether the photos, were they free to, would change the lens by more than chance."""

    def finding(state: State, message: str, value: float | None = None) -> Finding:
        return Finding("reference-fit", state, value, None, "%", None, "f and K1-K3, chi-square", message)

    if e.held is None:
        return finding(State.UNKNOWN, "The lens was not held.")
    value = e.held.move_percent
    left_free = f"left free, they move the focal length by {percent(abs(value))} and the distortion with it"
    if e.held.move_p < LEAST_P:
        return finding(
            State.FLAG,
            f"The photos contradict the reference: {left_free}, which chance does in less than one of "
            f"{round(1 / LEAST_P)} flights. Zoom, focus or body are not those of the reference, or the "
            "lens has moved.",
            value,
        )
    return finding(
        State.PASS, f"The photos do not contradict the reference: {left_free}, as chance does.", value
    )


def radial_residuals(e: Evidence) -> Finding:
    """Whether residuals point inwards or outwards anywhere on the sensor."""

    def finding(
        state: State, message: str, value: float | None = None, sigma: float | None = None
    ) -> Finding:
        return Finding("radial-residuals", state, value, sigma, "px", RING_LIMIT_PX, "fieldcal", message)

    if e.held is None or not len(e.held.ring_mean_px):
        return finding(State.UNKNOWN, "There are too few tie points to see a pattern in the residuals.")
    mean, sigma = e.held.ring_mean_px, e.held.ring_sigma_px
    worst = int(np.argmax(np.abs(mean)))
    # The largest of several is looked at: three sigmas, not two.
    wide = 1.5 * sigma[worst]
    state = decide(float(mean[worst]), float(wide), RING_LIMIT_PX)
    way = "outwards" if mean[worst] > 0 else "inwards"
    text = (
        f"With the lens held, residuals point {way} by {abs(mean[worst]):.2f} px on average, "
        f"{e.held.ring_radius_px[worst]:.0f} px from the middle of the image"
    )
    ending = {
        State.PASS: ": no ring is off by more.",
        State.FLAG: ": the distortion is not that of the reference.",
        State.UNKNOWN: ": not known well enough to tell.",
    }[state]
    return finding(state, text + ending, float(mean[worst]), float(sigma[worst]))


def position_dome(e: Evidence) -> Finding:
    """The dome against the measured camera positions."""

    def finding(
        state: State, message: str, value: float | None = None, sigma: float | None = None
    ) -> Finding:
        return Finding(
            "position-dome", state, value, sigma, "% H", DOME_LIMIT_PERCENT, f"{CD}, conclusion", message
        )

    value = None if e.held is None else e.held.position_dome_percent
    sigma = None if e.held is None else e.held.sigma_position_dome_percent
    if value is None or sigma is None:
        return finding(
            State.UNKNOWN,
            "The photos have too few believed positions to look for a dome in the camera heights.",
        )
    state = decide(value, sigma, DOME_LIMIT_PERCENT)
    text = f"Against the measured positions the block bends by {percent(abs(value))} of the height"
    ending = {
        State.PASS: ": within the limit.",
        State.FLAG: ": more than the limit.",
        State.UNKNOWN: f", known to {percent(Z95 * sigma)} only.",
    }[state]
    return finding(state, text + ending, value, sigma)

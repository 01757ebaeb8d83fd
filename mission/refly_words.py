"""An extra pass in words: what it is, what it brings, what stands against it."""

from __future__ import annotations

from calib.findings import State, Verdict
from calib.flown_file import FlownCheck
from calib.limits import FOCAL_LIMIT_PERCENT, percent
from mission.plan import Station
from mission.refly_search import CURED_DOME_PERCENT, Found
from mission.timing import minutes

WALL = (
    "From the ground, without flying: photograph a flat, textured wall by hand from about 10 m, 10 to 15 "
    "pairs of photos that meet on it at 45 degrees from either side, check them on their own and keep them "
    "with --save-reference; then check the survey against that reference."
)

#: So far beyond the limit, in its own sigmas, another focal length is another focal length.
DOUBTLESS_SIGMAS = 5.0
#: Share of the limit from which what no lens model follows is what keeps a pass from curing.
LENS_SHARE = 0.8


def metres(value: float) -> str:
    """A small length for people."""
    if value >= 1:
        return f"{value:.1f} m"
    # Two rounds of formatting, or 99.9 would be 1e+02.
    return f"{float(f'{100 * value:.2g}'):g} cm" if value >= 0.01 else f"{float(f'{1000 * value:.1g}'):g} mm"


def time_words(seconds: float) -> str:
    """A short time in the air."""
    return f"{seconds:.0f} s" if seconds < 100 else minutes(seconds)


def span(values: list[float], unit: str) -> str:
    """Lowest to highest of sorted numbers."""
    low, high = f"{values[0]:.0f}", f"{values[-1]:.0f}"
    return f"{low} {unit}" if low == high else f"{low} to {high} {unit}"


def described(found: Found) -> str:
    """What the pass is."""
    shape, stations = found.shape, found.stations
    if shape is not None and len(stations) == len(shape.stations) and shape.kind in ("orbit", "arc"):
        what = "an orbit" if shape.kind == "orbit" else "an arc"
        return (
            f"{what} of {shape.radius_m:.0f} m radius at {shape.height_m:.0f} m, camera "
            f"{shape.tilt_deg:.0f} degrees off nadir"
        )
    if all(s.pitch_deg < -89.0 for s in stations):
        return f"photos straight down along a line at {span(_heights(stations), 'm')}"
    tilts = sorted(90.0 + s.pitch_deg for s in stations)
    return f"single photos {span(tilts, 'degrees')} off nadir from {span(_heights(stations), 'm')}"


def _heights(stations: tuple[Station, ...]) -> list[float]:
    return sorted(s.height_m for s in stations)


def before_after(check: FlownCheck, found: Found) -> str:
    """What is known of f and dome without and with the pass."""
    dome_m = found.worth.dome_percent / 100 * check.height_agl_m
    return (
        f"Now: focal length known to {percent(check.sigma_f_percent)}, possible dome "
        f"{metres(check.dome_sigma_m)}. After: {percent(found.worth.sigma_f_percent)}, {metres(dome_m)}."
    )


def reason(check: FlownCheck, found: Found, seconds: float) -> str:
    """The pass in a line."""
    count = "1 photo" if len(found.stations) == 1 else f"{len(found.stations)} photos"
    return f"{count}, {time_words(seconds)}: {described(found)}. {before_after(check, found)}"


def contradicts(check: FlownCheck) -> bool:
    """Whether f is not the reference's beyond any doubt, although it is known well enough to say so.

    A weak flight's f may be off by several of its sigmas, and there photos help.
    """
    return any(
        f.rule == "focal-drift"
        and f.state is State.FLAG
        and f.value is not None
        and f.sigma is not None
        and check.sigma_f_percent <= FOCAL_LIMIT_PERCENT
        and abs(f.value) > FOCAL_LIMIT_PERCENT + DOUBTLESS_SIGMAS * f.sigma
        for f in check.findings
    )


def why_no_pass(check: FlownCheck, strong: bool) -> str | None:
    """Why flying more does not help; None where it does.

    ``strong``: the network itself already holds what the pass would be flown for. A reference that the photos
    contradict beyond doubt is not cured by more of them either.
    """
    flagged = {f.rule: f.message for f in check.findings if f.state is State.FLAG}
    if check.verdict is Verdict.TRUST:
        return f"Nothing needs to be flown. {check.headline}"
    if "alignment" in flagged:
        return f"More photos do not help before the photos themselves are in order. {flagged['alignment']}"
    if not strong and not contradicts(check):
        return None
    known = f"the photos already determine the focal length ({percent(check.sigma_f_percent)})"
    for rule in ("focal-drift", "equifinal-deviation", "equifinal-line", "predicted-dome"):
        if rule in flagged:
            return (
                f"More photos would say the same again: {known}, and it is the reference that they do not "
                f"agree with. {flagged[rule]} Has the zoom or the focus moved, is it another body, or is the "
                "reference another camera's?"
            )
    if "model-sensitivity" in flagged or "cross-validation" in flagged:
        rule = "model-sensitivity" if "model-sensitivity" in flagged else "cross-validation"
        return (
            f"The photos' geometry is not at fault, so more of it does not help. {flagged[rule]} "
            "Look for blurred photos, moving water or leaves, and a zoom or focus that moved in flight."
        )
    if "coverage" in flagged:
        return (
            f"Convergent photos are not what is missing. {flagged['coverage']} Fly the survey again with "
            "more overlap, over ground that shows texture up to the edges of the photos."
        )
    return f"More photos are not what is missing: {known}. {check.headline}"


def cautions(check: FlownCheck) -> tuple[str, ...]:
    """What the pass does not cure although it helps."""
    flagged = {f.rule: f.message for f in check.findings if f.state is State.FLAG}
    return tuple(
        f"The pass may not cure this: {flagged[rule]}"
        for rule in ("cross-validation", "coverage")
        if rule in flagged
    )


def short_of(found: Found, tie_points: float, noise_px: float) -> str:
    """Why the best pass does not do where no limit forbids a better one."""
    if found.worth.dome_beyond_percent > LENS_SHARE * CURED_DOME_PERCENT:
        return (
            "Not a limit but the lens: it bends rays in a way that no lens model follows, and over a site "
            "this wide for its height that alone leaves room for a dome of "
            f"{percent(found.worth.dome_beyond_percent)} of the height (1 sigma), whatever is flown. Fly the "
            "survey again from higher up, or in parts."
        )
    if found.worth.dome_reference_percent > LENS_SHARE * CURED_DOME_PERCENT:
        return (
            "Not a limit but the reference: over a site this wide for its height its own uncertainty alone "
            f"leaves room for a dome of {percent(found.worth.dome_reference_percent)} of the height "
            "(1 sigma), whatever is flown. Calibrate the camera anew (fieldcal calibrate) and check against "
            "that."
        )
    return (
        f"Not a limit but the survey itself: with {tie_points:.0f} tie points a photo, measured to "
        f"{noise_px:.1f} px, even {len(found.stations)} more photos leave {found.ratio:.1f} times what is "
        "asked for when one of them fails. Fly the survey again with more overlap, or calibrate on a wall."
    )


def ratio_words(found: Found) -> str:
    """How far the best pass is from what is asked for."""
    if not found.counted and found.ratio <= 1.0:
        return "too few of its photos count as convergent"
    return f"{found.ratio:.1f} times what is asked for when one photo fails"

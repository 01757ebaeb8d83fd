"""An assessment in sentences."""

from __future__ import annotations

import math

import numpy as np

from calib.assess.model import SEVEN_NAMES
from calib.assess.study import CloudAssessment
from calib.wording import quantity

#: What the seven are for people, and their units.
SEVEN_WORDS = {
    "Tx": ("Shift east", "m"),
    "Ty": ("Shift north", "m"),
    "Tz": ("Shift up", "m"),
    "Rphi": ("Turn about the vertical", "degrees"),
    "Rtheta": ("Tilt about the x axis", "degrees"),
    "Rpsi": ("Tilt about the y axis", "degrees"),
    "S": ("Scale", "%"),
}
SIGNIFICANT = 0.05
_SIGMAS = 1.96


def seven_rows(made: CloudAssessment) -> list[tuple[str, str, str, str]]:
    """What, symbol, value with sigma, what it amounts to at the edge of the site; of the seven."""
    seven = made.registration.seven
    rows = []
    for i, name in enumerate(SEVEN_NAMES):
        words, unit = SEVEN_WORDS[name]
        if made.registration.determined[i]:
            value = quantity(float(seven.values[i]), float(seven.sigmas[i]), unit)
            edge = quantity(float(made.at_edge_m[i]), None, "m", 2)
        else:
            value, edge = "not determined by these points", ""
        rows.append((words, name, value, edge))
    return rows


def precision_text(made: CloudAssessment) -> str:
    """eta_p in one sentence."""
    sigma = made.eta.sigma_m if math.isfinite(made.eta.sigma_m) else None
    return (
        f"What no shift, turn or scale removes (eta_p) is {quantity(made.eta.eta_p_m, sigma, 'm', 3)}"
        + _percent(made.eta.eta_p_m, made)
        + f"; without the worst points (grass, mismatches) {quantity(made.eta.robust_m, None, 'm', 2)}. At "
        f"the reference points themselves it is {quantity(made.at_points_m, None, 'm', 2)}; more in between "
        "is relief that they do not show."
    )


def shape_text(made: CloudAssessment) -> str:
    """Dome, dish or neither, in one sentence."""
    bowl = made.bowl
    if bowl is None:
        return "Too few reference points lie on the cloud to tell a dome or dish."
    size = quantity(abs(bowl.amplitude_m), bowl.sigma_m, "m")
    if abs(bowl.amplitude_m) > _SIGMAS * bowl.sigma_m:
        kind = "dome: its middle is too high" if bowl.amplitude_m > 0 else "dish: its middle is too low"
        return f"The cloud is a {kind} by {size}{_percent(bowl.amplitude_m, made)}."
    limit = abs(bowl.amplitude_m) + _SIGMAS * bowl.sigma_m
    if bowl.chance < SIGNIFICANT:
        return (
            f"Neither dome nor dish ({size}), but the cloud is bent otherwise: second-order terms as large "
            f"come by chance in {100 * bowl.chance:.1g} % of cases."
        )
    return f"Neither dome nor dish can be told; one of {quantity(limit, None, 'm', 2)} would have been."


def elevation_text(made: CloudAssessment) -> str | None:
    """The vertical scale in one sentence; None where too few points lie on the cloud."""
    trend = made.trend
    if trend is None:
        return None
    if not trend.told:
        relief = quantity(made.relief_m, None, "m", 2)
        known = (
            f"only known to {quantity(100 * trend.sigma, None, '%', 2)}" if trend.sigma < 1 else "not known"
        )
        return f"Whether heights have the scale of the plan is {known}: the ground is too flat ({relief})."
    size = quantity(100 * trend.slope, 100 * trend.sigma, "%")
    if abs(trend.slope) > _SIGMAS * trend.sigma:
        return f"Heights have another scale than the plan: {size} of the height difference."
    return f"Heights have the scale of the plan; {size} is nothing that can be told from zero."


def offset_text(made: CloudAssessment) -> str:
    """Shift and scale in one sentence."""
    registration = made.registration
    seven = registration.seven
    parts = []
    if registration.determined[:2].all():
        parts.append(f"{quantity(float(np.hypot(*seven.values[:2])), None, 'm', 2)} off in plan")
    if registration.determined[2]:
        up = float(seven.values[2])
        parts.append(f"{quantity(abs(up), None, 'm', 2)} too {'high' if up > 0 else 'low'}")
    if registration.determined[6]:
        error = float(seven.values[6]) - 100
        parts.append(f"{quantity(abs(error), None, '%', 2)} too {'large' if error > 0 else 'small'}")
    return f"The cloud is {', '.join(parts)}." if parts else "The points do not tell where the cloud is."


def _percent(metres: float, made: CloudAssessment) -> str:
    if not made.height_agl_m:
        return ""
    return f" ({quantity(100 * abs(metres) / made.height_agl_m, None, '%', 2)} of the flying height)"

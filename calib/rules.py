"""All rules of the field check in the order in which they are reported."""

from __future__ import annotations

from calib.rules_held import position_dome, radial_residuals, reference_fit
from calib.rules_network import (
    alignment,
    convergent_share,
    coverage,
    cross_validation,
    focal_sigma,
    model_sensitivity,
)
from calib.rules_reference import (
    equifinal_deviation,
    equifinal_line,
    focal_drift,
    opposite_signs,
    predicted_dome,
)

RULES = (
    focal_drift,
    equifinal_deviation,
    equifinal_line,
    opposite_signs,
    convergent_share,
    predicted_dome,
    focal_sigma,
    cross_validation,
    model_sensitivity,
    coverage,
    alignment,
)

#: The same for a survey whose lens was held at a reference.
HELD_RULES = (reference_fit, radial_residuals, predicted_dome, position_dome, coverage, alignment)

"""How good a cloud or height model is against reference points ([C&D] eq. 4)."""

from calib.assess.model import (
    SEVEN_NAMES,
    Assessment,
    ElevationTrend,
    Seven,
    Surface,
    assess,
    elevation_trend,
    profile,
    seven_parameters,
)

__all__ = [
    "SEVEN_NAMES",
    "Assessment",
    "ElevationTrend",
    "Seven",
    "Surface",
    "assess",
    "elevation_trend",
    "profile",
    "seven_parameters",
]

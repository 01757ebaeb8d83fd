"""Plotly figures of a check: pure functions from parts of a CheckResult to figures."""

from calib.figures.lens import correlation_figure, equifinal_figure, profile_figure
from calib.figures.sensor import coverage_figure, residual_figure
from calib.figures.site import camera_network_figure, dome_figure
from calib.figures.style import error_ellipse

__all__ = [
    "camera_network_figure",
    "correlation_figure",
    "coverage_figure",
    "dome_figure",
    "equifinal_figure",
    "error_ellipse",
    "profile_figure",
    "residual_figure",
]

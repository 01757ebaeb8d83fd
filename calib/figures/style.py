"""Colours, fonts and small geometry that all figures share.

The palette keeps its contrast on white paper and in sunlight and for colour-blind readers
(Okabe & Ito, darkened); every colour is paired with a marker or line style of its own.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import plotly.graph_objects as go

from calib.camera import FloatArray

INK = "#111111"
GRID = "#d0d0d0"
FLIGHT = "#b03000"
FLIGHT_BAND = "rgba(176,48,0,0.20)"
REFERENCE = "#00508c"
BAND = "rgba(0,80,140,0.16)"
PASSED = "#00592b"
MUTED = "#666666"
#: A colour bar along the lower edge of the figure, whatever its height.
BELOW = {"orientation": "h", "yref": "container", "y": 0, "yanchor": "bottom", "thickness": 14}
#: Chi-square quantile of 95 % with two degrees of freedom.
CHI2_95_2D = 5.991


def styled(figure: go.Figure, height_px: int, **layout: Any) -> go.Figure:
    """Common layout: readable type, white ground, legend below, touch scrolls the page.

    ``meta={"ratio": r, "extra": e}`` asks the page to lower the figure to r times its width plus
    e px on narrow screens (figures with equal axes would be mostly empty there).
    """
    figure.update_layout(
        template=go.layout.Template(),
        height=height_px,
        autosize=True,
        paper_bgcolor="white",
        plot_bgcolor="white",
        font={"family": "system-ui, sans-serif", "size": 14, "color": INK},
        margin={"l": 58, "r": 14, "t": 14, "b": 50},
        legend={"orientation": "h", "x": 0, "xanchor": "left", "y": -0.22, "yanchor": "top"},
        # Without a drag mode a finger on a figure scrolls the page; zooming stays in the tool bar.
        dragmode=False,
        hoverlabel={"font": {"size": 14}},
    )
    axis = {
        "gridcolor": GRID,
        "linecolor": INK,
        "showline": True,
        "ticks": "outside",
        "zerolinecolor": MUTED,
        "automargin": True,
        "title": {"standoff": 8},
    }
    figure.update_xaxes(**axis)
    figure.update_yaxes(**axis)
    figure.update_layout(**layout)
    return figure


def float32(values: FloatArray) -> Any:
    """Half the bytes in the page; seven digits are more than a screen shows."""
    return np.asarray(values, dtype=np.float32)


def error_ellipse(
    centre: FloatArray, covariance: FloatArray, quantile: float = CHI2_95_2D, steps: int = 97
) -> FloatArray | None:
    """Outline (steps, 2) of the error ellipse of a point (2,) with covariance (2, 2).

    None where the covariance is not finite or not positive. The two axes may differ by many
    orders of magnitude (K1 and K2 do), so the axes are scaled before the decomposition.
    """
    scale = np.sqrt(np.abs(np.diag(covariance)))
    if not np.isfinite(covariance).all() or not (np.diag(covariance) > 0).all():
        return None
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    angle = np.linspace(0, 2 * np.pi, steps)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    outline = vectors @ (np.sqrt(quantile * np.clip(values, 0, None))[:, None] * circle)
    return np.asarray(centre + scale * outline.T)


def padded(low: float, high: float, share: float = 0.12) -> list[float]:
    pad = (high - low) * share or abs(high) * share or 1.0
    return [low - pad, high + pad]

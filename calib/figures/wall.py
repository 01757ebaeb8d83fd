"""Figures of a wall: how its points lie on it, and where the cameras stood in front of it."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go

from calib.align.flatness import Flatness
from calib.figures.style import BELOW, FLIGHT, INK, REFERENCE, float32, styled

MOST_POINTS = 4000


def wall_figure(flatness: Flatness) -> go.Figure:
    """Points of the wall seen from the front, coloured by how far they lie in front of its plane."""
    step = max(1, len(flatness.points) // MOST_POINTS)
    points, out = flatness.points[::step], flatness.out_percent[::step]
    reach = max(float(np.percentile(np.abs(out), 98)), 1e-3)
    figure = go.Figure()
    figure.add_scatter(
        x=float32(points[:, 0]),
        y=float32(points[:, 1]),
        mode="markers",
        marker={
            "size": 4,
            "color": float32(out),
            "colorscale": "RdBu",
            "cmin": -reach,
            "cmax": reach,
            "colorbar": BELOW | {"ticksuffix": " %", "nticks": 5, "tickangle": 0},
        },
        hovertemplate="%{marker.color:.3f} %<extra></extra>",
        name="points",
    )
    ratio = float(flatness.half_size[1] / flatness.half_size[0])
    styled(figure, 420, showlegend=False, meta={"ratio": min(ratio, 1.0), "extra": 150})
    figure.update_xaxes(title_text="along the wall (distances)", constrain="domain", nticks=7)
    figure.update_yaxes(title_text="up", scaleanchor="x", constrain="domain", nticks=4)
    return figure


def wall_plan_figure(flatness: Flatness) -> go.Figure:
    """The cameras in front of the wall, seen from above, with the directions they look in."""
    cameras, axes = flatness.cameras, flatness.axes
    tips = cameras + 0.45 * axes
    gaps = np.full(len(cameras), np.nan)
    half = float(flatness.half_size[0])
    figure = go.Figure()
    figure.add_scatter(
        x=[-half, half], y=[0.0, 0.0], mode="lines", line={"color": INK, "width": 6}, name="wall"
    )
    figure.add_scatter(
        x=float32(np.stack([cameras[:, 0], tips[:, 0], gaps], axis=1).ravel()),
        y=float32(np.stack([cameras[:, 2], tips[:, 2], gaps], axis=1).ravel()),
        mode="lines",
        line={"color": FLIGHT, "width": 1.5},
        hoverinfo="skip",
        showlegend=False,
    )
    figure.add_scatter(
        x=float32(cameras[:, 0]),
        y=float32(cameras[:, 2]),
        mode="markers",
        marker={"symbol": "triangle-up", "size": 9, "color": REFERENCE},
        name="cameras",
    )
    styled(figure, 420, meta={"ratio": 0.5, "extra": 150})
    figure.update_xaxes(title_text="along the wall (distances)", constrain="domain", nticks=7)
    figure.update_yaxes(
        title_text="away from it", scaleanchor="x", rangemode="tozero", constrain="domain", nticks=5
    )
    return figure

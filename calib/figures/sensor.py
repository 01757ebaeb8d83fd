"""Figures of the sensor: where tie points were observed, and what is left in the residuals."""

from __future__ import annotations

import math

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from calib.camera import FloatArray
from calib.figures.style import BELOW, FLIGHT, INK, REFERENCE, float32, styled
from calib.solution import Solution

#: Cells along the longer side of the sensor.
DENSITY_CELLS, ARROW_CELLS = 24, 14


def _grid(width: int, height: int, cells: int) -> tuple[FloatArray, FloatArray]:
    """Edges of about square cells, ``cells`` along the longer side."""
    cell = max(width, height) / cells
    columns, rows = max(1, round(width / cell)), max(1, round(height / cell))
    return np.linspace(0, width, columns + 1), np.linspace(0, height, rows + 1)


def coverage_figure(solution: Solution) -> go.Figure:
    """Observations per cell of the sensor, with counts by column above and by row at the side."""
    brown = solution.lens.brown
    x_edges, y_edges = _grid(brown.width, brown.height, DENSITY_CELLS)
    pixels = solution.observations.pixels
    count, _, _ = np.histogram2d(pixels[:, 0], pixels[:, 1], bins=[x_edges, y_edges])
    x_mid, y_mid = (x_edges[1:] + x_edges[:-1]) / 2, (y_edges[1:] + y_edges[:-1]) / 2
    figure = sensor_with_counts()
    figure.add_bar(x=float32(x_mid), y=float32(count.sum(axis=1)), marker_color=REFERENCE, row=1, col=1)
    figure.add_heatmap(
        x=float32(x_mid),
        y=float32(y_mid),
        z=float32(count.T),
        zmin=0,
        colorscale="Viridis",
        colorbar=BELOW,
        row=2,
        col=1,
    )
    figure.add_bar(
        x=float32(count.sum(axis=0)), y=float32(y_mid), orientation="h", marker_color=REFERENCE, row=2, col=2
    )
    styled(figure, 460, showlegend=False, bargap=0.08, meta={"ratio": 0.72, "extra": 150})
    scale_sensor(figure, brown.width, brown.height)
    return figure


def sensor_with_counts() -> go.Figure:
    """An empty figure: the sensor below on the left, counts by column above it and by row at its side."""
    return make_subplots(
        rows=2,
        cols=2,
        shared_xaxes=True,
        shared_yaxes=True,
        column_widths=[0.8, 0.2],
        row_heights=[0.22, 0.78],
        horizontal_spacing=0.03,
        vertical_spacing=0.03,
    )


def scale_sensor(figure: go.Figure, width: int, height: int) -> None:
    """Axes of :func:`sensor_with_counts` in pixels; the counts show the shape only and go without numbers."""
    figure.update_xaxes(range=[0, width], row=1, col=1)
    figure.update_yaxes(range=[height, 0], row=2, col=2)
    figure.update_yaxes(showticklabels=False, ticks="", row=1, col=1)
    figure.update_xaxes(showticklabels=False, ticks="", row=2, col=2)
    figure.update_xaxes(title_text="column (px)", range=[0, width], nticks=5, row=2, col=1)
    figure.update_yaxes(title_text="row (px)", range=[height, 0], nticks=5, row=2, col=1)


def mean_residuals(solution: Solution, least: int = 5) -> tuple[FloatArray, FloatArray]:
    """Residuals averaged over cells of the sensor, outliers left out.

    Returns:
        cell centres (c, 2) and mean residuals (c, 2), px, of cells with ``least`` observations.
    """
    brown = solution.lens.brown
    x_edges, y_edges = _grid(brown.width, brown.height, ARROW_CELLS)
    good = (solution.weights > 0.1) & np.isfinite(solution.residuals_px).all(axis=1)
    pixels, residuals = solution.observations.pixels[good], solution.residuals_px[good]
    columns, rows = len(x_edges) - 1, len(y_edges) - 1
    i = np.clip(np.digitize(pixels[:, 0], x_edges) - 1, 0, columns - 1)
    j = np.clip(np.digitize(pixels[:, 1], y_edges) - 1, 0, rows - 1)
    cell = j * columns + i
    number = np.bincount(cell, minlength=rows * columns)
    total = np.stack([np.bincount(cell, residuals[:, a], rows * columns) for a in (0, 1)], axis=1)
    used = np.flatnonzero(number >= least)
    x_mid, y_mid = (x_edges[1:] + x_edges[:-1]) / 2, (y_edges[1:] + y_edges[:-1]) / 2
    centres = np.stack([x_mid[used % columns], y_mid[used // columns]], axis=1)
    return centres, total[used] / number[used, None]


def residual_exaggeration(solution: Solution) -> float:
    """Factor by which :func:`residual_figure` stretches the arrows: 1, 2 or 5 times a power of ten."""
    brown = solution.lens.brown
    _, mean = mean_residuals(solution)
    longest = float(np.hypot(*mean.T).max(initial=0.0))
    if longest <= 0:
        return 1.0
    wanted = 0.9 * max(brown.width, brown.height) / ARROW_CELLS / longest
    power = 10.0 ** math.floor(math.log10(wanted))
    return max(step * power for step in (1, 2, 5) if step * power <= wanted)


def residual_figure(solution: Solution) -> go.Figure:
    """Mean residual of every cell of the sensor as an arrow, exaggerated."""
    brown = solution.lens.brown
    centres, mean = mean_residuals(solution)
    tips = centres + mean * residual_exaggeration(solution)
    gaps = np.full(len(centres), np.nan)
    figure = go.Figure()
    figure.add_scatter(
        x=float32(np.stack([centres[:, 0], tips[:, 0], gaps], axis=1).ravel()),
        y=float32(np.stack([centres[:, 1], tips[:, 1], gaps], axis=1).ravel()),
        mode="lines",
        line={"color": FLIGHT, "width": 2},
        hoverinfo="skip",
        name="mean residual",
    )
    figure.add_scatter(
        x=float32(centres[:, 0]),
        y=float32(centres[:, 1]),
        mode="markers",
        marker={"size": 4, "color": INK},
        customdata=float32(mean),
        hovertemplate="%{customdata[0]:.3f}, %{customdata[1]:.3f} px<extra></extra>",
        name="cell",
    )
    styled(figure, 560, showlegend=False, meta={"ratio": 0.9 * brown.height / brown.width, "extra": 70})
    figure.update_xaxes(title_text="column (px)", range=[0, brown.width], nticks=5, constrain="domain")
    figure.update_yaxes(
        title_text="row (px)", range=[brown.height, 0], nticks=5, scaleanchor="x", constrain="domain"
    )
    return figure

"""Figures of the site: the camera network from above and the predicted dome."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from calib.camera import FloatArray
from calib.figures.style import BELOW, FLIGHT, INK, MUTED, REFERENCE, float32, styled
from calib.solution import Dome, Network, Solution
from calib.wording import html_text

#: Sparse points drawn at most; more would only slow a phone down.
MOST_POINTS = 2500
#: [C&D] section 5: the tilt range that counts as convergent.
CONVERGENT_DEG = (20.0, 45.0)


@dataclass(frozen=True)
class Unit:
    """What lengths of the site are drawn in: ``size_m`` of the block's own unit, and its words."""

    size_m: float
    across: str
    along: str
    short: str
    #: For the heights of a dome: their size, and their short word.
    fine_m: float
    fine: str


METRES = Unit(1.0, "east (m)", "north (m)", "m", 0.01, "cm")


def relative_unit(flying_height_m: float) -> Unit:
    """For a block without scale or heading: everything in flying heights."""
    return Unit(
        flying_height_m,
        "across (flying heights)",
        "along (flying heights)",
        "H",
        0.01 * flying_height_m,
        "% H",
    )


def camera_network_figure(solution: Solution, network: Network, unit: Unit = METRES) -> go.Figure:
    """Stations with their viewing directions over the sparse points, seen from above, equal axes."""
    # Metric coordinates are those of the exports; others have no origin of their own.
    origin = np.zeros(3) if unit is METRES else np.median(solution.points_m, axis=0)
    points = (_thinned(solution.points_m) - origin) / unit.size_m
    figure = go.Figure()
    if len(points):
        low, high = np.percentile(points[:, 2], [2, 98])
        figure.add_scatter(
            x=float32(points[:, 0]),
            y=float32(points[:, 1]),
            mode="markers",
            marker={
                "size": 4,
                "color": float32(points[:, 2]),
                "colorscale": "Viridis",
                "cmin": float(low),
                "cmax": float(high),
                "colorbar": BELOW | {"ticksuffix": f" {unit.short}", "nticks": 5, "tickangle": 0},
            },
            hovertemplate=f"%{{marker.color:.3~g}} {unit.short}<extra></extra>",
            showlegend=False,
            name="points",
        )
    centres = (solution.centres_m - origin) / unit.size_m
    forward = solution.rotations_cam_from_world[:, 2, :]
    extent = float(np.ptp(centres[:, :2], axis=0).max(initial=1.0))
    tips = centres[:, :2] + 0.25 * extent * forward[:, :2]
    gaps = np.full(len(centres), np.nan)
    figure.add_scatter(
        x=float32(np.stack([centres[:, 0], tips[:, 0], gaps], axis=1).ravel()),
        y=float32(np.stack([centres[:, 1], tips[:, 1], gaps], axis=1).ravel()),
        mode="lines",
        line={"color": INK, "width": 2},
        hoverinfo="skip",
        name="viewing direction",
    )
    convergent = (network.tilt_deg >= CONVERGENT_DEG[0]) & (network.tilt_deg <= CONVERGENT_DEG[1])
    names = np.array([html_text(photo.path.name) for photo in solution.photos], dtype=object)
    for chosen, name, symbol, colour in (
        (~convergent, "other photos", "circle", REFERENCE),
        (convergent, "convergent photos", "triangle-up", FLIGHT),
    ):
        if not chosen.any():
            continue
        figure.add_scatter(
            x=float32(centres[chosen, 0]),
            y=float32(centres[chosen, 1]),
            mode="markers",
            marker={"symbol": symbol, "size": 9, "color": colour, "line": {"color": "white", "width": 1}},
            text=list(names[chosen]),
            customdata=float32(network.tilt_deg[chosen]),
            hovertemplate="%{text}<br>%{customdata:.0f}° off straight down<extra></extra>",
            name=name,
        )
    box = np.ptp(np.concatenate([points[:, :2], centres[:, :2], tips]), axis=0)
    ratio = float(np.clip(box[1] / max(box[0], 1e-9), 0.4, 1.6))
    styled(
        figure, 640, meta={"ratio": 0.8 * ratio, "extra": 200}, margin={"l": 58, "r": 14, "t": 40, "b": 110}
    )
    figure.update_layout(legend={"y": 1.02, "yanchor": "bottom"})
    figure.update_xaxes(title_text=unit.across, constrain="domain", nticks=6)
    figure.update_yaxes(title_text=unit.along, scaleanchor="x", constrain="domain", nticks=6)
    return figure


def _thinned(points_m: FloatArray) -> FloatArray:
    """At most ``MOST_POINTS`` finite points, without the far outliers that would ruin the scale."""
    points = points_m[np.isfinite(points_m).all(axis=1)]
    if len(points) > 20:
        low, high = np.percentile(points, [1, 99], axis=0)
        room = high - low
        points = points[((points >= low - room) & (points <= high + room)).all(axis=1)]
    step = max(1, -(-len(points) // MOST_POINTS))
    return points[::step]


def dome_figure(dome: Dome, unit: Unit = METRES) -> go.Figure | None:
    """Map of the height difference and its mean over the distance from the middle.

    None where there was nothing to compare with (no reference).
    """
    if dome.grid_difference_m is None or dome.grid_east_m is None or dome.grid_north_m is None:
        return None
    east, north = dome.grid_east_m / unit.size_m, dome.grid_north_m / unit.size_m
    difference = dome.grid_difference_m / unit.fine_m
    largest = float(np.nan_to_num(np.abs(difference)).max(initial=0.0)) or 1.0
    metric = unit is METRES
    figure = make_subplots(rows=2, cols=1, row_heights=[0.66, 0.34], vertical_spacing=0.14)
    figure.add_heatmap(
        x=float32(east),
        y=float32(north),
        z=float32(difference),
        zmin=-largest,
        zmax=largest,
        colorscale=[[0, "#2166ac"], [0.5, "#f7f7f7"], [1, "#b2182b"]],
        colorbar={"title": {"text": unit.fine}, "len": 0.62, "y": 1, "yanchor": "top", "thickness": 14},
        hovertemplate=f"%{{x:.3~g}}, %{{y:.3~g}} {unit.short}: %{{z:.2~g}} {unit.fine}<extra></extra>",
        name="difference",
        row=1,
        col=1,
    )
    for axis, values, name, colour, dash in (
        (east, _middle(difference, axis=0), "west to east" if metric else "across", FLIGHT, "solid"),
        (north, _middle(difference, axis=1), "south to north" if metric else "along", REFERENCE, "dash"),
    ):
        figure.add_scatter(
            x=float32(axis - np.mean(axis)),
            y=float32(values),
            mode="lines",
            line={"color": colour, "width": 2.5, "dash": dash},
            name=name,
            row=2,
            col=1,
        )
    figure.add_hline(0, line={"color": MUTED, "width": 1}, row=2, col=1)
    styled(figure, 680, meta={"ratio": 1.0, "extra": 300})
    figure.update_layout(legend_y=-0.12)
    figure.update_xaxes(title_text=unit.across, constrain="domain", nticks=6, row=1, col=1)
    figure.update_yaxes(title_text=unit.along, scaleanchor="x", constrain="domain", nticks=6, row=1, col=1)
    figure.update_xaxes(title_text=f"distance from the middle ({unit.short})", row=2, col=1)
    figure.update_yaxes(title_text=f"difference ({unit.fine})", row=2, col=1)
    return figure


def _middle(grid: FloatArray, axis: int) -> FloatArray:
    """The row (axis 0) or column (axis 1) through the middle of the grid."""
    return np.asarray(np.take(grid, grid.shape[axis] // 2, axis=axis))

"""Figures of an assessment: map of eta, profiles, eta against elevation."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go

from calib.assess.study import CloudAssessment
from calib.camera import FloatArray
from calib.figures.style import FLIGHT, INK, MUTED, REFERENCE, float32, padded, styled
from calib.wording import html_text

_COLOURS = (FLIGHT, REFERENCE, "#00592b", "#6a3d9a", "#7a4d00")
_DASHES = ("solid", "dash", "dot", "dashdot", "longdash")
#: Share of the cells, or points, that may lie beyond the end of the scale.
_BEYOND_PERCENT = 96.0
_MOST_NAMES = 1500


def _scale(values_m: FloatArray) -> tuple[float, str, float]:
    """A unit for heights: how many to the metre, its name, and the end of a scale that holds nearly all."""
    known = np.abs(values_m[np.isfinite(values_m)])
    reach = float(np.percentile(known, _BEYOND_PERCENT)) if len(known) else 1.0
    factor, unit = (1000.0, "mm") if reach < 0.02 else (100.0, "cm") if reach < 1 else (1.0, "m")
    return factor, unit, max(reach * factor, 1e-6)


def eta_map_figure(made: CloudAssessment) -> go.Figure:
    """Mean eta of cells, seen from above, with the reference points."""
    east, north = made.map.east_m, made.map.north_m
    origin = made.registration.origin
    factor, unit, reach = _scale(made.map.eta_m)
    figure = go.Figure()
    figure.add_heatmap(
        x=float32(east - origin[0]),
        y=float32(north - origin[1]),
        z=float32(made.map.eta_m * factor),
        zmin=-reach,
        zmax=reach,
        colorscale=[[0, "#2166ac"], [0.5, "#f7f7f7"], [1, "#b2182b"]],
        colorbar={"title": {"text": unit}, "thickness": 14, "len": 1, "y": 1, "yanchor": "top"},
        hovertemplate=f"%{{x:.1f}}, %{{y:.1f}} m: %{{z:.2~f}} {unit}<extra></extra>",
        name="cloud minus reference",
        showlegend=False,
    )
    names = np.array([html_text(name) for name in made.truth.names], dtype=object)
    at = made.truth.xyz_m[:, :2] - origin[:2]
    outlier = made.registration.outlier
    for mine, name, symbol, colour in (
        (~outlier, "reference points", "circle-open", INK),
        (outlier, "left out", "x", FLIGHT),
    ):
        index = np.flatnonzero(mine)
        index = index[:: max(1, len(index) // _MOST_NAMES)]
        if len(index):
            figure.add_scatter(
                x=float32(at[index, 0]),
                y=float32(at[index, 1]),
                mode="markers",
                marker={"size": _size(len(index)), "symbol": symbol, "color": colour},
                text=list(names[index]),
                hovertemplate="%{text}<extra></extra>",
                name=name,
            )
    for i, one in enumerate(made.profiles):
        ends = np.stack([one.line.start_m, one.line.end_m]) - origin[:2]
        figure.add_scatter(
            x=float32(ends[:, 0]),
            y=float32(ends[:, 1]),
            mode="lines",
            line={"color": _COLOURS[i % 5], "width": 2, "dash": _DASHES[i % 5]},
            name=html_text(one.line.name),
            hoverinfo="skip",
        )
    box = np.ptp(at, axis=0)
    ratio = float(np.clip(box[1] / max(box[0], 1e-9), 0.4, 1.6))
    styled(figure, 620, meta={"ratio": 0.85 * ratio, "extra": 150})
    figure.update_layout(legend={"y": -0.16})
    figure.update_xaxes(title_text="east of the middle (m)", constrain="domain", nticks=7)
    figure.update_yaxes(title_text="north of the middle (m)", scaleanchor="x", constrain="domain", nticks=7)
    return figure


def _size(points: int) -> int:
    """Of markers: many must not hide the map."""
    return 7 if points <= 200 else 5 if points <= 600 else 2


def profile_lines_figure(made: CloudAssessment) -> go.Figure:
    """eta along every line, mean with one standard deviation around it."""
    factor, unit, _ = _scale(np.concatenate([one.eta_m for one in made.profiles]))
    figure = go.Figure()
    for i, one in enumerate(made.profiles):
        known = np.isfinite(one.eta_m)
        along, mean, spread = one.along_m[known], one.eta_m[known] * factor, one.spread_m[known] * factor
        colour = _COLOURS[i % 5]
        figure.add_scatter(
            x=float32(np.concatenate([along, along[::-1]])),
            y=float32(np.concatenate([mean + spread, (mean - spread)[::-1]])),
            mode="lines",
            line={"width": 0},
            fill="toself",
            fillcolor=_faint(colour),
            hoverinfo="skip",
            showlegend=False,
        )
        figure.add_scatter(
            x=float32(one.along_m),
            y=float32(one.eta_m * factor),
            mode="lines",
            line={"color": colour, "width": 2.5, "dash": _DASHES[i % 5]},
            name=html_text(one.line.name),
        )
    figure.add_hline(0, line={"color": MUTED, "width": 1})
    styled(figure, 380)
    figure.update_xaxes(title_text="distance along the line (m)")
    figure.update_yaxes(title_text=f"cloud minus reference ({unit})")
    return figure


def _faint(colour: str) -> str:
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.15)"


def elevation_figure(made: CloudAssessment) -> go.Figure:
    """eta of some of the cloud's points and of the reference points against elevation ([C&D] fig. 9)."""
    registration = made.registration
    there = np.isfinite(registration.residual_m) & ~registration.outlier
    elevation, residual = made.truth.xyz_m[there, 2], registration.residual_m[there]
    factor, unit, reach = _scale(made.shown[:, 1])
    figure = go.Figure()
    figure.add_scatter(
        x=float32(made.shown[:, 0]),
        y=float32(made.shown[:, 1] * factor),
        mode="markers",
        marker={"size": 3, "color": REFERENCE, "opacity": 0.35},
        name="cloud",
        hoverinfo="skip",
    )
    figure.add_scatter(
        x=float32(elevation),
        y=float32(residual * factor),
        mode="markers",
        marker={
            "size": max(_size(len(residual)) - 1, 3),
            "color": FLIGHT,
            "symbol": "diamond",
            "line": {"color": "white", "width": 0.5 if len(residual) <= 600 else 0},
        },
        name="at the reference points",
    )
    if made.trend is not None and made.trend.told:
        ends = np.array([elevation.min(), elevation.max()])
        fitted = residual.mean() + made.trend.slope * (ends - elevation.mean())
        figure.add_scatter(
            x=float32(ends),
            y=float32(fitted * factor),
            mode="lines",
            line={"color": INK, "width": 2.5},
            name="trend",
        )
    figure.add_hline(0, line={"color": MUTED, "width": 1})
    styled(figure, 380)
    figure.update_xaxes(title_text="elevation (m)")
    figure.update_yaxes(title_text=f"cloud minus reference ({unit})", range=padded(-reach, reach, 0.2))
    return figure

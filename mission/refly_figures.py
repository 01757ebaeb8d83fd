"""Pictures of an extra pass: the map with the photos there are, and the K1-K2 plane before and after."""

from __future__ import annotations

import math

import numpy as np
import plotly.graph_objects as go
import shapely

from calib.figures.style import (
    FLIGHT,
    FLIGHT_BAND,
    INK,
    MUTED,
    PASSED,
    REFERENCE,
    error_ellipse,
    float32,
    padded,
    styled,
)
from calib.propagation import radial_px_covariance
from calib.wording import html_text, power_of_ten
from mission.refly import Refly

_AFTER_BAND = "rgba(0,89,43,0.28)"


def k1_k2_figure(pass_: Refly) -> go.Figure | None:
    """95 % ellipses of K1 and K2 as they are known now and with the pass, side by side at their own scales.

    The large one around this flight's values; a second panel shows the small one. None without a pass.
    """
    check, after = pass_.check, pass_.radial_covariance_px()
    if after is None:
        return None
    here = np.array([check.brown.k1_px, check.brown.k2_px])
    now = error_ellipse(here, radial_px_covariance(check.brown, check.brown_covariance)[:2, :2])
    then = error_ellipse(here, after)
    if now is None or then is None:
        return None
    exponents = [math.floor(math.log10(v)) if v > 0 else 0 for v in np.abs(here)]
    scale = 10.0 ** np.array(exponents)
    figure = go.Figure()
    for outline, name, line, fill in (
        (now, "now, 95 %", FLIGHT, FLIGHT_BAND),
        (then, "after the pass, 95 %", PASSED, _AFTER_BAND),
    ):
        figure.add_scatter(
            x=float32(outline[:, 0] / scale[0]), y=float32(outline[:, 1] / scale[1]), mode="lines",
            fill="toself", fillcolor=fill, line={"color": line, "width": 2}, name=name, hoverinfo="skip",
        )  # fmt: skip
    figure.add_scatter(
        x=[here[0] / scale[0]], y=[here[1] / scale[1]], mode="markers", name="this flight",
        marker={"symbol": "x", "size": 10, "color": INK},
    )  # fmt: skip
    styled(figure, 440)
    both = np.concatenate([now, then]) / scale
    x_range, y_range = (
        padded(float(low), float(high)) for low, high in zip(both.min(0), both.max(0), strict=True)
    )
    figure.update_xaxes(title_text=f"K1 ({power_of_ten(exponents[0])} px⁻²)", range=x_range, nticks=6)
    figure.update_yaxes(title_text=f"K2 ({power_of_ten(exponents[1])} px⁻⁴)", range=y_range)
    return figure


def map_figure(pass_: Refly) -> go.Figure | None:
    """The pass from above: path, stations with their numbers and where they look, photos there are, fence."""
    if pass_.plan is None or pass_.found is None:
        return None
    space, path = pass_.flown.site.space, pass_.plan.path_m
    old, stations = pass_.flown.centres_m, pass_.found.stations
    at = np.array([[s.east_m, s.north_m] for s in stations])
    corners = np.concatenate([path[:, :2], old[:, :2]])
    (west, south), (east, north) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
    room = 0.08 * max(east - west, north - south, 1.0)
    figure = go.Figure()
    if space.has_zones:
        frame = shapely.box(west - room, south - room, east + room, north + room)
        for part in shapely.get_parts(space.fence_area.boundary.intersection(frame)):
            xy = shapely.get_coordinates(part)
            figure.add_scatter(
                x=float32(xy[:, 0]), y=float32(xy[:, 1]), mode="lines", name="fence", showlegend=False,
                line={"color": "#9b0000", "width": 2, "dash": "dash"}, hoverinfo="skip",
            )  # fmt: skip
    for structure in space.structures:
        xy = shapely.get_coordinates(structure.outline)
        figure.add_scatter(
            x=float32(xy[:, 0]), y=float32(xy[:, 1]), mode="lines", fill="toself",
            fillcolor="rgba(60,60,60,0.55)", line={"color": INK, "width": 1},
            name=html_text(structure.name), hoverinfo="skip",
        )  # fmt: skip
    figure.add_scatter(
        x=float32(old[:, 0]), y=float32(old[:, 1]), mode="markers", name=f"photos there are ({len(old)})",
        marker={"symbol": "circle", "size": 5, "color": REFERENCE, "opacity": 0.5}, hoverinfo="skip",
    )  # fmt: skip
    figure.add_scatter(
        x=float32(path[:, 0]), y=float32(path[:, 1]), mode="lines", name="path",
        line={"color": MUTED, "width": 1.5}, hoverinfo="skip",
    )  # fmt: skip
    length = 0.07 * max(east - west, north - south)
    yaw = np.radians([s.yaw_deg for s in stations])
    gap = np.full(len(stations), np.nan)
    figure.add_scatter(
        x=float32(np.stack([at[:, 0], at[:, 0] + length * np.sin(yaw), gap], axis=1).ravel()),
        y=float32(np.stack([at[:, 1], at[:, 1] + length * np.cos(yaw), gap], axis=1).ravel()),
        mode="lines", line={"color": FLIGHT, "width": 2}, name="looks towards", hoverinfo="skip",
    )  # fmt: skip
    figure.add_scatter(
        x=float32(at[:, 0]), y=float32(at[:, 1]), mode="markers+text", name=f"new photos ({len(stations)})",
        text=[str(number) for number in range(1, len(stations) + 1)], textposition="top center",
        marker={"symbol": "triangle-up", "size": 12, "color": FLIGHT, "line": {"color": "white", "width": 1}},
        customdata=float32(np.array([[s.height_m, s.yaw_deg, s.pitch_deg] for s in stations])),
        hovertemplate="%{text}: %{customdata[0]:.0f} m up, yaw %{customdata[1]:.0f}°, "
        "pitch %{customdata[2]:.0f}°<extra></extra>",
    )  # fmt: skip
    figure.add_scatter(
        x=[0.0], y=[0.0], mode="markers", name="launch",
        marker={"symbol": "x", "size": 13, "color": INK, "line": {"color": "white", "width": 1.5}},
    )  # fmt: skip
    ratio = float(np.clip((north - south) / max(east - west, 1e-9), 0.4, 1.6))
    styled(
        figure,
        600,
        meta={"ratio": 0.85 * ratio, "extra": 170},
        margin={"l": 58, "r": 14, "t": 70, "b": 60},
    )
    figure.update_layout(legend={"y": 1.02, "yanchor": "bottom"})
    figure.update_xaxes(
        title_text="east (m)", constrain="domain", nticks=6, range=[west - room, east + room], zeroline=False
    )
    figure.update_yaxes(
        title_text="north (m)", scaleanchor="x", constrain="domain", nticks=6,
        range=[south - room, north + room], zeroline=False,
    )  # fmt: skip
    return figure

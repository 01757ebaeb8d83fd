"""Figures of the plan sheet: the map, heights along the path, how many photos see each place."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import plotly.graph_objects as go
import shapely
from shapely import Polygon
from shapely.geometry.base import BaseGeometry

from calib.camera import FloatArray
from calib.figures.style import BELOW, FLIGHT, INK, MUTED, REFERENCE, float32, styled
from calib.wording import html_text
from mission.plan import Station, stations
from mission.planned import Planned
from mission.sheet_data import MOST_FOOTPRINTS, extent, profile, views

#: Markers and colours of patterns, straight down first.
_STYLES = {
    "nadir": ("circle", REFERENCE),
    "height2": ("square", "#4b2e83"),
    "crosshatch": ("diamond", "#005f73"),
    "oblique": ("triangle-right", "#7a4d00"),
    "orbit": ("triangle-up", FLIGHT),
    "fan": ("star", FLIGHT),
    "rings": ("triangle-down", "#8a1c5b"),
    "wall": ("cross", "#333333"),
}
_OTHER = ("hexagon", "#9b0000")


def map_figure(planned: Planned) -> go.Figure:
    """Area, fence, structures, path, photos with where they look, from above; equal axes."""
    plan, site = planned.plan, planned.site
    figure = go.Figure()
    _outline(figure, site.area, "area", INK, "solid", "rgba(0,89,43,0.10)")
    if site.space.has_zones:
        # Its outline, not its area: cut to the picture, the area would get edges that are none.
        frame = shapely.box(*extent(planned))
        _outline(figure, site.space.fence_area.boundary.intersection(frame), "fence", "#9b0000", "dash", None)
    for structure in site.space.structures:
        label = f"{html_text(structure.name)}, {structure.height_m:g} m"
        _outline(figure, structure.outline, label, INK, "solid", "rgba(60,60,60,0.55)")
    path = plan.path_m
    figure.add_scatter(
        x=float32(path[:, 0]), y=float32(path[:, 1]), mode="lines", name="path",
        line={"color": MUTED, "width": 1.5}, hoverinfo="skip",
    )  # fmt: skip
    photos = stations(plan)
    _looks(figure, photos, planned)
    for pattern in dict.fromkeys(s.pattern for s in photos):
        _photos(figure, [s for s in photos if s.pattern == pattern], pattern, len(photos))
    figure.add_scatter(
        x=[0.0], y=[0.0], mode="markers", name="launch", hovertemplate="launch<extra></extra>",
        marker={"symbol": "x", "size": 13, "color": INK, "line": {"color": "white", "width": 1.5}},
    )  # fmt: skip
    return _from_above(figure, planned)


def profile_figure(planned: Planned) -> go.Figure:
    """Height of the path over the ground and the ceiling, along the way."""
    site = planned.site
    along, ground, heights = profile(planned)
    figure = go.Figure()
    figure.add_scatter(
        x=float32(along), y=float32(ground), mode="lines",
        name=f"ground ({html_text(_short(site.terrain.name))})",
        line={"color": "#7a4d00", "width": 2}, fill="tozeroy" if ground.min() >= 0 else None,
        fillcolor="rgba(122,77,0,0.18)", hovertemplate="%{y:.0f} m<extra>ground</extra>",
    )  # fmt: skip
    figure.add_scatter(
        x=float32(along), y=float32(ground + site.clearance_m), mode="lines", name="least clearance",
        line={"color": "#7a4d00", "width": 1.5, "dash": "dot"}, hoverinfo="skip",
    )  # fmt: skip
    figure.add_scatter(
        x=float32(along), y=float32(heights), mode="lines", name="path",
        line={"color": REFERENCE, "width": 2.5},
        hovertemplate="%{y:.0f} m<extra>path</extra>",
    )  # fmt: skip
    if site.space.ceiling_m is not None:
        figure.add_scatter(
            x=[0.0, float(along[-1])], y=[site.space.ceiling_m] * 2, mode="lines", name="ceiling",
            line={"color": "#9b0000", "width": 2, "dash": "dash"}, hoverinfo="skip",
        )  # fmt: skip
    styled(figure, 380)
    figure.update_layout(legend_y=-0.24)
    figure.update_xaxes(title_text="along the path (m)", nticks=7, range=[0, float(along[-1])])
    figure.update_yaxes(title_text="above launch (m)", rangemode="tozero" if ground.min() >= 0 else "normal")
    return figure


def views_figure(planned: Planned) -> go.Figure:
    """How many photos see each place of the area, and outlines of some photos."""
    site = planned.site
    x, y, grid, outlines = views(planned)
    figure = go.Figure()
    figure.add_heatmap(
        x=float32(x), y=float32(y), z=float32(grid), colorscale="Viridis", zmin=0,
        colorbar=BELOW | {"title": {"text": "photos", "side": "right"}, "nticks": 6},
        hovertemplate="%{x:.0f}, %{y:.0f} m: %{z} photos<extra></extra>", name="photos",
    )  # fmt: skip
    chosen = outlines[:: max(1, -(-len(outlines) // MOST_FOOTPRINTS))]
    gap = np.full((1, 2), np.nan)
    rings = np.concatenate([np.concatenate([o, o[:1], gap]) for o in chosen]) if chosen else np.zeros((0, 2))
    figure.add_scatter(
        x=float32(rings[:, 0]), y=float32(rings[:, 1]), mode="lines", name="what photos see",
        hoverinfo="skip",
        line={"color": "rgba(176,48,0,0.35)", "width": 1},
    )  # fmt: skip
    _outline(figure, site.area, "area", INK, "solid", None)
    return _from_above(figure, planned, bar=True)


def _photos(figure: go.Figure, photos: list[Station], pattern: str, total: int) -> None:
    symbol, colour = _STYLES.get(pattern, _OTHER)
    # A thousand photos must not hide each other; the few oblique ones must be seen.
    size = float(np.clip(11 - 3.2 * math.log10(max(total, 1)), 4, 9)) + (4 if len(photos) < 100 else 1)
    figure.add_scatter(
        x=float32(np.array([s.east_m for s in photos])),
        y=float32(np.array([s.north_m for s in photos])),
        mode="markers",
        marker={
            "symbol": symbol, "size": size, "color": colour, "line": {"color": "white", "width": 0.7}
        },
        customdata=float32(np.array([[s.height_m, s.yaw_deg, s.pitch_deg] for s in photos])),
        hovertemplate="%{customdata[0]:.0f} m up, yaw %{customdata[1]:.0f}°, pitch %{customdata[2]:.0f}°"
        f"<extra>{html_text(pattern)}</extra>",
        name=f"{html_text(pattern) or 'added'} ({len(photos)})",
    )  # fmt: skip


def _looks(figure: go.Figure, photos: tuple[Station, ...], planned: Planned) -> None:
    """Short strokes where oblique photos look."""
    tilted = [s for s in photos if s.pitch_deg > -80]
    if not tilted:
        return
    west, south, east, north = extent(planned)
    length = 0.05 * max(east - west, north - south)
    yaw = np.radians([s.yaw_deg for s in tilted])
    x, y = np.array([s.east_m for s in tilted]), np.array([s.north_m for s in tilted])
    gap = np.full(len(tilted), np.nan)
    figure.add_scatter(
        x=float32(np.stack([x, x + length * np.sin(yaw), gap], axis=1).ravel()),
        y=float32(np.stack([y, y + length * np.cos(yaw), gap], axis=1).ravel()),
        mode="lines", line={"color": FLIGHT, "width": 1.5}, hoverinfo="skip", name="looks towards",
    )  # fmt: skip


def _outline(
    figure: go.Figure, shape: BaseGeometry, name: str, colour: str, dash: str, fill: str | None
) -> None:
    rings: list[FloatArray] = []
    for part in shapely.get_parts(shape):
        for ring in (part.exterior, *part.interiors) if isinstance(part, Polygon) else (part,):
            rings += [shapely.get_coordinates(ring), np.full((1, 2), np.nan)]
    if not rings:
        return
    xy = np.concatenate(rings)
    figure.add_scatter(
        x=float32(xy[:, 0]), y=float32(xy[:, 1]), mode="lines", name=name, hoverinfo="skip",
        line={"color": colour, "width": 2, "dash": dash},
        **({"fill": "toself", "fillcolor": fill} if fill else {}),
    )  # fmt: skip


def _from_above(figure: go.Figure, planned: Planned, bar: bool = False) -> go.Figure:
    west, south, east, north = extent(planned)
    ratio = float(np.clip((north - south) / max(east - west, 1e-9), 0.4, 1.6))
    below = 120 if bar else 60
    styled(
        figure,
        660,
        meta={"ratio": 0.85 * ratio, "extra": 110 + below},
        margin={"l": 58, "r": 14, "t": 70, "b": below},
    )
    figure.update_layout(legend={"y": 1.02, "yanchor": "bottom"})
    figure.update_xaxes(zeroline=False)
    figure.update_yaxes(zeroline=False)
    figure.update_xaxes(title_text="east (m)", constrain="domain", nticks=6, range=[west, east])
    figure.update_yaxes(
        title_text="north (m)", scaleanchor="x", constrain="domain", nticks=6, range=[south, north]
    )
    return figure


def _short(name: str) -> str:
    return name.rpartition("/")[2]


def figures(planned: Planned) -> list[tuple[str, str, Any]]:
    """Title, caption and figure, in the order of the sheet."""
    return [
        (
            "Map",
            "The path from the launch point and back, every photo, and where the oblique ones look.",
            map_figure(planned),
        ),
        (
            "Heights along the path",
            f"The path over the ground; the way home is flown at {planned.plan.return_height_m:g} m "
            "above the launch "
            "point, or higher where the aircraft is higher already.",
            profile_figure(planned),
        ),
        (
            "Photos of each place",
            f"How many photos see each place of the area on level ground; the prediction finds "
            f"{planned.prediction.least_views} at the worst place.",
            views_figure(planned),
        ),
    ]

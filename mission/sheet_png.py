"""The plan sheet as one picture: for a message, a print or a slide, where no browser is at hand."""

from __future__ import annotations

import io
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from shapely import Polygon
from shapely.geometry.base import BaseGeometry

from calib.figures.style import FLIGHT, INK, MUTED, REFERENCE
from calib.files import write_bytes_atomic
from calib.findings import Verdict
from calib.wording import VERDICT_WORDS
from mission.limits import hard_violations
from mission.plan import Station, stations
from mission.planned import Planned
from mission.sheet_data import MOST_FOOTPRINTS, extent, profile, views
from mission.timing import minutes

#: A4, landscape, and its pixels per inch.
_SIZE_INCHES, _DPI = (11.7, 8.3), 150
_WARNING, _GROUND = "#9b0000", "#7a4d00"
#: Characters of a line of the text column, and lines that fit.
_TEXT_WIDTH, _TEXT_LINES = 62, 46
#: Markers and colours of patterns; the others are added photos.
_STYLES = {
    "nadir": ("o", REFERENCE),
    "height2": ("s", "#4b2e83"),
    "crosshatch": ("D", "#005f73"),
    "oblique": (">", _GROUND),
    "orbit": ("^", FLIGHT),
    "fan": ("*", FLIGHT),
    "rings": ("v", "#8a1c5b"),
    "wall": ("P", "#333333"),
}


def write_picture(planned: Planned, path: Path) -> None:
    """Write the sheet as PNG, whole or not at all.

    Raises:
        OutputError: not writable.
    """
    write_bytes_atomic(path, render_picture(planned))


def render_picture(planned: Planned) -> bytes:
    """The sheet as PNG, the same for the same plan."""
    figure = Figure(figsize=_SIZE_INCHES, dpi=_DPI)
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(
        2, 3, width_ratios=(1.0, 1.0, 1.05), height_ratios=(1.7, 1.0), left=0.06, right=0.985, top=0.84,
        bottom=0.08, wspace=0.28, hspace=0.32,
    )  # fmt: skip
    _head(figure, planned)
    _map(figure.add_subplot(grid[0, 0]), planned)
    _views(figure, figure.add_subplot(grid[0, 1]), planned)
    _heights(figure.add_subplot(grid[1, :2]), planned)
    _text(figure.add_subplot(grid[:, 2]), planned)
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=_DPI, metadata={"Software": "fieldcal"})
    return data.getvalue()


def _head(figure: Figure, planned: Planned) -> None:
    broken = hard_violations(planned.findings)
    prediction, cost = planned.prediction, planned.timing
    if broken:
        word, text, colour = "DO NOT FLY", broken[0].message, _WARNING
    elif prediction.verdict is Verdict.TRUST:
        word, text, colour = "READY", prediction.reason, "#00592b"
    else:
        word = f"{VERDICT_WORDS[prediction.verdict]} EXPECTED"
        text, colour = prediction.reason, _GROUND
    figure.text(0.015, 0.955, _plain(f"{planned.plan.name}: {word}"), size=17, weight="bold", color=colour)
    figure.text(0.015, 0.905, textwrap.fill(_plain(text), 150), size=9, color=INK, va="center")
    facts = (
        f"{cost.photos} photos with {planned.plan.camera_name}, {planned.site.height_m:g} m above ground, "
        f"{100 * planned.gsd_m:.1f} cm per pixel; {cost.length_m / 1000:.1f} km, {minutes(cost.duration_s)}, "
        f"{100 * cost.battery_share:.0f} % of a battery"
    )
    figure.text(0.015, 0.872, _plain(facts), size=8, color=MUTED)


def _map(axes: Axes, planned: Planned) -> None:
    plan, site = planned.plan, planned.site
    _outline(axes, site.area, INK, "-", "area", fill="#00592b")
    if site.space.has_zones:
        frame = shapely.box(*extent(planned))
        _outline(axes, site.space.fence_area.boundary.intersection(frame), _WARNING, "--", "fence")
    for structure in site.space.structures:
        _outline(axes, structure.outline, INK, "-", f"{structure.name}, {structure.height_m:g} m", fill=INK)
    path = plan.path_m
    axes.plot(path[:, 0], path[:, 1], color=MUTED, linewidth=0.7, zorder=1)
    photos = stations(plan)
    for pattern in dict.fromkeys(s.pattern for s in photos):
        _photos(axes, [s for s in photos if s.pattern == pattern], pattern, len(photos))
    axes.plot(0, 0, "x", color=INK, markersize=9, markeredgewidth=2.5, label="launch", zorder=5)
    _from_above(axes, planned, "Path and photos")
    axes.legend(fontsize=6.5, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3, frameon=False)


def _photos(axes: Axes, photos: list[Station], pattern: str, total: int) -> None:
    marker, colour = _STYLES.get(pattern, ("h", _WARNING))
    at = np.array([[s.east_m, s.north_m] for s in photos])
    size = (3.0 if total < 150 else 1.6) + (2.5 if len(photos) < 100 else 0.0)
    label = f"{_plain(pattern) or 'added'} ({len(photos)})"
    axes.plot(
        at[:, 0], at[:, 1], marker, color=colour, markersize=size, markeredgewidth=0, label=label, zorder=3
    )
    tilted = [s for s in photos if s.pitch_deg > -80]
    if tilted and len(tilted) <= 200:
        yaw = np.radians([s.yaw_deg for s in tilted])
        axes.quiver(
            [s.east_m for s in tilted], [s.north_m for s in tilted], np.sin(yaw), np.cos(yaw), color=colour,
            scale=16, width=0.004, zorder=2, angles="xy",
        )  # fmt: skip


def _views(figure: Figure, axes: Axes, planned: Planned) -> None:
    x, y, grid, outlines = views(planned)
    mesh: Any = axes.pcolormesh(x, y, grid, cmap="viridis", vmin=0, shading="nearest", rasterized=True)
    for outline in outlines[:: max(1, -(-len(outlines) // MOST_FOOTPRINTS))]:
        ring = np.concatenate([outline, outline[:1]])
        axes.plot(ring[:, 0], ring[:, 1], color=FLIGHT, alpha=0.35, linewidth=0.6)
    _outline(axes, planned.site.area, INK, "-", "")
    _from_above(axes, planned, "Photos of each place; footprints")
    bar = figure.colorbar(mesh, ax=axes, orientation="horizontal", pad=0.13, fraction=0.05, aspect=30)
    bar.ax.tick_params(labelsize=7)


def _heights(axes: Axes, planned: Planned) -> None:
    site = planned.site
    along, ground, heights = profile(planned)
    floor = min(float(ground.min()), 0.0)
    axes.fill_between(along, ground, floor, color=_GROUND, alpha=0.2, linewidth=0)
    axes.plot(along, ground, color=_GROUND, linewidth=1.2, label="ground")
    axes.plot(along, ground + site.clearance_m, ":", color=_GROUND, linewidth=1, label="least clearance")
    axes.plot(along, heights, color=REFERENCE, linewidth=1.6, label="path")
    if site.space.ceiling_m is not None:
        axes.axhline(site.space.ceiling_m, linestyle="--", color=_WARNING, linewidth=1.2, label="ceiling")
    axes.set_xlim(0, float(along[-1]))
    axes.set_ylim(bottom=floor)
    axes.set_xlabel("along the path (m)", size=8)
    axes.set_ylabel("above launch (m)", size=8)
    _plain_axes(axes, "Heights along the path")
    axes.legend(fontsize=6.5, loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=4, frameon=False)


def _text(axes: Axes, planned: Planned) -> None:
    """Predicted quality and limits, broken ones first; what does not fit is counted."""
    p = planned.prediction
    lines = [
        ("Predicted quality", True, INK),
        (f"Verdict to expect: {VERDICT_WORDS[p.verdict]}", False, INK),
        (f"Focal length known to {p.sigma_f_percent:.2g} %", False, INK),
        (f"Dome or dish {p.dome_percent:.2g} % of the height, {100 * p.dome_sigma_m:.2g} cm", False, INK),
        (f"Correlation of K1 and K2 {p.k1_k2_correlation:.3f}", False, INK),
        (f"{100 * p.convergent_share:.0f} % of the photos convergent", False, INK),
        (
            f"{p.least_views} photos of the worst place, {100 * p.gsd_worst_m:.2g} cm per pixel there",
            False,
            INK,
        ),
        ("", False, INK),
        ("Limits", True, INK),
    ]
    for finding in sorted(planned.findings, key=lambda f: (f.ok, not f.hard)):
        sign = "\u2713" if finding.ok else ("\u2717" if finding.hard else "!")
        colour = INK if finding.ok else _WARNING
        for i, part in enumerate(textwrap.wrap(finding.message, _TEXT_WIDTH - 3)):
            lines.append((f"{sign if i == 0 else ' '} {part}", False, colour))
    lines += [("", False, INK), ("To know before the flight", True, INK)] if planned.notes else []
    for note in planned.notes:
        lines += [(part, False, INK) for part in textwrap.wrap(note, _TEXT_WIDTH)]
    if len(lines) > _TEXT_LINES:
        over = len(lines) - _TEXT_LINES + 1
        lines = [*lines[:-over], (f"... and {over} more lines: see the HTML sheet", False, MUTED)]
    axes.set_axis_off()
    for number, (text, bold, colour) in enumerate(lines):
        axes.text(
            -0.02, 1 - number / _TEXT_LINES, _plain(text), size=7, color=colour, va="top",
            weight="bold" if bold else "normal", transform=axes.transAxes,
        )  # fmt: skip


def _outline(
    axes: Axes, shape: BaseGeometry, colour: str, style: str, label: str, fill: str | None = None
) -> None:
    for part in shapely.get_parts(shape):
        for ring in (part.exterior, *part.interiors) if isinstance(part, Polygon) else (part,):
            xy = shapely.get_coordinates(ring)
            axes.plot(
                xy[:, 0], xy[:, 1], style, color=colour, linewidth=1.3, label=_plain(label) or None, zorder=2
            )
            label = ""
        if fill is not None and isinstance(part, Polygon):
            xy = shapely.get_coordinates(part.exterior)
            axes.fill(xy[:, 0], xy[:, 1], color=fill, alpha=0.10, linewidth=0, zorder=0)


def _from_above(axes: Axes, planned: Planned, title: str) -> None:
    west, south, east, north = extent(planned)
    axes.set_xlim(west, east)
    axes.set_ylim(south, north)
    axes.set_aspect("equal")
    axes.set_xlabel("east (m)", size=8, labelpad=1)
    axes.set_ylabel("north (m)", size=8, labelpad=1)
    _plain_axes(axes, title)


def _plain_axes(axes: Axes, title: str) -> None:
    axes.set_title(title, size=9, loc="left", color=INK)
    axes.tick_params(labelsize=7)
    axes.grid(True, linewidth=0.3, alpha=0.6)


def _plain(text: str) -> str:
    """Text as it is: a dollar sign would start a formula."""
    return text.replace("$", r"\$")

"""Figures of the lens: the K1-K2 plane, the radial profiles, the correlations."""

from __future__ import annotations

import math

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from calib.camera import BROWN_NAMES, BrownCamera, FloatArray
from calib.equifinal import Radial, image_radius_px
from calib.evidence import reference_on_line
from calib.figures.style import (
    BAND,
    FLIGHT,
    FLIGHT_BAND,
    INK,
    PASSED,
    REFERENCE,
    error_ellipse,
    float32,
    padded,
    styled,
)
from calib.propagation import correlations, profile_px, profile_sigma_px, radial_px_covariance
from calib.reference import EquifinalLine, Reference
from calib.solution import Estimate
from calib.wording import power_of_ten


def equifinal_figure(
    estimate: Estimate, reference: Reference | None, line: EquifinalLine | None
) -> go.Figure | None:
    """K1-K2 plane in pixel units: line, band and domain, the reference, this flight with its 95 % ellipse.

    None where nothing but this flight's point is known.
    """
    here = np.array([estimate.brown.k1_px, estimate.brown.k2_px])
    ellipse = error_ellipse(here, radial_px_covariance(estimate.brown, estimate.covariance)[:2, :2])
    there = None
    if reference is not None and reference.brown is not None:
        # At the K3 of this flight: the line between them is one for that K3.
        survey, radius_px = Radial.of(estimate.brown), image_radius_px(estimate.brown)
        there = np.array(reference_on_line(Radial.of(reference.brown), survey, radius_px))
    if line is None and there is None and ellipse is None:
        return None
    anchor = np.abs(here if there is None else there)
    exponents = [math.floor(math.log10(v)) if v > 0 else 0 for v in anchor]
    scale = 10.0 ** np.array(exponents)

    corners = [here]
    if there is not None:
        corners.append(there)
    if line is not None:
        corners += [np.array([line.k1_min, line.k2_min]), np.array([line.k1_max, line.k2_max])]
    if ellipse is not None:
        size, room = np.ptp(ellipse, axis=0), np.ptp(np.array(corners), axis=0)
        # An ellipse far larger than everything else would shrink the line to a dot: let it leave.
        if len(corners) == 1 or (size <= 6 * room).all():
            corners += list(ellipse)
    at = np.array(corners) / scale
    x_range, y_range = (padded(float(lo), float(hi)) for lo, hi in zip(at.min(0), at.max(0), strict=True))

    figure = go.Figure()
    if line is not None:
        _add_line(figure, line, scale, x_range)
    if ellipse is not None:
        figure.add_scatter(
            x=float32(ellipse[:, 0] / scale[0]),
            y=float32(ellipse[:, 1] / scale[1]),
            mode="lines",
            fill="toself",
            fillcolor=FLIGHT_BAND,
            line={"color": FLIGHT, "width": 2},
            name="95 % of this flight",
            hoverinfo="skip",
        )
    if there is not None:
        figure.add_scatter(
            x=[there[0] / scale[0]],
            y=[there[1] / scale[1]],
            mode="markers",
            marker={
                "symbol": "diamond",
                "size": 13,
                "color": REFERENCE,
                "line": {"color": "white", "width": 1},
            },
            name="reference",
        )
    figure.add_scatter(
        x=[here[0] / scale[0]],
        y=[here[1] / scale[1]],
        mode="markers",
        marker={"symbol": "x", "size": 12, "color": FLIGHT, "line": {"color": "white", "width": 1}},
        name="this flight",
    )
    styled(figure, 440)
    figure.update_xaxes(title_text=f"K1 ({power_of_ten(exponents[0])} px⁻²)", range=x_range, nticks=6)
    figure.update_yaxes(title_text=f"K2 ({power_of_ten(exponents[1])} px⁻⁴)", range=y_range)
    return figure


def _add_line(figure: go.Figure, line: EquifinalLine, scale: FloatArray, x_range: list[float]) -> None:
    x = np.linspace(x_range[0], x_range[1], 2)
    y = (line.slope * x * scale[0] + line.intercept) / scale[1]
    if line.band_k2_px is not None:
        half = line.band_k2_px / scale[1]
        figure.add_scatter(
            x=float32(np.concatenate([x, x[::-1]])),
            y=float32(np.concatenate([y - half, y[::-1] + half])),
            mode="lines",
            line={"width": 0},
            fill="toself",
            fillcolor=BAND,
            name="band",
            hoverinfo="skip",
        )
    figure.add_scatter(
        x=float32(x), y=float32(y), mode="lines", line={"color": REFERENCE, "width": 2}, name="equifinal line"
    )
    k1 = np.array([line.k1_min, line.k1_max, line.k1_max, line.k1_min, line.k1_min]) / scale[0]
    k2 = np.array([line.k2_min, line.k2_min, line.k2_max, line.k2_max, line.k2_min]) / scale[1]
    figure.add_scatter(
        x=float32(k1),
        y=float32(k2),
        mode="lines",
        line={"color": INK, "width": 1.5, "dash": "dash"},
        name="domain",
        hoverinfo="skip",
    )


def _linear_free(radius: FloatArray, profile: FloatArray) -> FloatArray:
    """``profile`` without its best-fitting multiple of the radius (what a change of f absorbs)."""
    return profile - radius * (radius @ profile) / (radius @ radius)


def profile_figure(
    estimate: Estimate, reference: Reference | None, tolerance_px: float | None = None
) -> go.Figure:
    """Radial displacement over the image radius: this flight (95 % band), the reference, the difference.

    ``tolerance_px`` draws the limits of the raw difference.
    """
    brown = estimate.brown
    radius = np.linspace(0, brown.diagonal_px / 2, 81)
    here = profile_px(brown, radius)
    band = 1.96 * profile_sigma_px(brown, estimate.covariance, radius)
    held: BrownCamera | None = None if reference is None else reference.brown
    rows = 1 if held is None else 2
    figure = make_subplots(rows=rows, cols=1, shared_xaxes=True, vertical_spacing=0.07)
    _add_band(figure, radius, here, band, row=1)
    figure.add_scatter(
        x=float32(radius),
        y=float32(here),
        mode="lines",
        line={"color": FLIGHT, "width": 2.5},
        name="this flight",
    )
    if held is not None:
        there = profile_px(held, radius)
        figure.add_scatter(
            x=float32(radius),
            y=float32(there),
            mode="lines",
            line={"color": REFERENCE, "width": 2.5, "dash": "dash"},
            name="reference",
        )
        difference = here - there
        if reference is not None and reference.covariance is not None:
            n = len(BROWN_NAMES)
            other = profile_sigma_px(held, reference.covariance[:n, :n], radius)
            band = np.hypot(band, 1.96 * np.nan_to_num(other))
        _add_band(figure, radius, difference, band, row=2)
        figure.add_scatter(
            x=float32(radius),
            y=float32(difference),
            mode="lines",
            line={"color": FLIGHT, "width": 2.5},
            name="difference",
            showlegend=False,
            row=2,
            col=1,
        )
        figure.add_scatter(
            x=float32(radius),
            y=float32(_linear_free(radius, difference)),
            mode="lines",
            line={"color": PASSED, "width": 2, "dash": "dot"},
            name="difference after the best scale",
            row=2,
            col=1,
        )
        if tolerance_px is not None:
            for limit in (-tolerance_px, tolerance_px):
                figure.add_hline(limit, line={"color": INK, "width": 1, "dash": "dash"}, row=2, col=1)
    styled(figure, 380 if held is None else 560)
    figure.update_layout(legend_y=-0.22 if held is None else -0.13)
    figure.update_yaxes(title_text="displacement (px)", row=1, col=1)
    if held is not None:
        figure.update_yaxes(title_text="difference (px)", row=2, col=1)
    figure.update_xaxes(title_text="image radius (px)", nticks=6, row=rows, col=1)
    return figure


def _add_band(figure: go.Figure, x: FloatArray, y: FloatArray, half: FloatArray, row: int) -> None:
    if not np.isfinite(half).all():
        return
    figure.add_scatter(
        x=float32(np.concatenate([x, x[::-1]])),
        y=float32(np.concatenate([y - half, (y + half)[::-1]])),
        mode="lines",
        line={"width": 0},
        fill="toself",
        fillcolor=FLIGHT_BAND,
        name="95 % of this flight",
        hoverinfo="skip",
        showlegend=row == 1,
        row=row,
        col=1,
    )


def correlation_figure(covariance: FloatArray) -> go.Figure | None:
    """Heat map of the correlations of the estimated parameters, with their numbers (None: no covariance)."""
    keys, matrix = correlations(covariance)
    if not keys:
        return None
    names = [key.removesuffix("_px") for key in keys]
    figure = go.Figure()
    figure.add_heatmap(
        z=float32(matrix),
        x=names,
        y=names,
        zmin=-1,
        zmax=1,
        # Red and blue at the ends, white at none; the numbers say it again.
        colorscale=[[0, "#2166ac"], [0.5, "#ffffff"], [1, "#b2182b"]],
        text=[[_short(v) for v in row] for row in matrix],
        texttemplate="%{text}",
        textfont={"size": 12 if len(names) < 10 else 10},
        showscale=False,
        xgap=1,
        ygap=1,
    )
    styled(figure, 460, meta={"ratio": 0.9, "extra": 60})
    figure.update_yaxes(autorange="reversed", showgrid=False)
    figure.update_xaxes(side="top", showgrid=False)
    return figure


def _short(value: float) -> str:
    """A correlation in the room of a phone's cell: .96, −.2, 1."""
    return (
        f"{value:.2f}".replace("-0.00", "0")
        .replace("0.00", "0")
        .replace("0.", ".")
        .replace("1.00", "1")
        .replace("-", "−")
    )

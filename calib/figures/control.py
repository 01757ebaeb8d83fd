"""Figures of a calibration on control points: marks over the sensor, profiles as far as there are marks."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from calib.control import ControlCalibration
from calib.figures.sensor import scale_sensor, sensor_with_counts
from calib.figures.style import FLIGHT, FLIGHT_BAND, REFERENCE, float32, styled
from calib.propagation import profile_px, profile_sigma_px


def marks_figure(calibration: ControlCalibration) -> go.Figure:
    """All marks on the sensor with counts by column above and by row at the side ([SEN] fig. 4)."""
    camera, marks = calibration.camera, calibration.marks
    figure = sensor_with_counts()
    u, v = marks.pixels[calibration.used].T
    columns, rows = np.linspace(0, camera.width, 17), np.linspace(0, camera.height, 13)
    above, beside = np.histogram(u, columns)[0], np.histogram(v, rows)[0]
    figure.add_bar(
        x=float32((columns[1:] + columns[:-1]) / 2), y=float32(above), marker_color=REFERENCE, row=1, col=1
    )
    control = marks.control[marks.point[calibration.used]]
    for name, mine, colour, symbol in (
        ("control", control, FLIGHT, "circle"),
        ("check", ~control, REFERENCE, "diamond-open"),
    ):
        figure.add_scatter(
            x=float32(u[mine]),
            y=float32(v[mine]),
            mode="markers",
            marker={"size": 6, "color": colour, "symbol": symbol},
            name=name,
            row=2,
            col=1,
        )
    figure.add_bar(
        x=float32(beside),
        y=float32((rows[1:] + rows[:-1]) / 2),
        orientation="h",
        marker_color=REFERENCE,
        row=2,
        col=2,
    )
    for trace in figure.data:
        trace.showlegend = trace.type == "scatter"
    styled(figure, 500, bargap=0.08, meta={"ratio": 0.72, "extra": 170})
    scale_sensor(figure, camera.width, camera.height)
    return figure


def control_profiles_figure(calibration: ControlCalibration) -> go.Figure:
    """Radial profile with its 95 % band, and decentring profile, as far out as there are marks."""
    camera, covariance = calibration.camera, calibration.covariance
    middle = np.array([camera.cx_px, camera.cy_px])
    reach = float(np.linalg.norm(calibration.marks.pixels[calibration.used] - middle, axis=1).max())
    radius = np.linspace(0, reach, 81)
    here, band = profile_px(camera, radius), 1.96 * profile_sigma_px(camera, covariance, radius)
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.08)
    figure.add_scatter(
        x=float32(np.concatenate([radius, radius[::-1]])),
        y=float32(np.concatenate([here + band, (here - band)[::-1]])),
        mode="lines",
        line={"width": 0},
        fill="toself",
        fillcolor=FLIGHT_BAND,
        hoverinfo="skip",
        name="95 %",
        row=1,
        col=1,
    )
    figure.add_scatter(
        x=float32(radius),
        y=float32(here),
        mode="lines",
        line={"color": FLIGHT, "width": 2.5},
        name="radial",
        row=1,
        col=1,
    )
    size = np.hypot(camera.p1, camera.p2) / camera.f_px
    figure.add_scatter(
        x=float32(radius),
        y=float32(size * radius**2),
        mode="lines",
        line={"color": REFERENCE, "width": 2.5, "dash": "dash"},
        name="decentring",
        row=2,
        col=1,
    )
    styled(figure, 500)
    figure.update_layout(legend_y=-0.15)
    figure.update_yaxes(title_text="radial (px)", row=1, col=1)
    figure.update_yaxes(title_text="decentring (px)", row=2, col=1)
    figure.update_xaxes(title_text="image radius (px)", nticks=6, row=2, col=1)
    return figure

"""Flights of recommended passes, for the tests and benchmarks of the refly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from calib.frames import LocalFrame
from sim.flights import Flight, rotation_looking
from sim.options import SurveyOptions


def flight_of(stations: Sequence[dict[str, Any]], options: SurveyOptions) -> Flight:
    """Stations of a fieldcal.refly/1 as a flight over the simulator's ground, launched at its zero height."""
    frame = LocalFrame(options.latitude_deg, options.longitude_deg)
    latitude, longitude, height, yaw, pitch = (
        np.array([float(s[key]) for s in stations])
        for key in ("lat", "lon", "height_m", "yaw_deg", "pitch_deg")
    )
    centres = frame.enu(latitude, longitude, height)
    turn = np.radians(yaw)
    track = np.stack([np.sin(turn), np.cos(turn), np.zeros_like(turn)], axis=-1)
    return Flight(rotation_looking(yaw, 90.0 + pitch), centres, track)

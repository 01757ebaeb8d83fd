"""What receivers get wrong: errors of stated size and of stated behaviour in time."""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from calib.camera import FloatArray


class GpsKind(StrEnum):
    """How position errors behave from photo to photo.

    ``white``: independent. ``drift``: first-order Gauss-Markov, always of the stated standard
    deviation, forgotten with a time constant. ``walk``: random walk that starts without error and
    grows by the stated size in a minute, by twice that in four. ``offset``: the same error in all
    photos, exactly of the stated size, in a random direction. ``rtk``: independent, centimetres.
    """

    WHITE = "white"
    DRIFT = "drift"
    WALK = "walk"
    OFFSET = "offset"
    RTK = "rtk"


def position_errors(
    kind: GpsKind,
    normals: FloatArray,
    seconds: FloatArray,
    sigma_m: tuple[float, float],
    time_constant_s: float = 300.0,
) -> FloatArray:
    """Errors of k positions, east, north, up (k, 3) in m.

    Args:
        normals: independent standard normal numbers (k, 3).
        seconds: when the photos were taken (k,), rising.
        sigma_m: per horizontal axis (for ``offset``: the horizontal length), and vertical.
        time_constant_s: of ``drift``.
    """
    horizontal, vertical = sigma_m
    size: FloatArray = np.array([horizontal, horizontal, vertical])
    if kind is GpsKind.OFFSET:
        east, north, up = normals[0]
        length = float(np.hypot(east, north))
        error: FloatArray = size * [east / length, north / length, np.copysign(1.0, up)]
        return np.tile(error, (len(normals), 1))
    errors: FloatArray = normals.astype(float)
    if kind in (GpsKind.WHITE, GpsKind.RTK):
        return errors * size
    elapsed = np.diff(seconds)
    if kind is GpsKind.WALK:
        steps = np.sqrt(elapsed / 60.0)[:, None] * normals[1:]
        errors = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        return errors * size
    kept = np.exp(-elapsed / time_constant_s)
    for i, share in enumerate(kept, start=1):
        errors[i] = share * errors[i - 1] + np.sqrt(1 - share * share) * normals[i]
    return errors * size

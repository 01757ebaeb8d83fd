"""What the vehicle writes into the photos: true poses with a receiver's and a gimbal's errors."""

from __future__ import annotations

from datetime import timedelta

import numpy as np

from calib.camera import FloatArray
from calib.frames import LocalFrame
from calib.photos.photo import CameraIdentity, GimbalAngles, Processing
from sim.flights import Flight
from sim.gps import GpsKind, position_errors
from sim.options import SurveyOptions
from sim.photo_writer import PhotoTags, level_gimbal

#: RTK heights are this much worse than its horizontal positions.
RTK_VERTICAL = 1.5
_DEWARP_FLAG = {Processing.RAW: False, Processing.LENS_CORRECTED: True, Processing.UNKNOWN: None}


def seconds_of(flight: Flight, speed_m_s: float, interval_s: float) -> FloatArray:
    """When each photo is taken (k,), s after the start: by the way flown, at least an interval apart."""
    way_m = np.linalg.norm(np.diff(flight.centres_m, axis=0, prepend=flight.centres_m[:1]), axis=1)
    seconds: FloatArray = np.cumsum(np.maximum(way_m / max(speed_m_s, 1.0), interval_s))
    return seconds


def tags_of(
    flight: Flight,
    seconds: FloatArray,
    launch_m: float,
    identity: CameraIdentity,
    focal: tuple[float, int],
    dji_xmp: bool,
    seed: int,
    options: SurveyOptions,
) -> list[PhotoTags]:
    """The tags of k photos.

    ``launch_m``: height of the launch point, where heights above launch count from. ``focal``: nominal
    focal length in mm and as 35 mm equivalent.
    """
    rng = np.random.default_rng([seed, 7])
    k = len(flight)
    rtk = options.gps is GpsKind.RTK
    sigma = (options.gps_sigma_m, options.height_sigma_m)
    if rtk:
        sigma = (options.rtk_sigma_m, RTK_VERTICAL * options.rtk_sigma_m)
    normals = rng.normal(size=(k, 3))
    error = position_errors(options.gps, normals, seconds, sigma, options.drift_time_s)
    turned = options.gimbal_sigma_deg * rng.normal(size=(k, 2))
    # The height above launch is a barometer's, which knows nothing of the receiver's errors; without
    # RTK DJI's altitudes are made from it, and share its errors.
    height_error = error[:, 2]
    if rtk or options.gps is GpsKind.OFFSET:
        height_error = options.height_sigma_m * rng.normal(size=k)
    frame = LocalFrame(options.latitude_deg, options.longitude_deg, options.ground_altitude_m)
    geodetic = frame.geodetic(flight.centres_m + error)
    gimbals = [level_gimbal(rotation) for rotation in flight.rotations_cam_from_world]
    return [
        PhotoTags(
            time=options.start + timedelta(seconds=round(float(s), 3)),
            latitude_deg=float(latitude),
            longitude_deg=float(longitude),
            altitude_m=float(altitude),
            height_above_launch_m=float(height - launch_m),
            gimbal=GimbalAngles(gimbal.yaw_deg + turn[0], max(gimbal.pitch_deg + turn[1], -90.0), 0.0),
            flight=GimbalAngles(gimbal.yaw_deg + turn[0], -6.0, 0.5),
            make=identity.make,
            model=identity.model,
            serial=identity.serial,
            lens_corrected=_DEWARP_FLAG[identity.processing],
            dji_xmp=dji_xmp,
            rtk_sigma_m=(sigma[0], sigma[0], sigma[1]) if rtk else None,
            focal_mm=focal[0],
            focal_35mm=focal[1],
        )
        for s, (latitude, longitude, altitude), height, gimbal, turn in zip(
            seconds, geodetic, flight.centres_m[:, 2] + height_error, gimbals, turned, strict=True
        )
    ]

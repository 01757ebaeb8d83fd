"""Frames: WGS84, UTM, a local east-north-up frame, and camera rotations from gimbal angles.

* World: x east, y north, z up, metres, origin on the WGS84 ellipsoid at a chosen point.
* Camera: x right, y down, z forward (the frame of :mod:`calib.camera`).
* Gimbal: DJI's angles, a north-east-down frame turned by yaw, pitch, roll in that order (ZYX),
  the optical axis being the body's forward axis. At pitch -90 roll turns the image about the
  optical axis, so the 180 degrees that some gimbals write at nadir are an image upside down.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from calib.photos.photo import GimbalAngles, Position

FloatArray = NDArray[np.float64]

#: Rows are north, east, down of the world frame: ned = _NED_FROM_WORLD @ world.
_NED_FROM_WORLD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
#: camera x right = body y, y down = body z, z forward = body x.
_CAM_FROM_BODY = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
#: A camera mounted to look down, image top forward: camera x = body y, y = -body x, z = body z.
_CAM_FROM_DOWNWARD_BODY = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def _ned_from_body(yaw_deg: float, pitch_deg: float, roll_deg: float) -> FloatArray:
    yaw, pitch, roll = np.radians([yaw_deg, pitch_deg, roll_deg])
    (cy, cp, cr), (sy, sp, sr) = np.cos([yaw, pitch, roll]), np.sin([yaw, pitch, roll])
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rotation_cam_from_world(gimbal: GimbalAngles) -> FloatArray:
    """Rotation (3, 3) that takes world directions into the camera frame."""
    ned_from_body = _ned_from_body(gimbal.yaw_deg, gimbal.pitch_deg, gimbal.roll_deg)
    cam_from_world: FloatArray = _CAM_FROM_BODY @ ned_from_body.T @ _NED_FROM_WORLD
    return cam_from_world


def gimbal_from_rotation(cam_from_world: FloatArray) -> GimbalAngles:
    """Inverse of :func:`rotation_cam_from_world`.

    Pitch comes out in [-90, 90]. Straight up or down yaw and roll turn about the same axis; then
    all of it is yaw and roll is 0.
    """
    body = (_CAM_FROM_BODY.T @ np.asarray(cam_from_world, dtype=float) @ _NED_FROM_WORLD.T).T
    level = float(np.hypot(body[0, 0], body[1, 0]))
    pitch = float(np.degrees(np.arctan2(-body[2, 0], level)))
    if level < 1e-9:
        return GimbalAngles(float(np.degrees(np.arctan2(-body[0, 1], body[1, 1]))), pitch, 0.0)
    yaw = float(np.degrees(np.arctan2(body[1, 0], body[0, 0])))
    return GimbalAngles(yaw, pitch, float(np.degrees(np.arctan2(body[2, 1], body[2, 2]))))


def gimbal_from_downward_body(yaw_deg: float, pitch_deg: float, roll_deg: float) -> GimbalAngles:
    """Pix4D's convention (XMP ``Camera:Yaw/Pitch/Roll``) -> gimbal angles.

    There the angles are those of the body that carries a downward camera, image top forward:
    pitch 0 looks straight down, 90 forward (Pix4D, Yaw, Pitch, Roll and Omega, Phi, Kappa angles).
    """
    ned_from_body = _ned_from_body(yaw_deg, pitch_deg, roll_deg)
    return gimbal_from_rotation(_CAM_FROM_DOWNWARD_BODY @ ned_from_body.T @ _NED_FROM_WORLD)


def tilt_deg(gimbal: GimbalAngles) -> float:
    """Angle of the optical axis off nadir: 0 looks straight down, 90 at the horizon."""
    return rotation_tilt_deg(rotation_cam_from_world(gimbal))


def rotation_tilt_deg(cam_from_world: FloatArray) -> float:
    """Angle off nadir of a camera's optical axis, from its rotation (3, 3)."""
    east, north, up = cam_from_world[2]
    return float(np.degrees(np.arctan2(np.hypot(east, north), -up)))


@dataclass(frozen=True)
class LocalFrame:
    """East-north-up frame with its origin at a WGS84 point (degrees; metres above the ellipsoid).

    Whatever datum the altitudes have is kept as if it were the ellipsoid: over a survey's few
    hundred metres that is a constant shift in z.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float = 0.0

    def enu(self, latitude_deg: FloatArray, longitude_deg: FloatArray, altitude_m: FloatArray) -> FloatArray:
        """WGS84 (n,), (n,), (n,) -> east, north, up (n, 3) in m; NaN stays NaN."""
        east, north, up = self._transformer.transform(longitude_deg, latitude_deg, altitude_m)
        enu = np.stack(np.broadcast_arrays(east, north, up), axis=-1).astype(float)
        enu[~np.isfinite(enu).all(axis=-1)] = np.nan
        return enu

    def geodetic(self, enu_m: FloatArray) -> FloatArray:
        """East, north, up (n, 3) in m -> latitude, longitude (degrees), altitude (m), (n, 3)."""
        longitude, latitude, altitude = self._transformer.transform(
            enu_m[..., 0], enu_m[..., 1], enu_m[..., 2], direction="INVERSE"
        )
        return np.stack([latitude, longitude, altitude], axis=-1)

    @property
    def _transformer(self) -> Transformer:
        # Plain floats: a numpy scalar's repr is no number to PROJ, which then takes zero, silently.
        return _topocentric(float(self.latitude_deg), float(self.longitude_deg), float(self.altitude_m))


@functools.lru_cache(maxsize=32)
def _topocentric(latitude_deg: float, longitude_deg: float, altitude_m: float) -> Transformer:
    return Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84"
        f" +step +proj=topocentric +ellps=WGS84 +lat_0={latitude_deg!r} +lon_0={longitude_deg!r}"
        f" +h_0={altitude_m!r}"
    )


def utm_crs(latitude_deg: float, longitude_deg: float) -> str:
    """Name of the UTM zone of a point ("EPSG:32615"); the polar zones beyond 84 N and 80 S.

    Plain six degree zones: Norway's and Svalbard's wider ones are conventions of map sheets.
    """
    if latitude_deg > 84:
        return "EPSG:32661"
    if latitude_deg < -80:
        return "EPSG:32761"
    zone = int((longitude_deg + 180) % 360 // 6) + 1
    return f"EPSG:{(32600 if latitude_deg >= 0 else 32700) + zone}"


def project(crs: str, latitude_deg: FloatArray, longitude_deg: FloatArray) -> FloatArray:
    """WGS84 (n,), (n,) -> easting, northing (n, 2) in m in a projected frame, see :func:`utm_crs`."""
    transformer = _projection(crs)
    return np.stack(transformer.transform(longitude_deg, latitude_deg), axis=-1)


@functools.lru_cache(maxsize=32)
def _projection(crs: str) -> Transformer:
    return Transformer.from_crs("EPSG:4326", crs, always_xy=True)


def heights_m(positions: Sequence[Position | None]) -> FloatArray:
    """One height per position (n,), all above the same datum; NaN where there is none.

    Where every position has a height above launch, that is used, shifted by the median difference
    to the absolute altitude: within a flight the barometer behind it drifts by decimetres, while
    absolute altitudes wander by metres, unless the receiver says it knows better (RTK).
    """
    known = [p for p in positions if p is not None]
    absolute = np.array([np.nan if p is None or p.altitude_m is None else p.altitude_m for p in positions])
    precise = any(p.sigma_vertical_m is not None and p.sigma_vertical_m < 0.5 for p in known)
    if precise or not known or any(p.height_above_launch_m is None for p in known):
        return absolute
    relative = np.array([np.nan if p is None else p.height_above_launch_m for p in positions], dtype=float)
    if np.isnan(absolute).all():
        return relative
    return relative + float(np.nanmedian(absolute - relative))


def local_positions(positions: Sequence[Position | None]) -> tuple[LocalFrame, FloatArray] | None:
    """A local frame at the middle of the positions, and they in it (n, 3); NaN where unknown.

    None where no position is known. Positions without a height get the median of the others'
    (0 where no height is known at all).
    """
    known = [p for p in positions if p is not None]
    if not known:
        return None
    latitude = np.array([np.nan if p is None else p.latitude_deg for p in positions])
    longitude = np.array([np.nan if p is None else p.longitude_deg for p in positions])
    # Across the date line the mean of +179 and -179 is not 0.
    reference = known[0].longitude_deg
    middle = reference + float(np.nanmedian((longitude - reference + 180) % 360 - 180))
    frame = LocalFrame(float(np.nanmedian(latitude)), (middle + 180) % 360 - 180)
    height = heights_m(positions)
    missing = np.isnan(height)
    height[missing] = 0.0 if missing.all() else float(np.median(height[~missing]))
    return frame, frame.enu(latitude, longitude, np.where(np.isnan(latitude), np.nan, height))

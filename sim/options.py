"""How a rendered survey is flown, photographed and tagged."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from calib.camera import BrownCamera
from sim.gps import GpsKind
from sim.sensor import RenderOptions


@dataclass(frozen=True)
class SurveyOptions:
    """What disturbs a rendered survey, and what its files say. None means: as the recipe has it.

    ``camera_model``: a name of :data:`sim.cameras.CAMERAS`. ``camera``: true lens (default: that of the
    camera model, brought to the size). ``pattern_px``: largest length of a non-Brown pattern at 4000 px
    image width; ``aspect``: b1 / f; ``haze_px``: rms, at that width, of a smooth shift of the image that is
    another in every photo, as hot air makes it. ``site_m`` scales the flight, 120 m being as flown;
    ``photos`` reduces those recipes that allow it. ``relief_m``: height
    of rolling ground; ``dem``, ``ortho``: GeoTIFFs to fly over instead of invented ground.

    What is written: ``gps`` says how position errors behave (:class:`sim.gps.GpsKind`), ``gps_sigma_m`` is
    their size horizontally and ``height_sigma_m`` vertically, ``drift_time_s`` the time constant of
    drifting ones; ``rtk_sigma_m`` takes their place for RTK. ``gimbal_sigma_deg``: of pitch and yaw.
    ``dji_tags``: DJI's EXIF and XMP, or plain EXIF as of a camera triggered over MAVLink.
    ``take_off_photo``: one on the ground before the flight, from where heights above launch count.
    ``apart``: nadir and convergent photos go to folders of their own. ``lens_corrected``: what the files
    say about it (see :func:`sim.survey.lens_corrected` for such a lens).
    """

    camera_model: str | None = None
    camera: BrownCamera | None = None
    pattern_px: float = 0.0
    aspect: float = 0.0
    haze_px: float = 0.0
    site_m: float = 120.0
    photos: int | None = None
    relief_m: float = 2.0
    dem: Path | None = None
    ortho: Path | None = None
    gps: GpsKind = GpsKind.WHITE
    gps_sigma_m: float = 2.5
    height_sigma_m: float = 0.5
    drift_time_s: float = 300.0
    rtk_sigma_m: float = 0.015
    gimbal_sigma_deg: float = 1.0
    position_jitter_m: float = 1.0
    height_jitter_m: float = 0.5
    attitude_jitter_deg: float = 1.0
    speed_m_s: float | None = None
    render: RenderOptions | None = None
    take_off_photo: bool = False
    apart: bool = False
    texel_m: float | None = None
    dji_tags: bool | None = None
    lens_corrected: bool | None = None
    model: str | None = None
    serial: str | None = "FIELDCALSIM0001"
    start: datetime = datetime(2026, 5, 12, 10, 30, 0, 250_000)  # local, as cameras write it
    latitude_deg: float = 50.8310
    longitude_deg: float = -0.1420
    ground_altitude_m: float = 75.0

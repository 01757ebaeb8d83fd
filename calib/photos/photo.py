"""What one photo's file says about itself."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from pathlib import Path


class Processing(StrEnum):
    """What the camera did to the pixels before it wrote the file."""

    RAW = "raw"
    LENS_CORRECTED = "lens-corrected"
    UNKNOWN = "unknown"


class AltitudeDatum(StrEnum):
    """What an absolute altitude counts from; makers differ, and many do not say."""

    ELLIPSOID = "WGS84 ellipsoid"
    SEA_LEVEL = "mean sea level"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class CameraIdentity:
    """Which camera took a photo; two photos may be adjusted together only if these agree."""

    make: str
    model: str
    serial: str | None
    width: int
    height: int
    processing: Processing = Processing.UNKNOWN
    #: Nominal focal length from EXIF, lens data or the maker's notes (None: unknown).
    focal_mm: float | None = None
    #: Which of a body's several cameras ("NIR", "ZoomCamera"); "" where there is one.
    band: str = ""

    @property
    def name(self) -> str:
        """Make and model in one, as the file has them; makers often repeat their name in the model."""
        make, model = self.make.strip(), self.model.strip()
        return model if model.lower().startswith(make.lower()) else f"{make} {model}".strip()


@dataclass(frozen=True)
class Position:
    """Where the file says the camera was, WGS84.

    ``altitude_m`` is the absolute altitude as written, above ``altitude_datum``;
    ``height_above_launch_m`` the relative one (None: not given). The sigmas are standard deviations
    as the receiver states them (RTK, GPSXYAccuracy, GPSHPositioningError), None where it does not.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None
    height_above_launch_m: float | None = None
    sigma_horizontal_m: float | None = None
    sigma_vertical_m: float | None = None
    altitude_datum: AltitudeDatum = AltitudeDatum.UNKNOWN


@dataclass(frozen=True)
class GimbalAngles:
    """Gimbal attitude in the world as DJI writes it (north-east-down, rotated in the order yaw,
    pitch, roll): yaw clockwise from true north, pitch -90 looks straight down and 0 at the
    horizon, roll about the optical axis; degrees."""

    yaw_deg: float
    pitch_deg: float
    roll_deg: float


@dataclass(frozen=True)
class Radiometric:
    """Raw counts in a photo of a thermal camera.

    ``kind``: in words ("FLIR radiometric JPEG"). ``hidden``: they stand beside the visible picture.
    ``levels``: counts to be shown black and white, the same in a whole set (None: not yet known).
    ``unread``: why the visible picture is used instead ("": it is not).
    """

    kind: str
    hidden: bool = True
    levels: tuple[float, float] | None = None
    unread: str = ""


@dataclass(frozen=True)
class Photo:
    """One photo and its metadata; the file itself is only ever read."""

    path: Path
    camera: CameraIdentity
    position: Position | None = None
    gimbal: GimbalAngles | None = None
    #: Exposure time on the camera's own clock, without zone (two photos of one camera compare);
    #: sub-seconds as far as the file has them (``time_resolution_s``).
    time: datetime | None = None
    time_resolution_s: float = 1.0
    #: Nominal focal length in px of this image (from 35 mm equivalent, sensor size or maker data).
    focal_px: float | None = None
    #: Factory calibration as the maker wrote it (DJI DewarpData, CalibratedFocalLength, ...).
    factory: dict[str, float] = field(default_factory=dict)
    #: EXIF orientation tag (1: rows are rows). Pixels are used as stored; this is for display only.
    orientation: int = 1
    #: Attitude of the aircraft (heading, pitch up, roll right), where the file has it; not the camera's.
    aircraft: GimbalAngles | None = None
    #: Same for two files with the same image data, whatever their names and metadata ("": not known).
    fingerprint: str = ""
    #: Raw counts of a thermal camera (None: an ordinary picture).
    radiometric: Radiometric | None = None
    #: Known to belong to one survey with the others that are so marked, whatever the pause between them.
    joined: bool = False
    #: Known to be taken by a vehicle that stood.
    standing: bool = False


@dataclass(frozen=True)
class LeftOut:
    """A file that was not used, and why, in words for the user."""

    path: Path
    reason: str

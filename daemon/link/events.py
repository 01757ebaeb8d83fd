"""What a vehicle says, as typed events. Units and clocks are in the names.

``vehicle_boot_s``: seconds since the autopilot started; ``utc_s``: seconds since 1970 in UTC as the
vehicle believes it; angles in degrees, yaw clockwise from true north in [0, 360), pitch positive
upwards. None: the vehicle did not say (MAVLink's marks for "unknown" never get through).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Autopilot(StrEnum):
    ARDUPILOT = "ardupilot"
    PX4 = "px4"
    OTHER = "other"


@dataclass(frozen=True)
class Angles:
    """Roll, pitch, yaw of a body turned in the order yaw, pitch, roll."""

    roll_deg: float
    pitch_deg: float
    yaw_deg: float


class AngleFrame(StrEnum):
    """What a gimbal's angles are measured from."""

    EARTH = "earth"  # pitch and roll from the horizon, yaw from north
    LEVEL = "level"  # pitch and roll from the horizon, yaw from the vehicle's nose
    BODY = "body"  # all from the vehicle's body
    UNSURE = "unsure"  # the message claims EARTH or LEVEL, but some mounts of this autopilot send BODY


@dataclass(frozen=True)
class Heartbeat:
    """``mode``: the flavour's own name in lower case, or its number. ``holding``: standing in the air
    by its mode (not by speed). ``in_mission``: the mode that flies the uploaded mission."""

    autopilot: Autopilot
    armed: bool
    mode: str
    in_mission: bool
    holding: bool


@dataclass(frozen=True)
class Position:
    """The vehicle's own estimate. ``height_m`` above home, ``velocity_enu_m_s`` east, north, up."""

    vehicle_boot_s: float
    latitude_deg: float
    longitude_deg: float
    altitude_msl_m: float
    height_m: float
    velocity_enu_m_s: tuple[float, float, float]
    yaw_deg: float | None


@dataclass(frozen=True)
class GnssFix:
    """``fix``: MAVLink's GPS_FIX_TYPE (3 and more is a place). Accuracies are the receiver's claim, ``hdop``
    and ``vdop`` its dilutions of precision."""

    fix: int
    satellites: int | None
    horizontal_accuracy_m: float | None
    vertical_accuracy_m: float | None
    hdop: float | None = None
    vdop: float | None = None


@dataclass(frozen=True)
class Attitude:
    """Of the vehicle."""

    vehicle_boot_s: float
    angles: Angles


@dataclass(frozen=True)
class GimbalAttitude:
    """Where the camera points; see :func:`daemon.link.attitude.earth_angles`."""

    vehicle_boot_s: float | None
    angles: Angles
    frame: AngleFrame


@dataclass(frozen=True)
class CameraPose:
    """Where a camera itself says that it is, and how it looks: from the horizon and from north."""

    vehicle_boot_s: float
    latitude_deg: float
    longitude_deg: float
    altitude_msl_m: float
    angles: Angles


class PhotoSource(StrEnum):
    FEEDBACK = "feedback"  # CAMERA_FEEDBACK, ArduPilot
    TRIGGER = "trigger"  # CAMERA_TRIGGER, PX4
    CAPTURED = "captured"  # CAMERA_IMAGE_CAPTURED of the autopilot, PX4
    CAMERA = "camera"  # CAMERA_IMAGE_CAPTURED of a camera component


@dataclass(frozen=True, kw_only=True)
class PhotoFacts:
    """What may be known of a photo, besides its time.

    ``vehicle``: the aircraft's angles, never the gimbal's; ``camera``: the camera's. ``height_m`` above
    home. ``confirmed``: the camera itself says that the photo was taken (True) or failed (False).
    ``url``: where the file can be fetched.
    """

    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_msl_m: float | None = None
    height_m: float | None = None
    vehicle_angles: Angles | None = None
    camera_angles: Angles | None = None
    completed: int | None = None
    confirmed: bool | None = None
    url: str = ""


@dataclass(frozen=True)
class PhotoReport(PhotoFacts):
    """One message about one photo. One photo may be reported several times and by several sources:
    :class:`daemon.link.triggers.TriggerFilter` counts photos. ``index``: the source's own number.
    """

    source: PhotoSource
    component_id: int
    camera: int
    index: int
    vehicle_boot_s: float | None
    utc_s: float | None


class MissionState(StrEnum):
    UNKNOWN = "unknown"
    NONE = "no mission"
    NOT_STARTED = "not started"
    ACTIVE = "active"
    PAUSED = "paused"
    COMPLETE = "complete"


@dataclass(frozen=True)
class MissionCurrent:
    """``item``: being flown. ``total``: highest item number or count as the flavour has it, None
    without a mission. ``mission_id`` changes when anybody uploads another mission (0: not told)."""

    item: int
    total: int | None
    state: MissionState
    mission_id: int


@dataclass(frozen=True)
class ItemReached:
    """Repeats and skips on both autopilots: see :mod:`daemon.link.progress`."""

    item: int


@dataclass(frozen=True)
class Battery:
    battery: int
    voltage_v: float | None
    current_a: float | None
    remaining_share: float | None
    used_ah: float | None


@dataclass(frozen=True)
class Health:
    """``prearm_ok`` may be true before the position estimate is: see :class:`EstimatorHealth`."""

    prearm_ok: bool
    load_share: float
    link_drop_share: float


@dataclass(frozen=True)
class EstimatorHealth:
    """Whether the estimate of a place on earth is in use."""

    absolute_position: bool


@dataclass(frozen=True)
class HomePosition:
    latitude_deg: float
    longitude_deg: float
    altitude_msl_m: float


@dataclass(frozen=True)
class StatusText:
    """``severity``: 0 emergency to 7 debug. ``group``, ``part``: pieces of one long text share a
    group other than 0 and are numbered from 0."""

    severity: int
    text: str
    group: int
    part: int


@dataclass(frozen=True)
class CommandAck:
    """``result``: MAV_RESULT. Accepted does not mean done: a photo command is accepted without a camera."""

    command: int
    result: int
    progress_percent: int | None


@dataclass(frozen=True)
class TimeSync:
    """Answer to our question: ``asked_s`` is our own clock as we sent it, in seconds."""

    vehicle_boot_s: float
    asked_s: float


@dataclass(frozen=True)
class SystemTime:
    """``utc_s`` None until the vehicle knows the date."""

    vehicle_boot_s: float
    utc_s: float | None


@dataclass(frozen=True)
class LandedState:
    """None: not known."""

    on_ground: bool | None


@dataclass(frozen=True)
class Radio:
    """Signal as the radio counts it (0-254), errors since its start."""

    rssi: int
    remote_rssi: int
    receive_errors: int


@dataclass(frozen=True)
class Parameter:
    """One of the autopilot's settings, asked for by name."""

    name: str
    value: float


@dataclass(frozen=True)
class Firmware:
    version: str


@dataclass(frozen=True)
class VehicleRestarted:
    """The vehicle's boot time began anew: photo numbers and boot times from here on are others.

    ``boots`` counts from 1. Made by :mod:`daemon.link.state`, not by a message.
    """

    boots: int


Event = (
    Heartbeat
    | Position
    | GnssFix
    | Attitude
    | GimbalAttitude
    | CameraPose
    | PhotoReport
    | MissionCurrent
    | ItemReached
    | Battery
    | Health
    | EstimatorHealth
    | HomePosition
    | StatusText
    | CommandAck
    | TimeSync
    | SystemTime
    | LandedState
    | Radio
    | Parameter
    | Firmware
    | VehicleRestarted
)

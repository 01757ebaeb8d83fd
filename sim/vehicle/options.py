"""What kind of vehicle is simulated."""

from __future__ import annotations

from dataclasses import dataclass, field

from calib.frames import LocalFrame
from mission.encode import Flavour
from sim.vehicle.air import Wind
from sim.vehicle.receiver import Gnss

#: Where it stands if nobody says otherwise.
HOME = LocalFrame(47.0, 8.5, 430.0)


@dataclass(frozen=True)
class VehicleOptions:
    """``home``: where it stands at first. ``boot_utc_s``: the date when it was switched on.
    ``feedback_pin``: ArduPilot tells photos in boot time and counts captures. ``camera_component``:
    a separate camera confirms every photo with CAMERA_IMAGE_CAPTURED (ArduPilot; from
    component 100, on its own clock, ``camera_lag_s`` late). ``camera_interval_s``: commands sooner
    after a photo are accepted and lost, photos by distance wait. ``parameters``: other values than
    :mod:`sim.vehicle.parameters` has. ``wind`` and ``gnss``: calm and without error unless told otherwise.
    """

    flavour: Flavour = "ardupilot"
    home: LocalFrame = HOME
    boot_utc_s: float = 1_780_000_000.0
    acceleration_m_s2: float = 2.5
    cruise_m_s: float = 8.0
    climb_m_s: float = 3.0
    descent_m_s: float = 2.0
    yaw_rate_deg_s: float = 60.0
    gimbal_rate_deg_s: float = 60.0
    gimbal_lowest_deg: float = -90.0
    gimbal_highest_deg: float = 20.0
    endurance_s: float = 1500.0
    camera_interval_s: float = 0.1
    camera_component: bool = False
    camera_lag_s: float = 0.3
    feedback_pin: bool = False
    system_id: int = 1
    parameters: tuple[tuple[str, float], ...] = ()
    wind: Wind = field(default_factory=Wind)
    gnss: Gnss = field(default_factory=Gnss)

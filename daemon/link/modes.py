"""Flight modes behind the bare number of a heartbeat."""

from __future__ import annotations

from daemon.link.events import Autopilot, Heartbeat

_COPTER = {
    **{0: "stabilize", 1: "acro", 2: "althold", 3: "auto", 4: "guided", 5: "loiter", 6: "rtl"},
    **{7: "circle", 9: "land", 11: "drift", 13: "sport", 14: "flip", 15: "autotune", 16: "poshold"},
    **{17: "brake", 18: "throw", 19: "avoid_adsb", 20: "guided_nogps", 21: "smart_rtl", 22: "flowhold"},
    **{23: "follow", 24: "zigzag", 25: "systemid", 26: "autorotate", 27: "auto_rtl", 28: "turtle"},
}
_PX4_MAIN = {
    **{1: "manual", 2: "altitude", 3: "position", 4: "auto", 5: "acro", 6: "offboard", 7: "stabilized"},
    **{8: "rattitude", 10: "termination"},
}
_PX4_AUTO = {
    **{1: "ready", 2: "takeoff", 3: "hold", 4: "mission", 5: "rtl", 6: "land", 8: "follow"},
    **{9: "precland", 10: "vtol_takeoff"},
}
_HOLDING = {
    Autopilot.ARDUPILOT: {"loiter", "poshold", "brake", "guided"},
    Autopilot.PX4: {"hold", "position"},
}
_MISSION = {Autopilot.ARDUPILOT: "auto", Autopilot.PX4: "mission"}
_AUTOPILOTS = {3: Autopilot.ARDUPILOT, 12: Autopilot.PX4}


def heartbeat(autopilot_number: int, base_mode: int, custom_mode: int) -> Heartbeat:
    """From the fields of HEARTBEAT (multirotors' mode numbers)."""
    autopilot = _AUTOPILOTS.get(autopilot_number, Autopilot.OTHER)
    mode = str(custom_mode)
    if base_mode & 1:  # else custom_mode means nothing
        if autopilot is Autopilot.ARDUPILOT:
            mode = _COPTER.get(custom_mode, mode)
        elif autopilot is Autopilot.PX4:
            main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
            mode = _PX4_AUTO.get(sub, mode) if main == 4 else _PX4_MAIN.get(main, mode)
    return Heartbeat(
        autopilot,
        bool(base_mode & 128),
        mode,
        _MISSION.get(autopilot) == mode,
        mode in _HOLDING.get(autopilot, set()),
    )

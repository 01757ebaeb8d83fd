"""MAVLink numbers that missions need, as plain integers (common.xml of the MAVLink project).

The names are those of MAVLink's enumerations MAV_CMD, MAV_FRAME, GIMBAL_MANAGER_FLAGS and
MAV_AUTOPILOT without their prefix; a test compares every one with pymavlink's.
"""

from __future__ import annotations

# MAV_CMD
NAV_WAYPOINT = 16
NAV_LOITER_UNLIM = 17
NAV_LOITER_TURNS = 18
NAV_LOITER_TIME = 19
NAV_RETURN_TO_LAUNCH = 20
NAV_LAND = 21
NAV_TAKEOFF = 22
NAV_SPLINE_WAYPOINT = 82
NAV_DELAY = 93
NAV_LAST = 95
CONDITION_DELAY = 112
CONDITION_YAW = 115
DO_CHANGE_SPEED = 178
DO_SET_ROI_LOCATION = 195
DO_SET_ROI_NONE = 197
DO_SET_ROI = 201
DO_DIGICAM_CONTROL = 203
DO_MOUNT_CONTROL = 205
DO_SET_CAM_TRIGG_DIST = 206
DO_GIMBAL_MANAGER_PITCHYAW = 1000
DO_GIMBAL_MANAGER_CONFIGURE = 1001
IMAGE_START_CAPTURE = 2000
IMAGE_STOP_CAPTURE = 2001

# MAV_FRAME
GLOBAL = 0
MISSION = 2
GLOBAL_RELATIVE_ALT = 3
GLOBAL_INT = 5
GLOBAL_RELATIVE_ALT_INT = 6
GLOBAL_TERRAIN_ALT = 10
GLOBAL_TERRAIN_ALT_INT = 11

#: Frames that differ only in whether a ground station sent floats or integers.
SAME_FRAME = {
    GLOBAL_INT: GLOBAL,
    GLOBAL_RELATIVE_ALT_INT: GLOBAL_RELATIVE_ALT,
    GLOBAL_TERRAIN_ALT_INT: GLOBAL_TERRAIN_ALT,
}

# GIMBAL_MANAGER_FLAGS
ROLL_LOCK = 4
PITCH_LOCK = 8
YAW_LOCK = 16

# MAV_AUTOPILOT
ARDUPILOTMEGA = 3
PX4 = 12

#: Commands whose x, y, z are latitude, longitude (1e-7 degrees) and height (m).
WITH_PLACE = frozenset(
    {
        NAV_WAYPOINT,
        NAV_LOITER_UNLIM,
        NAV_LOITER_TURNS,
        NAV_LOITER_TIME,
        NAV_LAND,
        NAV_TAKEOFF,
        NAV_SPLINE_WAYPOINT,
        DO_SET_ROI_LOCATION,
        DO_SET_ROI,
    }
)

#: Commands that fly the vehicle to their place.
FLOWN_TO = frozenset(
    {
        NAV_WAYPOINT,
        NAV_LOITER_UNLIM,
        NAV_LOITER_TURNS,
        NAV_LOITER_TIME,
        NAV_LAND,
        NAV_TAKEOFF,
        NAV_SPLINE_WAYPOINT,
    }
)

"""The settings that a photo mission depends on, as each autopilot tells them when asked by name."""

from __future__ import annotations

import struct

from sim.vehicle.dialect import MavMessage, mavlink
from sim.vehicle.options import VehicleOptions

_INT8, _INT16, _INT32, _REAL = 2, 4, 6, 9
#: Value and MAV_PARAM_TYPE of a vehicle whose camera and gimbal are set up.
_ARDUPILOT = {
    "CAM1_TYPE": (1.0, _INT8),
    "CAM1_INTRVAL_MIN": (0.1, _REAL),
    "CAM1_FEEDBAK_PIN": (-1.0, _INT8),
    "MNT1_TYPE": (1.0, _INT8),
    "MNT1_PITCH_MIN": (-90.0, _REAL),
    "MNT1_PITCH_MAX": (20.0, _REAL),
    "FENCE_ENABLE": (0.0, _INT8),
    "SYSID_ENFORCE": (0.0, _INT8),
    "WP_YAW_BEHAVIOR": (2.0, _INT8),
}
_PX4 = {
    "TRIG_MODE": (4.0, _INT32),
    "TRIG_INTERFACE": (3.0, _INT32),
    "MNT_MODE_IN": (4.0, _INT32),
    "MNT_MODE_OUT": (0.0, _INT32),
    "MNT_DO_STAB": (0.0, _INT32),
    "MNT_RANGE_PITCH": (180.0, _REAL),
    "GF_ACTION": (2.0, _INT32),
}


def answer(options: VehicleOptions, message: MavMessage) -> list[MavMessage]:
    """To PARAM_REQUEST_READ by name; nothing for a name that is not known."""
    known = _ARDUPILOT if options.flavour == "ardupilot" else _PX4
    name = message.param_id
    if name not in known:
        return []
    value, kind = known[name]
    value = dict(options.parameters).get(name, value)
    if options.flavour == "px4" and kind == _INT32:
        # PX4 sends the bits of a whole number where the message has a float.
        value = struct.unpack("<f", struct.pack("<i", int(value)))[0]
    index = list(known).index(name)
    return [mavlink.MAVLink_param_value_message(name.encode(), value, kind, len(known), index)]

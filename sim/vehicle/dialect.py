"""pymavlink's generated dialect behind one door: 30,000 lines that no type checker should read."""

from __future__ import annotations

import importlib
from typing import Any

mavlink: Any = importlib.import_module("pymavlink.dialects.v20.ardupilotmega")

#: An instance of one of the dialect's message classes.
MavMessage = Any

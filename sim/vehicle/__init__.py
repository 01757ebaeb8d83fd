"""A simulated MAVLink vehicle in the two flavours that the project flies.

:class:`Vehicle` is a state machine without clock or socket: ``receive(message)``, ``step(dt_s)``,
both return the messages to send. :mod:`sim.vehicle.server` runs one over UDP.
"""

from sim.vehicle.air import Wind
from sim.vehicle.camera import PhotoTaken
from sim.vehicle.faults import Faults
from sim.vehicle.options import VehicleOptions
from sim.vehicle.receiver import Gnss
from sim.vehicle.server import VehicleServer
from sim.vehicle.vehicle import Vehicle

__all__ = ["Faults", "Gnss", "PhotoTaken", "Vehicle", "VehicleOptions", "VehicleServer", "Wind"]

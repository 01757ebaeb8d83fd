"""A simulated camera beside a vehicle: it hears of photos over MAVLink, renders what was to be seen and
drops the files into a folder, as a tether does.

:mod:`sim.tether.poses` knows where the camera was, :mod:`sim.tether.shutter` which photos there are,
:mod:`sim.tether.studio` makes them; :mod:`sim.tether.camera` is the loop around them.
"""

"""Faults between a vehicle and whoever talks to it: a line in the middle that loses, doubles, delays and
cuts, and another ground station that writes its own mission. All by a seed."""

from sim.faults.line import FaultyLine, LineFaults, Moment, MomentKind
from sim.faults.proxy import Proxy
from sim.faults.recipes import Recipe, random_recipe

__all__ = ["FaultyLine", "LineFaults", "Moment", "MomentKind", "Proxy", "Recipe", "random_recipe"]

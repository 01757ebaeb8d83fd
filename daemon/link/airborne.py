"""Whether the vehicle flies, has flown, and is down again. Pure."""

from __future__ import annotations

from dataclasses import dataclass, replace

from daemon.link.events import Event, Heartbeat, LandedState, Position

#: Above home, for vehicles that do not say whether they are on the ground.
LEAST_HEIGHT_M = 3.0


@dataclass(frozen=True)
class Airborne:
    """``flown``: it has been in the air. ``tells``: it says itself whether it is on the ground."""

    armed: bool = False
    in_air: bool = False
    flown: bool = False
    tells: bool = False

    @property
    def landed(self) -> bool:
        """Down and disarmed after a flight."""
        return self.flown and not self.in_air and not self.armed

    def add(self, event: Event) -> Airborne:
        if isinstance(event, Heartbeat):
            return replace(self, armed=event.armed, in_air=self.in_air and event.armed)
        if isinstance(event, LandedState) and event.on_ground is not None:
            return replace(self, tells=True)._with(not event.on_ground)
        if isinstance(event, Position) and not self.tells:
            return self._with(event.height_m > LEAST_HEIGHT_M)
        return self

    def _with(self, up: bool) -> Airborne:
        up = up and self.armed  # what is disarmed does not fly, whatever a late message says
        return replace(self, in_air=up, flown=self.flown or up)

"""Which photos the camera takes, and when: everything that the vehicle tells of photos, each counted once."""

from __future__ import annotations

import random
from collections import deque
from dataclasses import dataclass, field

from daemon.link import events as ev
from daemon.link.clock import TimeBase
from daemon.link.triggers import Trigger, TriggerFilter
from sim.tether.poses import Pose, Poses

#: Telemetry after the photo is waited for so long, on the listener's clock (s).
PATIENCE_S = 3.0


@dataclass(frozen=True)
class Exposure:
    """A photo to be made. ``utc_s``: the vehicle's date of it. ``heard_s``: listener's clock."""

    trigger: Trigger
    pose: Pose
    utc_s: float
    heard_s: float


@dataclass
class Shutter:
    """``missed``: photos that this camera left out (``miss_share`` of them, drawn from ``rng``);
    ``blind``: photos of which nobody told where they were taken from; ``failed``: those that the vehicle
    itself called failed."""

    rng: random.Random
    miss_share: float = 0.0
    missed: int = 0
    blind: int = 0
    failed: int = 0
    poses: Poses = field(default_factory=Poses)
    filter: TriggerFilter = field(default_factory=TriggerFilter)
    _waiting: deque[int] = field(default_factory=deque)

    @property
    def waiting(self) -> int:
        return len(self._waiting)

    def hear(self, event: ev.Event, at_s: float) -> None:
        """One event, heard at a time on a clock that never steps (s)."""
        if isinstance(event, ev.VehicleRestarted):
            self.filter.restarted()
            self.poses.forget()
            self.blind += len(self._waiting)
            self._waiting.clear()
        elif isinstance(event, ev.PhotoReport):
            photo = self.filter.add(event, at_s)
            if photo is not None and photo.revision == 0:
                self._waiting.append(photo.number - 1)
        else:
            self.poses.add(event)

    def exposures(self, base: TimeBase, now_s: float) -> list[Exposure]:
        """The photos of which everything is known now, in the order in which they were triggered."""
        found = []
        while self._waiting:
            photo = self.filter.photos[self._waiting[0]]
            times = _times(photo, base)
            late = now_s - photo.heard_s > PATIENCE_S
            if not late and (times is None or not self.poses.complete(times[0])):
                break
            self._waiting.popleft()
            pose = None if times is None else self.poses.at(times[0], photo)
            if photo.confirmed is False:
                self.failed += 1
            elif times is None or pose is None:
                self.blind += 1
            elif self.rng.random() < self.miss_share:
                self.missed += 1
            else:
                found.append(Exposure(photo, pose, times[1], photo.heard_s))
        return found


def _times(photo: Trigger, base: TimeBase) -> tuple[float, float] | None:
    """Boot time and UTC of a photo, the one from the other where only one was told."""
    boot_s, utc_s = photo.vehicle_boot_s, photo.utc_s
    if boot_s is None and utc_s is not None:
        boot_s = base.boot_of_utc(utc_s)
    if utc_s is None and boot_s is not None:
        known = base.utc_of_boot(boot_s)
        utc_s = None if known is None else known[0]
    return None if boot_s is None or utc_s is None else (boot_s, utc_s)

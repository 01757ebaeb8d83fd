"""Modes, arming and flying of missions: what both autopilots share.

The vehicle changes its mode only when told to (or when a mission ends in a return). On the ground
a mode does nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from mission.encode import Item
from mission.encode import constants as mav
from sim.vehicle.camera import Camera
from sim.vehicle.motion import Body, turn_deg
from sim.vehicle.options import VehicleOptions
from sim.vehicle.receiver import Place
from sim.vehicle.storage import NAVIGATION, PLACED

RETURN_HEIGHT_M = {"ardupilot": 15.0, "px4": 30.0}
#: A corner sharper than this is stopped at.
STRAIGHT_DEG = 5.0
_CLOSE_M = 0.05
_TRIGGERS = frozenset({mav.DO_SET_CAM_TRIGG_DIST, mav.IMAGE_START_CAPTURE, mav.IMAGE_STOP_CAPTURE})
#: Items that take their time; all others are commands.
FLOWN = NAVIGATION


class Mode(StrEnum):
    MANUAL = "manual"
    HOLD = "hold"
    GUIDED = "guided"
    MISSION = "mission"
    RETURN = "return"
    LAND = "land"


class MissionStage(StrEnum):
    NOT_STARTED = "not started"
    ACTIVE = "active"
    PAUSED = "paused"
    COMPLETE = "complete"


@dataclass
class Pilot:
    """``mission``: the items the vehicle holds now. ``reached``: item numbers as they are told.
    ``texts``: what it says. ``shoot``: takes a photo by command."""

    options: VehicleOptions
    body: Body
    camera: Camera
    mission: Callable[[], list[Item]]
    shoot: Callable[[], None]
    mode: Mode = Mode.MANUAL
    armed: bool = False
    current: int = 0
    stage: MissionStage = MissionStage.NOT_STARTED
    reached: list[int] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)
    _legs: list[Place] = field(default_factory=list)
    _wait_s: float = 0.0

    @property
    def flying(self) -> bool:
        return self.armed and self.body.at_m[2] > _CLOSE_M

    def arm(self, armed: bool) -> bool:
        """False where it is refused: disarming in the air."""
        if not armed and self.flying:
            return False
        self.armed = armed
        return True

    def set_mode(self, mode: Mode) -> bool:
        """False where it is refused."""
        if mode is self.mode:
            return True
        if self.mode is Mode.MISSION:
            self._leave_mission()
        self.mode = mode
        self._legs = []
        if not self.flying:
            return True
        if mode is Mode.MISSION:
            self._enter_mission()
        elif mode is Mode.RETURN:
            self._return()
        elif mode is Mode.LAND:
            self._fly_legs([(self.body.at_m[0], self.body.at_m[1], 0.0)])
        else:
            self.body.hold()
        return True

    def take_off(self, height_m: float) -> bool:
        """By command: climb where it stands, then hold."""
        if not self.armed or self.flying:
            return False
        self._fly_legs([(self.body.at_m[0], self.body.at_m[1], height_m)])
        return True

    def pause(self, paused: bool) -> bool:
        """DO_PAUSE_CONTINUE; False where it is refused."""
        del paused
        return False

    def start_mission(self) -> int:
        """MISSION_START; a MAV_RESULT."""
        raise NotImplementedError

    def jump(self, item: int, reset: bool) -> bool:
        """Fly this item next."""
        raise NotImplementedError

    def changed(self) -> None:
        """Another mission was stored."""
        raise NotImplementedError

    def may_clear(self) -> bool:
        return True

    def step(self, dt_s: float) -> None:
        if not self.armed:
            return
        if self.mode is Mode.MISSION and self.stage is MissionStage.ACTIVE and not self._legs:
            self._step_mission(dt_s)
        elif self._legs and self.body.arrived:
            del self._legs[0]
            if self._legs:
                self.body.fly_to(self._legs[0])
            elif self.body.at_m[2] <= _CLOSE_M:
                self.armed = False
                self.body.hold()
                if self.mode is Mode.MISSION:
                    self.stage = MissionStage.COMPLETE

    def switched_off(self) -> None:
        """In flight, and on again: it stands still meanwhile, and goes on with what it was at."""
        if not self.flying or self._legs:
            return
        self.body.hold()
        if self.mode is Mode.MISSION and self.stage is MissionStage.ACTIVE:
            self._leave_mission()
            self._enter_mission()

    def _step_mission(self, dt_s: float) -> None:
        raise NotImplementedError

    def _enter_mission(self) -> None:
        raise NotImplementedError

    def _leave_mission(self) -> None:
        raise NotImplementedError

    def _fly_legs(self, legs: list[Place]) -> None:
        self._legs = legs
        self.body.fly_to(legs[0])

    def _return(self) -> None:
        self.body.look_at_m = None
        east, north, up = self.body.at_m
        height = max(up, RETURN_HEIGHT_M[self.options.flavour])
        self._fly_legs([(east, north, height), (0.0, 0.0, height), (0.0, 0.0, 0.0)])

    def _place(self, item: Item) -> Place | None:
        """East, north, up of home; None where the item has no place of its own."""
        if item.command not in PLACED:
            return None
        home = self.options.home
        above = 0.0 if item.frame in (0, 5) else home.altitude_m
        found = home.enu(
            np.array([item.latitude_deg]), np.array([item.longitude_deg]), np.array([item.z + above])
        )[0]
        east, north, up = (float(v) for v in found)
        # "Here", and "as high as now" (Copter).
        if item.x == 0 and item.y == 0:
            east, north = self.body.at_m[:2]
            up = item.z
        return (east, north, self.body.at_m[2] if item.z == 0 and above else up)

    def _end_speed(self, here: Place, index: int) -> float:
        """Speed at which a waypoint is passed: that of flight on a straight line, none before a wait."""
        following = next((i for i in self.mission()[index + 1 :] if i.command in FLOWN), None)
        if following is None or following.command != mav.NAV_WAYPOINT:
            return 0.0
        there = self._place(following)
        if there is None:
            return 0.0
        one = tuple(b - a for a, b in zip(self.body.at_m, here, strict=True))
        two = tuple(b - a for a, b in zip(here, there, strict=True))
        size = math.hypot(*one) * math.hypot(*two)
        cosine = sum(a * b for a, b in zip(one, two, strict=True)) / size if size > 1e-6 else -1.0
        return self.body.cruise_m_s if cosine > math.cos(math.radians(STRAIGHT_DEG)) else 0.0

    def do(self, item: Item) -> bool:
        """Run a command without a way; False where it is not one of these."""
        command, body = item.command, self.body
        if command == mav.DO_CHANGE_SPEED:
            if item.param2 > 0 and item.param1 in (0, 1):
                body.cruise_m_s = item.param2
        elif command in (mav.DO_GIMBAL_MANAGER_PITCHYAW, mav.DO_MOUNT_CONTROL):
            body.look_at_m = None
            if math.isfinite(item.param1):
                body.gimbal_pitch_goal_deg = item.param1
        elif command in (mav.DO_SET_ROI_LOCATION, mav.DO_SET_ROI):
            body.look_at_m = self._place(item)
        elif command == mav.DO_SET_ROI_NONE:
            body.look_at_m = None  # the gimbal stays as it is
        elif command == mav.DO_SET_CAM_TRIGG_DIST:
            self.camera.by_distance(item.param1)
            if item.param3 == 1 and item.param1 > 0:
                self.shoot()
            self.camera.start_here(body)
        elif command == mav.IMAGE_START_CAPTURE or (command == mav.DO_DIGICAM_CONTROL and item.x == 1):
            self.shoot()
        else:
            return False
        return True


@dataclass
class CopterPilot(Pilot):
    """ArduCopter: of the commands between two ways the first runs before the second way starts, the
    others after; starting a way turns the nose into the flight; a mission taken up again flies its
    waypoint but does not run its commands again."""

    _nav: Item | None = None
    _do_index: int | None = None
    _yaw_fixed: bool = False

    def arm(self, armed: bool) -> bool:
        """Not in AUTO, in which a vehicle that has landed there still is."""
        if armed and not self.armed and self.mode is Mode.MISSION:
            self.texts.append("Arm: AUTO mode not armable")
            return False
        return super().arm(armed)

    def may_clear(self) -> bool:
        return not (self.armed and self.mode is Mode.MISSION)

    def changed(self) -> None:
        """In flight the vanished item is flown to the end."""
        if not self.flying:
            self.current, self._nav, self.stage = 0, None, MissionStage.NOT_STARTED

    def start_mission(self) -> int:
        """Accepted whatever happens; takes off only armed and with a take-off in the mission."""
        if not self.armed:
            return 0
        first = next((i for i in self.mission()[1:] if i.command in FLOWN), None)
        if not self.flying and (first is None or first.command != mav.NAV_TAKEOFF):
            self.texts.append("Auto: Missing Takeoff Cmd")
            return 0
        if self.mode is not Mode.MISSION:
            self.set_mode(Mode.MISSION)
        if self.stage is not MissionStage.ACTIVE:
            self._enter_mission()
        return 0

    def jump(self, item: int, reset: bool) -> bool:
        if not 0 <= item < len(self.mission()):
            return False
        if reset:
            self.stage = MissionStage.NOT_STARTED
        self.current, self._nav = item, None
        if self.mode is Mode.MISSION and self.flying:
            self.stage = MissionStage.ACTIVE
            self._advance(item)
        return True

    def pause(self, paused: bool) -> bool:
        if self.mode is not Mode.MISSION:
            return False
        if paused:
            self.stage = MissionStage.PAUSED
            self.body.hold()
        elif self.stage is MissionStage.PAUSED:
            self._enter_mission()
        return True

    def _enter_mission(self) -> None:
        """A mission that was uploaded meanwhile is begun at the number where the old one was left."""
        self.stage = MissionStage.ACTIVE
        items = self.mission()
        if self._nav is None:
            self._advance(max(self.current, 1))
        elif self.current >= len(items):
            self._advance(1)
        elif items[self.current].command not in FLOWN:
            self._advance(self.current)
        else:
            self._do_index, self._nav = None, items[self.current]
            self._start(self._nav)

    def _leave_mission(self) -> None:
        if self.stage is MissionStage.ACTIVE:
            self.stage = MissionStage.PAUSED

    def _advance(self, start: int) -> None:
        """On to the next item that is flown; the first command before it runs now."""
        self._do_index = None
        items = self.mission()
        for index in range(start, len(items)):
            if items[index].command in FLOWN:
                self.current, self._nav = index, items[index]
                self._start(items[index])
                return
            if self._do_index is None:
                self._do_index = index
                self._start_do(items[index], index)
        self._nav, self.stage = None, MissionStage.COMPLETE
        self.body.hold()

    def _start(self, item: Item) -> None:
        self._wait_s = 0.0
        if item.command == mav.NAV_RETURN_TO_LAUNCH:
            self._return()
        elif item.command == mav.NAV_LAND:
            place = self._place(item) or self.body.at_m
            east, north = place[:2]
            self._fly_legs([(east, north, self.body.at_m[2]), (east, north, 0.0)])
        elif item.command == mav.NAV_TAKEOFF:
            self.body.fly_to((self.body.at_m[0], self.body.at_m[1], item.z))
        elif item.command != mav.NAV_DELAY:
            self._fly(item)

    def _fly(self, item: Item) -> None:
        place = self._place(item)
        if place is None:
            return
        course = self.body.course_deg(place)
        if self.body.look_at_m is None and course is not None:
            self.body.yaw_goal_deg = course
        end = 0.0 if item.param1 > 0 else self._end_speed(place, self.current)
        self.body.fly_to(place, end)

    def _step_mission(self, dt_s: float) -> None:
        if self._nav is None:
            return
        self._step_do(dt_s)
        if not self._flown(self._nav, dt_s):
            return
        done, following = self.current, self.current + 1
        # The number is sent a moment later, when a command has written its own over it.
        items = self.mission()
        over = following < len(items) and items[following].command not in FLOWN
        self.reached.append(following if over else done)
        self._advance(following)

    def _flown(self, item: Item, dt_s: float) -> bool:
        if item.command == mav.NAV_LOITER_UNLIM:
            return False
        if item.command != mav.NAV_DELAY and not self.body.arrived:
            return False
        self._wait_s += dt_s
        return self._wait_s >= item.param1 or item.command == mav.NAV_TAKEOFF

    def _start_do(self, item: Item, index: int) -> None:
        if item.command == mav.CONDITION_YAW:
            base = self.body.yaw_deg if item.param4 else 0.0
            turn = -item.param1 if item.param4 and item.param3 < 0 else item.param1
            self.body.yaw_goal_deg = (base + turn) % 360
        else:
            self.do(item)
        self._do_index = index

    def _step_do(self, _: float) -> None:
        """The next command after the one that runs, up to the next item that is flown."""
        items = self.mission()
        if self._do_index is None or self._do_index >= len(items):
            return
        if items[self._do_index].command == mav.CONDITION_YAW and not self.body.turned:
            return
        following = self._do_index + 1
        # Commands before the item being flown, then no more: those after it are not its own.
        if following >= min(self.current, len(items)) or items[following].command in FLOWN:
            self._do_index = None
            return
        self._start_do(items[following], following)


@dataclass
class Px4Pilot(Pilot):
    """PX4: one item after the other; waypoints carry the yaw and are reached when it is; leaving the
    mission stops the photos. Taken up again after a command for photos it begins at the place before the
    one it was left at, and there the command is run once more, beside what follows there anyway.

    ``owns_gimbal``: whether the mission may turn it. It is given to the mission by a command of its own,
    without which the others are denied. Leaving the mission turns it ahead and takes it away; a mission that
    is taken up in its middle has its last commands for the gimbal run again."""

    owns_gimbal: bool = False
    _started: int = -1
    _left: int = -1
    _again: tuple[int, Item] | None = None

    def changed(self) -> None:
        """Another mission starts anew; without one the vehicle holds."""
        self.current, self._started, self.stage = 0, -1, MissionStage.NOT_STARTED
        self._left, self._again = -1, None
        self.camera.by_distance(0.0)
        if self.flying and self.mode is Mode.MISSION:
            if self.mission():
                self.stage = MissionStage.ACTIVE
            else:
                self.set_mode(Mode.HOLD)

    def set_mode(self, mode: Mode) -> bool:
        if mode is Mode.MISSION and not self.mission():
            return False
        return super().set_mode(mode)

    def start_mission(self) -> int:
        if not self.mission():
            return 2  # DENIED
        if not self.armed:
            return 1  # TEMPORARILY_REJECTED
        self.mode = Mode.MISSION
        self._enter_mission()
        return 0

    def jump(self, item: int, reset: bool) -> bool:
        """By the message MISSION_SET_CURRENT only."""
        if reset or not 0 <= item < len(self.mission()):
            return False
        self.current, self._started, self._left = item, -1, -1
        return True

    def _enter_mission(self) -> None:
        if self.stage is MissionStage.COMPLETE:
            self.current = 0
        self.stage, self._started = MissionStage.ACTIVE, -1
        before = self.mission()[: self.current]
        for command in (mav.DO_GIMBAL_MANAGER_CONFIGURE, mav.DO_GIMBAL_MANAGER_PITCHYAW):
            last = [item for item in before if item.command == command]
            if last:
                self.do(last[-1])
        shots = [item for item in before if item.command in _TRIGGERS]
        if self._left > 0 and shots and (shots[-1].command != mav.DO_SET_CAM_TRIGG_DIST or shots[-1].param1):
            earlier = [i for i, item in enumerate(before[: self._left - 1]) if item.command in mav.FLOWN_TO]
            if earlier:
                self.current, self._again = earlier[-1], (earlier[-1], shots[-1])
        self._left = -1

    def do(self, item: Item) -> bool:
        if item.command == mav.DO_GIMBAL_MANAGER_CONFIGURE:
            if item.param1 in (-2, -3):
                self.owns_gimbal = item.param1 == -2
            return True
        if item.command == mav.DO_GIMBAL_MANAGER_PITCHYAW and not self.owns_gimbal:
            return False
        return super().do(item)

    def _return(self) -> None:
        self._free_gimbal()
        super()._return()

    def _free_gimbal(self) -> None:
        self.owns_gimbal, self.body.look_at_m = False, None
        self.body.gimbal_pitch_goal_deg = 0.0

    def _leave_mission(self) -> None:
        self.camera.by_distance(0.0)
        self._free_gimbal()
        if self.stage is MissionStage.ACTIVE:
            self.stage, self._left, self._again = MissionStage.PAUSED, self.current, None

    def _step_mission(self, dt_s: float) -> None:
        items = self.mission()
        if self.current >= len(items):
            self.stage = MissionStage.COMPLETE
            self.set_mode(Mode.HOLD)
            return
        item = items[self.current]
        if self._started != self.current:
            self._started, self._wait_s = self.current, 0.0
            self._start(item)
            if self.mode is not Mode.MISSION:
                return
        if self._done(item, dt_s):
            if item.command in FLOWN:
                self.reached += [self.current, self.current]
            self.current = min(self.current + 1, len(items))
            if self._again is not None and self.current > self._again[0]:
                self.do(self._again[1])
                self._again = None

    def _start(self, item: Item) -> None:
        if item.command == mav.NAV_RETURN_TO_LAUNCH:
            self.stage, self.mode = MissionStage.COMPLETE, Mode.RETURN
            self._return()
        elif item.command == mav.NAV_LAND:
            east, north = (self._place(item) or self.body.at_m)[:2]
            self._fly_legs([(east, north, self.body.at_m[2]), (east, north, 0.0)])
        elif item.command == mav.NAV_TAKEOFF:
            height = (self._place(item) or self.body.at_m)[2]
            self.body.fly_to((self.body.at_m[0], self.body.at_m[1], height))
        elif item.command == mav.NAV_DELAY:
            return
        elif item.command in FLOWN:
            place = self._place(item)
            if place is None:
                return
            yaw = item.param4 if math.isfinite(item.param4) else self.body.course_deg(place)
            if self.body.look_at_m is None and yaw is not None:
                self.body.yaw_goal_deg = yaw % 360
            straight = abs(turn_deg(self.body.yaw_deg, self.body.yaw_goal_deg)) < STRAIGHT_DEG
            self.body.fly_to(place, self._end_speed(place, self.current) if straight else 0.0)
        else:
            self.do(item)

    def _done(self, item: Item, dt_s: float) -> bool:
        if item.command not in FLOWN:
            return True
        if item.command == mav.NAV_LOITER_UNLIM:
            return False
        if item.command != mav.NAV_DELAY and not self.body.arrived:
            return False
        if item.command == mav.NAV_WAYPOINT and math.isfinite(item.param4) and not self.body.turned:
            return False
        self._wait_s += dt_s
        return self._wait_s >= item.param1 or item.command == mav.NAV_TAKEOFF

"""The whole vehicle: no clock, no socket; messages in, time in, messages out."""

from __future__ import annotations

import random
from dataclasses import replace

from sim.vehicle import parameters
from sim.vehicle.camera import Camera, PhotoTaken
from sim.vehicle.commands import Commands
from sim.vehicle.dialect import MavMessage, mavlink
from sim.vehicle.faults import Faults
from sim.vehicle.motion import Body
from sim.vehicle.options import VehicleOptions
from sim.vehicle.pilot import CopterPilot, MissionStage, Px4Pilot
from sim.vehicle.receiver import Receiver
from sim.vehicle.telemetry import STREAM_GROUPS, Telemetry
from sim.vehicle.transfer import MissionTransfer

#: Main loop of the simulated autopilot (s): 50 Hz, as ArduPilot looks at distances.
TICK_S = 0.02
CAMERA_COMPONENT = 100


class Vehicle:
    """See :class:`VehicleOptions`. ``photos`` holds the truth about every photo taken.

    Two clocks: ``boot_s``, the vehicle's (flight, streams, photos), and ``link_s`` (timeouts of the
    mission transfer), which run apart when a flight is simulated faster than it would be.
    """

    def __init__(
        self, options: VehicleOptions, rng: random.Random | None = None, faults: Faults | None = None
    ) -> None:
        faults, rng = faults or Faults(), rng or random.Random(0)
        self.options = options
        self.boot_s = 0.0
        self.link_s = 0.0
        # Of their own, so that what the air does changes nothing of what the shutter does.
        seeds = random.Random()
        seeds.setstate(rng.getstate())
        self.body = Body(options, random.Random(seeds.random()))
        self.receiver = Receiver(options.gnss, random.Random(seeds.random()))
        self.camera = Camera(options, rng, faults.miss_photo_share)
        kind = CopterPilot if options.flavour == "ardupilot" else Px4Pilot
        self.pilot = kind(options, self.body, self.camera, lambda: self.transfer.mission, self._shoot)
        self.telemetry = Telemetry(options, self.body, self.receiver, self.pilot)
        self.transfer = MissionTransfer(
            options.flavour,
            self.telemetry.home_item,
            self.pilot.may_clear,
            self.pilot.changed,
            faults.reject_item,
        )
        self.commands = Commands(self.pilot, self.telemetry)
        self._out: list[MavMessage] = []
        self._confirm: list[PhotoTaken] = []
        self._told_low = False
        self._behind_s = 0.0
        self._off_s, self._air_s = faults.off_s, 0.0
        self._power_cycles_s = sorted(faults.power_cycles_s)

    @property
    def photos(self) -> list[PhotoTaken]:
        return self.camera.photos

    @property
    def done(self) -> bool:
        """Landed and disarmed after a mission."""
        return not self.pilot.armed and self.pilot.stage in (MissionStage.COMPLETE, MissionStage.PAUSED)

    def receive(self, message: MavMessage) -> list[MavMessage]:
        """Answer one message. Messages for other systems, and of no interest, are left alone."""
        if self.boot_s < 0 or getattr(message, "target_system", 0) not in (0, self.options.system_id):
            return []
        name = message.get_type()
        if name in ("COMMAND_LONG", "COMMAND_INT"):
            if message.target_component not in (0, 1):
                return []
            self._out += self.commands.receive(message, self.boot_s)
        elif name == "REQUEST_DATA_STREAM" and self.options.flavour == "ardupilot":
            groups = STREAM_GROUPS if message.req_stream_id == 0 else {message.req_stream_id}
            for group in groups:
                for one in STREAM_GROUPS.get(group, ()):
                    self.telemetry.want(one, float(message.req_message_rate * message.start_stop))
        elif name == "TIMESYNC" and message.tc1 == 0:
            now_s = self.boot_s + self._behind_s
            self._out.append(mavlink.MAVLink_timesync_message(round(now_s * 1e9), message.ts1))
        elif name == "PARAM_REQUEST_READ":
            self._out += parameters.answer(self.options, message)
        elif name == "MISSION_SET_CURRENT":
            self.pilot.jump(message.seq, False)
        else:
            self._out += self.transfer.receive(message, self.link_s)
        return self._take()

    def step(self, dt_s: float, link_dt_s: float | None = None) -> list[MavMessage]:
        """Let ``dt_s`` of vehicle time pass (in whole ticks of its main loop, the rest is kept for the
        next call), and ``link_dt_s`` of link time (None: as much)."""
        self.link_s += dt_s if link_dt_s is None else link_dt_s
        self._behind_s += dt_s
        while self._behind_s >= TICK_S - 1e-9:
            self._behind_s -= TICK_S
            self._tick(TICK_S)
        self._out += self.transfer.tick(self.link_s)
        return self._take()

    def power_cycle(self, off_s: float) -> None:
        """The autopilot's power fails for so long and comes back, in the air: it stays up and takes its
        mission up again, as after a watchdog's restart. Clock, numbers of photos and streams begin anew, and
        commands of the mission that were run are not run again."""
        self.options = replace(self.options, boot_utc_s=self.options.boot_utc_s + self.boot_s + off_s)
        self.boot_s = -off_s
        self.camera.switched_off()
        self._confirm.clear()
        self._out.clear()
        self.telemetry.switched_off(self.options)
        self.pilot.switched_off()

    def _tick(self, dt_s: float) -> None:
        self.boot_s += dt_s
        if self.pilot.flying:
            self._air_s += dt_s
        if self.boot_s >= 0:
            self.pilot.step(dt_s)
        if self.pilot.armed:
            self.body.step(dt_s)
        self.receiver.step(dt_s)
        self.body.error_m = self.receiver.bias_m
        self._drain(dt_s)
        if self.boot_s < 0:
            return
        if self._power_cycles_s and self._air_s >= self._power_cycles_s[0]:
            del self._power_cycles_s[0]
            self.power_cycle(self._off_s)
            return
        if self.camera.due(self.body):
            self._shoot()
        for text in self.pilot.texts:
            self._out.append(self.telemetry.text(text, 3))
        for item in self.pilot.reached:
            self._out.append(mavlink.MAVLink_mission_item_reached_message(item))
        self.pilot.texts.clear()
        self.pilot.reached.clear()
        while self._confirm and self.boot_s >= self._confirm[0].boot_s + self.options.camera_lag_s:
            message = self.telemetry.captured(self._confirm.pop(0), True)
            message.from_component = CAMERA_COMPONENT
            self._out.append(message)
        self._out += self.telemetry.due(self.boot_s)

    def _shoot(self) -> None:
        utc_s = self.options.boot_utc_s + self.boot_s
        self._tell(self.camera.trigger(self.body, self.boot_s, utc_s, self.receiver))

    def _tell(self, photo: PhotoTaken | None) -> None:
        if photo is None:
            return
        if self.options.flavour == "px4":
            self._out += [self.telemetry.trigger(photo), self.telemetry.captured(photo, False)]
            return
        self.telemetry.last_photo = photo
        self._out.append(self.telemetry.feedback(photo))
        if self.options.camera_component:
            self._confirm.append(photo)

    def _drain(self, dt_s: float) -> None:
        telemetry = self.telemetry
        telemetry.used_share += dt_s * (1.0 if self.pilot.flying else 0.03) / self.options.endurance_s
        if telemetry.used_share > 0.8 and not self._told_low:
            self._told_low = True
            self._out.append(telemetry.text("Battery 1 is low", 4))

    def _take(self) -> list[MavMessage]:
        out, self._out = self._out, []
        return out

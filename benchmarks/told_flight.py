"""A flight that is told of: a vehicle's messages over UDP at the pace asked for, and its photos, one by one.

No simulation of motion: the photos are there already, and the vehicle says what they say.
"""

from __future__ import annotations

import bisect
import contextlib
import shutil
import socket
import threading
import time
from collections.abc import Sequence
from datetime import UTC
from pathlib import Path
from typing import Any

from calib.photos.photo import Photo
from daemon.closing import Closing
from sim.vehicle.dialect import mavlink

_LOOK_S, _BEAT_S, _FEEDBACK_S = 0.02, 1.0, 0.5
#: ArduPilot's quadcopter, armed, in AUTO.
_ARMED = 81 | 128


class ToldFlight(Closing):
    """ArduPilot's messages to ``port`` of this computer, and files into ``card`` half an interval later.

    Args:
        photos: with time and position, in the order of their times.
        at_s: when each is triggered, on the wall, s from the start; the vehicle's own times are the photos'.
        card: photos appear there whole.
        telemetry_s: on the wall, between two messages of place and attitude.
    """

    def __init__(
        self,
        photos: Sequence[Photo],
        at_s: Sequence[float],
        port: int,
        card: Path,
        telemetry_s: float = 0.2,
    ) -> None:
        self._telemetry_s = telemetry_s
        self._photos, self._at_s, self._card = photos, at_s, card
        self._utc_s = [p.time.replace(tzinfo=UTC).timestamp() for p in photos if p.time is not None]
        self._to = ("127.0.0.1", port)
        self._sender = mavlink.MAVLink(None, 1, 1)
        self._began_s = time.monotonic()
        self._stop = threading.Event()
        self.triggered = self.written = self.sent = 0
        self._thread = threading.Thread(target=self._run, name="told", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join(5)

    def _run(self) -> None:
        due = {"beat": 0.0, "position": 0.0, "feedback": 0.0}
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
            while not self._stop.wait(_LOOK_S):
                now = time.monotonic() - self._began_s
                said: list[Any] = []
                while self.triggered < len(self._photos) and now >= self._at_s[self.triggered]:
                    said.append(self._feedback(self.triggered))
                    self.triggered += 1
                    due["feedback"] = now + _FEEDBACK_S
                late_s = 0.5 * (self._at_s[1] - self._at_s[0])
                while self.written < self.triggered and now >= self._at_s[self.written] + late_s:
                    self._write(self._photos[self.written].path)
                    self.written += 1
                if now >= due["beat"]:
                    due["beat"] = now + _BEAT_S
                    said += [mavlink.MAVLink_heartbeat_message(2, 3, _ARMED, 3, 4, 3), self._time(now)]
                if now >= due["position"]:
                    due["position"] = now + self._telemetry_s
                    said += self._motion(now)
                if self.triggered and now >= due["feedback"]:
                    due["feedback"] = now + _FEEDBACK_S
                    said.append(self._feedback(self.triggered - 1))
                for message in said:
                    raw = message.pack(self._sender)
                    self._sender.seq = (self._sender.seq + 1) % 256
                    with contextlib.suppress(OSError):  # Nobody listens now.
                        line.sendto(raw, self._to)
                        self.sent += 1

    def _write(self, photo: Path) -> None:
        part = self._card / f".{photo.name}"
        shutil.copy(photo, part)
        part.rename(self._card / photo.name)

    def _vehicle_utc_s(self, now_s: float) -> float:
        """Its date, which goes from photo to photo as the wall does."""
        last = max(bisect.bisect_right(self._at_s, now_s) - 1, 0)
        if last + 1 < len(self._at_s) and now_s >= self._at_s[0]:
            share = (now_s - self._at_s[last]) / (self._at_s[last + 1] - self._at_s[last])
            return self._utc_s[last] + share * (self._utc_s[last + 1] - self._utc_s[last])
        return self._utc_s[last] + now_s - self._at_s[last]

    def _boot_ms(self, utc_s: float) -> int:
        return round(1e3 * (utc_s - self._utc_s[0] + 60.0))

    def _time(self, now_s: float) -> Any:
        utc_s = self._vehicle_utc_s(now_s)
        return mavlink.MAVLink_system_time_message(round(utc_s * 1e6), self._boot_ms(utc_s))

    def _motion(self, now_s: float) -> list[Any]:
        boot_ms = self._boot_ms(self._vehicle_utc_s(now_s))
        x, y, altitude_m, height_m = self._place(max(self.triggered - 1, 0))
        place = (x, y, round(altitude_m * 1e3), round(height_m * 1e3))
        return [
            mavlink.MAVLink_global_position_int_message(boot_ms, *place, 0, 0, 0, 0),
            mavlink.MAVLink_attitude_message(boot_ms, 0.0, -0.1, 0.0, 0.0, 0.0, 0.0),
        ]

    def _feedback(self, number: int) -> Any:
        x, y, altitude_m, height_m = self._place(number)
        return mavlink.MAVLink_camera_feedback_message(
            *(round(self._utc_s[number] * 1e6), 0, 0, number + 1, x, y, altitude_m, height_m),
            *(0.0, -6.0, 0.0, 0.0, 0, 0),
        )

    def _place(self, number: int) -> tuple[int, int, float, float]:
        at = self._photos[number].position
        assert at is not None
        degrees = (round(at.latitude_deg * 1e7), round(at.longitude_deg * 1e7))
        return *degrees, at.altitude_m or 0.0, at.height_above_launch_m or 0.0

"""What ``fieldcal doctor`` looks at: this computer, and the vehicle at the other end of a link.

Pure but for :func:`computer`: what is known goes in, one sentence for each thing comes out.
"""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from importlib.util import find_spec
from pathlib import Path

from daemon.link import events as ev
from daemon.link.live import LinkHealth
from daemon.link.state import LinkState
from daemon.link.streams import WANTED, Streams

#: Photos, a log and a report of one flight fit into this.
LEAST_DISK_BYTES = 5 * 10**9
CLOCK_S = 2.0
LOSS_SHARE = 0.05
SATELLITES = 8
#: Before this the computer's clock was never set.
BUILT_S = 1_760_000_000.0

ARDUPILOT_PARAMETERS = (
    *("CAM1_TYPE", "CAM1_INTRVAL_MIN", "CAM1_FEEDBAK_PIN", "MNT1_TYPE", "MNT1_PITCH_MIN", "FENCE_ENABLE"),
    *("SYSID_ENFORCE", "MAV_OPTIONS"),
)
PX4_PARAMETERS = (
    *("TRIG_MODE", "TRIG_INTERFACE", "MNT_MODE_IN", "MNT_MODE_OUT", "MNT_RANGE_PITCH", "MNT_DO_STAB"),
    "GF_ACTION",
)


class Level(StrEnum):
    GOOD = "good"
    NOTE = "note"  # worth knowing, or not decided
    BAD = "bad"  # a photo mission would suffer


@dataclass(frozen=True)
class Check:
    """``topic``: a word or two."""

    level: Level
    topic: str
    sentence: str


def computer(folder: Path, now_s: float) -> list[Check]:
    """Programs, disk, rights and clock of this computer. ``folder``: where flights are recorded."""
    return [_programs(), *_disk(folder), _serial_rights(), _own_clock(now_s)]


def _programs() -> Check:
    parts = {"pymavlink": "the vehicle link", "serial": "serial lines", "zenoh": "the live status"}
    missing = [words for name, words in parts.items() if find_spec(name) is None]
    if missing:
        return Check(
            Level.BAD, "programs", f"Missing for {' and '.join(missing)}: pip install 'fieldcal[flight]'."
        )
    version = ".".join(map(str, sys.version_info[:3]))
    return Check(Level.GOOD, "programs", f"All parts are installed (Python {version}).")


def _disk(folder: Path) -> list[Check]:
    there = folder
    while not there.exists() and there != there.parent:
        there = there.parent
    free = shutil.disk_usage(there).free
    text = f"{free / 1e9:.1f} GB are free where flights are recorded ({folder})"
    room = (
        Check(Level.GOOD, "disk", text + ".")
        if free >= LEAST_DISK_BYTES
        else Check(Level.BAD, "disk", f"Only {text}: free some space, a flight takes a few GB.")
    )
    if not os.access(there, os.W_OK | os.X_OK):
        return [
            room,
            Check(Level.BAD, "rights", f"You may not write in {there}: flights cannot be recorded."),
        ]
    return [room, Check(Level.GOOD, "rights", "Flights can be recorded there.")]


def _serial_rights() -> Check:
    devices = sorted(Path("/dev").glob("ttyACM*")) + sorted(Path("/dev").glob("ttyUSB*"))
    if not devices:
        return Check(Level.NOTE, "serial", "No serial radio or USB autopilot is plugged in.")
    closed = [d for d in devices if not os.access(d, os.R_OK | os.W_OK)]
    if closed:
        return Check(
            Level.BAD,
            "serial",
            f"You may not use {', '.join(map(str, closed))}: add your user to the group that owns it (often "
            "dialout) and log in again.",
        )
    return Check(Level.GOOD, "serial", f"{', '.join(map(str, devices))} can be used.")


def _own_clock(now_s: float) -> Check:
    words = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(now_s))
    if now_s < BUILT_S:
        return Check(Level.BAD, "clock", f"This computer believes that it is {words}: set its clock.")
    return Check(Level.GOOD, "clock", f"This computer's clock says {words}.")


def vehicle(state: LinkState, health: LinkHealth, streams: Streams, now_s: float) -> list[Check]:
    """What was heard of the vehicle. ``now_s``: the link's clock."""
    return [
        _who(state),
        _link(state, health, now_s),
        _answer_time(state, now_s),
        _streams(state, streams),
        _gnss(state),
        _vehicle_clock(state, now_s),
        *_camera(state),
        *_others(state),
    ]


def _who(state: LinkState) -> Check:
    beat, firmware = state.last(ev.Heartbeat), state.last(ev.Firmware)
    name = {ev.Autopilot.ARDUPILOT: "ArduPilot", ev.Autopilot.PX4: "PX4"}.get(state.autopilot)
    if beat is None or name is None:
        return Check(
            Level.BAD, "vehicle", "The vehicle flies neither ArduPilot nor PX4: missions do not fit."
        )
    version = "" if firmware is None else f" {firmware.version}"
    doing = f"{'armed' if beat.armed else 'disarmed'}, mode {beat.mode}"
    return Check(Level.GOOD, "vehicle", f"{name}{version}, system {state.system_id}, {doing}.")


def _link(state: LinkState, health: LinkHealth, now_s: float) -> Check:
    quality = state.quality
    share, age = quality.loss_share or 0.0, quality.age_s(now_s) or 0.0
    text = f"{quality.received} messages, {100 * share:.0f} % lost, last heartbeat {age:.1f} s ago"
    if health.reopened:
        text += f", the line was opened again {health.reopened} times"
    if share > LOSS_SHARE:
        return Check(Level.BAD, "link", f"{text}: move the antennas, or ask for fewer streams elsewhere.")
    return Check(Level.GOOD, "link", text + ".")


def _answer_time(state: LinkState, now_s: float) -> Check:
    found = state.time_base.boot_of_local(now_s)
    if found is None:
        text = "The vehicle does not answer the question for its clock; UTC is used."
        if state.time_base.boot_from_local.samples:
            text = "The vehicle's clock does not run like this computer's (a simulator's may); UTC is used."
        return Check(Level.NOTE, "time base", text)
    return Check(
        Level.GOOD, "time base", f"The vehicle's clock is known to {1e3 * max(found[1], 1e-3):.0f} ms."
    )


def _streams(state: LinkState, streams: Streams) -> Check:
    # Nothing is due before the first photo.
    missing = [name for name in streams.missing(state.counts) if name != "CAMERA_FEEDBACK"]
    if missing:
        return Check(
            Level.BAD,
            "streams",
            f"The vehicle does not send {', '.join(missing)} though asked; is this line open for missions?",
        )
    wanted = [name for name in WANTED[state.autopilot] if name != "CAMERA_FEEDBACK"]
    there = sum(1 for name in wanted if state.counts.get(name))
    if there < len(wanted):
        return Check(Level.NOTE, "streams", f"{there} of {len(wanted)} kinds of messages come so far.")
    return Check(Level.GOOD, "streams", f"All {there} kinds of messages come that were asked for.")


def _gnss(state: LinkState) -> Check:
    fix = state.last(ev.GnssFix)
    if fix is None:
        return Check(Level.BAD, "satellites", "The vehicle tells nothing of its satellite receiver.")
    seen = "an unknown number of" if fix.satellites is None else str(fix.satellites)
    error = "" if fix.horizontal_accuracy_m is None else f", good to {fix.horizontal_accuracy_m:.1f} m"
    kind = {4: "differential", 5: "RTK float", 6: "RTK fixed"}.get(fix.fix, "3D" if fix.fix == 3 else "no")
    text = f"{kind} fix, {seen} satellites{error}"
    text = text[0].upper() + text[1:]
    if fix.fix < 3 or (fix.satellites is not None and fix.satellites < SATELLITES):
        return Check(Level.BAD, "satellites", f"{text}: wait, or move away from walls and trees.")
    return Check(Level.GOOD, "satellites", text + ".")


def _vehicle_clock(state: LinkState, now_s: float) -> Check:
    boot = state.time_base.boot_of_local(now_s)
    utc = None if boot is None else state.time_base.utc_of_boot(boot[0])
    if utc is None:
        text = "The vehicle does not know the date yet (no satellite time)."
        if state.time_base.utc_from_boot.samples:
            text = "The vehicle knows the date, but its clock cannot be compared with this computer's."
        return Check(Level.NOTE, "date", text)
    away = now_s - utc[0]
    if abs(away) > CLOCK_S + utc[1]:
        late = "ahead of" if away > 0 else "behind"
        return Check(
            Level.BAD, "date", f"This computer's clock is {_span(abs(away))} {late} satellite time: set it."
        )
    return Check(Level.GOOD, "date", f"This computer's clock and satellite time agree to {abs(away):.1f} s.")


def _span(seconds: float) -> str:
    for size, name in ((86400, "days"), (3600, "hours"), (60, "minutes")):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {name}"
    return f"{seconds:.0f} seconds"


def _camera(state: LinkState) -> list[Check]:
    found = state.parameters
    return _ardupilot(found) if state.autopilot is ev.Autopilot.ARDUPILOT else _px4(found)


def _ardupilot(found: Mapping[str, float]) -> list[Check]:
    if not found:
        return [Check(Level.NOTE, "camera", "The vehicle's settings could not be read.")]
    checks = []
    camera = found.get("CAM1_TYPE")
    if not camera:
        checks.append(
            Check(
                Level.BAD,
                "camera",
                "No camera is set up (CAM1_TYPE is 0 or missing): photo commands do nothing.",
            )
        )
    else:
        pin = found.get("CAM1_FEEDBAK_PIN", -1.0)
        told = f"each photo is told by pin {pin:.0f}" if pin >= 0 else "photos are told when commanded"
        least = found.get("CAM1_INTRVAL_MIN", 0.0)
        text = f"A camera is set up (CAM1_TYPE {camera:.0f}); {told}"
        text += f", at most one each {least:g} s." if least else "."
        checks.append(Check(Level.GOOD, "camera", text))
        if pin < 0:
            checks.append(
                Check(
                    Level.NOTE,
                    "feedback",
                    "Without a feedback pin (CAM1_FEEDBAK_PIN) a photo that failed is not noticed.",
                )
            )
    mount, lowest = found.get("MNT1_TYPE"), found.get("MNT1_PITCH_MIN")
    if not mount:
        checks.append(
            Check(Level.NOTE, "gimbal", "No gimbal is set up (MNT1_TYPE): the camera cannot be aimed.")
        )
    elif lowest is not None and lowest > -90:
        checks.append(
            Check(
                Level.BAD,
                "gimbal",
                f"The gimbal stops at {lowest:g} degrees (MNT1_PITCH_MIN): photos straight down need -90.",
            )
        )
    else:
        checks.append(
            Check(Level.GOOD, "gimbal", f"A gimbal is set up (MNT1_TYPE {mount:.0f}), down to -90.")
        )
    # Of 4.6, and bit 0 of its heir in 4.7.
    enforced = "SYSID_ENFORCE is 1" if found.get("SYSID_ENFORCE") else ""
    if int(found.get("MAV_OPTIONS", 0.0)) & 1:
        enforced = "MAV_OPTIONS has bit 0"
    if enforced:
        text = f"The vehicle obeys one ground station only ({enforced}): it hears no other."
        checks.append(Check(Level.BAD, "rights", text))
    return checks


def _px4(found: Mapping[str, float]) -> list[Check]:
    if not found:
        return [Check(Level.NOTE, "camera", "The vehicle's settings could not be read.")]
    mode = found.get("TRIG_MODE", 0.0)
    good = Check(Level.GOOD, "camera", f"A camera trigger is set up (TRIG_MODE {mode:.0f}).")
    bad = Check(
        Level.BAD, "camera", "No camera trigger is set up (TRIG_MODE is 0 or missing): no photo is taken."
    )
    checks = [good if mode else bad]
    if mode in (1, 2):
        text = f"The camera takes no photos by distance (TRIG_MODE {mode:.0f}): missions need 4."
        checks = [Check(Level.BAD, "camera", text)]
    elif mode == 3:
        text = "The camera takes photos by distance all the time (TRIG_MODE 3): with 4 only on command."
        checks = [Check(Level.NOTE, "camera", text)]
    source, range_deg = found.get("MNT_MODE_IN", -1.0), found.get("MNT_RANGE_PITCH", 180.0)
    if source < 0:
        checks.append(
            Check(
                Level.NOTE, "gimbal", "No gimbal is set up (MNT_MODE_IN is -1): the camera cannot be aimed."
            )
        )
    elif found.get("MNT_MODE_OUT") == 0 and range_deg < 180:
        text = f"The gimbal stops at {-range_deg / 2:g} degrees (MNT_RANGE_PITCH {range_deg:g})"
        checks.append(Check(Level.BAD, "gimbal", f"{text}: photos straight down need 180."))
    else:
        text = f"A gimbal is set up (MNT_MODE_IN {source:.0f})"
        ready = source == 4
        text += "." if ready else ": missions aim it only with MNT_MODE_IN 4."
        checks.append(Check(Level.GOOD if ready else Level.NOTE, "gimbal", text))
    return checks


def _others(state: LinkState) -> list[Check]:
    found = []
    if state.stations:
        names: Sequence[str] = [str(one) for one in sorted(state.stations)]
        found.append(
            Check(
                Level.NOTE,
                "stations",
                f"Another ground station is on this link (system {', '.join(names)}): agree who uploads.",
            )
        )
    if state.others:
        names = [str(one) for one in sorted(state.others)]
        found.append(
            Check(
                Level.BAD,
                "vehicles",
                f"There is another vehicle on this link (system {', '.join(names)}): use a link each.",
            )
        )
    return found

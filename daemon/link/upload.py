"""A mission to a vehicle as one transaction: it ends with the new mission on board, read back and compared,
or with the old one.

It never arms, starts or changes a mode (see :mod:`daemon.link.allowed`), and writes only while the
vehicle is disarmed, or holding in the air where that is allowed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path

from calib.errors import InputError
from calib.files import output_errors, write_text_atomic
from daemon.link.events import Autopilot, Heartbeat
from daemon.link.live import Link
from daemon.link.state import SILENT_S, LinkState
from daemon.link.transfer import REASONS, Clear, Download, Exchange, Kind, Patience, Upload
from daemon.link.vehicle_mission import Held, mission_differences, write_held
from mission.encode import Flavour, Item
from mission.encode.fence_items import compare_fence

#: Called with the step's name, how much is done and how much there is (0: not known).
Progress = Callable[[str, int, int], None]
_FLAVOURS: dict[Autopilot, Flavour] = {Autopilot.ARDUPILOT: "ardupilot", Autopilot.PX4: "px4"}
_READ_TIMES = 3
#: Beside the kept missions while one is changed: names the file, for whoever comes after a kill.
UNDER_WAY = "upload-under-way.txt"
#: ArduPilot keeps the number of the item at which it left a mission, also for the next mission.
GOES_ON = (
    "It would go on with it at the item where it stopped: restart the mission (set item 1) before you "
    "switch to AUTO, or its first photos are missing."
)


class NotAllowedError(InputError):
    """The vehicle must not be written to now."""


class Outcome(StrEnum):
    UPLOADED = "uploaded"
    REFUSED = "refused"  # the operator said no: nothing was sent
    INTACT = "intact"  # it failed; the old mission was never touched
    RESTORED = "restored"  # it failed; the old mission is back, read back and compared
    UNSURE = "unsure"  # it failed, and what the vehicle holds is not known


@dataclass(frozen=True)
class Mission:
    """What is to be uploaded. ``items`` as the autopilot wants them (ArduPilot's with home as item 0);
    ``fence`` None: the vehicle keeps its own."""

    name: str
    flavour: Flavour
    items: tuple[Item, ...]
    fence: tuple[Item, ...] | None = None

    @property
    def count(self) -> int:
        """Items without ArduPilot's home."""
        return len(self.items) - (self.flavour == "ardupilot")


@dataclass(frozen=True)
class Result:
    """``message``: one or two sentences for the operator. ``kept``: the file with the old mission."""

    outcome: Outcome
    message: str
    kept: Path | None = None
    differences: tuple[str, ...] = ()


@dataclass(frozen=True)
class Terms:
    """``holding``: a vehicle that holds in the air may be written to as well (refly pass).
    ``restore_s``: for so long the old mission is tried to be brought back, cuts of the link included."""

    holding: bool = False
    patience: Patience = field(default_factory=Patience)
    restore_s: float = 120.0


def _quiet(step: str, done: int, total: int) -> None:
    del step, done, total


def flavour_of(state: LinkState) -> Flavour:
    """
    Raises:
        NotAllowedError: neither ArduPilot nor PX4.
    """
    found = _FLAVOURS.get(state.autopilot)
    if found is None:
        raise NotAllowedError("The vehicle flies neither ArduPilot nor PX4: its missions are not known.")
    return found


def why_not(state: LinkState, now_s: float, holding: bool = False) -> str | None:
    """Why the vehicle must not be written to, in a sentence; None: it may."""
    beat = state.last(Heartbeat)
    if beat is None or not state.connected(now_s):
        return "The vehicle is not heard."
    if beat.armed and not (holding and beat.holding):
        if holding:
            return f"The vehicle is armed and does not hold (its mode is {beat.mode}): let it hold first."
        return f"The vehicle is armed (its mode is {beat.mode}): land and disarm it first."
    return None


def upload(
    link: Link,
    mission: Mission,
    word: Callable[[], bool],
    keep_in: Path,
    terms: Terms | None = None,
    progress: Progress = _quiet,
) -> Result:
    """Bring ``mission`` onto the vehicle, or leave it as it was.

    Args:
        word: asked once, before anything is read or written; True is the operator's explicit word.
        keep_in: folder for what the vehicle held before.

    Raises:
        NotAllowedError: wrong autopilot, armed, not heard, or the old mission cannot be read: nothing was
            written. OutputError: the old mission cannot be kept.
    """
    task = _Transaction(link, mission, terms or Terms(), progress)
    task.check()
    if not word():
        return Result(Outcome.REFUSED, "Nothing was uploaded.")
    task.check()  # The operator may have taken time.
    before = task.read_before()
    kept = write_held(before, keep_in)
    task.check_now()
    marker = keep_in / UNDER_WAY
    write_text_atomic(marker, f"{kept.name}\n")
    result = task.change(before, kept)
    if result.outcome is not Outcome.UNSURE:
        with output_errors(marker):
            marker.unlink(missing_ok=True)
    return result


def cut_off(keep_in: Path) -> Path | None:
    """The vehicle's mission from before an upload that was killed, or ended unsure; None: there is none."""
    try:
        kept = keep_in / (keep_in / UNDER_WAY).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return None
    return kept if kept.is_file() else None


def read_held(link: Link, terms: Terms | None = None, progress: Progress = _quiet) -> Held:
    """What the vehicle holds now.

    Raises:
        NotAllowedError: it cannot be read.
    """
    task = _Transaction(link, Mission("", flavour_of(link.state), ()), terms or Terms(), progress)
    return task.read_before()


@dataclass(frozen=True)
class _Problem:
    sentence: str
    details: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Put:
    """``refused``: the vehicle's reason; neither: it fell silent."""

    accepted: bool
    refused: str = ""


@dataclass
class _Transaction:
    link: Link
    mission: Mission
    terms: Terms
    progress: Progress

    def check(self) -> None:
        flavour = flavour_of(self.link.state)
        if flavour != self.mission.flavour:
            raise NotAllowedError(
                f"The mission is written for {self.mission.flavour}, the vehicle is {flavour}."
            )
        reason = why_not(self.link.state, self.link.now_s(), self.terms.holding)
        if reason is not None:
            raise NotAllowedError(f"{reason} Nothing was uploaded.")

    def check_now(self) -> None:
        """As :meth:`check`, of a heartbeat that comes from now on."""
        before = self.link.state.quality.heartbeat_s
        self.link.wait(lambda: self.link.state.quality.heartbeat_s != before, SILENT_S)
        self.check()

    def change(self, before: Held, kept: Path) -> Result:
        """The new mission, or the old one again."""
        try:
            problem = self.write()
        except BaseException:
            # Interrupted: what was begun is undone before anything else.
            self.restore(before)
            raise
        if problem is None:
            what = f"{self.mission.count} items" + ("" if self.mission.fence is None else " and the fence")
            text = f"The vehicle holds the mission: {what}, read back and compared."
            beat = self.link.state.last(Heartbeat)
            if self.mission.flavour == "ardupilot" and beat is not None and beat.armed:
                text = f"{text} {GOES_ON}"
            return Result(Outcome.UPLOADED, text, kept)
        result = self.restore(before)
        text = f"{problem.sentence} {result.message}"
        return replace(result, message=text, kept=kept, differences=problem.details)

    def read_before(self) -> Held:
        mission = self._read(Kind.MISSION, "reading the old mission")
        if mission is None:
            raise NotAllowedError("The vehicle's mission cannot be read, so it was not touched.")
        fence = self._read(Kind.FENCE, "reading the old fence")
        if fence is None and self.mission.fence is not None:
            raise NotAllowedError("The vehicle's fence cannot be read, so nothing was touched.")
        return Held(self.mission.flavour, mission, fence)

    def write(self) -> _Problem | None:
        """New mission and fence, each compared; what went wrong, or None."""
        fence = self.mission.fence
        parts = [(Kind.MISSION, self.mission.items)] + ([] if fence is None else [(Kind.FENCE, fence)])
        for kind, items in parts:
            put = self._put(kind, items, "uploading")
            if put.refused:
                return _Problem(put.refused)
            # Accepted or silent: what it holds decides. An answer may be lost after all went well.
            held = self._read(kind, "reading back")
            if held is None:
                return _Problem(f"The link was cut, and the {_noun(kind)} could not be read back.")
            differences = tuple(self._differences(kind, items, held))
            if differences and not put.accepted:
                return _Problem(f"The link was cut before the {_noun(kind)} was across.", differences)
            if differences:
                return _Problem(
                    f"The vehicle accepted the {_noun(kind)} and then held another one; perhaps another "
                    "ground station wrote to it.",
                    differences,
                )
        return None

    def restore(self, before: Held) -> Result:
        """Bring back what the vehicle held, as often as it takes."""
        end = time.monotonic() + self.terms.restore_s
        written, reason = False, None
        while time.monotonic() < end:
            reason = why_not(self.link.state, self.link.now_s(), self.terms.holding)
            if reason is not None:
                self.progress("waiting for the vehicle", 0, 0)
                time.sleep(0.1)
                continue
            wrong = self._wrong_parts(before)
            if wrong is None:
                continue
            if not wrong:
                if written:
                    return Result(Outcome.RESTORED, "The old mission is back, read back and compared.")
                return Result(Outcome.INTACT, "The old mission is still there, read back and compared.")
            for kind, items in wrong:
                self._put(kind, items, "bringing back the old one")
                written = True
        why = f" {reason}" if reason else ""
        return Result(
            Outcome.UNSURE,
            "DO NOT FLY before looking: the old mission could not be brought back, and the vehicle may hold "
            f"parts of both.{why}",
        )

    def _wrong_parts(self, before: Held) -> list[tuple[Kind, Sequence[Item]]] | None:
        """What is not as it was; None where the vehicle does not tell."""
        wrong: list[tuple[Kind, Sequence[Item]]] = []
        parts: list[tuple[Kind, tuple[Item, ...] | None]] = [(Kind.MISSION, before.mission)]
        if self.mission.fence is not None:
            parts.append((Kind.FENCE, before.fence))
        for kind, items in parts:
            held = self._read(kind, "looking at what it holds")
            if held is None or items is None:
                return None
            if self._differences(kind, items, held):
                wrong.append((kind, items))
        return wrong

    def _differences(self, kind: Kind, ours: Sequence[Item], held: Sequence[Item]) -> list[str]:
        if kind is Kind.FENCE:
            return compare_fence(ours, held)
        return mission_differences(ours, held, self.mission.flavour)

    def _put(self, kind: Kind, items: Sequence[Item], step: str) -> _Put:
        vehicle = self._vehicle()
        bare = self.mission.flavour == "ardupilot" and kind is Kind.MISSION and len(items) <= 1
        if not items or bare:
            clear = Clear(vehicle, kind, self.terms.patience)
            self._run(clear, step, lambda: (0, 0))
            result = clear.result
        else:
            sending = Upload(vehicle, items, kind, self.terms.patience)
            self._run(sending, step, lambda: (sending.sent, len(items)))
            result = sending.result
        if result in (None, 0):
            return _Put(result == 0)
        reason = REASONS.get(result or 0, f"its reason has the number {result}")
        where = ""
        if items and not bare and sending.asked >= 0:
            where = f" at item {sending.asked} (command {items[sending.asked].command})"
        return _Put(False, f"The vehicle refused the {_noun(kind)}{where}: {reason}.")

    def _read(self, kind: Kind, step: str) -> tuple[Item, ...] | None:
        for _ in range(_READ_TIMES):
            reading = Download(self._vehicle(), kind, self.terms.patience)
            self._run(reading, step, lambda: (len(reading.items), reading.count or 0))  # noqa: B023 run at once
            if reading.ok:
                return tuple(reading.items)
            if not self.link.wait(lambda: self.link.connected, self.terms.patience.silence_s):
                return None
        return None

    def _run(self, exchange: Exchange, step: str, done: Callable[[], tuple[int, int]]) -> None:
        self.link.run(exchange, lambda: self.progress(step, *done()))

    def _vehicle(self) -> int:
        system_id = self.link.state.system_id
        if system_id is None:
            raise NotAllowedError("The vehicle is not heard.")
        return system_id


def _noun(kind: Kind) -> str:
    return "fence" if kind is Kind.FENCE else "mission"

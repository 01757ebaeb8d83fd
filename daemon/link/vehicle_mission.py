"""What a vehicle holds, as a file: kept before anything is changed on it, and loaded back from.

JSON with every item as the vehicle told it, and a ``.waypoints`` file beside it for other programs.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from calib.errors import FormatError, OutputError
from calib.files import output_errors, write_text_atomic
from daemon.session.rows import Clock, system_clock
from mission.encode import Flavour, Item, compare, waypoints
from mission.encode.fence_items import compare_fence
from mission.encode.files import read_bytes, text_of

SCHEMA = "fieldcal.vehicle-mission/1"
_NAMES = 1000
Whole32 = Annotated[int, Field(ge=-(2**31), lt=2**31)]
Whole16 = Annotated[int, Field(ge=0, lt=2**16)]


@dataclass(frozen=True)
class Held:
    """A vehicle's mission (ArduPilot's with home as item 0) and fence; ``fence`` None: it does not tell."""

    flavour: Flavour
    mission: tuple[Item, ...]
    fence: tuple[Item, ...] | None

    def differences(self, now: Held) -> list[str]:
        """In what the vehicle now holds something else, one sentence each."""
        found = mission_differences(self.mission, now.mission, self.flavour)
        if self.fence is not None and now.fence is not None:
            found += compare_fence(self.fence, now.fence)
        return found


def mission_differences(ours: Sequence[Item], theirs: Sequence[Item], flavour: Flavour) -> list[str]:
    """As :func:`mission.encode.compare`; ArduPilot's home alone is no mission."""
    if flavour == "ardupilot" and len(ours) <= 1 and len(theirs) <= 1:
        return []
    return compare(ours, theirs, flavour)


class _ItemKeys(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    command: Whole16
    frame: Annotated[int, Field(ge=0, le=255)]
    param1: float | None
    param2: float | None
    param3: float | None
    param4: float | None
    x: Whole32
    y: Whole32
    z: float
    autocontinue: bool


class _FileKeys(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    schema_: Annotated[Literal["fieldcal.vehicle-mission/1"], Field(alias="schema")]
    saved: str
    autopilot: Literal["ardupilot", "px4"]
    mission: list[_ItemKeys]
    fence: list[_ItemKeys] | None


def write_held(held: Held, folder: Path, clock: Clock = system_clock) -> Path:
    """Keep what a vehicle holds in a new file of ``folder``: its path. On the disk when it returns.

    Raises:
        OutputError: not writable, disk full.
    """
    now = clock()
    with output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    base = f"vehicle-{now:%Y%m%d-%H%M%S}"
    for number in range(1, _NAMES):
        path = folder / (f"{base}.json" if number == 1 else f"{base}-{number}.json")
        if not path.exists():
            break
    else:
        raise OutputError(f"{folder} holds too many missions named {base}: choose another folder.")
    data = {
        "schema": SCHEMA,
        "saved": now.isoformat(),
        "autopilot": held.flavour,
        "mission": [_plain(item) for item in held.mission],
        "fence": None if held.fence is None else [_plain(item) for item in held.fence],
    }
    write_text_atomic(path, json.dumps(data, indent=1, allow_nan=False) + "\n")
    if held.mission:
        write_text_atomic(path.with_suffix(".waypoints"), waypoints.text(held.mission))
    return path


def read_held(path: Path) -> Held:
    """
    Raises:
        InputError: not readable. FormatError: not such a file.
    """
    text = text_of(read_bytes(path), f"{path}")
    try:
        found = _FileKeys.model_validate_json(text)
    except ValidationError as error:
        raise FormatError(
            f"{path} is not a mission kept from a vehicle ({error.errors()[0]['msg'].lower()})."
        ) from error
    fence = None if found.fence is None else tuple(map(_item, found.fence))
    return Held(found.autopilot, tuple(map(_item, found.mission)), fence)


def _plain(item: Item) -> dict[str, object]:
    return {key: None if value != value else value for key, value in asdict(item).items()}


def _item(keys: _ItemKeys) -> Item:
    one, two, three, four = (
        math.nan if value is None else value for value in (keys.param1, keys.param2, keys.param3, keys.param4)
    )
    return Item(keys.command, keys.frame, one, two, three, four, keys.x, keys.y, keys.z, keys.autocontinue)

"""What goes over the bus: JSON with a named, versioned schema each. Unknown is null.

A new field gets a default and keeps the version; readers pass over fields they do not know. Whatever
changes a meaning gets a new version.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class Message(BaseModel):
    """``vehicle`` is the name in the key, ``sent`` the sender's UTC."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False, frozen=True, populate_by_name=True)

    vehicle: str
    sent: datetime = Field(default_factory=lambda: datetime.now(UTC))


class Status(Message):
    """What the daemon does. ``degraded``: what does not work now, in words, empty if all does."""

    schema_: Literal["fieldcal.status/1"] = Field(default="fieldcal.status/1", alias="schema")
    phase: Literal["waiting", "collecting", "concluding", "ended"]
    session: str
    since: datetime
    degraded: list[str] = []


class Link(Message):
    """The vehicle. ``connected`` is null where the daemon has no link at all, only photos.

    ``quality`` is the share of messages that came through (0-1), ``battery`` the charge left (0-1).
    """

    schema_: Literal["fieldcal.link/1"] = Field(default="fieldcal.link/1", alias="schema")
    connected: bool | None = None
    autopilot: str | None = None
    mode: str | None = None
    armed: bool | None = None
    quality: float | None = None
    battery: float | None = None
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    height_m: float | None = None


class Capture(Message):
    """Triggers, exposures that the camera confirmed, and files; null without a link.

    ``waiting`` files are not whole yet. ``warning``: where the counts part, or the card is away.
    """

    schema_: Literal["fieldcal.capture/1"] = Field(default="fieldcal.capture/1", alias="schema")
    triggers: int | None = None
    confirmed: int | None = None
    photos: int = 0
    waiting: int = 0
    paired: int | None = None
    sure: int | None = None
    warning: str | None = None


class Progress(Message):
    """The alignment: photos that it knows of those there, and what it is at (``of`` null: not known)."""

    schema_: Literal["fieldcal.progress/1"] = Field(default="fieldcal.progress/1", alias="schema")
    photos: int = 0
    aligned: int = 0
    stage: str = ""
    done: int = 0
    of: int | None = None


class FindingLine(BaseModel):
    """One finding: its rule, state and plain sentence."""

    model_config = ConfigDict(frozen=True)

    rule: str
    state: Literal["pass", "flag", "unknown"]
    message: str


class Verdict(Message):
    """The newest verdict; ``final`` once no more photos come. ``at``: when it was found.

    ``photos`` it rests on. Sigmas are standard deviations: what is still uncertain.
    """

    schema_: Literal["fieldcal.verdict/1"] = Field(default="fieldcal.verdict/1", alias="schema")
    verdict: Literal["TRUST", "REFLY", "CANNOT_TELL"]
    final: bool
    at: datetime
    headline: str
    what_to_fly: str | None = None
    photos: int
    f_px: float | None = None
    sigma_f_percent: float | None = None
    dome_percent: float | None = None
    sigma_dome_m: float | None = None
    findings: list[FindingLine] = []


class Log(Message):
    """One line for people, written ``at`` this time."""

    schema_: Literal["fieldcal.log/1"] = Field(default="fieldcal.log/1", alias="schema")
    at: datetime
    level: Literal["info", "warning", "error"]
    text: str

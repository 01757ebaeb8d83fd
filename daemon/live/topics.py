"""The one table of what is on the bus: key, schema, how often, and when it is old."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass

from daemon.live.schemas import Capture, Link, Log, Message, Progress, Status, Verdict

ROOT = "fieldcal"
ALIVE, COMMAND = "alive", "command"
#: Asked for, not told: the flight's record, the report, the mission.
QUERIES = {
    "session": "the flight as `fieldcal sessions show --json` has it (`fieldcal.session/1`)",
    "report": "the newest report (`fieldcal.check/1`); `?format=html` the page itself",
    "plan": "the newest mission file, byte for byte",
}
#: A vehicle's name is one chunk of a key.
_NAME = re.compile(r"[a-z0-9][a-z0-9_.-]{0,63}")


@dataclass(frozen=True)
class Topic:
    """``every_s``: sent again at least so often; ``least_s``: and never more often than this; ``stale_s``:
    older than this it says nothing about now (None: it stays true until another comes)."""

    name: str
    schema: type[Message]
    every_s: float
    least_s: float
    stale_s: float | None

    def key(self, vehicle: str) -> str:
        return f"{ROOT}/{vehicle}/{self.name}"

    @property
    def schema_name(self) -> str:
        return str(self.schema.model_fields["schema_"].default)


TOPICS = {
    topic.name: topic
    for topic in (
        Topic("status", Status, 2.0, 0.0, 6.0),
        Topic("link", Link, 2.0, 0.5, 6.0),
        Topic("capture", Capture, 5.0, 0.5, 15.0),
        Topic("progress", Progress, 5.0, 0.5, 15.0),
        Topic("verdict", Verdict, 10.0, 0.0, None),
        Topic("log", Log, 60.0, 0.0, None),
    )
}


def topic_of(message: Message) -> Topic:
    """The topic that a message belongs on."""
    return next(topic for topic in TOPICS.values() if topic.schema is type(message))


def vehicle_name(text: str) -> str:
    """``text`` as one chunk of a key: lower case, no spaces; "vehicle" where nothing is left."""
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode().lower()
    name = re.sub(r"[^a-z0-9_.-]+", "-", plain).strip("-._")[:64]
    return name if _NAME.fullmatch(name) else "vehicle"

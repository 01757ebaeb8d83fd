"""The daemon's side of the bus: tells what changes, repeats what holds, answers who comes later.

Nothing here waits for anybody: messages that cannot be sent are dropped (and sent again later), so a
slow or dead network costs the flight nothing.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime

import zenoh

from calib.errors import FieldcalError
from daemon.closing import Closing
from daemon.live.answers import Answer, Answers
from daemon.live.commands import Commands
from daemon.live.network import leave, open_for_daemon
from daemon.live.schemas import Message
from daemon.live.settings import Settings
from daemon.live.topics import ALIVE, COMMAND, QUERIES, ROOT, TOPICS, Topic, topic_of

_LOOP_S = 0.25


@dataclass
class _Last:
    message: Message
    changed: bool = True
    sent_s: float = field(default=-1e9)


class Bus(Closing):
    """Publishes for one vehicle, from a thread of its own, until it is closed.

    Args:
        answers: by the names of :data:`~daemon.live.topics.QUERIES`; called from zenoh's threads.
        commands: None: none are taken.

    Raises:
        InputError: zenoh cannot start so.
    """

    def __init__(
        self,
        vehicle: str,
        settings: Settings,
        answers: Answers | None = None,
        commands: Commands | None = None,
    ) -> None:
        self.vehicle = vehicle
        self._last: dict[str, _Last] = {}
        self._mutex = threading.Lock()
        self._ended = threading.Event()
        self._session = open_for_daemon(settings)
        try:
            declare = self._session.declare_queryable
            for topic in TOPICS.values():
                declare(topic.key(vehicle), self._tell_last(topic))
            for name, answer in (answers or {}).items():
                assert name in QUERIES, name
                declare(f"{ROOT}/{vehicle}/{name}", _answering(f"{ROOT}/{vehicle}/{name}", answer))
            if commands is not None:
                key = f"{ROOT}/{vehicle}/{COMMAND}"
                declare(key, _answering_payload(key, commands.take))
            # Last, so that whoever sees the vehicle finds everything of it.
            # Kept: a token that nobody holds is taken back.
            self._token = self._session.liveliness().declare_token(f"{ROOT}/{vehicle}/{ALIVE}")
        except BaseException:
            leave(self._session)
            raise
        self._thread = threading.Thread(target=self._run, name="live status", daemon=True)
        self._thread.start()

    def tell(self, message: Message) -> None:
        """Have a message sent, at once or as soon as its topic may again; never waits."""
        topic = topic_of(message)
        with self._mutex:
            before = self._last.get(topic.name)
            if before is None:
                self._last[topic.name] = _Last(message)
            elif topic.least_s == 0 or _content(before.message) != _content(message):
                before.message, before.changed = message, True
        if topic.least_s == 0:
            self._send_due()

    def close(self) -> None:
        """Send what has changed and leave; more than once does no harm."""
        if not self._ended.is_set():
            self._ended.set()
            self._thread.join(2.0)
            self._send_due(everything_changed=True)
            leave(self._session)

    def _run(self) -> None:
        while not self._ended.wait(_LOOP_S):
            self._send_due()

    def _send_due(self, everything_changed: bool = False) -> None:
        now = time.monotonic()
        with self._mutex:
            due = []
            for name, last in self._last.items():
                topic, age_s = TOPICS[name], now - last.sent_s
                if (
                    last.changed and (age_s >= topic.least_s or everything_changed)
                ) or age_s >= topic.every_s:
                    last.changed, last.sent_s = False, now
                    due.append((topic, last.message))
            for topic, message in due:
                self._session.put(
                    topic.key(self.vehicle),
                    _encoded(message),
                    encoding=_encoding(topic),
                    congestion_control=zenoh.CongestionControl.DROP,
                )

    def _tell_last(self, topic: Topic) -> Callable[[zenoh.Query], None]:
        def reply(query: zenoh.Query) -> None:
            with query:
                with self._mutex:
                    last = self._last.get(topic.name)
                if last is not None:
                    query.reply(topic.key(self.vehicle), _encoded(last.message), encoding=_encoding(topic))

        return reply


def _content(message: Message) -> dict[str, object]:
    return message.model_dump(exclude={"sent"})


def _encoded(message: Message) -> bytes:
    fresh = message.model_copy(update={"sent": datetime.now(UTC)})
    return fresh.model_dump_json(by_alias=True).encode()


def _encoding(topic: Topic) -> zenoh.Encoding:
    return zenoh.Encoding.APPLICATION_JSON.with_schema(topic.schema_name)


def _answering(key: str, answer: Callable[[Mapping[str, str]], Answer]) -> Callable[[zenoh.Query], None]:
    def reply(query: zenoh.Query) -> None:
        with query:
            asked = dict(pair.partition("=")[::2] for pair in str(query.parameters).split(";") if pair)
            try:
                content, encoding = answer(asked)
            except (ValueError, FieldcalError) as error:
                query.reply_err(str(error).encode(), encoding=zenoh.Encoding.TEXT_PLAIN)
            else:
                query.reply(key, content, encoding=zenoh.Encoding(encoding))

    return reply


def _answering_payload(key: str, take: Callable[[bytes], str]) -> Callable[[zenoh.Query], None]:
    def reply(query: zenoh.Query) -> None:
        with query:
            try:
                said = take(b"" if query.payload is None else query.payload.to_bytes())
            except (ValueError, FieldcalError) as error:
                query.reply_err(str(error).encode(), encoding=zenoh.Encoding.TEXT_PLAIN)
            else:
                query.reply(key, said.encode(), encoding=zenoh.Encoding.TEXT_PLAIN)

    return reply

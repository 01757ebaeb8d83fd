"""The bus as one looks at it from outside: every vehicle, what it last said, and how old that is."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import timedelta
from types import TracebackType
from typing import Self

import zenoh
from pydantic import ValidationError

from calib.errors import InputError
from daemon.live.commands import make_command
from daemon.live.network import for_viewer, leave, open_session
from daemon.live.schemas import Log, Message
from daemon.live.settings import Settings
from daemon.live.topics import ALIVE, COMMAND, ROOT, TOPICS

LOG_LINES = 200
#: Connecting takes this long on a slow link; asked again so often meanwhile.
_ASK_AGAIN_S = 0.5
_OVERTAKEN = timedelta(seconds=10)


@dataclass(frozen=True)
class Heard:
    """A message, how long ago it came by this machine's clock, and whether it says anything about now."""

    message: Message
    age_s: float
    stale: bool


@dataclass(frozen=True)
class Vehicle:
    """``alive``: its daemon is there now; ``heard`` by topic."""

    name: str
    alive: bool
    heard: Mapping[str, Heard]
    log: tuple[Log, ...]


class Fleet:
    """Listens to all vehicles, or to one, until it is closed.

    Raises:
        InputError: zenoh cannot start so.
    """

    def __init__(
        self,
        settings: Settings,
        vehicle: str = "*",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._vehicle, self._clock = vehicle, clock
        self._mutex = threading.Lock()
        self._alive: dict[str, bool] = {}
        self._last: dict[tuple[str, str], tuple[Message, float]] = {}
        self._log: dict[str, list[Log]] = {}
        self._session = open_session(for_viewer(settings))
        try:
            declare = self._session.liveliness().declare_subscriber
            self._held = [declare(f"{ROOT}/{vehicle}/{ALIVE}", self._presence, history=True)]
            for name in TOPICS:
                key = f"{ROOT}/{vehicle}/{name}"
                self._held.append(self._session.declare_subscriber(key, self._sample))
        except BaseException:
            leave(self._session)
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        leave(self._session)

    def ask(self, timeout_s: float = 1.0) -> None:
        """Ask all vehicles for the last they said: what a late joiner does."""
        for name in TOPICS:
            with contextlib.suppress(zenoh.ZError):
                for reply in self._session.get(f"{ROOT}/{self._vehicle}/{name}", timeout=timeout_s):
                    if reply.ok is not None:
                        self._sample(reply.ok)

    def wait(self, timeout_s: float, enough: Callable[[tuple[Vehicle, ...]], bool] | None = None) -> None:
        """Wait until somebody is there and has been asked, or ``enough``, at most ``timeout_s``."""
        enough = enough or (lambda found: any(v.alive and v.heard for v in found))
        deadline = self._clock() + timeout_s
        while True:
            self.ask(min(_ASK_AGAIN_S, timeout_s))
            if enough(self.vehicles()) or self._clock() >= deadline:
                return
            time.sleep(min(0.1, timeout_s))

    def vehicles(self) -> tuple[Vehicle, ...]:
        """All that were heard of, by name."""
        now = self._clock()
        with self._mutex:
            names = sorted({*self._alive, *(name for name, _ in self._last)})
            return tuple(
                Vehicle(
                    name,
                    self._alive.get(name, False),
                    {
                        topic: Heard(message, now - at_s, _stale(topic, now - at_s))
                        for (vehicle, topic), (message, at_s) in self._last.items()
                        if vehicle == name
                    },
                    tuple(self._log.get(name, ())),
                )
                for name in names
            )

    def query(self, vehicle: str, name: str, parameters: str = "", timeout_s: float = 10.0) -> bytes:
        """Ask a vehicle for its session, report or plan.

        Raises:
            InputError: it is not there, or has none.
        """
        return self._get(
            f"{ROOT}/{vehicle}/{name}" + (f"?{parameters}" if parameters else ""), None, timeout_s
        )

    def command(self, vehicle: str, action: str, token: str, timeout_s: float = 10.0) -> str:
        """Ask a vehicle's daemon to do something; what it did.

        Raises:
            InputError: it is not there, takes no commands, or refuses.
        """
        payload = make_command(vehicle, action, token).model_dump_json(by_alias=True).encode()
        return self._get(f"{ROOT}/{vehicle}/{COMMAND}", payload, timeout_s).decode()

    def _get(self, selector: str, payload: bytes | None, timeout_s: float) -> bytes:
        try:
            for reply in self._session.get(selector, payload=payload, timeout=timeout_s):
                if reply.ok is not None:
                    return reply.ok.payload.to_bytes()
                if reply.err is not None:
                    raise InputError(reply.err.payload.to_bytes().decode("utf-8", "replace"))
        except zenoh.ZError as error:
            raise InputError(f"{selector} cannot be asked for: {error}.") from error
        vehicle, name = selector.split("/")[1:3]
        if name == COMMAND:
            raise InputError(f"{vehicle} is not there, or takes no commands (`--allow-commands` lets it).")
        raise InputError(f"{vehicle} is not there, or has no {name.partition('?')[0]}.")

    def _presence(self, sample: zenoh.Sample) -> None:
        vehicle = str(sample.key_expr).split("/")[1]
        with self._mutex:
            self._alive[vehicle] = sample.kind == zenoh.SampleKind.PUT

    def _sample(self, sample: zenoh.Sample) -> None:
        _, vehicle, name = str(sample.key_expr).split("/")
        try:
            message = TOPICS[name].schema.model_validate_json(sample.payload.to_bytes())
        except ValidationError:
            return  # Of a newer fieldcal, or somebody else's.
        with self._mutex:
            before = self._last.get((vehicle, name))
            if before is not None and timedelta() < before[0].sent - message.sent < _OVERTAKEN:
                return  # An answer that was overtaken; further back, the sender's clock was set.
            self._last[vehicle, name] = (message, self._clock())
            if isinstance(message, Log):
                lines = self._log.setdefault(vehicle, [])
                if not lines or lines[-1].at < message.at:
                    lines.append(message)
                    del lines[:-LOG_LINES]


def _stale(topic: str, age_s: float) -> bool:
    limit_s = TOPICS[topic].stale_s
    return limit_s is not None and age_s > limit_s

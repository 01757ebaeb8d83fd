"""What may be asked of a daemon over the bus: off unless switched on, and only with the token.

The token itself never travels: a request carries an HMAC over what is asked, for whom and when
(RFC 2104 with SHA-256). Requests that are old or come a second time are refused. Nothing here can
arm, start or move a vehicle.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
import threading
from collections.abc import Callable, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Literal

import platformdirs
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from calib.errors import InputError
from calib.files import output_errors

#: A request made longer ago, or so far in the future, is refused: clocks must agree that well.
LIFETIME = timedelta(seconds=60)
_TOKEN_FILE = "token"
_LEAST_TOKEN = 16


class Command(BaseModel):
    """``mac``: HMAC-SHA256 of "schema vehicle action sent nonce" under the token, in hex."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)

    schema_: Literal["fieldcal.command/1"] = Field(default="fieldcal.command/1", alias="schema")
    vehicle: str
    action: str
    sent: datetime
    nonce: str
    mac: str = ""

    def signed(self, token: str) -> Command:
        return self.model_copy(update={"mac": self._mac(token)})

    def is_of(self, token: str) -> bool:
        return hmac.compare_digest(self._mac(token).encode(), self.mac.encode())

    def _mac(self, token: str) -> str:
        said = "\n".join((self.schema_, self.vehicle, self.action, self.sent.isoformat(), self.nonce))
        return hmac.new(token.encode(), said.encode(), hashlib.sha256).hexdigest()


def make_command(vehicle: str, action: str, token: str) -> Command:
    """A request as it is sent."""
    sent = datetime.now(UTC)
    return Command(vehicle=vehicle, action=action, sent=sent, nonce=secrets.token_hex(16)).signed(token)


class Commands:
    """The actions of one vehicle's daemon behind its token."""

    def __init__(
        self,
        vehicle: str,
        token: str,
        actions: Mapping[str, Callable[[], str]],
        clock: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        self._vehicle, self._token, self._actions, self._clock = vehicle, token, actions, clock
        self._seen: dict[str, datetime] = {}
        self._mutex = threading.Lock()

    def take(self, payload: bytes) -> str:
        """Do what a request asks; what was done, in words.

        Raises:
            ValueError: refused, with one sentence that tells a stranger nothing.
        """
        try:
            command = Command.model_validate_json(payload)
        except ValidationError:
            raise ValueError("Refused: this is no request of fieldcal.command/1.") from None
        now = self._clock()
        with self._mutex:
            if command.sent.tzinfo is None or not command.is_of(self._token):
                raise ValueError("Refused: the token is not that of this vehicle.")
            if command.vehicle != self._vehicle or abs(now - command.sent) > LIFETIME:
                raise ValueError("Refused: the request is for another vehicle, or the clocks differ.")
            self._seen = {n: t for n, t in self._seen.items() if abs(now - t) <= 2 * LIFETIME}
            if command.nonce in self._seen:
                raise ValueError("Refused: this request was made before.")
            self._seen[command.nonce] = command.sent
        action = self._actions.get(command.action)
        if action is None:
            raise ValueError(f"There is nothing called {command.action[:40]!r}: {', '.join(self._actions)}.")
        return action()


def default_token_file() -> Path:
    return platformdirs.user_data_path("fieldcal") / _TOKEN_FILE


def daemon_token(file: Path) -> str:
    """The token in ``file``, which is made at the first time, readable by its owner only.

    Raises:
        InputError: it is too short, or others may read it. OutputError: it cannot be made.
    """
    with output_errors(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        try:
            descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        except FileExistsError:
            pass
        else:
            with os.fdopen(descriptor, "w") as made:
                made.write(secrets.token_urlsafe(24) + "\n")
    if file.stat().st_mode & 0o077:
        raise InputError(f"Others may read the token in {file}; protect it first: chmod 600 {file}")
    return read_token(file)


def read_token(file: Path) -> str:
    """The token in ``file``.

    Raises:
        InputError: there is none, or it is too short.
    """
    try:
        token = file.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"The token cannot be read from {file}; copy it from the daemon's machine."
        ) from error
    if len(token) < _LEAST_TOKEN:
        raise InputError(f"The token in {file} is too short; it needs {_LEAST_TOKEN} characters or more.")
    return token

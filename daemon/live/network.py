"""Joining the bus: zenoh's configuration from a few options or a file.

By default a daemon listens on this computer only and nothing is announced; ``listen`` opens it to
the network, and with it multicast scouting, by which peers find each other where the network lets it.
"""

from __future__ import annotations

import json
import re
from dataclasses import replace

import zenoh

from calib.errors import InputError
from daemon.live.settings import LOCAL, Settings

_ANY_PORT = "tcp/127.0.0.1:0"
_LOOPBACK = ("/127.", "/localhost", "/[::1]")


def for_viewer(settings: Settings) -> Settings:
    """With the daemon of this computer to look at, where nothing else is said."""
    if settings.connect or settings.config is not None:
        return settings
    return replace(settings, connect=(LOCAL,))


def open_for_daemon(settings: Settings) -> zenoh.Session:
    """Join the bus; where nothing else is said, listening on this computer only.

    Raises:
        InputError: as :func:`open_session`.
    """
    if settings.listen or settings.config is not None or settings.mode == "client":
        return open_session(settings)
    try:
        return open_session(replace(settings, listen=(LOCAL,)))
    except InputError:
        # Another daemon of this computer has the usual place: through it viewers learn of this one.
        return open_session(replace(settings, connect=(*settings.connect, LOCAL), listen=(_ANY_PORT,)))


def open_session(settings: Settings) -> zenoh.Session:
    """Join the bus.

    Raises:
        InputError: an endpoint or the file makes no sense, or nothing can be listened at there.
    """
    try:
        config = zenoh.Config() if settings.config is None else zenoh.Config.from_file(settings.config)
        for key, value in _values(settings):
            config.insert_json5(key, json.dumps(value))
    except zenoh.ZError as error:
        where = "the options --connect and --listen" if settings.config is None else str(settings.config)
        raise InputError(f"The configuration of zenoh in {where} is not valid: {_first(error)}.") from error
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        ends = ", ".join((*settings.listen, *settings.connect)) or "its configured endpoints"
        raise InputError(
            f"zenoh cannot start with {ends}: {_first(error)}; is the port in use, or the address another's?"
        ) from error


def leave(session: zenoh.Session) -> None:
    """Close a session; all that it declared goes with it."""
    session.close()  # type: ignore[no-untyped-call]


def _values(settings: Settings) -> list[tuple[str, object]]:
    values: list[tuple[str, object]] = []
    if settings.mode is not None:
        values.append(("mode", settings.mode))
    if settings.connect:
        values += [("connect/endpoints", list(settings.connect)), ("connect/exit_on_failure", False)]
        values.append(("connect/timeout_ms", 0))
    if settings.config is None or settings.listen:
        values.append(("listen/endpoints", list(settings.listen)))
    if settings.config is None:
        away = [end for end in settings.listen if not any(part in end for part in _LOOPBACK)]
        values.append(("scouting/multicast/enabled", bool(away) or not settings.listen))
    return values


def _first(error: Exception) -> str:
    """What zenoh says, without the places in its own source."""
    text = " ".join(str(error).split())
    told = re.search(r'msg: "(.*?)"', text)
    return re.sub(r" at /.*", "", told[1] if told else text).replace("[", "").rstrip(".] ")

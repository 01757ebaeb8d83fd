"""How machines are to find each other, in a few options or a file. No zenoh in here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

CONFIG_VARIABLE = "FIELDCAL_ZENOH"
LOCAL = "tcp/127.0.0.1:7447"


@dataclass(frozen=True)
class Settings:
    """``connect`` and ``listen``: endpoints as zenoh writes them (tcp/192.168.1.5:7447). ``config``: a
    zenoh configuration file (router or client mode, TLS, access control), which the others add to."""

    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    config: Path | None = None
    mode: Literal["peer", "client"] | None = None

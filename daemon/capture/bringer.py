"""Whoever brings photos into a flight's folder, where it is not somebody else."""

from __future__ import annotations

from abc import abstractmethod
from typing import Literal

from daemon.closing import Closing


class Bringer(Closing):
    """``moved_s``: when something last came, on the flight's clock."""

    def __init__(self, now_s: float) -> None:
        self.moved_s = now_s
        self._fault: str | None = None
        self._news: list[tuple[Literal["info", "warning"], str]] = []

    @abstractmethod
    def poll(self) -> None:
        """Go on with it. Never waits."""

    @property
    def missing(self) -> int:
        """Photos known of that are not there."""
        return 0

    @property
    def degraded(self) -> tuple[str, ...]:
        """What is wrong now, in sentences."""
        return (self._fault,) if self._fault else ()

    def news(self) -> list[tuple[Literal["info", "warning"], str]]:
        """What is to be told, since the last time."""
        found, self._news = self._news, []
        return found

    def anchors(self) -> dict[str, int]:
        """File name -> number of the vehicle's photo, for files since the last time."""
        return {}

    def _failed(self, fault: str) -> None:
        """Told once, and again when it has been well meanwhile."""
        if fault != self._fault:
            self._fault = fault
            self._news.append(("warning", f"{fault} Trying again."))

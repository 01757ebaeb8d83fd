"""Findings and verdicts: what the check says, as data."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class State(StrEnum):
    PASS = "pass"
    FLAG = "flag"
    UNKNOWN = "unknown"


class Verdict(StrEnum):
    TRUST = "TRUST"
    REFLY = "REFLY"
    CANNOT_TELL = "CANNOT_TELL"

    @property
    def exit_code(self) -> int:
        return {"TRUST": 0, "REFLY": 3, "CANNOT_TELL": 4}[self.value]


@dataclass(frozen=True)
class Finding:
    """One rule's answer. ``sigma`` and ``value`` are in ``unit``; None where nothing was measured."""

    rule: str
    state: State
    value: float | None
    sigma: float | None
    unit: str
    threshold: float | None
    source: str
    message: str

"""One limit held against a plan."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """``hard``: a plan that breaks it is written only when forced. ``value`` and ``limit`` in ``unit``.

    ``message``: one sentence for the operator, whether the rule is kept or not.
    """

    rule: str
    hard: bool
    ok: bool
    value: float | None
    limit: float | None
    unit: str
    message: str

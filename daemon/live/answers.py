"""What a daemon answers when its flight, report or mission is asked for."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping

from calib.output import REPORT_HTML
from daemon.session.as_json import session_json
from daemon.session.reader import SessionReader

#: Content with its media type; ValueError: one sentence why there is none.
Answer = tuple[bytes, str]
#: By the names of :data:`~daemon.live.topics.QUERIES`, given the query's parameters.
Answers = Mapping[str, Callable[[Mapping[str, str]], Answer]]
_JSON = "application/json"


def answers_of(flight_now: Callable[[], SessionReader | None]) -> Answers:
    """Answers out of the record of the flight that is under way, always of the newest."""

    def record() -> SessionReader:
        found = flight_now()
        if found is None:
            raise ValueError("There is no flight yet.")
        return found

    def flight(asked: Mapping[str, str]) -> Answer:
        del asked
        return _json(session_json(record())), f"{_JSON};fieldcal.session/1"

    def report(asked: Mapping[str, str]) -> Answer:
        if asked.get("format") == "html":
            try:
                return (record().folder / REPORT_HTML).read_bytes(), "text/html"
            except OSError:
                raise ValueError("There is no page yet; it is made with the final verdict.") from None
        verdict = record().latest_verdict()
        if verdict is None:
            raise ValueError("There is no verdict yet.")
        return _json(dict(verdict.value.report)), f"{_JSON};fieldcal.check/1"

    def plan(asked: Mapping[str, str]) -> Answer:
        del asked
        plans = record().plans()
        if not plans:
            raise ValueError("This flight has no plan.")
        return plans[-1].value.content, "application/octet-stream"

    return {"session": flight, "report": report, "plan": plan}


def _json(data: object) -> bytes:
    return json.dumps(data, ensure_ascii=True, allow_nan=False).encode()

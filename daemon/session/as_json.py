"""A flight as data for other programs."""

from __future__ import annotations

from typing import Any

from calib.wording import printable
from daemon.session.library import Summary, summarise
from daemon.session.reader import SessionReader

SHOW_SCHEMA = "fieldcal.session/1"


def state_of(summary: Summary) -> str:
    """In a word: recording, unfinished or finished."""
    if summary.held:
        return "recording"
    return "unfinished" if summary.unfinished.resumable else "finished"


def summary_json(summary: Summary) -> dict[str, Any]:
    """A flight as an entry of ``fieldcal.sessions/1``."""
    counts, rest = summary.counts, summary.unfinished
    return {
        "name": printable(summary.name),
        "created": summary.created.isoformat(),
        "state": state_of(summary),
        "verdict": None if summary.verdict is None else summary.verdict.value,
        "final": summary.final,
        "counts": {
            "plans": counts.plans,
            "events": counts.events,
            "triggers": counts.triggers,
            "photos": counts.photos,
            "pairings": counts.pairings,
            "solutions": counts.solutions,
            "verdicts": counts.verdicts,
        },
        "unfinished": {
            "ended": rest.ended,
            "unseen_photos": rest.unseen_photos,
            "lonely_photos": rest.lonely_photos,
            "lonely_triggers": rest.lonely_triggers,
            "behind": rest.behind,
            "final_verdict": rest.final_verdict,
        },
    }


def session_json(session: SessionReader) -> dict[str, Any]:
    """A flight as ``fieldcal.session/1``."""
    verdict = session.latest_verdict()
    return {
        "schema": SHOW_SCHEMA,
        **summary_json(summarise(session)),
        "plans": [
            {
                "name": printable(p.value.name),
                "recorded": p.recorded.isoformat(),
                "bytes": len(p.value.content),
            }
            for p in session.plans()
        ],
        "provenance": [
            {"recorded": p.recorded.isoformat(), "versions": dict(p.value.versions)}
            for p in session.provenance()
        ],
        "report": None if verdict is None else dict(verdict.value.report),
    }

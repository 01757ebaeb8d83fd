"""What a flight tells, as messages of the bus. Pure."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from daemon.capture.hot_folder import Poll
from daemon.capture.matching import Matching, parted
from daemon.capture.trigger_book import TriggerBook
from daemon.live.schemas import Capture, FindingLine, Verdict


def capture_message(
    vehicle: str, poll: Poll, book: TriggerBook | None = None, matching: Matching | None = None
) -> Capture:
    """Triggers, exposures and files, and where they part; without a link only files."""
    waiting = len(poll.waiting)
    warning = poll.fault or (f"{waiting} files are not whole yet." if waiting else None)
    if book is None or matching is None:
        return Capture(vehicle=vehicle, photos=poll.whole, waiting=waiting, warning=warning)
    pairing = matching.pairing
    return Capture(
        vehicle=vehicle,
        triggers=book.count,
        confirmed=book.confirmed,
        photos=poll.whole,
        waiting=waiting,
        paired=len(pairing.pairs),
        sure=len(pairing.sure_pairs),
        warning=warning or parted(pairing, book.count, len(book.lost)),
    )


def verdict_message(vehicle: str, report: dict[str, Any], final: bool, at: datetime) -> Verdict:
    """The verdict of a ``fieldcal.check/1`` report as it goes over the bus."""
    calibration, dome = report["calibration"], report["dome"]
    f_px, sigma_px = calibration["f_px"], calibration["sigma"]["f_px"]
    return Verdict(
        vehicle=vehicle,
        verdict=report["verdict"],
        final=final,
        at=at,
        headline=report["headline"],
        what_to_fly=report["what_to_fly"],
        photos=report["alignment"]["aligned"],
        f_px=f_px,
        sigma_f_percent=100 * sigma_px / f_px if f_px and sigma_px is not None else None,
        dome_percent=dome["amplitude_percent"],
        sigma_dome_m=dome["sigma_m"],
        findings=[
            FindingLine(rule=f["rule"], state=f["state"], message=f["message"]) for f in report["findings"]
        ],
    )

"""The terminal of `fieldcal run`: a progress line while something goes on, words beside it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import typer

from calib.wording import printable
from daemon.live.schemas import Capture, Log, Message, Progress, Verdict
from daemon.progress import Report, progress_line


class Screen:
    """``talkative``: words are printed; ``hidden``: no progress line."""

    def __init__(self, talkative: bool, hidden: bool) -> None:
        self.talkative, self._hidden = talkative, hidden
        self._line: Report | None = None

    @contextmanager
    def busy(self, first: str) -> Iterator[Report]:
        """With a progress line, ``first`` its first words."""
        with progress_line(self._hidden, first) as self._line:
            try:
                yield self._line
            finally:
                self._line = None

    def show(self, message: Message) -> None:
        """The progress line moves, words and verdicts so far are printed."""
        if isinstance(message, Progress):
            self._move(message.stage, message.done, message.of or 0)
        elif isinstance(message, Capture) and message.photos == 0:
            self._move("waiting for photos", 0, 0)
        elif isinstance(message, Log) and self.talkative:
            print(printable(message.text), flush=True)
        elif isinstance(message, Verdict) and self.talkative and not message.final:
            print(so_far(message), flush=True)

    def ask(self, question: str) -> bool:
        """The operator's word; pressing return means no."""
        return typer.confirm(printable(question), default=False)

    def _move(self, stage: str, done: int, total: int) -> None:
        if self._line is not None:
            self._line(stage, done, total)


def so_far(verdict: Verdict) -> str:
    """A provisional verdict in a line."""
    known = []
    if verdict.sigma_f_percent is not None:
        known.append(f"focal length known to {verdict.sigma_f_percent:.2g} %")
    if verdict.dome_percent is not None:
        known.append(f"dome {verdict.dome_percent:.2g} % of the height")
    words = verdict.verdict.replace("_", " ")
    return f"So far {words}: {verdict.photos} photos, {', '.join(known)}." if known else f"So far {words}."

"""An extra pass that was found among the photos: what it was to bring, and what it brought."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from calib.limits import percent
from calib.wording import path_text

if TYPE_CHECKING:
    from calib.result import CheckResult

#: Names in a sentence; more are counted.
_NAMES = 3


@dataclass(frozen=True)
class Knowledge:
    """Standard deviations: of f in percent, of the dome in percent of the flying height."""

    sigma_f_percent: float
    dome_percent: float


@dataclass(frozen=True)
class ExtraPass:
    """A recommended pass whose photos are here.

    ``photos``: that of each station in the order of the pass, None where there is none. ``before``: what
    was known without the pass; ``predicted``: what was to be known with it.
    """

    photos: tuple[Path | None, ...]
    before: Knowledge
    predicted: Knowledge

    @property
    def found(self) -> tuple[Path, ...]:
        """The photos that are there."""
        return tuple(path for path in self.photos if path is not None)

    @property
    def missing(self) -> tuple[int, ...]:
        """Numbers of the stations that have none, from 1 as on the sheet."""
        return tuple(n for n, path in enumerate(self.photos, start=1) if path is None)


def knowledge_of(result: CheckResult) -> Knowledge:
    """What is known now, as the prediction counts it."""
    estimate, dome = result.estimate, result.dome
    return Knowledge(
        100 * estimate.sigma_f_px / estimate.brown.f_px, 100 * dome.left_open_m / dome.flying_height_m
    )


def not_joined(result: CheckResult) -> tuple[Path, ...]:
    """Photos of the pass that are not in the block."""
    if result.extra_pass is None:
        return ()
    aligned = {photo.path for photo in result.solution.photos}
    return tuple(path for path in result.extra_pass.found if path not in aligned)


def extra_pass_words(result: CheckResult) -> str | None:
    """The pass in a few sentences; None where there is none."""
    extra = result.extra_pass
    if extra is None:
        return None
    before, then, now = extra.before, extra.predicted, knowledge_of(result)
    count, all_of_it = len(extra.found), len(extra.photos)
    text = f"{count} of the {all_of_it} photos of the recommended pass were found"
    if count:
        text += f" ({_names(extra.found)})"
    if extra.missing:
        numbers = ", ".join(map(str, extra.missing))
        one = len(extra.missing) == 1
        text += f"; station{'' if one else 's'} {numbers} {'has' if one else 'have'} none"
    outside = not_joined(result)
    if outside:
        text += f"; {len(outside)} of them could not be used ({_names(outside)})"
    return (
        f"{text}. Focal length: known to {percent(before.sigma_f_percent)} before, "
        f"{percent(then.sigma_f_percent)} predicted, {percent(now.sigma_f_percent)} now. Possible dome, "
        f"of the flying height: {percent(before.dome_percent)} before, {percent(then.dome_percent)} "
        f"predicted, {percent(now.dome_percent)} now."
    )


def _names(paths: Sequence[Path]) -> str:
    names = ", ".join(path_text(Path(path.name)) for path in paths[:_NAMES])
    return names if len(paths) <= _NAMES else f"{names} and {len(paths) - _NAMES} more"

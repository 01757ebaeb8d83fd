"""Counts with their intervals: the campaign's figures as numbers."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from benchmarks.campaign import wilson
from benchmarks.verdict_score import NO_RESULT, Score
from benchmarks.verdict_world import reference_sigma_f_percent
from calib.limits import FOCAL_LIMIT_PERCENT, Z95

#: Probability of an ideal decision from which on one may be asked for.
CLEAR = 0.9
VERDICTS = ("TRUST", "REFLY", "CANNOT_TELL", NO_RESULT)


@dataclass(frozen=True)
class Rate:
    """``hits`` of ``n``."""

    hits: int
    n: int

    @property
    def percent(self) -> float:
        return 100 * self.hits / self.n if self.n else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """95 %, Wilson, percent."""
        return wilson(self.hits, self.n)

    def __str__(self) -> str:
        if not self.n:
            return "–"
        low, high = self.interval
        return f"{self.hits} of {self.n}: {self.percent:.1f} % ({max(low, 0):.1f}–{high:.1f})"


def rate(
    scores: Iterable[Score], hit: Callable[[Score], bool], among: Callable[[Score], bool] = lambda _: True
) -> Rate:
    """Share of ``hit`` among the scores that ``among`` chooses."""
    chosen = [hit(one) for one in scores if among(one)]
    return Rate(sum(chosen), len(chosen))


def counts(scores: Sequence[Score]) -> list[int]:
    """Flights by verdict, in the order of ``VERDICTS``."""
    return [sum(s.verdict == verdict for s in scores) for verdict in VERDICTS]


def false_trust(scores: Sequence[Score]) -> Rate:
    """Trusted, of the flights where TRUST would be false."""
    return rate(scores, lambda s: s.false_trust, lambda s: s.trust_wrong)


def trust_that_is_wrong(scores: Sequence[Score]) -> Rate:
    """False, of all TRUST verdicts."""
    return rate(scores, lambda s: s.false_trust, lambda s: s.verdict == "TRUST")


def false_refly(scores: Sequence[Score]) -> Rate:
    """Sent back, of the flights where REFLY would be false."""
    return rate(scores, lambda s: s.false_refly, lambda s: s.refly_wrong)


def cannot_tell(scores: Sequence[Score]) -> Rate:
    """CANNOT_TELL, of the flights where a verdict may be asked for."""
    return rate(scores, lambda s: s.verdict == "CANNOT_TELL", lambda s: s.should_tell)


def settled(one: Score) -> float:
    """Probability that an ideal adjustment settles the 0.1 % rule against this reference.

    It finds f with ``ideal_sigma_percent`` and knows what the reference is worth: near the limit, or
    with a sigma near the largest that can decide at all, nobody settles it at 95 %.
    """
    if one.case.reference == "none" or not math.isfinite(one.ideal_sigma_percent):
        return 0.0
    drift, own = -one.ref_df_percent, one.ideal_sigma_percent
    reach = Z95 * math.hypot(own, reference_sigma_f_percent(one.case.lens, one.case.reference))
    inside, outside = FOCAL_LIMIT_PERCENT - reach, FOCAL_LIMIT_PERCENT + reach
    within = max(float(ndtr((inside - drift) / own) - ndtr((-inside - drift) / own)), 0.0)
    return within + float(ndtr((-outside - drift) / own) + ndtr((drift - outside) / own))


def cannot_tell_though_clear(scores: Sequence[Score]) -> Rate:
    """CANNOT_TELL, of the flights where an ideal adjustment settles the 0.1 % rule in nine of ten."""
    return rate(scores, lambda s: s.verdict == "CANNOT_TELL", lambda s: s.should_tell and settled(s) >= CLEAR)


def open_at_best(scores: Sequence[Score]) -> float:
    """How many flights an ideal adjustment would be expected to leave open where f can be fixed."""
    return sum(1 - settled(s) for s in scores if s.should_tell)


def dome_rate(scores: Iterable[Score], least_percent: float = 0.0) -> Rate:
    """Predicted within 25 % or two stated sigmas of the true dome, against a true reference.

    ``least_percent``: only where the true dome is larger than that.
    """
    return rate(
        scores,
        lambda s: (
            abs(s.predicted_dome_percent - s.true_dome_percent)
            <= max(0.25 * abs(s.true_dome_percent), 2 * s.sigma_dome_percent)
        ),
        lambda s: (
            s.case.reference == "true"
            and math.isfinite(s.true_dome_percent)
            and abs(s.true_dome_percent) > least_percent
        ),
    )


def rms(values: Iterable[float]) -> tuple[float, float, int]:
    """Root mean square of the finite values, its standard deviation for normal values, their number."""
    finite = np.array([v for v in values if math.isfinite(v)])
    if not len(finite):
        return math.nan, math.nan, 0
    size = float(np.sqrt(np.mean(finite**2)))
    return size, size / math.sqrt(2 * len(finite)), len(finite)


def why_trust_wrong(one: Score) -> str:
    """What a false TRUST overlooked."""
    parts = []
    if one.reference_bad:
        parts.append("reference")
    if one.calibration_bad(1.0):
        parts.append("focal length" if abs(one.df_percent) > 0.1 + one.sigma_percent else "dome")
    return " and ".join(parts)


def rules(scores: Iterable[Score], of: Callable[[Score], tuple[str, ...]]) -> list[tuple[str, int]]:
    """Sets of rules by how often they occur, the most frequent first."""
    return Counter(", ".join(of(one)) for one in scores).most_common()

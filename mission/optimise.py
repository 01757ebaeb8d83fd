"""The cheapest photos that make a network calibrate: greedy choice, then exchange.

Serves the plan before take-off and the pass after a flight alike: what differs is the network that
the photos are added to, and the path that they are flown from. The criterion is robust: it holds
with any one of the added photos missing. Deterministic.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations, starmap

import numpy as np

from calib.camera import FloatArray
from calib.limits import FOCAL_SIGMA_ALONE_PERCENT
from calib.network_extension import Joint, PhotoPool
from mission.route import Detours

#: Half of [C&D]'s 0.1 % of the flying height.
DOME_SIGMA_PERCENT = 0.05
#: More photos than this are not an extra pass any more.
MOST_ADDED = 40
#: Candidates looked at in every round after the first.
SHORT_LIST = 80
#: Pools of fewer photos than this are searched from more than one start.
SMALL_POOL = 200
#: Of the exchanges that save time, how many are looked at, and of those how many tried in full.
_LOOKED_AT, _TRIED = 40, 3


@dataclass(frozen=True)
class Criterion:
    """What has to be reached, model error included, with any one added photo missing.

    ``least_photos``: at least so many are added, however good they are.
    """

    sigma_f_percent: float = FOCAL_SIGMA_ALONE_PERCENT
    dome_percent: float = DOME_SIGMA_PERCENT
    least_photos: int = 0

    def ratio(self, worth: tuple[float, float]) -> float:
        """(sigma f, dome sigma) in percent against the limits; at most 1 where both hold."""
        return max(worth[0] / self.sigma_f_percent, worth[1] / self.dome_percent)


@dataclass(frozen=True)
class Choice:
    """Photos of the pool, what they cost, and the criterion's ratio with the worst one missing."""

    photos: tuple[int, ...]
    seconds: float
    ratio: float

    @property
    def good(self) -> bool:
        """Whether the criterion is met."""
        return self.ratio <= 1.0


def _never(one: int, other: int) -> bool:
    del one, other
    return False


class Search:
    """Chooses photos of a pool.

    Args:
        worth: covariance of lens and functionals -> (sigma f, dome sigma) in percent.
        alike: two photos of the pool of which a choice takes only one; None: there are none.
    """

    def __init__(
        self,
        pool: PhotoPool,
        worth: Callable[[FloatArray], tuple[float, float]],
        detours: Detours,
        criterion: Criterion,
        alike: Callable[[int, int], bool] | None = None,
    ) -> None:
        self.alike = alike or _never
        self.pool, self.worth, self.detours, self.criterion = pool, worth, detours, criterion
        self._known: dict[tuple[int, ...], float] = {}
        self._singles: dict[int, float] = {}

    def ratio(self, photos: Sequence[int]) -> float:
        """The criterion's ratio with the worst photo missing; infinite with too few of them."""
        key = tuple(sorted(photos))
        if key not in self._known:
            if len(key) < self.criterion.least_photos or any(starmap(self.alike, combinations(key, 2))):
                worst = math.inf
            elif not key:
                worst = self._one_ratio(self.pool.joint.head)
            else:
                with_all = self.pool.combined(key)
                worst = max(self._one_ratio(with_all.without(a)) for a in range(len(key)))
            self._known[key] = worst
        return self._known[key]

    def _one_ratio(self, head: FloatArray) -> float:
        return self.criterion.ratio(self.worth(head))

    def choice(self, photos: Sequence[int]) -> Choice:
        """A set of photos as a :class:`Choice`."""
        key = tuple(sorted(photos))
        return Choice(key, self.detours.seconds(key), self.ratio(key))

    def greedy(self, start: Sequence[int] = (), by_time: bool = True, most_s: float = math.inf) -> Choice:
        """Add the photo that helps most (per second in the air) until the criterion is met.

        Given up where that takes more than ``most_s`` or ``MOST_ADDED`` photos.
        """
        chosen = list(start)
        joint = self._joint(chosen)
        left = [i for i in range(len(self.pool)) if i not in chosen and not self._taken(i, chosen)]
        while left and len(chosen) < MOST_ADDED and self.detours.seconds(chosen) <= most_s:
            now = self._one_ratio(joint.head)
            # With a photo missing it is worse still.
            if now <= 1.0 and self.ratio(chosen) <= 1.0:
                break
            cost = self.detours.insertion_s(chosen)
            after = {i: self._with_one(joint, i) if chosen else self._alone(i) for i in left}
            gain = {i: math.log(now / after[i]) / (cost[i] if by_time else 1.0) for i in left}
            # What helps little now helps little later: information of more photos only overlaps.
            left = sorted(left, key=lambda i: (-gain[i], i))[:SHORT_LIST]
            chosen.append(left.pop(0))
            left = [i for i in left if not self.alike(i, chosen[-1])]
            joint = joint.with_photo(self.pool.rows[chosen[-1]])
        return self.choice(chosen)

    def _taken(self, i: int, chosen: Sequence[int]) -> bool:
        return any(self.alike(i, one) for one in chosen)

    def _with_one(self, joint: Joint, i: int) -> float:
        return self._one_ratio(joint.head_with(self.pool.rows[i]))

    def _alone(self, i: int) -> float:
        """The ratio with one photo of the pool, none missing."""
        if i not in self._singles:
            self._singles[i] = self._with_one(self.pool.joint, i)
        return self._singles[i]

    def _joint(self, photos: Sequence[int]) -> Joint:
        joint = self.pool.joint
        for i in photos:
            joint = joint.with_photo(self.pool.rows[i])
        return joint

    def exchange(self, choice: Choice) -> Choice:
        """Leave photos out and swap them for others as long as that saves time and stays good."""
        if not choice.good:
            return choice
        while True:
            better = self._without_one(choice) or self._with_another(choice)
            if better is None:
                return choice
            choice = better

    def _without_one(self, choice: Choice) -> Choice | None:
        """The choice without its dearest dispensable photo; one decomposition serves all of them."""
        n = len(choice.photos)
        if n < 3 or n <= self.criterion.least_photos:
            return None
        with_all = self.pool.combined(choice.photos)
        rest = [tuple(p for p in choice.photos if p != one) for one in choice.photos]
        costs = [self.detours.seconds(r) for r in rest]
        for a in sorted(range(n), key=lambda a: (costs[a], a)):
            if all(self._one_ratio(with_all.without(a, b)) <= 1.0 for b in range(n) if b != a):
                return self.choice(rest[a])
        return None

    def _with_another(self, choice: Choice) -> Choice | None:
        with_all = self._joint(choice.photos)
        for one in choice.photos:
            rest = tuple(p for p in choice.photos if p != one)
            cost = self.detours.seconds(rest) + self.detours.insertion_s(rest)
            order = np.argsort(cost, kind="stable")
            cheaper = [int(i) for i in order if cost[i] < choice.seconds - 0.1 and i not in choice.photos]
            if not cheaper:
                continue
            joint = with_all.without_photo(self.pool.rows[one])
            tried = 0
            for i in cheaper[:_LOOKED_AT]:
                if self._taken(i, rest) or self._with_one(joint, i) > 1.0:
                    continue
                found = self.choice((*rest, i))
                if found.good and found.seconds < choice.seconds - 0.05:
                    return found
                tried += 1
                if tried == _TRIED:
                    break
        return None

    def best(self, sets: Sequence[Sequence[int]] = ()) -> Choice:
        """The best choice from several starts: greedy ones, and given sets (orbits, fans).

        Where none meets the criterion, the one that comes nearest to it.
        """
        found: list[Choice] = []
        for one in sorted(sets, key=lambda s: (self.detours.seconds(s), tuple(s))):
            found.append(self.choice(one))
            # The others take longer.
            if found[-1].good:
                break
        # Small pools are searched from many first photos.
        firsts = sorted(range(len(self.pool)), key=lambda i: (self._alone(i), i))
        starts: list[tuple[int, ...]] = [(), *((i,) for i in firsts[: min(SMALL_POOL // len(firsts), 10)])]
        for start in starts:
            for by_time in (True, False):
                cheapest = min((c.seconds for c in found if c.good), default=math.inf)
                found.append(self.greedy(start, by_time, 1.5 * cheapest))
        good = sorted((c for c in found if c.good), key=lambda c: (c.seconds, c.photos))
        if not good:
            return min(found, key=lambda c: (c.ratio, c.seconds, c.photos))
        fewest = min(good, key=lambda c: (len(c.photos), c.seconds, c.photos))
        improved = [self.exchange(c) for c in dict.fromkeys([*good[: 1 + len(starts)], fewest])]
        # Time counts, but a photo is also one more thing to go wrong.
        least = min(len(c.photos) for c in improved)
        return min((c for c in improved if len(c.photos) <= least + 1), key=lambda c: (c.seconds, c.photos))
